# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The belief of the filter, its estimate and record, and the events that change it: immutable."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.fusion.driven_path import Knot
from sfa_localization.fusion.inputs import symmetric
from sfa_localization.fusion.lateness import Lateness
from sfa_localization.fusion.motion import SIZE, State, Twist
from sfa_localization.fusion.mounting import Mounting
from sfa_localization.fusion.turn_noise import TurnNoise

LARGEST_STD_M = 100.0
"""The standard deviation of the position never exceeds this: larger than the places mapped."""
_NO_DOUBT = (0.0, 0.0, 0.0)


class OdometryEvent(NamedTuple):
    """An odometry reading at its stamp; `pose` is the message's own, in the odometry frame."""

    stamp_ns: int
    twist: Twist
    pose: tuple[float, float, float] | None = None


class PoseEvent(NamedTuple):
    """A pose (3,) set from outside, with its covariance (3, 3)."""

    stamp_ns: int
    pose: Array
    covariance: Array


class MeasurementEvent(NamedTuple):
    """A position (2,) or pose (3,) from an image, with its covariance. `apart`: turns show another
    time or robot.

    `jacobian` (2 or 3, 10) and `white`, the part of the noise that is this image's own, follow
    from the covariance: see update.measurement_event.
    """

    stamp_ns: int
    value: Array
    covariance: Array
    jacobian: Array
    white: Array
    apart: bool = False


Event = OdometryEvent | PoseEvent | MeasurementEvent


class Update(NamedTuple):
    """What became of one measurement.

    `d2` is the squared Mahalanobis distance of the full innovation, with `threshold` its gate;
    both NaN where there was nothing to compare with. `innovation` (2,) or (3,) with its covariance.
    `far`: if the measurement is right, the estimate is LOST.
    """

    stamp_ns: int
    accepted: bool
    d2: float
    threshold: float
    reason: str
    innovation: Array | None = None
    covariance: Array | None = None
    far: bool = False


class Evidence(NamedTuple):
    """A measurement beside the dead-reckoned pose at its stamp; yaw is NaN where unknown."""

    dead_reckoned: tuple[float, float, float]
    traveled_m: float
    position: tuple[float, float]
    yaw: float
    variance: float
    yaw_variance: float
    accepted: bool


COMPARED_IMAGES = 5
"""Images that show whether they move as the odometry does, and look in that direction."""


class Trust(NamedTuple):
    """Images over the last meters, and how they contradict the odometry's motion, '' if not;
    `judged` are those enough to do so.

    With a problem, `misfit` are the standard deviations (m, rad) by which they do. `moves` counts
    how often images moved the estimate elsewhere lately, `moved_m` is the distance traveled when
    they did it last, and `contradicted_m` when they contradicted the motion since, before the
    estimate was confirmed, as they have from `doubted_m` on; until an image fits `confirming_m`
    later, `jump_m` is the standard deviation of being wrong. `proven`: an estimate before the last
    move was confirmed.
    """

    recent: tuple[Evidence, ...] = ()
    judged: bool = False
    problem: str = ''
    misfit: tuple[float, float] = (0.0, 0.0)
    moves: int = 0
    moved_m: float = 0.0
    confirming_m: float = 0.0
    jump_m: float = 0.0
    contradicted_m: float = 0.0
    doubted_m: float = 0.0
    proven: bool = False

    @property
    def since_m(self) -> float:
        """The distance traveled from which on images confirm the estimate."""
        return max(self.moved_m, self.contradicted_m)

    def unconfirmed(self, accepted_m: float) -> bool:
        """Whether no image has fitted yet that far from where images moved the estimate, or
        contradicted it, or those since then could not be compared with the odometry's motion.
        """
        unjudged = not self.judged and self.confirming_m > 0.0
        return unjudged or accepted_m - self.since_m < self.confirming_m

    def variances(self, accepted_m: float) -> tuple[float, float, float]:
        """Of x, y and yaw, on top, while the estimate is not trusted."""
        off_m, off_rad = self.misfit if self.problem else (0.0, 0.0)
        position = off_m**2 + (self.jump_m**2 if self.unconfirmed(accepted_m) else 0.0)
        return position, position, off_rad**2


