# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from slow features to meters: monomials (section 4 of the paper), or a Gaussian process.

The paper estimates p = W^T s (section 3). Both are linear in an expansion phi(s), position = Phi w,
with a Gaussian prior on w. A Gaussian process is its expansion over the training features
themselves, so one solver serves both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array

Arrays = dict[str, NDArray[Any]]


class Basis(Protocol):
    """An expansion of slow features, with the precision of its prior."""

    @property
    def ridge(self) -> Array:
        """(m,) prior precision of each weight over the precision of a point; 0: no prior."""

    @property
    def features(self) -> int:
        """K: how many of the slowest features it reads."""

    def expand(self, features: Array) -> Array:
        """Expansion (M, m) of slow features (M, >= K)."""

    def missing(self, expanded: Array) -> Array:
        """(M,) prior variance that the expansion leaves out, over a point's variance."""


@dataclass(frozen=True, slots=True)
class Monomials:
    """All monomials up to degree 2 of the slowest K features; 45 for the paper's K = 8.

    The monomials are rotated to orthonormal columns: the same functions, well conditioned.
    """

    center: Array
    """(m,) mean of the monomials."""
    turn: Array
    """(m, r) to orthonormal columns."""
    ridge_: Array
    """(r + 1,)"""
    features: int
    """K."""

    @classmethod
    def fit(cls, features: Array, count: int, ridge: float) -> Monomials:
        """On features (M, >= count); `ridge` penalizes the weights of standardized monomials."""
        terms = monomials(features[:, :count])[:, 1:]
        center, spread = terms.mean(0), terms.std(0)
        spread = np.where(spread > 0, spread, 1.0)
        _, s, vt = np.linalg.svd((terms - center) / spread, full_matrices=False)
        kept = s > 1e-10 * s[0]
        turn = (vt[kept].T / s[kept]) / spread[:, None] * np.sqrt(len(terms))
        penalty = ridge * len(terms) ** 2 / s[kept] ** 2
        return cls(center, turn, np.append(penalty, 0.0), count)

    @property
    def ridge(self) -> Array:
        return self.ridge_

    def expand(self, features: Array) -> Array:
        terms = (monomials(features[:, : self.features])[:, 1:] - self.center) @ self.turn
        return np.column_stack([terms, np.ones(len(terms))])

    def missing(self, expanded: Array) -> Array:
        return np.zeros(len(expanded))

    def to_arrays(self) -> Arrays:
        return {
            'center': self.center,
            'turn': self.turn,
            'ridge': self.ridge_,
            'features': np.array(self.features),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Monomials:
        features = int(arrays['features'])
        return cls(arrays['center'], arrays['turn'], arrays['ridge'], features)


def monomials(features: Array) -> Array:
    """1, s_i, s_i s_j with i <= j: (M, 1 + K + K (K + 1) / 2)."""
    features = np.asarray(features, float)
    i, j = np.triu_indices(features.shape[1])
    return np.column_stack([np.ones(len(features)), features, features[:, i] * features[:, j]])


@dataclass(frozen=True, slots=True)
class Process:
    """A Gaussian process with a Matern 5/2 kernel of unit variance and a free constant mean.

    It is spanned by m inducing points chosen among the training features; all of them when m
    allows, and then it is the exact process.
    """

    scale: Array
    """(K,) weight of each feature over the kernel's length."""
    points: Array
    """(m, K) scaled inducing features."""
    whiten: Array
    """(m, m) inverse of the lower Cholesky factor of their kernel."""
    noise: float
    """Variance of a point over the process's variance."""

    @classmethod
    def fit(cls, features: Array, scale: Array, noise: float, size: int) -> Process:
        """On features (M, >= K), scaled by `scale` (K,), with at most `size` inducing points."""
        scaled = np.asarray(features[:, : len(scale)], float) * scale
        chosen = spread(scaled, size)
        return cls.at(scaled[chosen], scale, noise)

    @classmethod
    def at(cls, points: Array, scale: Array, noise: float) -> Process:
        """With given inducing points (m, K), already scaled; rounded as model files hold them."""
        points = points.astype(np.float32).astype(np.float64)
        kernel = matern(points, points)
        kernel[np.diag_indices_from(kernel)] += 1e-9
        factor = scipy.linalg.cholesky(kernel, lower=True)
        whiten = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True)
        return cls(np.asarray(scale, float), points, whiten, noise)

    @property
    def ridge(self) -> Array:
        return np.append(np.full(len(self.points), self.noise), 0.0)

    @property
    def features(self) -> int:
        return len(self.scale)

    def expand(self, features: Array) -> Array:
        scaled = features[:, : len(self.scale)] * self.scale
        terms = matern(scaled, self.points) @ self.whiten.T
        return np.column_stack([terms, np.ones(len(terms))])

    def missing(self, expanded: Array) -> Array:
        held = np.einsum('ij,ij->i', expanded[:, :-1], expanded[:, :-1])
        return np.asarray(np.maximum(1.0 - held, 0.0) / self.noise)


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


