# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Linear Slow Feature Analysis from streaming, mergeable statistics.

SFA minimises <(ds_j/dt)^2> under zero mean, unit variance and decorrelation (section 2.1 of the
paper). The linear case is the generalised symmetric eigenproblem Cdot v = lambda C v with C the
covariance of the signal and Cdot the second moment of its temporal difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array

# Relative variance that sums of float32 products cannot tell from zero.
_ROUNDING = 1e-9

Signal = NDArray[np.float32] | NDArray[np.float64]


@dataclass(slots=True)
class Statistics:
    """Sufficient statistics of linear SFA for signals of D dimensions; float64, mergeable.

    `weight` and `total` (D,), `second` (D, D): sums of 1, x and x x^T;
    `steps` and `difference` (D, D): sums of 1 and dx dx^T. The sums may be weighted.
    """

    weight: float
    total: Array
    second: Array
    steps: float
    difference: Array

    @classmethod
    def empty(cls, dimensions: int) -> Statistics:
        square = (dimensions, dimensions)
        return cls(0.0, np.zeros(dimensions), np.zeros(square), 0.0, np.zeros(square))

    @property
    def dimensions(self) -> int:
        return len(self.total)

    def __add__(self, other: Statistics) -> Statistics:
        """Statistics of both signals together, with a break between them."""
        if self.dimensions != other.dimensions:
            raise DataError(f'cannot merge {self.dimensions} with {other.dimensions} dimensions')
        return Statistics(
            self.weight + other.weight,
            self.total + other.total,
            self.second + other.second,
            self.steps + other.steps,
            self.difference + other.difference,
        )

    def covariance(self) -> tuple[Array, Array]:
        """Mean (D,) and covariance (D, D) of the signal."""
        mean = self.total / self.weight
        return mean, self.second / self.weight - np.outer(mean, mean)


@dataclass(frozen=True, slots=True)
class Solution:
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


def solve(statistics: Statistics, outputs: int, relative_cut: float = 1e-7) -> Solution:
    """Slowest `outputs` directions of unit variance, decorrelated, in order of Delta.

    Directions whose variance is below `relative_cut` times the largest are dropped first (C is
    often rank deficient), but `outputs` of them stay as long as they are no mere rounding.
    Signs are deterministic: the largest weight of each is positive.
    Raises DataError when fewer than `outputs` dimensions remain or there is no difference.
    """
    if statistics.steps <= 0 or statistics.weight <= 1:
        raise DataError('SFA needs at least two consecutive samples')
    mean, covariance = statistics.covariance()
    white = whitening(covariance, relative_cut, outputs)
    rank = white.shape[1]
    if rank < outputs:
        raise DataError(
            f'the signal has rank {rank}, fewer than the {outputs} slow features asked for: '
            'record more varied pictures or ask for fewer'
        )
    slow = white.T @ (statistics.difference / statistics.steps) @ white
    delta, rotation = linalg.eigh((slow + slow.T) / 2, subset_by_index=[0, outputs - 1])
    weights = signed(white @ rotation)
    return Solution(mean, weights, delta, rank)


def whitening(covariance: Array, relative_cut: float, least: int) -> Array:
    """Matrix (D, rank) that makes the kept part of a signal of this covariance (D, D) white.

    At least `least` directions are kept, as long as they are no mere rounding.
    """
    variance, axes = linalg.eigh(covariance, driver='evd')
    cut = min(relative_cut * variance[-1], variance[-min(least, len(variance))])
    kept = (variance >= cut) & (variance > max(_ROUNDING * variance[-1], np.finfo(float).tiny))
    return np.asarray(axes[:, kept] / np.sqrt(variance[kept]))


def signed(weights: Array) -> Array:
    """Weights (D, K) with each column flipped so that its largest entry is positive."""
    largest = np.argmax(np.abs(weights), axis=0)
    signs = np.sign(weights[largest, np.arange(weights.shape[1])])
    return np.asarray(weights * np.where(signs == 0, 1.0, signs))


class StreamingSFA:
    """Linear SFA of signals fed chunk by chunk: `partial_fit` any number of times, then `fit`.

    >>> sfa = StreamingSFA(outputs=2)
    >>> for chunk in chunks:
    ...     sfa.partial_fit(chunk)
    >>> slow = sfa.fit().apply(signal)
    """

    def __init__(self, outputs: int, relative_cut: float = 1e-7) -> None:
        self.outputs = outputs
        self.relative_cut = relative_cut
        self.statistics: Statistics | None = None
        self._last: Signal | None = None
        self._last_time: float | None = None

    def partial_fit(self, x: Signal, time: Array | None = None) -> StreamingSFA:
        """Continue the signal with x (N, D).

        With `time` (N,), seconds or metres driven, differences are divided by its real steps.
        """
        if x.ndim != 2 or not np.isfinite(x).all():
            raise DataError(f'expected a finite (N, D) signal, got shape {x.shape}')
        if self.statistics is None:
            self.statistics = Statistics.empty(x.shape[1])
        if x.shape[1] != self.statistics.dimensions:
            raise DataError(f'expected {self.statistics.dimensions} dimensions, got {x.shape[1]}')
        if len(x):
            self._accumulate(x, time)
        return self

    def _accumulate(self, x: Signal, time: Array | None) -> None:
        s = self.statistics
        assert s is not None
        dx = np.diff(x, axis=0) if self._last is None else np.diff(x, axis=0, prepend=self._last)
        dx = dx / self._steps(time, len(dx))[:, None]
        s.weight += len(x)
        s.total += x.sum(0, dtype=np.float64)
        s.second += x.T @ x
        s.steps += len(dx)
        s.difference += dx.T @ dx
        self._last = x[-1:].copy()
        self._last_time = None if time is None else float(time[-1])

    def _steps(self, time: Array | None, count: int) -> Array:
        """Real steps between the samples, 1 without times."""
        if time is None:
            return np.ones(count)
        known = [] if self._last_time is None else [self._last_time]
        steps = np.diff(np.concatenate([known, np.asarray(time, float)]))
        if len(steps) != count or (steps <= 0).any():
            raise DataError('times of an SFA signal must increase, one for each sample')
        return np.asarray(steps)

    def end_run(self) -> StreamingSFA:
        """Mark a break: no difference is taken across it."""
        self._last = self._last_time = None
        return self

    def merge(self, other: StreamingSFA) -> StreamingSFA:
        """Add what another estimator has seen."""
        if other.statistics is not None:
            mine = self.statistics
            self.statistics = other.statistics if mine is None else mine + other.statistics
        return self.end_run()

    def fit(self) -> Solution:
        """Solve for the slow features of everything seen so far."""
        if self.statistics is None:
            raise DataError('SFA has seen no signal')
        return solve(self.statistics, self.outputs, self.relative_cut)
