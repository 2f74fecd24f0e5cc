# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The basis of a map: monomials (section 4 of the paper), or a Gaussian process.

The paper estimates p = W^T s (section 3). Both are linear in an expansion phi(s), position = Phi w,
with a Gaussian prior on w. The expansion of a Gaussian process is its kernel at training features.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.array_files import Arrays
from sfa_localization.data.geometry import Array

PAPER_FEATURES = 8
"""Section 4: the eight slowest features, 45 monomials."""


def expand(basis: Basis, features: Array) -> Array:
    """Expansion (M, m) of slow features (M, >= K)."""
    terms = basis.kernel(features) @ basis.turn
    return np.column_stack([terms, np.ones(len(terms))])


def missing(basis: Basis, expanded: Array) -> Array:
    """(M,) prior variance that an expansion lacks, over a point's variance."""
    return np.asarray(np.maximum(1.0 - np.square(expanded[:, :-1]).sum(1), 0.0) * basis.prior)


@dataclass(frozen=True, slots=True)
class Monomials:
    """All monomials up to degree 2 of the slowest K features, rotated to orthonormal columns."""

    center: Array
    """(k,) mean of the monomials."""
    turn: Array
    """(k, r) to orthonormal columns."""
    ridge: Array
    """(r + 1,)"""
    features: int
    """K."""

    @classmethod
    def fit(cls, features: Array, count: int, ridge: float) -> Monomials:
        """On features (M, >= count); `ridge` penalizes the weights of standardized monomials."""
        terms = monomials(features[:, :count])[:, 1:]
        center = terms.mean(0)
        spread = terms.std(0)
        spread = np.where(spread > 0, spread, 1.0)
        _, s, vt = np.linalg.svd((terms - center) / spread, full_matrices=False)
        kept = s > 1e-10 * s[0]
        turn = (vt[kept].T / s[kept]) / spread[:, None] * np.sqrt(len(terms))
        penalty = ridge * len(terms) ** 2 / s[kept] ** 2
        return cls(center, turn, np.append(penalty, 0.0), count)

    @property
    def prior(self) -> float:
        return 0.0

    def kernel(self, features: Array) -> Array:
        return monomials(features[:, : self.features])[:, 1:] - self.center

    def to_arrays(self) -> Arrays:
        count = np.array(self.features)
        return {'center': self.center, 'turn': self.turn, 'ridge': self.ridge, 'features': count}


def monomials(features: Array) -> Array:
    """1, s_i, s_i s_j with i <= j: (M, 1 + K + K (K + 1) / 2)."""
    features = np.asarray(features, float)
    i, j = np.triu_indices(features.shape[1])
    return np.column_stack([np.ones(len(features)), features, features[:, i] * features[:, j]])


@dataclass(frozen=True)
class Process:
    """A Gaussian process with a Matern 5/2 kernel of unit variance and a free constant mean.

    It is spanned by m inducing points among the training features; by all of them, it is exact.
    """

    scale: Array
    """(K,) weight of each feature, divided by the length scale of the kernel."""
    points: Array
    """(m, K) scaled inducing features."""
    noise: float
    """Variance of a point over the process's variance."""

    @cached_property
    def turn(self) -> Array:
        """(m, m) transposed inverse of the lower Cholesky factor of the points' kernel."""
        from scipy import linalg  # for training alone

        kernel = matern(self.points, self.points)
        kernel[np.diag_indices_from(kernel)] += 1e-9
        factor = linalg.cholesky(kernel, lower=True)
        return np.asarray(linalg.solve_triangular(factor, np.eye(len(factor)), lower=True).T)

    @classmethod
    def fit(cls, features: Array, scale: Array, noise: float, size: int) -> Process:
        """On features (M, >= K), scaled by `scale` (K,), with at most `size` inducing points, which
        are rounded as in model files."""
        scaled = np.asarray(features[:, : len(scale)], float) * scale
        points = scaled[spread(scaled, size)].astype(np.float32).astype(float)
        return cls(np.asarray(scale, float), points, noise)

    @property
    def features(self) -> int:
        return len(self.scale)

    @property
    def ridge(self) -> Array:
        return np.append(np.full(len(self.points), self.noise), 0.0)

    @property
    def prior(self) -> float:
        return 1.0 / self.noise

    def kernel(self, features: Array) -> Array:
        return matern(features[:, : len(self.scale)] * self.scale, self.points)

    def to_arrays(self) -> Arrays:
        points = self.points.astype(np.float32)
        noise = np.array(self.noise)
        return {'scale': self.scale, 'points': points, 'noise': noise}


Basis = Monomials | Process
"""phi(s) = [k(s) turn, 1] of the slowest K = `features`: `kernel` gives k(s) (M, k), and `turn` is
(k, m - 1). `ridge` (m,) is the prior precision of each weight over that of a point, `prior` the
prior variance of a position over that of a point, 0 without a prior."""


def basis_from(arrays: Arrays) -> Basis:
    """The basis of saved arrays. Raises KeyError when an array is missing."""
    if 'points' in arrays:
        return Process(arrays['scale'], arrays['points'].astype(float), float(arrays['noise']))
    return Monomials(arrays['center'], arrays['turn'], arrays['ridge'], int(arrays['features']))


def matern(a: Array, b: Array) -> Array:
    """Matern 5/2 kernel (M, m) of unit length and variance between (M, K) and (m, K)."""
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1)[None, :] - 2.0 * (a @ b.T)
    distance = np.sqrt(5.0 * np.maximum(squared, 0.0))
    return np.asarray((1.0 + distance + distance * distance / 3.0) * np.exp(-distance))


def spread(points: Array, size: int) -> NDArray[np.int64]:
    """Indices (<= size,) of well-spread points (M, K): each the farthest from those before."""
    if size >= len(points):
        return np.arange(len(points))
    chosen = np.zeros(size, np.int64)
    chosen[0] = np.argmin(((points - points.mean(0)) ** 2).sum(1))
    distance = ((points - points[chosen[0]]) ** 2).sum(1)
    for k in range(1, size):
        chosen[k] = np.argmax(distance)
        distance = np.minimum(distance, ((points - points[chosen[k]]) ** 2).sum(1))
    return chosen
