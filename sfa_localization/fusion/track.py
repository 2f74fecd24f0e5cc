# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is remembered of a drive: images beside the path that dead reckoning drove."""

from __future__ import annotations

import math
from typing import NamedTuple

from sfa_localization.data.geometry import wrap_angle

Pose = tuple[float, float, float]
"""x m, y m, yaw rad."""
Knot = tuple[int, float, float, float]
"""Stamp ns, x m, y m, yaw rad by dead reckoning."""
SPACING_M, SPACING_RAD = 0.5, 0.2
"""An image that shows less motion than this, as the odometry does, shows nothing new: neighboring
images err alike."""
WINDOW, WINDOW_M = 32, 12.0
"""Images that are compared, over this distance at most: then the odometry has drifted."""
LONGEST_DELAY_S = 10.0
"""The path is remembered for so long before the first image: images may be late."""
_KNOT_NS, _LONGEST_NS = 100_000_000, 60_000_000_000
_FORGIVEN_M = 30.0
"""An estimate that was right for so long was not moved for nothing."""


class Image(NamedTuple):
    """What one image showed, at x + iy m and `yaw` rad (NaN where unknown), with variances m^2 per
    axis and rad^2, beside the dead-reckoned pose at its stamp.
    """

    stamp_ns: int
    place: complex
    yaw: float
    variance: float
    yaw_variance: float
    dead_reckoned: Pose
    traveled_m: float
    accepted: bool = False

    def fused(self) -> Image:
        """The image after it was accepted."""
        return Image(*self[:-1], True)


class Placing(NamedTuple):
    """The filter was placed anew, by images that it had rejected."""

    stamp_ns: int
    traveled_m: float


class Track(NamedTuple):
    """The path by its `knots`, the images in a window, and where the filter was placed.

    `since_m` is the distance traveled at the first image, before which nothing is confirmed.
    """

    knots: tuple[Knot, ...] = ()
    images: tuple[Image, ...] = ()
    placings: tuple[Placing, ...] = ()
    since_m: float = math.inf

    def driven(self, stamp_ns: int, pose: Pose) -> Track:
        """With the pose that dead reckoning leads to."""
        knots, knot = self.knots, (stamp_ns, *pose)
        if knots and 0 <= stamp_ns - knots[-1][0] < _KNOT_NS:
            return self
        if len(knots) > 1 and knots[-1][1:] == pose == knots[-2][1:]:
            return self._replace(knots=(*knots[:-1], knot))  # it stands
        oldest_ns = self.images[0].stamp_ns if self.images else stamp_ns
        oldest_ns -= round(LONGEST_DELAY_S * 1e9)
        first = 0
        while first + 1 < len(knots) and knots[first + 1][0] <= oldest_ns:
            first += 1
        return self._replace(knots=(*knots[first:], knot))

    def seen(self, image: Image) -> Track:
        """With one more image, if it shows something new."""
        images = self.images
        if not images:
            return self._replace(images=(image,), since_m=min(self.since_m, image.traveled_m))
        if not _is_new(images[-1], image):
            return self
        first = max(len(images) + 1 - WINDOW, 0)
        while first < len(images) and (
            image.traveled_m - images[first].traveled_m > WINDOW_M
            or image.stamp_ns - images[first].stamp_ns > _LONGEST_NS
        ):
            first += 1
        return self._replace(images=(*images[first:], image))

    def interrupted(self) -> Track:
        """After a silence of the odometry: the path begins anew."""
        return Track((), (), self.placings, self.since_m)

    def trusted(self) -> Track:
        """After the pose was set from outside, by somebody who knows."""
        return Track(self.knots, since_m=-math.inf)

    def placed(self, stamp_ns: int, traveled_m: float) -> Track:
        """After images placed the filter anew."""
        kept = (item for item in self.placings if traveled_m - item.traveled_m < _FORGIVEN_M)
        return self._replace(placings=(*kept, Placing(stamp_ns, traveled_m)))


def _is_new(last: Image, image: Image) -> bool:
    """Whether the robot moved between two images, by the odometry, or by more than they may err."""
    seen_m = abs(image.place - last.place) - 3 * math.sqrt(last.variance + image.variance)
    turned = abs(float(wrap_angle(image.dead_reckoned[2] - last.dead_reckoned[2])))
    way_m = max(abs(image.traveled_m - last.traveled_m), seen_m)
    return way_m >= SPACING_M or turned >= SPACING_RAD
