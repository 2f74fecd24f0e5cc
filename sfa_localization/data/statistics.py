# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Robust statistics: spread by the median, quantiles by weight, outliers, peaks."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array

F = TypeVar('F', bound=np.floating)
MEDIAN_TO_STD = 1.4826
"""Standard deviation of a normal variable over the median of its absolute value."""
LENGTH_TO_STD = float(1.0 / np.sqrt(2.0 * np.log(2.0)))
"""Standard deviation per axis of a normal vector in the plane over the median of its length."""
TAIL = 4.0
"""Degrees of freedom of Student's distribution, for errors with outliers: wheels slip, places look
alike."""


def quantile(values: Array, share: float, weight: Array | None = None) -> float:
    """The smallest of the values (M,) whose cumulated share of the weight (M,) reaches `share`."""
    weight = np.ones(len(values)) if weight is None else weight
    order = np.argsort(values, kind='stable')
    below = np.cumsum(weight[order])
    at = int(np.searchsorted(below, share * below[-1]))
    return float(values[order[min(at, len(values) - 1)]])


def outlier_factor(squares: Array, axes: int = 1) -> Array:
    """Factor (M,) on the variances of errors whose normalized `squares` (M,) are summed over axes.

    It follows from Student's distribution; its inverse is the weight in least squares.
    """
    return np.asarray((TAIL + squares) / (TAIL + axes))


def surprise(squares: Array | float, axes: int) -> Array:
    """Negative log-likelihood (M,) of normalized squares (M,), up to a constant."""
    return np.asarray((TAIL + axes) / 2 * np.log1p(squares / TAIL))


def parabola_peak(before: NDArray[F], middle: NDArray[F], after: NDArray[F]) -> NDArray[F]:
    """Vertex, -0.5 to 0.5, of parabolas through values (N,) at -1, 0 and 1 that peak at 0."""
    bend = np.minimum(before - 2 * middle + after, -1e-9)
    peak: NDArray[F] = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return peak


def needed_factor(ratio: Array, weight: Array | None = None) -> float:
    """Multiply variances by this to get at least 50 % of errors into the 50 % region of the plane,
    and 95 % into the 95 % region. `ratio` (M,): squared error over the variance of one axis.
    """
    return max(quantile(ratio, share, weight) / _region(share) for share in (0.5, 0.95))


def share_within(ratio: Array, share: float, weight: Array) -> float:
    """Share by `weight` (M,) of errors in the plane inside the region of that probability.

    `ratio` (M,) is the squared error over the variance of one axis.
    """
    return float(np.average(ratio <= _region(share), weights=weight))


def _region(share: float) -> float:
    """Squared radius of the circle that holds this share of normal vectors of unit variance."""
    return -2 * math.log1p(-share)


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Indices (S,) of at most `most` of `count` images, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
