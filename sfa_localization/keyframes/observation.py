# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What one image shows of the robot's pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import UNKNOWN_YAW_STD

UNKNOWN_YAW_VARIANCE = UNKNOWN_YAW_STD**2
"""rad^2, of an unknown angle."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What one image shows: `pose` (3,) [x m, y m, yaw rad] in the map and its `covariance` (3, 3),
    in which an unknown yaw has UNKNOWN_YAW_VARIANCE.

    `explained` is the part of the image that its place explains, 0 to 1: of foreign images 0.1,
    0.28 at most. `problem` says why the image at `stamp_ns` is unusable, '' where it is usable: the
    covariance of an unusable one means that nothing is known. `turned` is the heading (rad, from
    any start) by the shifts between successive images, NaN for an unusable one: it needs no map,
    and shows the camera's delay. `tilt` (2,) rad is the roll and pitch of the robot, relative to
    the training. `drowned` is the share of the columns that light drowns: they are not compared.
    """

    pose: Array
    covariance: Array
    slow_features: Array
    explained: float = 0.0
    stamp_ns: int = 0
    problem: str = ''
    turned: float = math.nan
    tilt: Array = field(default_factory=lambda: np.zeros(2))
    drowned: float = 0.0

    @property
    def position(self) -> Array:
        """Where the robot is, (2,) m."""
        return self.pose[:2]

    @property
    def yaw(self) -> float:
        """Its heading, rad; NaN where unknown."""
        return float(self.pose[2]) if self.covariance[2, 2] < UNKNOWN_YAW_VARIANCE else math.nan

    @property
    def finite(self) -> bool:
        """Whether all of its numbers are."""
        parts = self.slow_features, self.pose, self.covariance
        return all(bool(np.isfinite(part).all()) for part in parts)
