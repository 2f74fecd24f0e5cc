# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning as a quadratic form in the directions of the segments.

With p = x + i y in meters and z_n = exp(i alpha_n), eq. 1 of the paper reads

    2 C = sum_n sum_m |o_n + z_n (q_nm - b drift_nm) - phi(s_nm)^T w|^2,

with paths q and biases b as in stack.py. This is the only square that reads the features. `gram`
minimizes it over the map's weights w, which leaves a quadratic form in [o, z, -b z].
`QuadraticForm` adds odometry's links (links.py), each square weighted by `variance`, that of an
image's position, over its own, and minimizes over the origins o: H, a form in [z, -b z]. At given
biases, z^H H z with |z_n| = 1 remains, see phases.py. Where eq. 2 to eq. 4 are zero, o is that of
`QuadraticForm.origins`, and w the regression (`Ridge`) to the places that follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.metric.basis import Basis, expand, missing
from sfa_localization.metric.links import Links
from sfa_localization.metric.phases import angle_covariance, derivatives, refine, synchronize
from sfa_localization.metric.stack import Solution, Stack

YAW_BIAS_STD = 0.003
"""rad/s: the yaw-rate bias to expect of odometry or a gyroscope, estimated per period."""
# Newton steps on the biases: their cost is nearly quadratic, so that three are usual.
_BIAS_STEPS = 8


@dataclass(frozen=True, slots=True)
class Ridge:
    """Least squares, phi(s)^T w, of what M images show, under the basis's prior of w.

    `expanded` (M, m) holds phi(s), `weights` (M,) count the images: over a point's variance, with
    what inducing points leave out of them. F = factor factor^T = `normal` (m, m).
    """

    basis: Basis
    expanded: Array
    weights: Array
    normal: Array
    factor: Array

    @classmethod
    def of(cls, basis: Basis, features: Array) -> Ridge:
        """From features (M, K) of the images."""
        expanded = expand(basis, features)
        weights = 1.0 / (1.0 + missing(basis, expanded))
        normal = (expanded * weights[:, None]).T @ expanded
        normal[np.diag_indices_from(normal)] += basis.ridge
        return cls(basis, expanded, weights, normal, _cholesky(normal))

    def without(self, rows: Indices) -> Ridge:
        """From the other images."""
        left, weights = self.expanded[rows], self.weights.copy()
        normal = self.normal - (left * weights[rows, None]).T @ left
        weights[rows] = 0.0
        return Ridge(self.basis, self.expanded, weights, normal, _cholesky(normal))

    def fitted(self, places: Complex) -> Complex:
        """The weights w (m,) for places (M,)."""
        right = self.expanded.T @ (self.weights * places)
        return np.asarray(scipy.linalg.cho_solve((self.factor, True), right))

    def averages(self, rows: Indices) -> Array:
        """Shares (K, M), of sum 1, of the places of all images in the map's at some of them."""
        shares = scipy.linalg.cho_solve((self.factor, True), self.expanded[rows].T)
        shares = (self.expanded @ shares * self.weights[:, None]).T
        return np.asarray(shares / shares.sum(axis=1, keepdims=True))

    def whitened(self, expanded: Array | Complex) -> Any:
        """factor^-1 phi (m, M) of expanded features (M, m)."""
        return np.asarray(scipy.linalg.solve_triangular(self.factor, expanded.T, lower=True))

    @property
    def root(self) -> Array:
        """factor^-1 (m, m), lower triangular."""
        return np.asarray(self.whitened(np.eye(len(self.factor))))

    @property
    def freedom(self) -> float:
        """Degrees of freedom that a map leaves to M residuals."""
        ridge = self.basis.ridge
        return len(self.expanded) - len(ridge) + float(ridge @ (self.root**2).sum(0))

    @property
    def log_determinant(self) -> float:
        """Of F."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())

    def gram(self, stack: Stack) -> Complex:
        """The quadratic form (3N, 3N) in [o, z, -b z] that eq. 1 leaves of the images' places."""
        count = len(self.weights)
        places = stack.place_rows(np.arange(count), np.ones(count))
        weighted = places.T.multiply(self.weights).tocsr()
        explained = self.whitened(weighted @ self.expanded)
        moments = (weighted.conj() @ places).toarray()
        return np.asarray(moments - explained.conj().T @ explained)


def _cholesky(matrix: Array) -> Array:
    """Lower factor; a singular matrix gets a weak ridge first."""
    try:
        return np.asarray(scipy.linalg.cholesky(matrix, lower=True))
    except np.linalg.LinAlgError:
        held = matrix + 1e-12 * max(np.trace(matrix), 1e-300) / len(matrix) * np.eye(len(matrix))
        return np.asarray(scipy.linalg.cholesky(held, lower=True))


