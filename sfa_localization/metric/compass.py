# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A visual compass from the maps that the network computes anyway.

Turning the robot by phi shifts the columns of a layer's map, so that the first harmonic of every
row and channel, f_j = sum_c Z_j[c] exp(-2 pi i c / R), turns by the phase phi. A Gaussian process
with the kernel k = exp(-|s - s'|^2 / 2 l^2) <f', f> maps (slow features s, harmonics f) to the unit
complex g = exp(-+i yaw), exactly equivariant: no rotated images are needed, and its labels are the
headings that metric learning found. |g| and the predictive variance measure its certainty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.array_files import packed, unpacked
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.features.observation import UNKNOWN_YAW_VARIANCE
from sfa_localization.metric.lower_factor import squares

Complex = NDArray[np.complex128]

LENGTH, NOISE = 1.5, 0.1
"""l of the kernel, in standard deviations of the slow features, and the noise of its process: from
half to twice as much of either is no better, and by a tenth worse."""


@dataclass(frozen=True, slots=True)
class Compass:
    """A learned heading: inducing images and their weights.

    `features` (M, K) and `harmonic` (M, J) of the inducing images, divided by `feature_scale`
    (K,) and `harmonic_scale` (J,); `weights` (M,) complex; `factor` (M, M) lower
    triangular in Fortran order, such that the predictive variance is prior - |k factor|^2;
    `calibration` (power, floor) of the variance of yaw; `sign` is -1 where columns grow clockwise.
    """

    features: Array
    harmonic: Complex
    feature_scale: Array
    harmonic_scale: Array
    weights: Complex
    factor: NDArray[np.complex64]
    sign: float
    calibration: Array
    _adjoint: NDArray[np.complex64] = field(init=False, repr=False, compare=False)
    """(J, M) of the harmonics."""

    def __post_init__(self) -> None:
        adjoint = np.ascontiguousarray(self.harmonic.conj().T, np.complex64)
        object.__setattr__(self, '_adjoint', adjoint)

    def predict(self, features: Array, harmonic: Complex) -> tuple[Array, Array]:
        """Yaw (T,) rad and its variance (T,) rad^2, at most pi^2 / 3 (a uniform yaw)."""
        g, variance = self._field(features, harmonic)
        yaw = wrap_angle(self.sign * np.angle(g))
        return yaw, calibrated(phase_variance(g, variance), self.calibration)

    def _field(self, features: Array, harmonic: Complex) -> tuple[Complex, Array]:
        s, f = scaled_inputs(features, harmonic, self.feature_scale, self.harmonic_scale)
        near = _near(s, self.features)
        kernel = near.astype(np.float32) * (f.astype(np.complex64) @ self._adjoint)
        left = np.maximum(prior_variance(f) - squares(kernel, self.factor), 0.0)
        return kernel @ self.weights, left + NOISE

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        return {
            'features': self.features.astype(np.float32),
            'harmonic': self.harmonic.astype(np.complex64),
            'feature_scale': self.feature_scale,
            'harmonic_scale': self.harmonic_scale,
            'weights': self.weights,
            'factor': packed(self.factor),
            'sign': np.array(self.sign),
            'calibration': self.calibration,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> Compass:
        return cls(
            np.asarray(arrays['features'], float),
            np.asarray(arrays['harmonic'], np.complex128),
            np.asarray(arrays['feature_scale'], float),
            np.asarray(arrays['harmonic_scale'], float),
            np.asarray(arrays['weights'], np.complex128),
            unpacked(np.asarray(arrays['factor'], np.complex64)),
            float(np.asarray(arrays['sign'], float)),
            np.asarray(arrays['calibration'], float),
        )


def scaled_inputs(
    features: Array, harmonic: Complex, feature_scale: Array, harmonic_scale: Array
) -> tuple[Array, Complex]:
    """Standardized features (T, K) and harmonics (T, J), these of unit length: contrast cancels."""
    s = features[:, : len(feature_scale)] / feature_scale
    f = harmonic / harmonic_scale
    return s, f / np.maximum(np.linalg.norm(f, axis=1, keepdims=True), 1e-12)


def prior_variance(f: Complex) -> Array:
    """Variance (T,) of the process at harmonics f (T, J)."""
    return np.asarray((np.abs(f) ** 2).sum(1))


def kernel_between(s: Array, f: Complex, s_m: Array, f_m: Complex) -> Complex:
    """k[t, m] = exp(-|s_t - s_m|^2 / 2 l^2) <f_m, f_t>: (T, M)."""
    return np.asarray(_near(s, s_m) * (f @ f_m.conj().T))


def _near(s: Array, s_m: Array) -> Array:
    """exp(-|s_t - s_m|^2 / 2 l^2): (T, M)."""
    apart = (s**2).sum(1)[:, None] + (s_m**2).sum(1) - 2 * s @ s_m.T
    return np.asarray(np.exp(-np.maximum(apart, 0.0) / (2 * LENGTH**2)))


def phase_variance(g: Complex, variance: Array) -> Array:
    """Variance of the angle of a complex g of the given variance (of both parts together)."""
    return np.asarray(variance / (2 * np.maximum(np.abs(g) ** 2, 1e-6)))


def calibrated(raw: Array, calibration: Array) -> Array:
    """floor + raw^power pi^2 / 3: from the floor where the process is certain to a uniform yaw.

    Raw variances are too large where the process is certain (its noise is a coarse choice), yet
    1, the prior, always means an unknown yaw; hence a power and no factor.
    """
    power, floor = calibration
    uncertain = np.minimum(raw, 1.0) ** power
    return np.asarray(np.minimum(floor + uncertain * UNKNOWN_YAW_VARIANCE, UNKNOWN_YAW_VARIANCE))
