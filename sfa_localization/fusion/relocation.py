# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the pose at the start, and again where images contradict the estimate.

A measurement that the filter rejects may be wrong, or the filter may be. What decides is whether
the rejected ones agree among themselves: laid along the odometry's path, which is turned and
shifted as one piece, they must match over a number of images and a distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Complex, wrap_angle
from sfa_localization.fusion.belief import ENOUGH_IMAGES, Belief, Columns, PositionFix
from sfa_localization.fusion.motion import YAW

FEW_IMAGES = 3
"""Fewest agreeing images: two always agree on some motion; the third is the test."""
AGREEING_M = 2.0
AGREEING_STDS = 3.0
"""Distance over which images must agree, because nearer ones share their errors, and standard
deviations within which two of them do."""
START_YAW_STD = 0.3
"""rad: positions alone must determine the heading to this; the EKF is linear enough up to there."""
AGREEING_PER_OTHER = 3
"""Agreeing images must outnumber the accepted ones on the same path by this factor."""
OBVIOUS_JUMP_M = 1.5
"""A larger displacement shows that the robot was moved; a smaller one may be the map's error."""
_TINY = 1e-12  # keeps the variance finite where a lone position shows no turn


class Relocation(NamedTuple):
    """Where agreeing images put the robot now: pose (3,), covariance (3, 3). `have_yaw`: they show
    headings. Over the same distance, `contradicting` counts those that the filter accepted,
    `dissenting` others that it rejected.
    """

    pose: Array
    covariance: Array
    images: int
    distance_m: float
    have_yaw: bool
    contradicting: int = 0
    dissenting: int = 0

    def shows_heading(self, remembered: int) -> bool:
        """Whether positions determine the heading, and most of those remembered agree."""
        certain = self.covariance[YAW, YAW] < START_YAW_STD**2
        return bool(certain and self.images >= max(FEW_IMAGES, remembered / 2))

    def outweighs(self, belief: Belief) -> bool:
        """Whether agreeing images outweigh the estimate that they contradict."""
        images = self.images
        support = belief.memory.support
        # Others that dissent: the fault "two far frames in turns".
        if images < AGREEING_PER_OTHER * self.contradicting or images <= self.dissenting:
            return False
        # A new estimate is overruled by one image more than support it.
        enough = images >= min(ENOUGH_IMAGES, max(2, support + 1))
        if not enough or self.covariance[YAW, YAW] > START_YAW_STD**2:
            return False
        if self.distance_m >= AGREEING_M:
            return True
        # An image turned in its place may be the camera's fault; one elsewhere is not.
        elsewhere = math.hypot(*(self.pose[:2] - belief.mean[:2])) >= OBVIOUS_JUMP_M
        return self.have_yaw and (support < ENOUGH_IMAGES or elsewhere)


def relocate(fixes: Sequence[PositionFix], decorrelation_m: float) -> Relocation | None:
    """The pose at the newest image that most others agree with; None without agreement.

    Only images that the filter rejected count. `decorrelation_m`: see ErrorCorrelation.distance_m.
    """
    rejected = Columns([fix for fix in fixes if not fix.accepted])
    tried = [_agreeing(rejected, *turn) for turn in _turns(rejected)]
    if not tried:
        return None
    agree = max(tried, key=np.count_nonzero)
    best = _fitted(rejected, agree, decorrelation_m)
    oldest_m = fixes[-1].traveled_m - best.distance_m
    recent = [fix.accepted for fix in fixes if fix.traveled_m >= oldest_m]
    against = sum(recent)
    return best._replace(contradicting=against, dissenting=len(recent) - against - best.images)


