# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The map's weights, by least squares of the images' places on their features.

With p = x + i y and z_n = exp(i alpha_n), eq. 1 of the paper reads

    2 C = sum_n sum_m |o_n + z_n (q_nm - b drift_nm) - phi(s_nm)^T w|^2,

with paths q and biases b as in stack.py. `Ridge.fitted` is the best w for given places, where eq. 4
is zero. `Ridge.gram` is what remains of eq. 1 at the best w: a quadratic form in [o, z, -b z].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.mapping.basis import Basis, expand, missing
from sfa_localization.metric.stack import Stack


@dataclass(frozen=True, slots=True)
class Ridge:
    """Least squares phi(s)^T w over M images, under the basis's prior of w.

    `expanded` (M, m) holds phi(s). `weights` (M,) are the variance of a point over that of an
    image, which is larger by what the inducing points leave out. F = factor factor^T = `normal`
    (m, m).
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
        normal = (expanded * weights[:, None]).T @ expanded + np.diag(basis.ridge)
        return cls(basis, expanded, weights, normal, _cholesky(normal))

    def without(self, rows: Indices) -> Ridge:
        """From the other images."""
        removed = self.expanded[rows]
        weights = self.weights.copy()
        normal = self.normal - (removed * weights[rows, None]).T @ removed
        weights[rows] = 0.0
        return Ridge(self.basis, self.expanded, weights, normal, _cholesky(normal))

    def fitted(self, places: Complex) -> Complex:
        """The weights w (m,) for places (M,)."""
        right = self.expanded.T @ (self.weights * places)
        return np.asarray(scipy.linalg.cho_solve((self.factor, True), right))

    def averages(self, rows: Indices) -> Array:
        """Shares (K, M), of sum 1, with which the map at some images averages the places of all
        images.
        """
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
        """Degrees of freedom of M residuals of the map."""
        ridge = self.basis.ridge
        return len(self.expanded) - len(ridge) + float(ridge @ (self.root**2).sum(0))

    @property
    def log_determinant(self) -> float:
        """Of F."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())

    def gram(self, stack: Stack) -> Complex:
        """The quadratic form (3N, 3N) in [o, z, -b z] of eq. 1 at the best w."""
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
        weak = 1e-12 * max(np.trace(matrix), 1e-300) / len(matrix)
        return np.asarray(scipy.linalg.cholesky(matrix + weak * np.eye(len(matrix)), lower=True))
