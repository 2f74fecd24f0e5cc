# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The map from features to positions as models save it.

With k the kernel of an image (see basis.py), phi = [k W, 1] its expansion, and w the learned
weights, every prediction is linear or quadratic in k:

    position  k W w + w_0,    variance  c + k a - |k C|^2,    C C^T = W (p I - Q) W^T

with Q the weights' posterior covariance, below its prior p I. Without a prior, C C^T = W Q W^T is
added instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfa_localization.data.array_files import Arrays, packed, unpacked
from sfa_localization.data.errors import DataError, ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.mapping.basis import Basis, basis_from


@dataclass(frozen=True, slots=True)
class MetricMap:
    """From slow features to meters in the map frame, with covariance.

    `linear` (k, 3) and `constant` (3,) give the position and the linear part of the variance;
    `factor` (k, k) is C, lower triangular; `floor` is a point's variance, m^2. `inflation`
    multiplies the covariance to make errors of held-out images consistent. `common_m` is the
    standard deviation per axis of the errors that all positions of the drive share.
    """

    basis: Basis
    linear: Array
    constant: Array
    factor: Array
    floor: float
    inflation: float
    common_m: float

    @classmethod
    def of(
        cls,
        basis: Basis,
        mean: Array,
        root: Array,
        noise_m: float,
        inflation: float,
        common_m: float,
    ) -> MetricMap:
        """Compile a map of learned weights, `mean` (m, 2) m, with the posterior covariance
        noise_m^2 root root^T (m, m); `noise_m` is the standard deviation of an image's residual per
        axis."""
        floor = noise_m**2
        prior = floor * basis.prior
        q = floor * (root @ root.T)
        inner = _sign(basis) * (q[:-1, :-1] - prior * np.eye(len(q) - 1))
        quadratic = basis.turn @ inner @ basis.turn.T
        # Rounded as in model files: standard deviations change by 0.5 % at most.
        factor = lower_root((quadratic + quadratic.T) / 2).astype(np.float32).astype(float)
        rows = np.column_stack([mean, 2 * q[:, -1]])
        constant = rows[-1].copy()
        constant[2] = q[-1, -1] + floor + prior
        linear = basis.turn @ rows[:-1]
        return cls(basis, linear, constant, factor, floor, inflation, common_m)

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
        quadratic = _sign(self.basis) * np.square(kernel @ self.factor).sum(1)
        variance = np.maximum(combined[:, 2] + quadratic, self.floor)
        variance = self.inflation * variance + self.common_m**2
        return combined[:, :2], variance[:, None, None] * np.eye(2)

    def to_arrays(self) -> Arrays:
        """Plain arrays, the factor packed."""
        return {
            **self.basis.to_arrays(),
            'linear': self.linear,
            'constant': self.constant,
            'factor': packed(self.factor.astype(np.float32)),
            'scalars': np.array([self.floor, self.inflation, self.common_m]),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> MetricMap:
        """The map of saved arrays. Raises ModelError where one is missing."""
        try:
            scalars = np.asarray(arrays['scalars'], float).tolist()
            factor = unpacked(arrays['factor']).astype(float)
            basis = basis_from(arrays)
            return cls(basis, arrays['linear'], arrays['constant'], factor, *scalars)
        except KeyError as error:
            raise ModelError(f'the metric map lacks {error}') from None


def _sign(basis: Basis) -> float:
    """Of the quadratic part of the variance."""
    return -1.0 if basis.prior else 1.0


def lower_root(symmetric: Array) -> Array:
    """Lower triangular L with L L^T = a matrix (N, N), its negative part (rounding) left out."""
    try:
        return np.asarray(np.linalg.cholesky(symmetric), float)
    except np.linalg.LinAlgError:
        values, axes = np.linalg.eigh(symmetric)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(np.linalg.qr(root.T, mode='r')).T
