# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Correlation of the position errors of neighboring images, estimated from held-out images.

Images of one place have similar errors, because the map is wrong there: a filter that takes them as
independent is overconfident.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.statistics import LENGTH_TO_STD

LEAST_M = 0.01
"""Least correlation distance: images nearer to each other show the same place."""
LARGEST_SHARE = 0.95
"""Largest share, below 1 so that every image adds some information."""
_FARTHEST_M = 8.0  # errors of images farther apart hardly correlate
_DISTANCES_M = np.geomspace(0.1, 20.0, 81)  # correlation distances that are tried
_BINS_M = np.geomspace(0.02, _FARTHEST_M, 25)  # edges of the bins of the distance of two images
_ENOUGH_PAIRS = 200  # with fewer, the estimate scatters more than the default is wrong
_OUTLYING = 3.0  # errors are limited to so many typical ones


@dataclass(frozen=True, slots=True)
class ErrorCorrelation:
    """Errors of images d m apart along the path correlate by share * exp(-d / distance_m).

    The defaults are assumed where nothing was learned. Raises DataError for impossible numbers.
    """

    share: float = 0.7
    distance_m: float = 1.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.share < 1.0 and LEAST_M <= self.distance_m < math.inf):
            raise DataError(
                f'a correlation of {self.share} over {self.distance_m} m is impossible: share must '
                f'be in [0, 1), distance_m finite and {LEAST_M} or more'
            )

    @classmethod
    def fit(
        cls, errors: Array, variances: Array, driven_m: Array, owner: NDArray[np.int64]
    ) -> ErrorCorrelation:
        """From errors (M, 2) m of images with predicted variances (M,) m^2 per axis.

        `driven_m` (M,) is the distance driven before each image, `owner` (M,) its segment: images
        are compared inside a segment. Outliers are limited. Too few images give the defaults.
        """
        spacing, product = _pairs(_standardized(errors, variances), driven_m, owner)
        if len(spacing) < _ENOUGH_PAIRS:
            return cls()
        at = np.digitize(spacing, _BINS_M)
        count = np.bincount(at, minlength=len(_BINS_M) + 1)
        filled = np.flatnonzero(count)
        distance = np.bincount(at, spacing)[filled] / count[filled]
        correlation = np.bincount(at, product)[filled] / count[filled]
        return cls(*_exponential(distance, correlation, count[filled].astype(float)))

    def alike(self, driven_m: Array) -> Array:
        """Sums (M,) of the correlations of each error with all, of images at `driven_m` (M,)."""
        order = np.argsort(driven_m, kind='stable')
        path = driven_m[order]
        total = np.ones(len(driven_m))
        for lag in range(1, len(path)):
            spacing = path[lag:] - path[:-lag]
            if spacing.min() > _FARTHEST_M:
                break
            correlation = self.share * np.exp(-spacing / self.distance_m)
            total[lag:] += correlation
            total[:-lag] += correlation
        return np.asarray(total[np.argsort(order)])


def _standardized(errors: Array, variances: Array) -> Array:
    """Errors (M, 2) over their standard deviations, outliers limited, scaled to unit variance."""
    ratio = errors / np.sqrt(variances)[:, None]
    size = np.hypot(*ratio.T)
    limit = _OUTLYING * LENGTH_TO_STD * float(np.median(size))
    ratio = ratio * np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None]
    return np.asarray(ratio / max(math.sqrt(float(np.mean(ratio**2))), 1e-12))


def _pairs(ratio: Array, driven_m: Array, owner: NDArray[np.int64]) -> tuple[Array, Array]:
    """Distance and mean product of all pairs inside a segment and nearer than _FARTHEST_M."""
    spacing = [np.zeros(0)]
    product = [np.zeros(0)]
    for lag in range(1, len(ratio)):
        distance = driven_m[lag:] - driven_m[:-lag]
        near = (owner[lag:] == owner[:-lag]) & (distance < _FARTHEST_M)
        if not near.any():
            break
        spacing.append(distance[near])
        product.append((ratio[lag:][near] * ratio[:-lag][near]).mean(1))
    return np.concatenate(spacing), np.concatenate(product)


def _exponential(distance: Array, correlation: Array, weight: Array) -> tuple[float, float]:
    """Share and distance of the exponential nearest to a correlation (B,), by least squares."""
    least = math.inf
    best = (0.0, 1.0)
    for length in _DISTANCES_M:
        shape = np.exp(-distance / length)
        share = float((weight * correlation) @ shape / ((weight * shape) @ shape))
        share = min(max(share, 0.0), LARGEST_SHARE)
        residual = float(weight @ (correlation - share * shape) ** 2)
        if residual < least - 1e-12:
            least = residual
            best = (share, float(length))
    return best
