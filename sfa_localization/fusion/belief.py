# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the filter believes and remembers, and the events that change it: all immutable."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import Quantity
from sfa_localization.fusion.motion import State, Twist
from sfa_localization.fusion.track import DrivenPath, Pose, PositionFix

ENOUGH_IMAGES = 5
"""Images in a row that overrule an established estimate: half a second to a second of a camera."""
DOUBT_STDS = 2.0
"""While lost, the difference from the images is taken as an error of so many sigma (95 %)."""


class OdometryEvent(NamedTuple):
    """An odometry reading at its stamp; `pose` is the message's, in the odometry frame."""

    stamp_ns: int
    twist: Twist
    pose: Pose | None = None


class Jump(NamedTuple):
    """A step of the odometry, m and rad beyond what a robot can do."""

    stamp_ns: int
    way_m: float
    turn_rad: float


class Odometer(NamedTuple):
    """Stamp and pose of the odometry's last message, the stamp at which the pose last changed (0:
    never), whether the twist is filled, and the standard deviation `noise` (m, rad) of the steps.

    A `suspect` is a message after an impossible step, which waits until the next one confirms it;
    `jump` is the last step that was confirmed.
    """

    stamp_ns: int | None = None
    pose: Pose | None = None
    renewed_ns: int = 0
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
    """A position (2,) or pose (3,) from an image, with its positive definite covariance.

    `late` is the delay of the camera by the turns of the images, s, beyond the expected one; its
    standard deviation is infinite before any turn.
    """

    stamp_ns: int
    value: Array
    covariance: Array
    late: Quantity


class DelayEvent(NamedTuple):
    """An image that is left out because it is `late` by more than can be compensated, s."""

    stamp_ns: int
    late: Quantity


Event = OdometryEvent | PoseEvent | MeasurementEvent | DelayEvent


class Update(NamedTuple):
    """What became of one measurement.

    `d2` is the squared Mahalanobis distance of the full innovation, `threshold` its gate; both are
    NaN where there was nothing to compare with. `innovation` (2,) or (3,) with its covariance.
    """

    stamp_ns: int
    accepted: bool
    d2: float
    threshold: float
    reason: str
    innovation: Array | None = None
    covariance: Array | None = None


class Memory(NamedTuple):
    """The record of measurements since the last start: `support` counts accepted images, `rejected`
    those outside the gate in a row; `accepted_ns` is the stamp of the last accepted image.
    """

    support: int = 0
    rejected: int = 0
    accepted_ns: int | None = None
    images: tuple[PositionFix, ...] = ()
    update: Update | None = None


class Belief(NamedTuple):
    """Everything that the next event changes. `located` is False before the first pose."""

    stamp_ns: int
    mean: Array
    covariance: Array
    located: bool
    dead_reckoned: Pose
    traveled_m: float
    twist: Twist
    odometry: Odometer
    memory: Memory
    path: DrivenPath = DrivenPath()

    @property
    def state(self) -> State | None:
        """The estimate, if there is any. While images in a row are rejected, its variance includes
        the last innovation; that of the gate does not, so that wrong images cannot open it.
        """
        if not self.located:
            return None
        covariance, update = symmetric(self.covariance), self.memory.update
        if self.memory.rejected >= ENOUGH_IMAGES and update and update.innovation is not None:
            squares = np.square(update.innovation / DOUBT_STDS)
            covariance[[0, 1], [0, 1]] += squares[:2].sum()
            covariance[2, 2] += squares[2:].sum()
        return State(self.stamp_ns, self.mean, covariance)


def symmetric(matrix: Array) -> Array:
    """The symmetric part."""
    return (matrix + matrix.T) / 2
