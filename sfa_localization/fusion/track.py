# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is remembered of a drive: position fixes by images beside the dead-reckoned path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import wrap_angle

Pose = tuple[float, float, float]
"""x m, y m, yaw rad."""
Knot = tuple[int, float, float, float]
"""Stamp ns, x m, y m, yaw rad by dead reckoning."""
SPACING_M, SPACING_RAD = 0.5, 0.2
"""An image that shows less motion than this shows nothing new: neighboring images err alike."""
LATEST, CAPACITY = 30, 60
"""All of the LATEST images are kept, of older ones those that show something new, CAPACITY in all.
"""
REACH_M, REACH_STDS = 12.0, 30.0
"""Images farther behind, in m and in standard deviations of the newest, are forgotten: there the
odometry has drifted."""
LONGEST_DELAY_S = 10.0
"""The path is remembered for so long before the first image: images may be late."""
ODOMETRY_DRIFT = 0.05
"""Allowed error of odometry per meter, m and rad: the 5 % of a poor robot."""
_KNOT_NS = 100_000_000
_FORGIVEN_M = 30.0
"""An estimate that was right for so long was not moved for nothing."""


class PositionFix(NamedTuple):
    """What one image showed, at x + iy m and `yaw` rad (NaN where unknown), with variances m^2 per
    axis and rad^2, beside the dead-reckoned pose at its stamp. `is_new`: the robot had moved.
    """

    stamp_ns: int
    place: complex
    yaw: float
    variance: float
    yaw_variance: float
    dead_reckoned: Pose
    traveled_m: float
    accepted: bool = False
    is_new: bool = True


def remembered(fixes: tuple[PositionFix, ...], newest: PositionFix) -> tuple[PositionFix, ...]:
    """The fixes with one more, without what is too far behind."""
    last = newest_new(fixes)
    if last is not None:
        turn = abs(float(wrap_angle(newest.dead_reckoned[2] - last.dead_reckoned[2])))
        moved_m = newest.traveled_m - last.traveled_m
        newest = newest._replace(is_new=moved_m >= SPACING_M or turn >= SPACING_RAD)
    reach_m = max(REACH_M, REACH_STDS * math.sqrt(newest.variance))
    near = [fix for fix in fixes if newest.traveled_m - fix.traveled_m <= reach_m]
    latest = (*near, newest)[-LATEST:]
    older = near[: len(near) + 1 - len(latest)]
    if len(older) + len(latest) > CAPACITY:
        older = [fix for fix in older if fix.is_new][LATEST - CAPACITY :]
    return (*older, *latest)


def newest_new(fixes: Sequence[PositionFix]) -> PositionFix | None:
    """The latest fix that showed something new."""
    return next((fix for fix in reversed(fixes) if fix.is_new), None)


class Columns:
    """Fixes as arrays (N,), the newest last: `place`, and the dead-reckoned `path` from the newest
    one, as complex numbers in the plane, `yaw` with the mask `has_yaw`, variances, and meters
    `behind_m`.
    """

    def __init__(self, fixes: Sequence[PositionFix]) -> None:
        self.stamps_ns = np.array([fix.stamp_ns for fix in fixes])
        self.place = np.array([fix.place for fix in fixes])
        rows = [(*f.dead_reckoned, f.yaw, f.variance, f.yaw_variance, f.traveled_m) for f in fixes]
        x, y, self.path_yaw, yaw, self.variance, self.yaw_variance, traveled_m = np.array(rows).T
        self.path, self.behind_m = x - x[-1] + 1j * (y - y[-1]), traveled_m[-1] - traveled_m
        self.has_yaw: NDArray[np.bool_] = np.isfinite(yaw)
        self.yaw = np.where(self.has_yaw, yaw, 0.0)
        self.drift = (ODOMETRY_DRIFT * self.behind_m) ** 2


class DrivenPath(NamedTuple):
    """The path by its `knots`, and where images placed the filter anew, `placed_m` traveled.

    `since_m` is the distance traveled at the first image, before which nothing is confirmed.
    """

    knots: tuple[Knot, ...] = ()
    placed_m: tuple[float, ...] = ()
    since_m: float = math.inf

    def driven(self, stamp_ns: int, pose: Pose, oldest_ns: int) -> DrivenPath:
        """With the pose that dead reckoning leads to; what is older than `oldest_ns` goes."""
        knots, knot = self.knots, (stamp_ns, *pose)
        if knots and 0 <= stamp_ns - knots[-1][0] < _KNOT_NS:
            return self
        if len(knots) > 1 and knots[-1][1:] == pose == knots[-2][1:]:
            return self._replace(knots=(*knots[:-1], knot))  # the robot stands
        oldest_ns -= round(LONGEST_DELAY_S * 1e9)
        first = 0
        while first + 1 < len(knots) and knots[first + 1][0] <= oldest_ns:
            first += 1
        return self._replace(knots=(*knots[first:], knot))

    def placed(self, traveled_m: float) -> DrivenPath:
        """After images placed the filter anew, here."""
        recent = (before for before in self.placed_m if traveled_m - before < _FORGIVEN_M)
        return self._replace(placed_m=(*recent, traveled_m))
