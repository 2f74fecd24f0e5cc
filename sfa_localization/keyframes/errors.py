# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How well images are located: variances whose parameters are learned from images left out.

Along each axis, an image of which no place explains u (`Fit.unlike`), so far outward o from the
middle of its keyframes, and whose residual moves it by s, is where keyframes put it with variance

    v_k = f^2 + (a s)^2 + (b o ln(1 + u))^2,

for likeness decays exponentially with the distance; and slow features, whose map claims a variance
c, put it with v_s = g c + (h ln(1 + u))^2. The five are those that make the true places of images
likeliest that both were learned without: first f, a and b by keyframes alone, then g and h by both
together, so that what errs in both is counted. Errors are Student's: see `surprise`. a is at least
1, for s shows what light does also where all images are of one light.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.statistics import MEDIAN_TO_STD, surprise
from sfa_localization.keyframes.regression import Fit

LEAST_STD, LEAST_M = 1e-3, 0.01
"""rad, m: nobody knows a pose better. (With 1 mm, ellipses held 69 % in another light.)"""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """The parameters, and what images that are left out do not show: errors that all share.

    `floor_m` is f, `residual` a, `outward_m` b, `slow` g, `slow_m` h. `yaw_std` rad is the
    standard deviation of a heading, times 1 + u. `map_m` and `turn_std` rad are those of the map,
    along each axis and of its directions.
    """

    floor_m: float = 0.03
    residual: float = 1.5
    outward_m: float = 1.0
    slow: float = 0.1
    slow_m: float = 0.15
    yaw_std: float = 0.03
    map_m: float = 0.0
    turn_std: float = 0.0

    def variance(self, by_residual: Array, outward: Array, unlike: Array) -> Array:
        """v_k (M,) m^2 of images by the variance, `outward` and `unlike` of each `Fit`, (M,)."""
        beyond = self.outward_m * outward * np.log1p(unlike)
        return np.asarray(self.floor_m**2 + self.residual**2 * by_residual + beyond**2)

    def slow_variance(self, claimed: Array, unlike: Array) -> Array:
        """v_s (M,) m^2."""
        return np.asarray(self.slow * claimed + (self.slow_m * np.log1p(unlike)) ** 2)

    def yaw_variance(self, unlike: Array) -> Array:
        """Of headings, (M,) rad^2."""
        return np.asarray((self.yaw_std * (1 + unlike)) ** 2)


@dataclass(frozen=True, slots=True)
class LeftOut:
    """M images that were located without their stretch of driving: `unlike`, `outward` and the
    `variance` m^2 of each `Fit`, the `error` (M, 2) m, the error `turn` (M,) rad of the heading,
    and how much each counts, `weight` (M,) of sum 1.
    """

    unlike: Array
    outward: Array
    variance: Array
    error: Array
    turn: Array
    weight: Array

    @classmethod
    def of(cls, fits: Sequence[Fit], poses: Array, weight: Array) -> LeftOut:
        """By the true poses (M, 3)."""
        numbers = np.array([[fit.unlike, fit.outward, fit.variance, fit.yaw] for fit in fits])
        error = np.array([fit.place for fit in fits]) - poses[:, :2]
        unlike, outward, variance, yaw = numbers.T
        return cls(unlike, outward, variance, error, wrap_angle(yaw - poses[:, 2]), weight)

    def learn(self) -> ErrorModel:
        """f, a and b, and that of the heading."""
        yaw_std = MEDIAN_TO_STD * float(np.median(np.abs(self.turn) / (1 + self.unlike)))
        start = ErrorModel(yaw_std=max(yaw_std, LEAST_STD))

        def tried(f: float, a: float, b: float) -> ErrorModel:
            return replace(start, floor_m=f, residual=a, outward_m=b)

        return tried(
            *_likeliest(
                lambda *numbers: self._surprise(self.error, self._variances(tried(*numbers))),
                (start.floor_m, start.residual, start.outward_m),
                least=(LEAST_M, 1.0, LEAST_STD),
            )
        )

    def learn_slow(self, errors: ErrorModel, error: Array, claimed: Array) -> ErrorModel:
        """g and h: slow features, whose map claims variances (M,) m^2, err by (M, 2) m."""

        def tried(root: float, h: float) -> ErrorModel:
            return replace(errors, slow=root**2, slow_m=h)

        return tried(
            *_likeliest(
                lambda *numbers: self._surprise(*self.fused(tried(*numbers), error, claimed)),
                (math.sqrt(errors.slow), errors.slow_m),
            )
        )

    def fused(self, errors: ErrorModel, error: Array, claimed: Array) -> tuple[Array, Array]:
        """Errors (M, 2) m of both together, and their variances (M,) m^2 along each axis."""
        own = self._variances(errors)
        other = errors.slow_variance(claimed, self.unlike)
        gain = own / (own + other)
        return self.error + gain[:, None] * (error - self.error), own * (1 - gain)

    def _variances(self, errors: ErrorModel) -> Array:
        return errors.variance(self.variance, self.outward, self.unlike)

    def _surprise(self, error: Array, variance: Array) -> float:
        """Negative log-likelihood of errors (M, 2) with variances (M,) along each axis."""
        squares = (error**2).sum(1) / variance
        return float(self.weight @ (surprise(squares, 2) + np.log(variance)))


def _likeliest(
    cost: Callable[..., float], start: tuple[float, ...], least: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    """The parameters of least cost, of so much at `least`."""
    from scipy.optimize import minimize  # for training alone

    lowest = np.log(least or (LEAST_STD,) * len(start))
    found = minimize(
        lambda logarithms: cost(*np.exp(logarithms)),
        np.log(start),
        method='Nelder-Mead',
        bounds=[(low, -math.log(LEAST_STD)) for low in lowest],
    )
    return tuple(np.exp(found.x).tolist())
