# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the filter believes and remembers, and the events that change it: all immutable."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import Quantity
from sfa_localization.fusion.inputs import symmetric
from sfa_localization.fusion.motion import State, Twist
from sfa_localization.fusion.track import Image, Pose, Track

ENOUGH_IMAGES = 5
"""Images in a row that overrule an established estimate: half a second to a second of a camera."""
DOUBT_STDS = 2.0
"""While lost, the difference from the images is taken as an error of so many sigma (95 %)."""


class OdometryEvent(NamedTuple):
    """An odometry reading at its stamp; `pose` is the message's own, in the odometry frame."""

    stamp_ns: int
    twist: Twist
    pose: Pose | None = None


class Jump(NamedTuple):
    """A step of the odometry, m and rad beyond what a robot can do."""

    stamp_ns: int
    way_m: float
    turn_rad: float


class Odometer(NamedTuple):
    """What is remembered of the odometry: the stamp and pose of its last message, the stamps at
    which position and heading were last renewed (0 where never), whether its twist is filled, and
    the standard deviation `noise` (m, rad) of its steps. A `suspect` is a message after an
    impossible step, which the next one confirms, or not; `jump` is the last one confirmed.
    """

    stamp_ns: int | None = None
    pose: Pose | None = None
    renewed_ns: tuple[int, int] = (0, 0)
    fills_twist: bool = True
    noise: float = 0.01
    suspect: OdometryEvent | None = None
    jump: Jump | None = None


class PoseEvent(NamedTuple):
    """A pose (3,) set from outside, with its covariance (3, 3)."""

    stamp_ns: int
    pose: Array
    covariance: Array


class MeasurementEvent(NamedTuple):
    """A position (2,) or pose (3,) from an image, with its covariance.

    It is fused `late`, s, earlier than expected of its stamp: what turns of the images show, with
    an infinite standard deviation where they show nothing. `jacobian` (2 or 3, 12) and `white`, the
    part of the noise that is this image's own, follow from the covariance: see
    ekf.measurement_event.
    """

    stamp_ns: int
    value: Array
    covariance: Array
    jacobian: Array
    white: Array
    late: Quantity


class DelayEvent(NamedTuple):
    """An image `late` by more than is compensated, s: where it shows the robot is left out."""

    stamp_ns: int
    late: Quantity


Event = OdometryEvent | PoseEvent | MeasurementEvent | DelayEvent


class Update(NamedTuple):
    """What became of one measurement.

    `d2` is the squared Mahalanobis distance of the full innovation, with `threshold` its gate;
    both NaN where there was nothing to compare with. `innovation` (2,) or (3,) with its covariance.
    """

    stamp_ns: int
    accepted: bool
    d2: float
    threshold: float
    reason: str
    innovation: Array | None = None
    covariance: Array | None = None


class Memory(NamedTuple):
    """The record of measurements since the last start.

    `support` counts accepted images, `rejected` those outside the gate in a row. `accepted_ns` is
    the stamp of the last accepted image; `images` are the latest. `scatter`, the usual squared
    distance of images over that expected, and `period_s`, the usual time between images, outlive
    restarts.
    """

    support: int = 0
    rejected: int = 0
    accepted_ns: int | None = None
    images: tuple[Image, ...] = ()
    update: Update | None = None
    scatter: float = 1.0
    period_s: float = 1.0


class Belief(NamedTuple):
    """Everything that the next event changes. `located` is False before the first pose.

    `omega` rad/s is the mean turn rate, as odometry shows it, over the time before its last
    message. `track` is the path beside images.
    """

    stamp_ns: int
    mean: Array
    covariance: Array
    located: bool
    dead_reckoned: Pose
    traveled_m: float
    twist: Twist
    odometry: Odometer
    memory: Memory
    track: Track = Track()
    omega: float = 0.0

    @property
    def state(self) -> State | None:
        """The estimate, if there is any. While images in a row were rejected, it is as uncertain as
        the last differs from it; the gate is not: wrong images must not open it.
        """
        if not self.located:
            return None
        covariance, update = symmetric(self.covariance), self.memory.update
        if self.memory.rejected >= ENOUGH_IMAGES and update and update.innovation is not None:
            x, y, *yaw = (update.innovation / DOUBT_STDS).tolist()
            covariance[:3, :3] += np.diag([x * x + y * y] * 2 + [sum(turn**2 for turn in yaw)])
        return State(self.stamp_ns, self.mean, covariance)
