# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Robust statistics: spread by the median, quantiles by weight, outliers, peaks."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array

F = TypeVar('F', bound=np.floating)
MEDIAN_TO_STD = 1.4826
"""Standard deviation of a normal variable over the median of its absolute value."""
LENGTH_TO_STD = float(1.0 / np.sqrt(2.0 * np.log(2.0)))
"""The same of a vector in the plane: along each axis, over the median of its length."""
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
