# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter: odometry drives a CTRV extended Kalman filter, pictures correct it at their stamp.

One class serves the live node, the command line and the evaluation. What it believes after any
set of messages depends on their stamps, not on the order or the pace in which they came, as long
as none is older than `FilterConfig.history`.
"""

from __future__ import annotations

import enum
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.fusion.camera_clock import CameraClock, CameraClockFinder
from sfa_localization.fusion.history import History
from sfa_localization.fusion.inputs import read_measurement, read_pose, read_twist
from sfa_localization.fusion.motion import State
from sfa_localization.fusion.rules import (
    DISTRUST_AFTER,
    Belief,
    Event,
    Fusion,
    OdometryEvent,
    PoseEvent,
    Update,
)
from sfa_localization.fusion.settings import FilterConfig, resolved

__all__ = ['Level', 'PoseFilter', 'State', 'Status', 'Update']

_ODOMETRY, _POSE, _MEASUREMENT = range(3)
_BACKWARD = 5
_AHEAD = 3
_FAR_OUTSIDE = 4.0
_MOVED_ON = 0.5
DELAY_LIMIT_NS = 500_000_000
"""Delay of the camera's stamps, either way, that is made up for."""
_APART = 'clocks of camera and odometry are more than 0.5 s apart'
# Some minutes of image pairs: clocks drift.
_CAMERA_MEMORY = 1000.0
_EXPECTED_STD_S = 0.05


class Level(enum.Enum):
    """How far the estimate can be trusted."""

    UNINITIALISED = 0
    LOCALISED = 1
    DEGRADED = 2
    LOST = 3


@dataclass(frozen=True, slots=True)
class Status:
    """The level and why it is not better."""

    level: Level
    reasons: tuple[str, ...] = ()


