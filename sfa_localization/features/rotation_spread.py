# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Disagreement of the rotated views of one image about the place, and the error it predicts.

The top node reads part of the panorama, in every simulated rotation another part. Where all parts
look as in training the views agree; a near trunk, a person or a covered part of the lens makes
some differ. The disagreement is available at run time, needs no other image, and scales the
variances of position and heading, as learned from parts of the drive that were left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.statistics import quantile, surprise
from sfa_localization.features.rotation import Map

_EXPONENTS = np.linspace(0.0, 6.0, 25)
# Of the relative disagreement: beyond these the left-out images are too few to learn from.
_LIMITS = (0.2, 30.0)
# Shares of the left-out errors that must lie within the regions of that probability.
_HALF_AND_MOST = (0.5, 0.95)


def disagreement(top: Map) -> Array:
    """Mean standard deviation (T,) of the slow features over the views of top maps (T, ..., K)."""
    views = top.reshape(len(top), -1, top.shape[-1])
    return np.asarray(views.std(1, dtype=np.float64).mean(1))


@dataclass(frozen=True, slots=True)
class Agreement:
    """Factor on a predicted variance: `level` (u / `typical`)^`exponent` at disagreement u."""

    typical: float
    level: float
    exponent: float

    def factor(self, disagreement: Array) -> Array:
        """Factors (T,) for disagreements (T,)."""
        return self.level * _relative(disagreement, self.typical) ** self.exponent

    @classmethod
    def fit(
        cls,
        disagreement: Array,
        squared_error: Array,
        variance: Array,
        axes: int,
        weight: Array | None = None,
    ) -> Agreement:
        """From left-out images (M,): squared error over `axes` axes, predicted variance per axis.

        The exponent is the likeliest under heavy tails; the level makes half of the errors fall
        inside the 50 % region and 95 % inside the 95 % region, whichever needs more. `weight`
        (M,) is how much each image counts; without it, all count alike.
        """
        typical = quantile(disagreement, 0.5, weight)
        relative = _relative(disagreement, typical)
        exponent = min(
            _EXPONENTS,
            key=lambda e: _surprise(squared_error, variance * relative**e, axes, weight),
        )
        ratio = squared_error / (variance * relative**exponent)
        return cls(typical, needed_factor(ratio, axes, weight), float(exponent))

    def to_arrays(self) -> dict[str, Array]:
        """Arrays to save, without pickle."""
        return {'numbers': np.array([self.typical, self.level, self.exponent])}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> Agreement:
        typical, level, exponent = (float(n) for n in np.asarray(arrays['numbers'], float))
        return cls(typical, level, exponent)


def _relative(disagreement: Array, typical: float) -> Array:
    return np.asarray(np.clip(disagreement / max(typical, 1e-9), *_LIMITS))


def _surprise(squared_error: Array, variance: Array, axes: int, weight: Array | None) -> float:
    """Mean negative log-likelihood of heavy-tailed errors at their best common scale."""
    ratio = squared_error / variance
    scale = quantile(ratio, 0.5, weight) / chi_square(0.5, axes) + 1e-300
    tails = surprise(ratio / scale, axes)
    return float(np.average(tails + axes / 2 * np.log(variance * scale), weights=weight))


def needed_factor(ratio: Array, axes: int, weight: Array | None = None) -> float:
    """Factor on variances for which half of the errors fall inside the 50 % region, and 95 %
    inside the 95 % region, whichever needs more.

    `ratio` (M,) is the squared error over `axes` axes over the variance of one; `weight` (M,).
    """
    needed = [quantile(ratio, p, weight) / chi_square(p, axes) for p in _HALF_AND_MOST]
    return float(max(needed))


def share_within(ratio: Array, axes: int, share: float, weight: Array) -> float:
    """Share by `weight` (M,) of the errors inside the region of that probability.

    `ratio` (M,) is the squared error over `axes` axes over the variance of one.
    """
    return float(np.average(ratio <= chi_square(share, axes), weights=weight))


def chi_square(share: float, axes: int) -> float:
    """Square that so many of the sums of `axes` squared standard normal variables do not exceed."""
    from scipy.special import gammaincinv  # for training alone

    return float(2 * gammaincinv(axes / 2, share))