def _turns(fixes: Columns) -> list[tuple[float, float]]:
    """Turns from dead reckoning to the map, and variances: by headings and by pairs of images."""
    turns = []
    if fixes.has_yaw[-1]:
        turn = float(wrap_angle(fixes.yaw[-1] - fixes.path_yaw[-1]))
        turns.append((turn, float(fixes.yaw_variance[-1])))
    both = fixes.variance + fixes.variance[-1]
    reach = np.abs(fixes.path)
    for i in np.flatnonzero(reach > AGREEING_STDS * np.sqrt(both)):
        turn = float(np.angle((fixes.place[i] - fixes.place[-1]) * np.conj(fixes.path[i])))
        turns.append((turn, float(both[i] / reach[i] ** 2)))
    return turns


def _yaw_residual(fixes: Columns, turn: float) -> Array:
    """Measured headings minus those of dead reckoning after a turn; 0 where there is none."""
    return np.asarray(wrap_angle(fixes.yaw - fixes.path_yaw - turn) * fixes.has_yaw)


def _agreeing(fixes: Columns, turn: float, turn_variance: float) -> NDArray[np.bool_]:
    """Mask of the images that agree with the newest one under a turn."""
    residual = fixes.place - fixes.place[-1] - np.exp(1j * turn) * fixes.path
    variance = fixes.variance + fixes.variance[-1] + fixes.drift
    variance = variance + turn_variance * np.abs(fixes.path) ** 2
    yaw_variance = fixes.yaw_variance + turn_variance + fixes.drift
    near = _yaw_residual(fixes, turn) ** 2 <= AGREEING_STDS**2 * yaw_variance
    return np.asarray(near & (np.abs(residual) ** 2 <= AGREEING_STDS**2 * variance))


def _fitted(fixes: Columns, agree: NDArray[np.bool_], decorrelation_m: float) -> Relocation:
    """Weighted least squares over the agreeing images."""
    has_yaw = agree & fixes.has_yaw
    weight = agree / (fixes.variance + fixes.drift)
    yaw_weight = has_yaw / (fixes.yaw_variance + fixes.drift)
    looks = np.exp(1j * (fixes.yaw - fixes.path_yaw))
    place, turn = aligned(fixes.path, fixes.place, looks, weight, yaw_weight)
    path = turn * centered(fixes.path, weight)
    newest = fixes.place[-1] - place[-1] + path[-1]
    turn_variance = 1 / (weight @ np.abs(path) ** 2 + yaw_weight.sum() + _TINY)
    by_turn = np.array([-path[-1].imag, path[-1].real, 1.0])
    place_variance = 1 / weight.sum()
    covariance = np.diag([place_variance, place_variance, 0.0])
    covariance += turn_variance * np.outer(by_turn, by_turn)
    count = int(agree.sum())
    distance_m = float(fixes.behind_m[agree].max())
    # Neighboring images err alike and count as fewer.
    dependence = max(1.0, count / (1 + distance_m / decorrelation_m))
    yaw = wrap_angle(fixes.path_yaw[-1] + np.angle(turn[0]))
    return Relocation(
        np.array([newest.real, newest.imag, yaw]),
        covariance * dependence,
        count,
        distance_m,
        bool(has_yaw.any()),
    )


def aligned(
    path: Complex, places: Complex, looks: Complex, weight: Array, yaw_weight: Array
) -> tuple[Complex, Complex]:
    """Lay paths (..., N) on places (N,) m, from which both have a shift: the places from their
    weighted mean, and the turns u (..., 1) of the paths.

    With weights w and w', centered places z and path d, and images whose headings are turned by v
    (`looks`) from those of the path, the error sum w |z - u d|^2 + w' |v - u|^2 is least for the u
    along sum w conj(d) z + w' v.
    """
    shown = centered(places, weight)
    turn = summed(weight * np.conj(centered(path, weight)) * shown) + summed(yaw_weight * looks)
    return shown, turn / np.maximum(np.abs(turn), _TINY)


def centered(values: NDArray[Any] | float, weight: Array) -> NDArray[Any]:
    """Values from their mean by weights (..., N)."""
    return np.asarray(values - summed(weight * values) / summed(weight))


def summed(values: NDArray[Any]) -> NDArray[Any]:
    """Sums (..., 1) of values (..., N)."""
    return np.asarray(values.sum(axis=-1, keepdims=True))
