# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The map from slow features to positions as models save it: few products for one image.

With k the kernel of an image (see basis.py), phi = [k W, 1] its expansion, and w the weights that
are learned, everything that is predicted is linear or quadratic in k:

    position  k W w + w_0,    sway  k W v + v_0,
    variance  c + k a - |k C|^2,    C C^T = W (p I - Q) W^T

with Q the weights' posterior covariance, below its prior p I. Without a prior, C C^T = W Q W^T is
added instead. So two m x m products become one triangular one, which reads a quarter of the memory,
or an eighth where float32 suffices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.array_files import Arrays, packed, unpacked
from sfa_localization.data.errors import DataError, ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.metric.basis import Basis, Process, basis_from, matern
from sfa_localization.metric.lower_factor import lower_root, squares

Factor = NDArray[np.float32] | NDArray[np.float64]

# Error of the variance, over the variance of a point, that float32 may make.
_TOLERANCE = 2e-3
# Factors of more points are rounded to float32, half of the model file: standard deviations
# change by 0.5 % at most where the map is surest. Fewer points are of maps that may be exact.
_EXACT_POINTS = 300


@dataclass(frozen=True, slots=True)
class Weights:
    """What is learned of a basis of m functions: `mean` (m, 2) m; `spread` (m, m), a square root of
    their posterior covariance; `sway` (m, r, 2), their change per standard deviation of the joint
    errors of the segments, m; and `noise_m`, an image's residual per axis, standard deviation.
    """

    mean: Array
    spread: Array
    sway: Array
    noise_m: float


@dataclass(frozen=True, slots=True)
class MetricMap:
    """From slow features to meters in the map frame, with covariance.

    `linear` (k, 3 + 2 r) and `constant` (3 + 2 r,) give the position, the linear part of the
    variance and r sways; `factor` (k, k) is C, lower triangular in Fortran order; `floor` is a
    point's variance, m^2, and `inflation` a factor on the covariance that makes left-out segments
    consistent.
    """

    basis: Basis
    linear: Array
    constant: Array
    factor: Factor
    floor: float
    inflation: float

    @classmethod
    def of(cls, basis: Basis, weights: Weights, inflation: float) -> MetricMap:
        """Compile a map."""
        floor = weights.noise_m**2
        prior = floor * basis.prior
        q = weights.spread @ weights.spread.T
        inner = _sign(basis) * (q[:-1, :-1] - prior * np.eye(len(q) - 1))
        quadratic = basis.turn @ inner @ basis.turn.T
        factor = lower_root((quadratic + quadratic.T) / 2)
        if len(factor) > _EXACT_POINTS:
            factor = factor.astype(np.float32).astype(np.float64)
        rows = np.column_stack([weights.mean, 2 * q[:, -1], weights.sway.reshape(len(q), -1)])
        constant = rows[-1].copy()
        constant[2] = q[-1, -1] + floor + prior
        small = _rounded(factor, basis, floor)
        return cls(basis, basis.turn @ rows[:-1], constant, small, floor, inflation)

    @property
    def features(self) -> int:
        """How many of the slowest features it reads."""
        return self.basis.features

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Positions (M, 2) m and covariances (M, 2, 2) of slow features (M, >= K), or of one (K,).

        Raises DataError when there are fewer features than it was learned from.
        """
        features = np.atleast_2d(np.asarray(features, float))
        if features.shape[1] < self.features:
            raise DataError(f'the map reads {self.features} slow features, not {features.shape[1]}')
        kernel = self.basis.kernel(features)
        combined = kernel @ self.linear + self.constant
        quadratic = _sign(self.basis) * squares(kernel, self.factor)
        own = np.maximum(combined[:, 2] + quadratic, self.floor)
        sway = combined[:, 3:].reshape(len(combined), -1, 2)
        joint = sway.transpose(0, 2, 1) @ sway
        return combined[:, :2], np.asarray(
            self.inflation * (joint + own[:, None, None] * np.eye(2))
        )

    def to_arrays(self) -> Arrays:
        """Plain arrays, the factor packed."""
        rounded = len(self.factor) > _EXACT_POINTS
        return {
            **self.basis.to_arrays(),
            'linear': self.linear,
            'constant': self.constant,
            'factor': packed(self.factor.astype(np.float32) if rounded else self.factor),
            'in_double': np.array(self.factor.dtype == np.float64),
            'scalars': np.array([self.floor, self.inflation]),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> MetricMap:
        """The map of saved arrays. Raises ModelError where one is missing."""
        try:
            floor, inflation = (float(value) for value in arrays['scalars'])
            factor: Factor = unpacked(arrays['factor'])
            if arrays['in_double']:
                factor = np.asfortranarray(factor, np.float64)
            basis = basis_from(arrays)
            return cls(basis, arrays['linear'], arrays['constant'], factor, floor, inflation)
        except KeyError as error:
            raise ModelError(f'the metric map lacks {error}') from None


def _sign(basis: Basis) -> float:
    """Of the quadratic part of the variance."""
    return -1.0 if basis.prior else 1.0


def _rounded(factor: Array, basis: Basis, floor: float) -> Factor:
    """The factor in float32 where the variance of a process stays accurate, in Fortran order."""
    if not isinstance(basis, Process):
        return np.asfortranarray(factor)
    small, points = np.asfortranarray(factor, np.float32), basis.points
    probe = matern(points[:: max(1, len(points) // 64)] * 1.02, points)
    change = squares(probe, small) - ((probe @ factor) ** 2).sum(1)
    accurate = np.abs(change).max() < _TOLERANCE * floor
    return small if accurate else np.asfortranarray(factor)
