# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Linear Slow Feature Analysis from sufficient statistics: section 2.1 of the paper.

Outputs s_j(t) = g_j(x(t)) minimize

    Delta(s_j) = <(ds_j/dt)^2>

under <s_j> = 0 (zero mean), <s_j^2> = 1 (unit variance) and <s_i s_j> = 0 for i < j (decorrelation
and order). For linear g_j this is the generalized symmetric eigenproblem Cdot v = lambda C v, with
C the covariance of the signal and Cdot the second moment of its temporal difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array

# Relative variance below the rounding error of sums of float32 products.
_ROUNDING = 1e-9


@dataclass(slots=True)
class Statistics:
    """Sufficient statistics of linear SFA for signals of D dimensions; float64.

    `weight` and `total` (D,), `second` (D, D): sums of 1, x and x x^T;
    `steps` and `difference` (D, D): sums of 1 and dx dx^T.
    """

    weight: float
    total: Array
    second: Array
    steps: float
    difference: Array

    def covariance(self) -> tuple[Array, Array]:
        """Mean (D,) and covariance (D, D) of the signal."""
        mean = self.total / self.weight
        return mean, self.second / self.weight - np.outer(mean, mean)


@dataclass(frozen=True, slots=True)
class LinearSfa:
    """Linear slow features s = (x - mean) weights, slowest first.

    `mean` (D,), `weights` (D, K), `delta` (K,) the Delta values <ds^2>, `rank` the number of
    dimensions kept by the spectral cut, of D.
    """

    mean: Array
    weights: Array
    delta: Array
    rank: int

    def apply(self, x: Array) -> Array:
        """Slow features (..., K) of signals (..., D)."""
        return np.asarray((x - self.mean) @ self.weights)


def solve(statistics: Statistics, outputs: int, relative_cut: float) -> LinearSfa:
    """Slowest `outputs` directions of unit variance, decorrelated, in order of Delta.

    Directions whose variance is below `relative_cut` times the largest are dropped first (C is
    often rank deficient), but at least `outputs` stay unless they are rounding errors.
    Signs are deterministic: the largest weight of each is positive.
    Raises DataError when fewer than `outputs` dimensions remain or there is no difference.
    """
    if statistics.steps <= 0 or statistics.weight <= 1:
        raise DataError('SFA needs at least two consecutive samples')
    mean, covariance = statistics.covariance()
    white = whitening(covariance, relative_cut, outputs)
    from scipy import linalg  # for training alone

    slow = white.T @ (statistics.difference / statistics.steps) @ white
    delta, rotation = linalg.eigh((slow + slow.T) / 2, subset_by_index=[0, outputs - 1])
    weights = signed(white @ rotation)
    return LinearSfa(mean, weights, delta, white.shape[1])


def whitening(covariance: Array, relative_cut: float, least: int) -> Array:
    """Matrix (D, rank) that makes the kept part of a signal of this covariance (D, D) white.

    At least `least` directions are kept. Raises DataError where fewer are above rounding errors.
    """
    variance, axes = np.linalg.eigh(covariance)
    cut = min(relative_cut * variance[-1], variance[-min(least, len(variance))])
    kept = (variance >= cut) & (variance > max(_ROUNDING * variance[-1], np.finfo(float).tiny))
    if kept.sum() < least:
        raise DataError(
            f'the signal has rank {kept.sum()}, fewer than the {least} slow features asked for: '
            'record more varied images or ask for fewer'
        )
    return np.asarray(axes[:, kept] / np.sqrt(variance[kept]))


def signed(weights: Array) -> Array:
    """Weights (D, K) with each column flipped so that its largest entry is positive."""
    largest = np.argmax(np.abs(weights), axis=0)
    signs = np.sign(weights[largest, np.arange(weights.shape[1])])
    return np.asarray(weights * np.where(signs == 0, 1.0, signs))
