# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is remembered of a drive: images beside the path that dead reckoning drove."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Pose = tuple[float, float, float]
"""x m, y m, yaw rad."""
Knot = tuple[int, float, float, float]
"""Stamp ns, x m, y m, yaw rad by dead reckoning."""
SPACING_M, SPACING_RAD = 0.5, 0.2
"""An image that shows less motion than this, as the odometry does, shows nothing new: neighboring
images err alike."""
LATEST, CAPACITY = 30, 60
"""Of the images before the LATEST only those that show something new are kept, CAPACITY in all."""
REACH_M, REACH_STDS = 12.0, 30.0
"""Images farther behind, in m and in standard deviations of the newest, are forgotten: there the
odometry has drifted."""
LONGEST_DELAY_S = 10.0
"""The path is remembered for so long before the first image: images may be late."""
ODOMETRY_DRIFT = 0.05
"""Error of odometry that is allowed for, per meter: m, and rad; a poor robot's 5 %."""
_KNOT_NS = 100_000_000
_FORGIVEN_M = 30.0
"""An estimate that was right for so long was not moved for nothing."""


class Image(NamedTuple):
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


def remembered(images: tuple[Image, ...], newest: Image) -> tuple[Image, ...]:
    """The images with one more, without what is too far behind."""
    last = newest_new(images)
    if last is not None and not _moved(last, newest):
        newest = Image(*newest[:-1], False)
    reach_m, first = max(REACH_M, REACH_STDS * math.sqrt(newest.variance)), 0
    while first < len(images) and newest.traveled_m - images[first].traveled_m > reach_m:
        first += 1
    kept = (*images[first:], newest)
    if len(kept) <= CAPACITY:
        return kept
    older = [image for image in kept[:-LATEST] if image.is_new]
    return (*older[LATEST - CAPACITY :], *kept[-LATEST:])


def newest_new(images: Sequence[Image]) -> Image | None:
    """The latest image that showed something new."""
    for image in reversed(images):
        if image.is_new:
            return image
    return None


def _moved(last: Image, image: Image) -> bool:
    turn = math.remainder(image.dead_reckoned[2] - last.dead_reckoned[2], 2 * math.pi)
    return image.traveled_m - last.traveled_m >= SPACING_M or abs(turn) >= SPACING_RAD


class Columns:
    """Images as arrays (N,), the newest last: `place`, and the dead-reckoned `path` from the newest
    one, as complex numbers in the plane, `yaw` with the mask `has_yaw`, variances, and meters
    `behind_m`.
    """

    def __init__(self, images: Sequence[Image]) -> None:
        self.stamps_ns = np.array([image.stamp_ns for image in images])
        self.place = np.array([image.place for image in images])
        rows = [(*i.dead_reckoned, i.yaw, i.variance, i.yaw_variance, i.traveled_m) for i in images]
        x, y, self.path_yaw, yaw, self.variance, self.yaw_variance, traveled_m = np.array(rows).T
        self.path, self.behind_m = x - x[-1] + 1j * (y - y[-1]), traveled_m[-1] - traveled_m
        self.has_yaw: NDArray[np.bool_] = np.isfinite(yaw)
        self.yaw = np.where(self.has_yaw, yaw, 0.0)
        self.drift = (ODOMETRY_DRIFT * self.behind_m) ** 2


class Track(NamedTuple):
    """The path by its `knots`, and where images placed the filter anew, `placed_m` traveled.

    `since_m` is the distance traveled at the first image, before which nothing is confirmed.
    """

    knots: tuple[Knot, ...] = ()
    placed_m: tuple[float, ...] = ()
    since_m: float = math.inf

    def driven(self, stamp_ns: int, pose: Pose, oldest_ns: int) -> Track:
        """With the pose that dead reckoning leads to; what is older than `oldest_ns` goes."""
        knots, knot = self.knots, (stamp_ns, *pose)
        if knots and 0 <= stamp_ns - knots[-1][0] < _KNOT_NS:
            return self
        if len(knots) > 1 and knots[-1][1:] == pose == knots[-2][1:]:
            return self._replace(knots=(*knots[:-1], knot))  # it stands
        oldest_ns -= round(LONGEST_DELAY_S * 1e9)
        first = 0
        while first + 1 < len(knots) and knots[first + 1][0] <= oldest_ns:
            first += 1
        return self._replace(knots=(*knots[first:], knot))

    def placed(self, traveled_m: float) -> Track:
        """After images placed the filter anew, here."""
        kept = (before for before in self.placed_m if traveled_m - before < _FORGIVEN_M)
        return self._replace(placed_m=(*kept, traveled_m))
