# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Phase synchronization: minimize z^H H z / 2 over unit phases, and prove the minimum global.

H (N, N) is Hermitian and positive semidefinite; z (N,) has |z_n| = 1. Unsupervised metric
learning (eq. 1 and eq. 5 of the paper) is this problem once the map and the segments' origins are
eliminated; the paper descends on the angles instead, eq. 2 and eq. 6 to eq. 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sfa_localization.data.geometry import Array, Complex

# Relative to the largest eigenvalue of H; what rounding leaves of an exact zero.
CERTIFICATE_TOLERANCE = 1e-9
# Far more than Newton needs; the damping makes each step a descent.
_NEWTON_STEPS = 100
# Newton's steps shrink quadratically: the one after this would be rounding.
_CONVERGED = 1e-9


@dataclass(frozen=True, slots=True)
class Certificate:
    """Proof that no other angles are better.

    With Lambda = diag(Re(conj(z) * (H z))), H - Lambda >= 0 proves global optimality.
    `eigenvalue` is its smallest eigenvalue over H's largest.
    """

    eigenvalue: float

    @property
    def certified(self) -> bool:
        return self.eigenvalue >= -CERTIFICATE_TOLERANCE


def phase_cost(h: Complex, z: Complex) -> float:
    """z^H H z / 2."""
    return float(np.real(np.vdot(z, h @ z))) / 2


def certify(h: Complex, z: Complex) -> Certificate:
    """Certificate of the phases z (N,) for H (N, N)."""
    multipliers = np.real(np.conj(z) * (h @ z))
    least = scipy.linalg.eigvalsh(h - np.diag(multipliers), subset_by_index=[0, 0])[0]
    scale = max(float(scipy.linalg.eigvalsh(h, subset_by_index=[len(h) - 1] * 2)[0]), 1e-300)
    return Certificate(float(least) / scale)


def synchronize(h: Complex, starts: Sequence[Complex] = ()) -> Complex:
    """Global minimizer z (N,), which may be unproven: see `certify`.

    Starts from `starts`; from the smallest eigenvector without any, or where they do not lead to a
    proven minimum, and then from the mirror image of the best so far.
    """

    def cost(z: Complex) -> float:
        return phase_cost(h, z)

    z = min((refine(h, unit(s)) for s in starts or [spectral_start(h)]), key=cost)
    if not certify(h, z).certified:
        z = min([z, *(refine(h, s) for s in (spectral_start(h), np.conj(z)))], key=cost)
    return z


def unit(z: Complex) -> Complex:
    """Phases of complex numbers, 1 for 0."""
    size = np.abs(z)
    return np.where(size > 0, z / np.where(size > 0, size, 1.0), 1.0)


def spectral_start(h: Complex) -> Complex:
    """Phases of the smallest eigenvector of H."""
    return unit(scipy.linalg.eigh(h, subset_by_index=[0, 0])[1][:, 0])


def refine(h: Complex, z: Complex) -> Complex:
    """Local minimum from z (N,) by damped Newton steps on the angles."""
    damping, cost = 0.0, phase_cost(h, z)
    scale = max(float(np.real(np.diag(h)).max()), 1e-300)
    for _ in range(_NEWTON_STEPS):
        gradient, hessian = derivatives(h, z)
        step = _step(hessian, gradient, damping + 1e-12 * scale)
        proposal = z * np.exp(1j * step)
        new = phase_cost(h, proposal)
        if new > cost + 1e-14 * abs(cost) + 1e-300 and np.abs(step).max() > 1e-12:
            damping = max(4 * damping, 1e-6 * scale)
            continue
        z, cost, damping = proposal, min(new, cost), damping / 8 if damping > 1e-9 * scale else 0.0
        if np.abs(step).max() < _CONVERGED:
            break
    return z


def derivatives(h: Complex, z: Complex) -> tuple[Array, Array]:
    """Gradient (N,) and Hessian (N, N) of the cost by the angles of z."""
    product = np.conj(z) * (h @ z)
    hessian = np.real(np.conj(z)[:, None] * h * z[None, :]) - np.diag(product.real)
    return np.asarray(product.imag), np.asarray(hessian)


def angle_covariance(h: Complex, z: Complex) -> Array:
    """Covariance (N, N) of the angles of z at a minimum, for a cost in units of the variance,
    without a rotation of all together."""
    values, vectors = np.linalg.eigh(derivatives(h, refine(h, z))[1])
    n = len(values)
    common = np.abs(vectors.sum(0)) / np.sqrt(n) > 0.999
    inverse = np.where(common, 0.0, 1.0 / np.maximum(values, 1e-12 * max(values[-1], 1e-300)))
    spread = (np.eye(n) - 1.0 / n) @ vectors
    return np.asarray((spread * inverse) @ spread.T)


def _step(hessian: Array, gradient: Array, damping: float) -> Array:
    """Newton step; where the Hessian is not positive, along its absolute value."""
    # Turning all together changes nothing: fix the mean.
    damped = hessian + np.mean(np.abs(np.diag(hessian))) / len(hessian)
    damped[np.diag_indices_from(damped)] += damping
    try:
        return np.asarray(-scipy.linalg.solve(damped, gradient, assume_a='pos'))
    except np.linalg.LinAlgError:
        values, vectors = scipy.linalg.eigh(hessian)
        values = np.maximum(np.abs(values), damping + 1e-9 * np.abs(values).max() + 1e-300)
        return np.asarray(-vectors @ ((vectors.T @ gradient) / values))