class PoseFilter:
    """Fuses odometry with positions (2,) or poses (3,) in the map; see FilterConfig.

    `correlation` is what is known of the pictures' errors where the settings leave it open.
    `counts` tells what became of all that came in. No message raises; what is unusable is counted.
    """

    def __init__(
        self, config: FilterConfig | None = None, correlation: ErrorCorrelation | None = None
    ) -> None:
        self.config = config or FilterConfig()
        self.counts: Counter[str] = Counter()
        self._correlation = correlation
        self._camera = CameraClockFinder(_CAMERA_MEMORY)
        self._fusion = Fusion(resolved(self.config, correlation))
        self._history = self._fresh(self._fusion.blank(0))
        self._forget()

    def reset(self) -> None:
        """Forget everything but the counts, and start as after construction."""
        self.counts['reset'] += 1
        self._forget()

    def reconfigure(self, config: FilterConfig) -> None:
        """Go on with other parameters, from what is believed now."""
        belief, newest_ns = self._history.newest, self._history.newest_ns
        self.config, self._fusion = config, Fusion(resolved(config, self._correlation))
        self._history = self._fresh(belief, newest_ns)

    def correlate(self, correlation: ErrorCorrelation) -> None:
        """Go on with what a model knows of how its errors hang together."""
        if correlation != self._correlation:
            self._correlation = correlation
            self.reconfigure(self.config)

    def _forget(self) -> None:
        # Stamps may start anew; the camera's delay stays what it was.
        self._camera = CameraClockFinder(_CAMERA_MEMORY, self._camera.clock)
        self._history = self._fresh(self._fusion.blank(0))
        self._backward = 0
        self._ahead = (0, 0)
        self._pending: tuple[Array, Array] | None = None
        if self.config.set_initial_pose:
            config = self.config
            pose = np.array([config.initial_x, config.initial_y, config.initial_yaw])
            self._pending = pose, self._initial_covariance()

    def _fresh(self, start: Belief, start_ns: int | None = None) -> History[Event, Belief]:
        span_ns = round(self.config.history * 1e9)
        return History(span_ns, start, self._fusion.step, start_ns)

    def _initial_covariance(self) -> Array:
        position, yaw = self.config.initial_position_std, self.config.initial_yaw_std
        return np.diag(np.square([position, position, yaw]))

    # What comes in.

    def initialise(
        self, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike | None = None
    ) -> None:
        """Set the pose (3,) in the map at a stamp; covariance (3, 3), or the configured one.

        A stamp that does not fit those of the messages, before or after, gives way to theirs.
        Raises DataError for a pose or covariance that is none.
        """
        told = self._initial_covariance() if covariance is None else covariance
        value, spread = read_pose(pose, told)
        self.counts['pose set'] += 1
        newest = self._history.newest_ns
        if newest is None or self._pending is not None:
            self._forget()
            self._pending = value, spread
            self._history.add((int(stamp_ns), _POSE), PoseEvent(int(stamp_ns), value, spread))
            return
        near = abs(stamp_ns - newest) <= self.config.coast_time * 1e9
        stamp_ns = int(stamp_ns) if near and self._history.reaches(stamp_ns) else newest
        self._history.add((stamp_ns, _POSE), PoseEvent(stamp_ns, value, spread))

    def add_odometry(
        self,
        stamp_ns: int,
        v: float,
        omega: float,
        variances: Sequence[float] | Array = (0.0, 0.0),
        pose: Sequence[float] | Array | None = None,
    ) -> str:
        """Take speed m/s and turn rate rad/s, held since the message before; '' or why not.

        `variances` (2,) of both; zero or less, or not finite, where unknown. `pose` (3,) is
        odometry's own, x m, y m, yaw rad in any frame: where it moves as the twist says, it is
        what says how far.
        """
        stamp_ns = int(stamp_ns)
        try:
            twist = read_twist(v, omega, variances, self.config)
            self._place(stamp_ns, _ODOMETRY)
        except DataError as error:
            self.counts[f'odometry: {error}'] += 1
            return str(error)
        self.counts['odometry: used'] += 1
        event = OdometryEvent(stamp_ns, twist, _finite(pose))
        driven = self._history.add((stamp_ns, _ODOMETRY), event)
        self._camera.add_odometry(stamp_ns, driven.twist.omega)
        return ''

    def add_measurement(self, stamp_ns: int, value: ArrayLike, covariance: ArrayLike) -> Update:
        """Fuse a position (2,) or pose (3,) seen at a stamp, with its covariance.

        A heading that is NaN or less sure than `yaw_std_limit` is left out. Zero covariance means
        unknown. The filter does not start from a pose so unsure that it would be lost at once.
        """
        stamp_ns = int(stamp_ns)
        try:
            fused, spread = read_measurement(value, covariance, self.config)
            taken_ns = self._taken(stamp_ns)
            self._place(taken_ns, _MEASUREMENT)
        except DataError as error:
            self.counts[f'measurement: {error}'] += 1
            return Update(stamp_ns, False, math.nan, math.nan, str(error))
        spread = spread + self._time_noise(taken_ns, stamp_ns, fused)
        event = self._fusion.measurement(taken_ns, fused, spread)
        update = self._history.add((taken_ns, _MEASUREMENT), event).memory.update
        assert update is not None
        self.counts[f'measurement: {update.reason}'] += 1
        return update._replace(stamp_ns=stamp_ns)

    def add_turned(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take how far images have turned, from wherever, at an image's stamp; NaN is left out.

        The turns of images and odometry together show by how much the camera's stamps are late;
        images are then fused where they were taken.
        """
        if stamp_ns > 0 and math.isfinite(yaw_rad):
            self._camera.add_heading(int(stamp_ns), yaw_rad)

    def _taken(self, stamp_ns: int) -> int:
        """When an image was taken, on the clock of the odometry."""
        if stamp_ns <= 0:
            return stamp_ns
        delay_ns = self._camera.clock_at(stamp_ns).delay_ns
        if abs(delay_ns) > DELAY_LIMIT_NS:
            raise DataError(_APART)
        return max(stamp_ns - delay_ns, 1)

    def expect_delay(self, delay_s: float) -> None:
        """Begin with the camera's delay of the training drives; turns under way overrule it."""
        if abs(delay_s) * 1e9 <= DELAY_LIMIT_NS and not self._camera.clock.known:
            self._camera.expect(CameraClock(delay_s, _EXPECTED_STD_S, True))

    def _time_noise(self, taken_ns: int, stamp_ns: int, value: Array) -> Array:
        """Covariance that a moving robot's pose has because the time it was seen is uncertain."""
        std_s = self._camera.clock_at(stamp_ns).std_s
        twist = self._history.before(taken_ns).twist
        if not math.isfinite(std_s):
            return np.zeros((len(value), len(value)))
        if len(value) == 2:
            return np.eye(2) * (std_s * twist.v) ** 2
        yaw = float(value[2])
        moved = np.array([twist.v * math.cos(yaw), twist.v * math.sin(yaw), twist.omega])
        return np.outer(moved, moved) * std_s**2

    @property
    def camera_clock(self) -> CameraClock:
        """By how much images are stamped late, as far as turns have shown it."""
        return self._camera.clock

    # What comes out.

    @property
    def state(self) -> State | None:
        """The estimate at the newest message; None before there is any."""
        return self._history.newest.state

    def at(self, stamp_ns: int) -> State | None:
        """The estimate at a stamp: predicted beyond the newest message, recalled within history.

        None before the start, and for stamps older than the history.
        """
        stamp_ns = int(stamp_ns)
        if self._history.newest_ns is None or not self._history.reaches(stamp_ns):
            return self.state if stamp_ns == self._history.newest.stamp_ns else None
        return self._fusion.coasted(self._history.before(stamp_ns), stamp_ns).state

    @property
    def travelled_m(self) -> float:
        """Way driven since the start, m."""
        return self._history.newest.travelled_m

    @property
    def status(self) -> Status:
        """How far the estimate at the newest message can be trusted, and why not further."""
        belief = self._history.newest
        state = belief.state
        if state is None:
            return Status(Level.UNINITIALISED, (_missing(belief),))
        lost = _lost(belief, state, self.config)
        poor = [*_degraded(belief, state, self.config), *_off(self._camera.clock)]
        level = Level.LOST if lost else Level.DEGRADED if poor else Level.LOCALISED
        return Status(level, (*lost, *poor))

    # Whether a message can be placed in time.

    def _place(self, stamp_ns: int, rank: int) -> None:
        """Raise DataError when a stamp cannot be used; start anew when the clock went back."""
        if stamp_ns <= 0:
            raise DataError('zero or negative stamp')
        if self._pending is not None:
            self._begin(stamp_ns)
        newest = self._history.newest_ns
        if newest is None:
            return
        if stamp_ns > newest:
            if stamp_ns > newest + self.config.time_jump * 1e9:
                self._far_ahead(stamp_ns)
            if rank == _ODOMETRY or self._history.newest.odometry_ns is None:
                self._backward = 0
        elif not self._history.reaches(stamp_ns):
            self._behind('too old', stamp_ns, rank)
        elif self._history.holds((stamp_ns, rank)):
            self._behind('duplicate stamp', stamp_ns, rank)
        elif rank == _ODOMETRY or self._history.newest.odometry_ns is None:
            self._backward = 0

    def _begin(self, stamp_ns: int) -> None:
        """The first message tells the time: a waiting pose is placed there."""
        assert self._pending is not None
        value, spread = self._pending
        given = self._history.newest_ns
        if given is None or not 0 <= stamp_ns - given <= self.config.odometry_timeout * 1e9:
            self._history = self._fresh(self._fusion.blank(0))
            self._history.add((stamp_ns, _POSE), PoseEvent(stamp_ns, value, spread))
        self._pending = None

    def _far_ahead(self, stamp_ns: int) -> None:
        """One stamp far ahead is an error; several that agree are a pause of the recording."""
        last, count = self._ahead
        near = abs(stamp_ns - last) <= self.config.time_jump * 1e9
        self._ahead = (stamp_ns, count + 1 if near else 1)
        if self._ahead[1] < _AHEAD:
            raise DataError('stamp far ahead')
        self._ahead = (0, 0)
        self.counts['gap in time'] += 1

    def _behind(self, reason: str, stamp_ns: int, rank: int) -> None:
        """Odometry that comes late time and again means that the clock went back: start anew."""
        if rank == _ODOMETRY or self._history.newest.odometry_ns is None:
            self._backward += 1
        if self._backward < _BACKWARD:
            raise DataError(reason)
        self.counts['clock went back'] += 1
        self.reset()
        if self._pending is not None:
            self._begin(stamp_ns)


def _finite(pose: Sequence[float] | Array | None) -> tuple[float, float, float] | None:
    """A pose in plain numbers, if there is a usable one."""
    if pose is None or not all(map(math.isfinite, pose)):
        return None
    x, y, yaw = map(float, pose)
    return x, y, yaw


def _missing(belief: Belief) -> str:
    if belief.odometry_ns is None and not belief.memory.evidence:
        return 'no odometry and no pictures yet'
    if not belief.memory.evidence:
        return 'no usable picture yet'
    return 'pictures tell no heading yet: drive on'


def _lost(belief: Belief, state: State, config: FilterConfig) -> list[str]:
    memory, found = belief.memory, []
    if state.position_std > config.lost_std:
        found.append(f'position known to {state.position_std:.1f} m only')
    if state.yaw_std > config.lost_yaw_std:
        found.append(f'heading known to {math.degrees(state.yaw_std):.0f} deg only')
    # A robot that stands where one place's pictures err would otherwise be declared lost.
    far = memory.excess > _FAR_OUTSIDE or belief.travelled_m - memory.accepted_m > _MOVED_ON
    if memory.refused >= config.recovery_pictures and far:
        found.append(f'{memory.refused} pictures in a row contradict the estimate')
    return found


def _degraded(belief: Belief, state: State, config: FilterConfig) -> list[str]:
    memory, found = belief.memory, []
    if config.degraded_std < state.position_std <= config.lost_std:
        found.append(f'position known to {state.position_std:.1f} m only')
    if memory.refused >= DISTRUST_AFTER:
        found.append(f'{memory.refused} pictures in a row did not fit')
    return [*found, *_silences(belief, config)]


def _off(clock: CameraClock) -> list[str]:
    """A camera whose clock is too far off to be made up for."""
    if abs(clock.delay_ns) <= DELAY_LIMIT_NS:
        return []
    late = 'late' if clock.delay_s > 0 else 'early'
    return [f'images are stamped {abs(clock.delay_s):.1f} s {late}: bring the clocks together']


def _silences(belief: Belief, config: FilterConfig) -> list[str]:
    memory, found = belief.memory, []
    if memory.accepted_ns is None:
        found.append('no picture has confirmed the start yet')
    elif (belief.stamp_ns - memory.accepted_ns) * 1e-9 > config.picture_timeout:
        seconds = (belief.stamp_ns - memory.accepted_ns) * 1e-9
        found.append(f'no usable picture for {seconds:.0f} s')
    if belief.odometry_ns is None:
        found.append('no odometry')
    elif (belief.stamp_ns - belief.odometry_ns) * 1e-9 > config.odometry_timeout:
        seconds = (belief.stamp_ns - belief.odometry_ns) * 1e-9
        found.append(f'no odometry for {seconds:.1f} s')
    return found
