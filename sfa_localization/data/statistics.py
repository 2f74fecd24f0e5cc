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
"""The same of a vector in the plane: along each axis, over the median of its length."""
# Shares of errors that must lie within the regions of that probability.
_HALF_AND_MOST = (0.5, 0.95)
TAIL = 4.0
"""Degrees of freedom of Student's distribution, which errors follow that are now and then far
larger than usual: wheels slip, places look alike."""


def quantile(values: Array, share: float, weight: Array | None = None) -> float:
    """Smallest of the values (M,) that at least this share, by weight (M,), does not exceed.

    Without `weight`, all count alike.
    """
    weight = np.ones(len(values)) if weight is None else weight
    order = np.argsort(values, kind='stable')
    below = np.cumsum(weight[order])
    at = int(np.searchsorted(below, share * below[-1]))
    return float(values[order[min(at, len(values) - 1)]])


def outlier_factor(squares: Array, axes: int = 1) -> Array:
    """Factor (M,) on the variance of errors, by their `squares` (M,): normalized, and summed over
    so many axes. By Student's distribution it is 1 on average where the variance is right. One over
    it is the weight in least squares.
    """
    return np.asarray((TAIL + squares) / (TAIL + axes))


def surprise(squares: Array | float, axes: int) -> Array:
    """Negative log-likelihood (M,) of such squares (M,), up to a constant and the normalization."""
    return np.asarray((TAIL + axes) / 2 * np.log1p(squares / TAIL))


def parabola_peak(before: NDArray[F], middle: NDArray[F], after: NDArray[F]) -> NDArray[F]:
    """Where parabolas through values (N,) at -1, 0 and 1 are largest, of which the middle one is
    the largest: -0.5 to 0.5; 0 where all are equal.
    """
    bend = np.minimum(before - 2 * middle + after, -1e-9)
    peak: NDArray[F] = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return peak


def needed_factor(ratio: Array, weight: Array | None = None) -> float:
    """Factor on variances for which half of the errors in the plane fall inside the 50 % region,
    and 95 % inside the 95 % region, whichever needs more.

    `ratio` (M,) is the squared error over the variance of one axis; `weight` (M,).
    """
    return max(quantile(ratio, share, weight) / region(share) for share in _HALF_AND_MOST)


def share_within(ratio: Array, share: float, weight: Array) -> float:
    """Share by `weight` (M,) of the errors in the plane inside the region of that probability.

    `ratio` (M,) is the squared error over the variance of one axis.
    """
    return float(np.average(ratio <= region(share), weights=weight))


def region(share: float) -> float:
    """Square that so many of the lengths of normal errors in the plane do not exceed."""
    return -2 * math.log1p(-share)


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Indices (S,) of at most `most` of `count` images, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
