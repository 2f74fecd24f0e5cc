# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the filter believes and remembers, and the events that change it: all immutable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.odometry_steps import NOISE_START
from sfa_localization.data.rig import Quantity
from sfa_localization.fusion.motion import Pace, State, Twist

Pose = tuple[float, float, float]
"""x m, y m, yaw rad."""
Knot = tuple[int, float, float, float]
"""Stamp ns, x m, y m, yaw rad by dead reckoning."""
SPACING_M = 0.5
SPACING_RAD = 0.2
LATEST = 30
CAPACITY = 60
"""An image that shows less motion than this is not new: neighboring images err alike. All of the
LATEST images are kept, of older ones those that are new, CAPACITY in all."""
REACH_M = 12.0
REACH_STDS = 30.0
"""Images farther behind, in m and in standard deviations of the newest, are forgotten: there the
odometry has drifted."""
LONGEST_DELAY_S = 10.0
"""The path is remembered for so long before the first image: images may be late."""
ODOMETRY_DRIFT = 0.05
"""Allowed error of odometry per meter, m and rad: the 5 % of a poor robot."""
_KNOT_NS = 100_000_000
_FORGIVEN_M = 30.0  # an estimate that was right for so long was not moved for nothing
ENOUGH_IMAGES = 5
"""Images in a row that overrule an established estimate: half a second to a second of a camera."""
DOUBT_STDS = 2.0
"""While lost, the last innovation counts as an error of so many standard deviations (95 %)."""


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
    noise: float = NOISE_START
    suspect: OdometryEvent | None = None
    jump: Jump | None = None


class PoseEvent(NamedTuple):
    """A pose (3,) set from outside, with its covariance (3, 3)."""

    stamp_ns: int
    pose: Array
    covariance: Array


class MeasurementEvent(NamedTuple):
    """A position (2,) or pose (3,) from an image, with its positive definite covariance.

    By the turns of the images: `late` is the delay of the camera, s, beyond the expected one, and
    `turn_factor` true over counted turns; before any turn, the standard deviations are infinite.
    """

    stamp_ns: int
    value: Array
    covariance: Array
    late: Quantity
    turn_factor: Quantity = Quantity(1.0, math.inf)


Event = OdometryEvent | PoseEvent | MeasurementEvent


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


class PositionFix(NamedTuple):
    """What one image showed, at x + iy m and `yaw` rad (NaN where unknown), with variances m^2 per
    axis and rad^2, beside the dead-reckoned pose at its stamp. `is_new`: the robot had moved.
    `is_reckoned`: odometry of its time had come; else the pose is a guess by the last speed.
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
    is_reckoned: bool = True


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
    # test_of_what_is_remembered_the_newer_half_is_complete_and_the_older_reaches_far
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
        self.path = x - x[-1] + 1j * (y - y[-1])
        self.behind_m = traveled_m[-1] - traveled_m
        self.has_yaw: NDArray[np.bool_] = np.isfinite(yaw)
        self.yaw = np.where(self.has_yaw, yaw, 0.0)
        self.drift = (ODOMETRY_DRIFT * self.behind_m) ** 2


class DrivenPath(NamedTuple):
    """The path by its `knots`, and the distances traveled, `placed_m`, where images placed the
    filter: at the start, and anew.
    """

    knots: tuple[Knot, ...] = ()
    placed_m: tuple[float, ...] = (math.inf,)

    def driven(self, stamp_ns: int, pose: Pose, oldest_ns: int) -> DrivenPath:
        """With the pose that dead reckoning leads to; what is older than `oldest_ns` goes."""
        knots = self.knots
        knot = (stamp_ns, *pose)
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
        start_m, *anew_m = self.placed_m
        recent_m = (before for before in anew_m if traveled_m - before < _FORGIVEN_M)
        return self._replace(placed_m=(start_m, *recent_m, traveled_m))


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
    """Everything that the next event changes. `located` is False before the first pose;
    `counted_rad` is how far the odometry has turned, uncorrected."""

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
    pace: Pace = Pace()
    counted_rad: float = 0.0

    @property
    def state(self) -> State | None:
        """The estimate, if there is any. While images in a row are rejected, its variance includes
        the last innovation; that of the gate does not, so that wrong images cannot open it.
        """
        if not self.located:
            return None
        covariance = symmetric(self.covariance)
        update = self.memory.update
        if self.memory.rejected >= ENOUGH_IMAGES and update and update.innovation is not None:
            squares = np.square(update.innovation / DOUBT_STDS)
            covariance[[0, 1], [0, 1]] += squares[:2].sum()
            covariance[2, 2] += squares[2:].sum()
        return State(self.stamp_ns, self.mean, covariance)


def symmetric(matrix: Array) -> Array:
    """The symmetric part."""
    return (matrix + matrix.T) / 2