class Pull(NamedTuple):
    """On which side of the estimate accepted images have lain over the last meters, until
    `traveled_m`: the mean x + i y of their innovations, in standard deviations, and in m
    (`offset_m`). `suspected`: it is no chance.
    """

    mean: complex
    offset_m: complex
    traveled_m: float
    suspected: bool = False

    @property
    def variance(self) -> float:
        """Of the position along each axis, on top, while the estimate is not trusted."""
        return abs(self.offset_m) ** 2 / 2 if self.suspected else 0.0


class Memory(NamedTuple):
    """The record of measurements: accepted ones, those rejected in a row, and where they lay.

    `support` counts accepted images since the last start, and `precise_ns` is the stamp of the last
    that shows the place well by itself; `rejected` those outside the gate in a
    row, `gate_excess` is d2 / threshold of the last. `outage`: they followed a long time without
    images. `doubt` are variances (x, y, yaw) that the published covariance has on top. `trust`,
    `scatter`, the usual squared distance of images over that expected, and `period_s`, the usual
    time between images, outlive restarts; `pull` does not.
    """

    support: int = 0
    rejected: int = 0
    gate_excess: float = 0.0
    accepted_ns: int | None = None
    accepted_m: float = 0.0
    precise_ns: int | None = None
    outage: bool = False
    doubt: tuple[float, float, float] = _NO_DOUBT
    evidence: tuple[Evidence, ...] = ()
    update: Update | None = None
    trust: Trust = Trust()
    scatter: float = 1.0
    period_s: float = 1.0
    pull: Pull | None = None


class Belief(NamedTuple):
    """Everything that the next event changes. `located` is False before the first pose.

    `added` are the variances that driving has added so far, to the heading (as expected, without
    the factor of `turns`) and to the position along each axis. `trail` is the dead-reckoned path of
    the last seconds, `lateness` what images beside it show about their time, and `mounting` where
    they show the camera on the robot. `omega` rad/s is the mean turn rate, as odometry shows it,
    over the time before its last message.
    """

    stamp_ns: int
    mean: Array
    covariance: Array
    located: bool
    dead_reckoned: tuple[float, float, float]
    traveled_m: float
    twist: Twist
    odometry_ns: int | None
    memory: Memory
    odometry_pose: tuple[float, float, float] | None = None
    added: tuple[float, float] = (0.0, 0.0)
    turns: TurnNoise | None = None
    turn_factor: float = 1.0
    trail: tuple[Knot, ...] = ()
    lateness: Lateness | None = None
    mounting: Mounting | None = None
    omega: float = 0.0

    @property
    def state(self) -> State | None:
        """The estimate, if there is any.

        Doubt and distrust widen what is published, not the gate: wrong images must not open it.
        """
        if not self.located:
            return None
        covariance = symmetric(self.covariance)
        if self.memory.doubt is not _NO_DOUBT:
            covariance[:3, :3] += np.diag(self.memory.doubt)
        trust = self.memory.trust
        if trust.problem or trust.confirming_m:
            covariance[:3, :3] += np.diag(trust.variances(self.memory.accepted_m))
        if self.memory.pull is not None:
            covariance[:2, :2] += self.memory.pull.variance * np.eye(2)
        if self.mounting is not None and self.mounting.suspected:
            covariance[:2, :2] += self.mounting.variance * np.eye(2)
        return State(self.stamp_ns, self.mean, covariance)


def capped(covariance: Array) -> Array:
    """A covariance (11, 11) with the pose's standard deviations held at LARGEST_STD_M and pi.

    The correlations stay what they are.
    """
    stds = np.sqrt(np.diag(covariance)[:3])
    factor = np.ones(SIZE)
    factor[:3] = np.minimum(1.0, np.array([LARGEST_STD_M, LARGEST_STD_M, math.pi]) / stds)
    return np.asarray(covariance * np.outer(factor, factor))
