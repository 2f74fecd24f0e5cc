# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How the errors of neighbouring pictures hang together, learnt where a map was learnt.

Pictures of one place err alike, because the map is wrong there; a filter that took each for new
evidence would be far too sure of itself. The trainer sees it in what it left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array

LARGEST_SHARE = 0.95
_FARTHEST_M = 8.0
_DISTANCES_M = np.geomspace(0.1, 20.0, 81)
_BINS_M = np.geomspace(0.02, _FARTHEST_M, 25)
_ENOUGH_PAIRS = 200
_OUTLYING = 3.0
_MEDIAN_OF_RAYLEIGH = 1.1774


@dataclass(frozen=True, slots=True)
class ErrorCorrelation:
    """Errors of pictures d m of way apart correlate by share * exp(-d / distance_m).

    The defaults are what is reckoned with where nothing is known. Raises DataError for numbers
    that cannot be.
    """

    share: float = 0.7
    distance_m: float = 1.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.share < 1.0 and 0.0 < self.distance_m < math.inf):
            raise DataError(
                f'errors of pictures cannot have a share of {self.share} in common over '
                f'{self.distance_m} m'
            )

    @classmethod
    def fit(
        cls, errors: Array, variances: Array, way_m: Array, owner: NDArray[np.int64]
    ) -> ErrorCorrelation:
        """From errors (M, 2) m of pictures with the variances (M,) m^2 per axis claimed for them.

        `way_m` (M,) is what had been driven, `owner` (M,) the stretch that a picture belongs to;
        pictures are compared inside one stretch. Outliers count as moderate errors. The defaults
        where there are too few pictures to say.
        """
        apart, product = _pairs(_standardised(errors, variances), way_m, owner)
        if len(apart) < _ENOUGH_PAIRS:
            return cls()
        at = np.digitize(apart, _BINS_M)
        count = np.bincount(at, minlength=len(_BINS_M) + 1)
        filled = np.flatnonzero(count)
        distance = np.bincount(at, apart)[filled] / count[filled]
        correlation = np.bincount(at, product)[filled] / count[filled]
        return cls(*_exponential(distance, correlation, count[filled].astype(float)))


def _standardised(errors: Array, variances: Array) -> Array:
    """Errors (M, 2) over what was claimed, cut at three typical ones, of unit mean square."""
    ratio = errors / np.sqrt(variances)[:, None]
    size = np.hypot(*ratio.T)
    limit = _OUTLYING * float(np.median(size)) / _MEDIAN_OF_RAYLEIGH
    ratio = ratio * np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None]
    return np.asarray(ratio / max(math.sqrt(float(np.mean(ratio**2))), 1e-12))


def _pairs(ratio: Array, way_m: Array, owner: NDArray[np.int64]) -> tuple[Array, Array]:
    """Distance of all pairs inside a stretch and inside _FARTHEST_M, and the mean product."""
    apart, product = [np.zeros(0)], [np.zeros(0)]
    for lag in range(1, len(ratio)):
        distance = way_m[lag:] - way_m[:-lag]
        near = (owner[lag:] == owner[:-lag]) & (distance < _FARTHEST_M)
        if not near.any():
            break
        apart.append(distance[near])
        product.append((ratio[lag:][near] * ratio[:-lag][near]).mean(1))
    return np.concatenate(apart), np.concatenate(product)


def _exponential(distance: Array, correlation: Array, weight: Array) -> tuple[float, float]:
    """Share and distance of the exponential nearest to a correlation (B,), by least squares."""
    best, found = math.inf, (0.0, 1.0)
    for length in _DISTANCES_M:
        shape = np.exp(-distance / length)
        share = float((weight * correlation) @ shape / ((weight * shape) @ shape))
        share = min(max(share, 0.0), LARGEST_SHARE)
        miss = float(weight @ (correlation - share * shape) ** 2)
        if miss < best - 1e-12:
            best, found = miss, (share, float(length))
    return found
