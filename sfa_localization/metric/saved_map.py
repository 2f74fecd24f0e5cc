# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The metric map's predictions from fewer products, for one image at a time; so it is saved.

With k the kernel of an image with the m inducing ones, e = k W^T whitens it. Everything that
MetricMap.predict returns is then linear or quadratic in k:

    position  k W^T w + w_0,    sway  k W^T v + v_0,
    variance  c + k a - |k C|^2,    C C^T = W^T (n I - Q) W,    n = noise^2 / ratio,

with Q the weights' posterior covariance, always below its prior n I. So two m x m products become
one triangular one, which reads a quarter of the memory, or an eighth where float32 suffices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sfa_localization.data.array_files import Arrays, packed, unpacked
from sfa_localization.data.errors import ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.metric.basis import (
    Basis,
    MetricMap,
    Process,
    checked_features,
    matern,
)

# Error of the variance, over the variance of a point, that float32 may make.
_TOLERANCE = 2e-3
# Factors of more points are rounded to float32, half of the model file: standard deviations
# change by 0.5 % at most where the map is surest. Fewer points are of maps that may be exact.
_EXACT_POINTS = 300


class Predictor(Protocol):
    """A map as a model holds it."""

    @property
    def basis(self) -> Basis:
        """The expansion that it is linear in."""

    @property
    def features(self) -> int:
        """How many of the slowest features it reads."""

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Positions (M, 2) m and covariances (M, 2, 2) of slow features (M, K)."""

    def to_arrays(self) -> Arrays:
        """Everything needed to restore it with `map_from_arrays`."""


def fast_map(metric: MetricMap) -> Predictor:
    """The fastest form of a map; the map itself where there is no faster one."""
    if not isinstance(metric.basis, Process):
        return metric
    return FastProcess.of(metric, metric.basis)


def map_from_arrays(arrays: Arrays) -> Predictor:
    """The map of saved arrays. Raises ModelError where they are not those of its kind."""
    kinds: dict[str, type[FastProcess] | type[MetricMap]]
    kinds = {'gp': FastProcess, 'monomials': MetricMap}
    try:
        return kinds[str(arrays['kind'])].from_arrays(arrays)
    except KeyError as error:
        raise ModelError(f'the metric map lacks {error}, or is of another kind') from None


@dataclass(frozen=True, slots=True)
class FastProcess:
    """A Gaussian process ready to predict.

    `points` (m, K) scaled inducing features; `linear` (m, 3 + 2 r) and `constant` (3 + 2 r,) give
    the position, the linear part of the variance and r sways; `factor` (m, m) is C, lower
    triangular in Fortran order; `inflation` multiplies the covariance, `floor` is a point's
    variance, and `noise` that over the variance of the process.
    """

    scale: Array
    points: Array
    linear: Array
    constant: Array
    factor: NDArray[np.float32] | NDArray[np.float64]
    floor: float
    inflation: float
    noise: float

    @classmethod
    def of(cls, metric: MetricMap, basis: Process) -> FastProcess:
        """Compile a map."""
        prior = metric.noise_m**2 / basis.noise
        q = metric.spread @ metric.spread.T
        inner = prior * np.eye(len(q) - 1) - q[:-1, :-1]
        quadratic = basis.whiten.T @ inner @ basis.whiten
        factor = _root((quadratic + quadratic.T) / 2)
        if len(factor) > _EXACT_POINTS:
            factor = factor.astype(np.float32).astype(np.float64)
        rows = np.column_stack([metric.weights, 2 * q[:, -1], metric.sway.reshape(len(q), -1)])
        constant = rows[-1].copy()
        constant[2] = q[-1, -1] + metric.noise_m**2 + prior
        return cls(
            basis.scale,
            basis.points,
            basis.whiten.T @ rows[:-1],
            constant,
            _rounded(factor, basis.points, metric.noise_m**2),
            metric.noise_m**2,
            metric.inflation,
            basis.noise,
        )

    @property
    def basis(self) -> Process:
        """The process that it was compiled from."""
        return Process.at(self.points, self.scale, self.noise)

    @property
    def features(self) -> int:
        return len(self.scale)

    def positions(self, features: Array) -> Array:
        """Positions (M, 2) m alone, for far less work."""
        kernel = matern(features[:, : len(self.scale)] * self.scale, self.points)
        return np.asarray(kernel @ self.linear[:, :2] + self.constant[:2])

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Positions (M, 2) m and covariances (M, 2, 2) of slow features (M, >= K).

        Raises DataError when there are fewer features than it was learned from.
        """
        features = checked_features(features, self.features)
        kernel = matern(features[:, : len(self.scale)] * self.scale, self.points)
        combined = kernel @ self.linear + self.constant
        own = np.maximum(combined[:, 2] - _explained(kernel, self.factor), self.floor)
        sway = combined[:, 3:].reshape(len(combined), -1, 2)
        joint = sway.transpose(0, 2, 1) @ sway
        return combined[:, :2], np.asarray(
            self.inflation * (joint + own[:, None, None] * np.eye(2))
        )

    def to_arrays(self) -> Arrays:
        """Plain arrays, the factor packed."""
        rounded = len(self.points) > _EXACT_POINTS
        return {
            'kind': np.array('gp'),
            'scale': self.scale,
            'points': self.points.astype(np.float32),
            'linear': self.linear,
            'constant': self.constant,
            'factor': packed(self.factor.astype(np.float32) if rounded else self.factor),
            'in_double': np.array(self.factor.dtype == np.float64),
            'scalars': np.array([self.floor, self.inflation, self.noise]),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> FastProcess:
        """Raises KeyError when an array is missing."""
        floor, inflation, noise = (float(value) for value in arrays['scalars'])
        factor: NDArray[np.float32] | NDArray[np.float64] = unpacked(arrays['factor'])
        if arrays['in_double']:
            factor = np.asfortranarray(factor, np.float64)
        return cls(
            arrays['scale'],
            arrays['points'].astype(np.float64),
            arrays['linear'],
            arrays['constant'],
            factor,
            floor,
            inflation,
            noise,
        )


def _root(symmetric: Array) -> Array:
    """Lower triangular C with C C^T = a matrix, its negative part (rounding) left out."""
    try:
        return np.asarray(linalg.cholesky(symmetric, lower=True))
    except linalg.LinAlgError:
        values, axes = linalg.eigh(symmetric)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(linalg.qr(root.T, mode='r')[0].T)


def _rounded(
    factor: Array, points: Array, floor: float
) -> NDArray[np.float32] | NDArray[np.float64]:
    """The factor in float32 where the variance stays accurate, in Fortran order."""
    small = np.asfortranarray(factor, np.float32)
    probe = matern(points[:: max(1, len(points) // 64)] * 1.02, points)
    change = _explained(probe, small) - ((probe @ factor) ** 2).sum(1)
    accurate = np.abs(change).max() < _TOLERANCE * floor
    return small if accurate else np.asfortranarray(factor)


def _explained(kernel: Array, factor: NDArray[np.float32] | NDArray[np.float64]) -> Array:
    """|k C|^2 (M,), reading only the lower triangle for a single image."""
    if len(kernel) > 1:
        product: Array = np.matmul(kernel, factor, dtype=factor.dtype, casting='same_kind')
    else:
        multiply = linalg.get_blas_funcs('trmv', (factor,))
        product = multiply(factor, kernel[0].astype(factor.dtype), lower=1, trans=1)[None]
    return np.asarray((product.astype(np.float64) ** 2).sum(1))
