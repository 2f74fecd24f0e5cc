# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A visual compass from the maps that the network computes anyway.

Turning the robot by phi shifts the columns of a layer's map, so that the first harmonic of every
row and channel, f_j = sum_c Z_j[c] exp(-2 pi i c / R), turns by the phase phi. A Gaussian process
with the kernel k = exp(-|s - s'|^2 / 2 l^2) <f', f> maps (slow features s, harmonics f) to the unit
complex exp(-+i yaw), exactly equivariant: no rotated pictures are needed, and its labels are the
headings that metric learning found. |g| < 1 and the predictive variance tell how sure it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import blas

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.features.rotation import Map
from sfa_localization.metric.settings import HeadingConfig

Complex = NDArray[np.complex128]
UNKNOWN_YAW_VARIANCE = float(np.pi**2 / 3)


def harmonics(maps: Map) -> Complex:
    """First harmonic over the columns of maps (T, rows, R, channels): (T, rows * channels)."""
    columns = maps.shape[2]
    wave = np.exp(-2j * np.pi * np.arange(columns) / columns).astype(np.complex64)
    parts = wave @ maps
    return np.asarray(parts.reshape(len(maps), -1), np.complex128)


@dataclass(frozen=True, slots=True)
class Compass:
    """Learnt heading: inducing pictures and their weights.

    `features` (M, K) and `harmonic` (M, J) of the inducing pictures, divided by `feature_scale`
    (K,) and `harmonic_scale` (J,); `weights` (M,) complex; `uncertainty` (M, M) Hermitian, such
    that the predictive variance is prior - k^H uncertainty k; `calibration` (power, floor) of the
    variance of yaw; `sign` is -1 where columns grow clockwise.
    """

    features: Array
    harmonic: Complex
    feature_scale: Array
    harmonic_scale: Array
    weights: Complex
    uncertainty: Complex
    length: float
    noise: float
    sign: float
    calibration: Array
    _fast: _Fast = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, '_fast', _Fast.of(self))

    def predict(self, features: Array, harmonic: Complex) -> tuple[Array, Array]:
        """Yaw (T,) rad and its variance (T,) rad^2, at most pi^2 / 3 (knowing nothing)."""
        g, variance = self._field(features, harmonic)
        yaw = wrap_angle(self.sign * np.angle(g))
        return yaw, _calibrated(_phase_variance(g, variance), self.calibration)

    def _field(self, features: Array, harmonic: Complex) -> tuple[Complex, Array]:
        s, f = self._scaled(features, harmonic)
        near = _near(s, self.features, self.length)
        kernel = near.astype(np.float32) * (f.astype(np.complex64) @ self._fast.adjoint)
        left = np.maximum(_prior(f) - self._fast.explained(kernel), 0.0)
        return kernel @ self.weights, left + self.noise

    def _scaled(self, features: Array, harmonic: Complex) -> tuple[Array, Complex]:
        return _scaled(features, harmonic, self.feature_scale, self.harmonic_scale)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        return {
            'features': self.features.astype(np.float32),
            'harmonic': self.harmonic.astype(np.complex64),
            'feature_scale': self.feature_scale,
            'harmonic_scale': self.harmonic_scale,
            'weights': self.weights,
            'uncertainty': self.uncertainty,
            'scalars': np.array([self.length, self.noise, self.sign]),
            'calibration': self.calibration,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> Compass:
        length, noise, sign = (float(v) for v in np.asarray(arrays['scalars'], float))
        return cls(
            np.asarray(arrays['features'], float),
            np.asarray(arrays['harmonic'], np.complex128),
            np.asarray(arrays['feature_scale'], float),
            np.asarray(arrays['harmonic_scale'], float),
            np.asarray(arrays['weights'], np.complex128),
            np.asarray(arrays['uncertainty'], np.complex128),
            length,
            noise,
            sign,
            np.asarray(arrays['calibration'], float),
        )


@dataclass(frozen=True, slots=True)
class _Fast:
    """What a prediction multiplies by: the harmonics' adjoint (J, M), complex64, and a factor.

    `factor` (M, M) is lower triangular in Fortran order, factor factor^H = uncertainty.
    """

    adjoint: NDArray[np.complex64]
    factor: NDArray[np.complex64]

    @classmethod
    def of(cls, compass: Compass) -> _Fast:
        adjoint = np.ascontiguousarray(compass.harmonic.conj().T, np.complex64)
        return cls(adjoint, np.asfortranarray(_root(compass.uncertainty), np.complex64))

    def explained(self, kernel: NDArray[np.complex64]) -> Array:
        """|k factor|^2 (T,), reading only the lower triangle for a single picture."""
        if len(kernel) > 1:
            whole = kernel @ self.factor
        else:
            whole = blas.ctrmv(self.factor, kernel[0], lower=1, trans=1)[None]
        return np.asarray((whole.real**2 + whole.imag**2).sum(1, dtype=np.float64))


def _root(hermitian: Complex) -> Complex:
    """Lower triangular L with L L^H = a matrix, its negative part (rounding) left out."""
    try:
        return np.asarray(linalg.cholesky(hermitian, lower=True))
    except linalg.LinAlgError:
        values, axes = linalg.eigh(hermitian)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(linalg.qr(root.conj().T, mode='r')[0].conj().T)


def _scaled(
    features: Array, harmonic: Complex, feature_scale: Array, harmonic_scale: Array
) -> tuple[Array, Complex]:
    """Standardized inputs; harmonics of unit length, so that contrast does not matter."""
    s = features[:, : len(feature_scale)] / feature_scale
    f = harmonic / harmonic_scale
    return s, f / np.maximum(np.linalg.norm(f, axis=1, keepdims=True), 1e-12)


def _prior(f: Complex) -> Array:
    return np.asarray((np.abs(f) ** 2).sum(1))


def _kernel(s: Array, f: Complex, s_m: Array, f_m: Complex, length: float) -> Complex:
    """k[t, m] = exp(-|s_t - s_m|^2 / 2 l^2) <f_m, f_t>: (T, M)."""
    return np.asarray(_near(s, s_m, length) * (f @ f_m.conj().T))


def _near(s: Array, s_m: Array, length: float) -> Array:
    """exp(-|s_t - s_m|^2 / 2 l^2): (T, M)."""
    apart = (s**2).sum(1)[:, None] + (s_m**2).sum(1) - 2 * s @ s_m.T
    return np.asarray(np.exp(-np.maximum(apart, 0.0) / (2 * length**2)))


def _phase_variance(g: Complex, variance: Array) -> Array:
    """Variance of the angle of a complex g of the given variance (of both parts together)."""
    return np.asarray(variance / (2 * np.maximum(np.abs(g) ** 2, 1e-6)))


@dataclass(frozen=True, slots=True)
class HeadingFit:
    """A compass and what leaving out whole parts of the drive says of it.

    `left_out_error` (T,) rad per labelled picture, `left_out_std` (T,) rad what it claimed,
    `certainty` (T,) its |g|.
    """

    compass: Compass
    left_out_error: Array
    left_out_std: Array
    certainty: Array


def fit_compass(
    features: Array,
    harmonic: Complex,
    yaw: Array,
    folds: NDArray[np.int64],
    config: HeadingConfig,
) -> HeadingFit:
    """Learn the compass from labels `yaw` (T,) rad of pictures with features and harmonics.

    `folds` (T,) numbers the parts that are left out in turn to choose the kernel's length and
    noise, the direction of the columns, and the variance's calibration.
    Raises DataError when there are too few labels.
    """
    if len(yaw) < _LABELS_MIN or len(np.unique(folds)) < 2:
        raise DataError(f'{len(yaw)} pictures with a heading are too few to learn a compass')
    problem = _Problem.of(features, harmonic, yaw, folds, config)
    choices = [(length, noise) for length in _LENGTHS for noise in _NOISES]
    sign = min((-1.0, 1.0), key=lambda s: problem.loss(s, _LENGTHS[1], _NOISES[1]))
    length, noise = min(choices, key=lambda choice: problem.loss(sign, *choice))
    g, variance = problem.left_out(sign, length, noise)
    error = wrap_angle(sign * np.angle(g) - yaw)
    raw = _phase_variance(g, variance)
    calibration = _calibrate(error, raw)
    std = np.sqrt(_calibrated(raw, calibration))
    return HeadingFit(problem.compass(sign, length, noise, calibration), error, std, np.abs(g))


_LABELS_MIN = 20
_LENGTHS = (0.7, 1.0, 1.5, 2.5, 4.0)
_NOISES = (1e-3, 1e-2, 1e-1)
_SELECTION_POINTS = 300


@dataclass(frozen=True, slots=True)
class _Problem:
    """Labels and standardized inputs; `chosen` (M,) are the inducing pictures."""

    s: Array
    f: Complex
    feature_scale: Array
    harmonic_scale: Array
    yaw: Array
    folds: NDArray[np.int64]
    chosen: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        features: Array,
        harmonic: Complex,
        yaw: Array,
        folds: NDArray[np.int64],
        config: HeadingConfig,
    ) -> _Problem:
        feature_scale = features[:, : config.heading_features].std(0) + 1e-12
        harmonic_scale = np.sqrt((np.abs(harmonic) ** 2).mean(0)) + 1e-12
        s, f = _scaled(features, harmonic, feature_scale, harmonic_scale)
        chosen = _spread(len(yaw), config.heading_inducing_points)
        return cls(s, f, feature_scale, harmonic_scale, yaw, folds, chosen)

    def loss(self, sign: float, length: float, noise: float) -> float:
        """Mean left-out error of a candidate, rad; fewer inducing pictures will do."""
        few = self.chosen[_spread(len(self.chosen), _SELECTION_POINTS)]
        g, _ = self.left_out(sign, length, noise, few)
        return float(np.abs(wrap_angle(sign * np.angle(g) - self.yaw)).mean())

    def left_out(
        self, sign: float, length: float, noise: float, chosen: NDArray[np.int64] | None = None
    ) -> tuple[Complex, Array]:
        """Prediction g (T,) and its variance (T,) for each fold by all the others."""
        m = self.chosen if chosen is None else chosen
        prior = _kernel(self.s[m], self.f[m], self.s[m], self.f[m], length)
        kernel = _kernel(self.s, self.f, self.s[m], self.f[m], length)
        target = np.exp(1j * sign * self.yaw)
        normal, moment = kernel.conj().T @ kernel, kernel.conj().T @ target
        g, variance = np.zeros(len(self.yaw), complex), np.zeros(len(self.yaw))
        for fold in np.unique(self.folds):
            out = self.folds == fold
            part = kernel[out]
            rest = normal - part.conj().T @ part
            weights, uncertainty = _solve(rest, moment - part.conj().T @ target[out], prior, noise)
            g[out] = part @ weights
            explained = np.einsum('tm,tm->t', part @ uncertainty, part.conj()).real
            variance[out] = np.maximum(_prior(self.f[out]) - explained, 0.0) + noise
        return g, variance

    def compass(self, sign: float, length: float, noise: float, calibration: Array) -> Compass:
        """The compass of all labels, solved for the inducing pictures as they will be saved."""
        s = self.s[self.chosen].astype(np.float32).astype(np.float64)
        f = self.f[self.chosen].astype(np.complex64).astype(np.complex128)
        kernel = _kernel(self.s, self.f, s, f, length)
        moment = kernel.conj().T @ np.exp(1j * sign * self.yaw)
        weights, uncertainty = _solve(
            kernel.conj().T @ kernel, moment, _kernel(s, f, s, f, length), noise
        )
        return Compass(
            s,
            f,
            self.feature_scale,
            self.harmonic_scale,
            weights,
            uncertainty,
            length,
            noise,
            sign,
            calibration,
        )


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `count` pictures, evenly along the drive."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _solve(
    normal: Complex, moment: Complex, prior: Complex, noise: float
) -> tuple[Complex, Complex]:
    """Weights and reduction of variance of a process spanned by inducing pictures.

    With B = K_nm^H K_nm + r K_mm: weights B^-1 K_nm^H y, reduction K_mm^-1 - r B^-1.
    """
    jitter = 1e-6 * np.eye(len(prior)) * np.trace(prior).real / len(prior)
    b = linalg.inv(normal + noise * (prior + jitter), check_finite=False)
    reduction = linalg.inv(prior + jitter, check_finite=False) - noise * b
    return b @ moment, (reduction + reduction.conj().T) / 2


def _calibrate(error: Array, raw: Array) -> Array:
    """(power, floor) such that the variance covers 95 % of the left-out errors, and little more.

    The floor is the error where the process is surest, the power the largest that covers.
    """
    surest = np.abs(error[raw <= np.quantile(raw, 0.25)])
    floor = float((1.4826 * np.median(surest)) ** 2) + 1e-8
    for power in _POWERS:
        variance = _calibrated(raw, np.array([power, floor]))
        if (error**2 <= 1.96**2 * variance).mean() >= _COVERAGE:
            break
    return np.array([power, floor])


_POWERS = tuple(np.geomspace(6.0, 0.05, 60).tolist())
_COVERAGE = 0.95


def _calibrated(raw: Array, calibration: Array) -> Array:
    """floor + raw^power pi^2 / 3: sure pictures have the floor, unsure ones know nothing.

    Raw variances are too large where the process is sure (its noise is a coarse choice), yet 1,
    the prior, always means that nothing is known; hence a power and no factor.
    """
    power, floor = calibration
    unsure = np.minimum(raw, 1.0) ** power
    return np.asarray(np.minimum(floor + unsure * UNKNOWN_YAW_VARIANCE, UNKNOWN_YAW_VARIANCE))