@dataclass(frozen=True, slots=True)
class MetricMap:
    """From slow features to meters in the map frame, with covariance."""

    basis: Basis
    weights: Array
    """(m, 2)"""
    spread: Array
    """(m, m) square root of the weights' posterior covariance, meters."""
    sway: Array
    """(m, r, 2) weights' change per standard deviation of the joint errors of the segments, m."""
    noise_m: float
    """Standard deviation of an image's residual per axis, meters."""
    inflation: float
    """Factor on the variance that makes left-out segments consistent."""

    @property
    def features(self) -> int:
        """How many of the slowest features it reads."""
        return self.basis.features

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Positions (M, 2) in meters and covariances (M, 2, 2) of slow features (M, >= K).

        Raises DataError when there are fewer features than it was learned from.
        """
        features = checked_features(features, self.features)
        expanded = self.basis.expand(features)
        return expanded @ self.weights, self._covariance(expanded)

    def _covariance(self, expanded: Array) -> Array:
        own = ((expanded @ self.spread) ** 2).sum(1)
        own += self.noise_m**2 * (1.0 + self.basis.missing(expanded))
        sway = np.einsum('ij,jkl->ikl', expanded, self.sway)
        joint = np.einsum('ikl,ikm->ilm', sway, sway)
        return np.asarray(self.inflation * (joint + own[:, None, None] * np.eye(2)))

    def to_arrays(self) -> Arrays:
        """Plain arrays, from which `from_arrays` restores a map of monomials.

        That of a process is saved in its fast form, see saved_map.py.
        """
        assert isinstance(self.basis, Monomials)
        own = {
            'kind': np.array('monomials'),
            'weights': self.weights,
            'spread': self.spread,
            'sway': self.sway,
            'noise_m': np.array(self.noise_m),
            'inflation': np.array(self.inflation),
        }
        return own | {f'basis_{name}': value for name, value in self.basis.to_arrays().items()}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> MetricMap:
        """Raises KeyError when an array is missing."""
        parts = {k[6:]: v for k, v in arrays.items() if k.startswith('basis_')}
        basis = Monomials.from_arrays(parts)
        weights, spread, sway = (np.asarray(arrays[n], float) for n in _ARRAYS)
        noise_m, inflation = float(arrays['noise_m']), float(arrays['inflation'])
        return cls(basis, weights, spread, sway, noise_m, inflation)


_ARRAYS = ('weights', 'spread', 'sway')


def checked_features(features: Array, count: int) -> Array:
    """Features (M, >= count), of one row also (K,). Raises DataError when there are fewer."""
    features = np.atleast_2d(np.asarray(features, float))
    if features.shape[1] < count:
        raise DataError(f'the map reads {count} slow features, not {features.shape[1]}')
    return features