@dataclass(frozen=True, slots=True)
class QuadraticForm:
    """The squares of the features and of odometry's links, for a position variance, m^2: H, `h`
    (2N, 2N), of c = [z, -b z], where o = `origins` (N, 2N) c; `own` (N, N) is the form of o.
    """

    h: Complex
    origins: Complex
    own: Array
    period: Indices
    variance: float

    @classmethod
    def of(cls, gram: Complex, links: Links, stack: Stack, variance: float) -> QuadraticForm:
        """From the form (3N, 3N) that the features leave."""
        ties = links.ties(stack)
        form = gram + variance * (ties.conj().T @ ties).toarray()
        own = np.real(form[: stack.segments, : stack.segments])
        return cls(*schur(form, stack.segments), own, stack.period, variance)

    def at(self, bias: Array) -> Complex:
        """H (N, N) of z, at the periods' biases (R,) rad/s."""
        n, b = len(self.period), -bias[self.period]
        product = self.h[:, :n] + self.h[:, n:] * b
        return np.asarray(product[:n] + b[:, None] * product[n:])

    def solved(self, z: Complex | None, bias: Array) -> Solution:
        """The best directions and origins at given biases; z (N,) is a start."""
        h = self.at(bias)
        z = synchronize(h, [] if z is None else [z])
        return Solution(z, self.origins @ np.concatenate([z, -bias[self.period] * z]), bias, h)

    def with_biases(self, z: Complex | None, bias: Array) -> Solution:
        """The best directions, origins and biases; near z (N,), or globally without one."""
        z = synchronize(self.at(bias)) if z is None else refine(self.at(bias), z)
        for _ in range(_BIAS_STEPS):
            step = self._bias_step(z, bias)
            bias = bias + step
            z = refine(self.at(bias), z)
            if np.abs(step).max() < 1e-6 * YAW_BIAS_STD:
                break
        return self.solved(z, bias)

    def unknown_links(self, solution: Solution, links: Links) -> tuple[Array, Array]:
        """Variances (L,) that a solution leaves of turns and, per axis, displacements."""
        turn = angle_covariance(solution.h, solution.z)
        # Moving all origins together costs nothing: fix the mean.
        place = scipy.linalg.inv(self.own + np.trace(self.own) / len(self.own) ** 2)
        return self.variance * _between(turn, links.at), self.variance * _between(place, links.at)

    def _bias_step(self, z: Complex, bias: Array) -> Array:
        """Newton's (R,) of the least cost at given biases; where that hardly bends, the prior's.

        The angles y follow the biases b: its second derivative is f_bb - f_by f_yy^-1 f_yb.
        """
        n, b, prior = len(z), -bias[self.period], self.variance / YAW_BIAS_STD**2
        change = -z[:, None] * np.eye(len(bias))[self.period]
        turned = 1j * np.vstack([np.diag(z), np.diag(b * z)])
        pull = self.h[n:] @ np.concatenate([z, b * z])
        slope = np.real(change.conj().T @ pull) + prior * bias
        bent = np.real(change.conj().T @ self.h[n:, n:] @ change) + prior * np.eye(len(bias))
        mixed = np.real(change.conj().T @ (self.h[n:] @ turned) + (1j * change).conj().T * pull)
        follow = np.linalg.lstsq(derivatives(self.at(bias), z)[1], mixed.T, rcond=None)[0]
        curvature = bent - (mixed @ follow + follow.T @ mixed.T) / 2
        if np.linalg.eigvalsh(curvature)[0] < prior / 2:
            curvature = prior * np.eye(len(bias))
        return np.clip(-np.linalg.solve(curvature, slope), -YAW_BIAS_STD, YAW_BIAS_STD)


def _between(covariance: Array, at: Indices) -> Array:
    """Variance (L,) of the differences of neighbors in a covariance (N, N)."""
    variance = np.diag(covariance)
    return np.asarray(variance[at] + variance[at + 1] - 2 * covariance[at, at + 1])


def schur(form: Complex, n: int) -> tuple[Complex, Complex]:
    """Minimize over the first n unknowns, the origins: the form of the others (K, K), and the
    origins (n, K) as a linear map of them."""
    own = np.real(form[:n, :n]).copy()
    level = max(float(np.trace(own)) / n, 1e-300)
    # Moving all origins together costs nothing: fix the mean.
    own += level / n
    origins = -np.asarray(scipy.linalg.cho_solve((_cholesky(own), True), form[:n, n:]))
    h = form[n:, n:] + form[n:, :n] @ origins
    return np.asarray((h + h.conj().T) / 2), origins
