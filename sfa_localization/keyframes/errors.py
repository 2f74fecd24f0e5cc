# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How well images are located: variances whose parameters are learned from images left out.

Keyframes locate an image along each axis with variance

    v_k = f^2 + (a s)^2 + (b o ln(1 + u))^2,

where u is the part that no place explains (`Fit.unlike`), o how far outside the keyframes the image
is, and s the displacement that the residual causes; the logarithm, because correlation decays
exponentially with the distance. Slow features, whose map claims a variance c, locate it with v_s =
g c + (h ln(1 + u))^2. The parameters maximize the likelihood of the true places of images left out:
first f, a and b by keyframes alone, then g and h by both together, so that errors which both share
are counted. Errors are Student's: see `surprise`. a is at least 1, because s shows what light does
also where all images are of one light.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.statistics import MEDIAN_TO_STD, surprise
from sfa_localization.keyframes.regression import Fit

LEAST_STD = 1e-3
LEAST_M = 0.01
"""rad, m: least standard deviations of a pose. (With 1 mm, ellipses contained 69 % of the errors in
another light.)"""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """The parameters, and the standard deviations of errors that all images share, which left-out
    images cannot show.

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
    and the `weight` (M,) of each, of sum 1.
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
        numbers = [[fit.unlike, fit.outward, fit.variance, fit.yaw] for fit in fits]
        unlike, outward, variance, yaw = np.array(numbers).T
        error = np.array([fit.place for fit in fits]) - poses[:, :2]
        return cls(unlike, outward, variance, error, wrap_angle(yaw - poses[:, 2]), weight)

    def learn(self) -> ErrorModel:
        """f, a, b and the standard deviation of headings."""
        yaw_std = MEDIAN_TO_STD * float(np.median(np.abs(self.turn) / (1 + self.unlike)))
        return self._likeliest(
            ErrorModel(yaw_std=max(yaw_std, LEAST_STD)),
            {'floor_m': LEAST_M, 'residual': 1.0, 'outward_m': LEAST_STD},
            lambda errors: (self.error, self._variances(errors)),
        )

    def learn_slow(self, errors: ErrorModel, error: Array, claimed: Array) -> ErrorModel:
        """g and h: slow features, whose map claims variances (M,) m^2, err by (M, 2) m."""
        return self._likeliest(
            errors,
            {'slow': LEAST_STD**2, 'slow_m': LEAST_STD},
            lambda errors: self.fused(errors, error, claimed),
        )

    def fused(self, errors: ErrorModel, error: Array, claimed: Array) -> tuple[Array, Array]:
        """Errors (M, 2) m of both together, and their variances (M,) m^2 along each axis."""
        by_keyframes = self._variances(errors)
        gain = by_keyframes / (by_keyframes + errors.slow_variance(claimed, self.unlike))
        return self.error + gain[:, None] * (error - self.error), by_keyframes * (1 - gain)

    def mean_m(self, error: Array) -> float:
        """Mean length, m, of errors (M, 2) m."""
        return float(np.average(np.hypot(*error.T), weights=self.weight))

    def _variances(self, errors: ErrorModel) -> Array:
        return errors.variance(self.variance, self.outward, self.unlike)

    def _likeliest(
        self,
        start: ErrorModel,
        least: dict[str, float],
        errors_of: Callable[[ErrorModel], tuple[Array, Array]],
    ) -> ErrorModel:
        """The parameters, named in `least` with their lower bounds, that maximize the likelihood of
        errors (M, 2) m with variances (M,) m^2, which depend on the parameters.
        """
        from scipy.optimize import minimize  # for training alone

        def model(logarithms: Array) -> ErrorModel:
            return replace(start, **dict(zip(least, np.exp(logarithms).tolist(), strict=True)))

        def cost(logarithms: Array) -> float:
            error, variance = errors_of(model(logarithms))
            squares = (error**2).sum(1) / variance
            return float(self.weight @ (surprise(squares, 2) + np.log(variance)))

        bounds = [(math.log(low), -math.log(LEAST_STD)) for low in least.values()]
        begin = [math.log(getattr(start, name)) for name in least]
        return model(minimize(cost, begin, method='Nelder-Mead', bounds=bounds).x)
