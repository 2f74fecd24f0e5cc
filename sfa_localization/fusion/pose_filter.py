# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter: odometry drives a CTRV extended Kalman filter, images correct it at their stamp.

One class serves the live node, the command line and the evaluation. The estimate depends on the
stamps of the messages, not on the order or pace of their arrival, unless one is older than
HISTORY_NS.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.events import DELAY_LIMIT_NS, clock_difference
from sfa_localization.data.geometry import Array
from sfa_localization.data.odometry_steps import Orientation, Paths
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.fusion.belief import (
    Belief,
    DrivenPath,
    Event,
    MeasurementEvent,
    Memory,
    OdometryEvent,
    Pose,
    PoseEvent,
    Update,
    newest_new,
)
from sfa_localization.fusion.camera_clock import CameraClock, CameraClockFinder, ImageClock
from sfa_localization.fusion.ekf import Ekf
from sfa_localization.fusion.health import Health, busy, health_of
from sfa_localization.fusion.history import History
from sfa_localization.fusion.inputs import OpenLoop, read_measurement, read_pose, read_twist
from sfa_localization.fusion.motion import State
from sfa_localization.fusion.odometry import COAST_S, ODOMETRY_TIMEOUT_S, stalled
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level, Status, status_of
from sfa_localization.fusion.timeline import (
    HISTORY_NS,
    MEASUREMENT,
    ODOMETRY,
    POSE,
    ClockWentBack,
    Timeline,
    odometry_ns,
)

__all__ = ['Level', 'PoseFilter', 'State', 'Status', 'Update']

# Image pairs, some minutes of them, over which the camera's clock is averaged: clocks drift.
_CLOCK_MEMORY = 1000.0


class PoseFilter:
    """Fuses odometry with positions (2,) or poses (3,) in the map; see FilterConfig.

    `correlation` is that of the errors of neighboring images, `scale` the factor on the way of
    odometry. No message raises: `counts` says how many were used, and why others were not.
    """

    def __init__(
        self, config: FilterConfig | None = None, correlation: ErrorCorrelation | None = None
    ) -> None:
        self.config = config or FilterConfig()
        self.correlation = correlation or ErrorCorrelation()
        self.counts: Counter[str] = Counter()
        self.scale = self.config.odometry_scale
        self.waited_s = 0.0
        """How long messages have recently waited for this program: they show no clocks."""
        self.lacking = ''
        """Why panoramas have lacked some of several cameras for too long; '' if they have not."""
        self._nis = 0.0, 0
        self._camera = CameraClockFinder(_CLOCK_MEMORY)
        self._expected_s = 0.0
        self._images = ImageClock(_CLOCK_MEMORY)
        self._rig = Rig()
        self._ekf = Ekf(self.config, self.correlation, self._rig)
        self._history = self._fresh(self._ekf.blank(0))
        self._forget()

    def reset(self) -> None:
        """Forget everything but the counts, and start as after construction."""
        self.counts['reset'] += 1
        self._forget()

    def reconfigure(
        self, config: FilterConfig | None = None, correlation: ErrorCorrelation | None = None
    ) -> None:
        """Go on with other parameters, or another model's errors, from what is believed now."""
        before = self.config, self.correlation
        self.config = config or self.config
        self.correlation = correlation or self.correlation
        if (self.config, self.correlation) != before:
            self._ekf = Ekf(self.config, self.correlation, self._rig)
            self._go_on(self._history.newest)

    def _go_on(self, belief: Belief) -> None:
        self._history = self._fresh(belief, self._history.newest_ns)

    def _forget(self) -> None:
        # Stamps may start anew; the camera's delay stays what it was.
        self._camera = CameraClockFinder(_CLOCK_MEMORY, self._camera.clock)
        self._history = self._fresh(self._ekf.blank(0))
        self._timeline = Timeline()
        self._open_loop = OpenLoop()
        self._paths = Paths()
        self._orientation = Orientation()
        self._was_empty = False
        self._judged: tuple[object, Health] | None = None
        self._waiting: tuple[Array, Array] | None = None
        if self.config.initial_pose:
            self._waiting = np.array(self.config.initial_pose), self._initial_covariance()

    def _fresh(self, start: Belief, start_ns: int | None = None) -> History[Event, Belief]:
        return History(HISTORY_NS, start, self._ekf.step, start_ns)

    def _initial_covariance(self) -> Array:
        position = self.config.initial_position_std
        yaw = self.config.initial_yaw_std
        return np.diag(np.square([position, position, yaw]))

    # Inputs.

    def set_pose(self, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike | None = None) -> None:
        """Set the pose (3,) in the map at a stamp; covariance (3, 3), or the configured one.

        If the stamp does not fit those of the messages, their stamp is used.
        Raises DataError for a pose or covariance that cannot be one.
        """
        given = self._initial_covariance() if covariance is None else covariance
        value, checked = read_pose(pose, given)
        self.counts['pose set'] += 1
        newest = self._history.newest_ns
        if newest is None or self._waiting is not None:
            self._forget()
            self._waiting = value, checked
        elif abs(stamp_ns - newest) > COAST_S * 1e9 or not self._history.reaches(stamp_ns):
            stamp_ns = newest
        event = PoseEvent(int(stamp_ns), value, checked)
        self._history.add((event.stamp_ns, POSE), event)

    def forget_pose(self) -> None:
        """The robot may be anywhere; what is estimated of its camera and odometry stays."""
        self.counts['pose forgotten'] += 1
        self._waiting = None
        belief = self._history.newest
        path = belief.path._replace(placed_m=DrivenPath().placed_m)
        self._go_on(belief._replace(located=False, memory=Memory(), path=path))

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
        odometry's, x m, y m, yaw rad in any frame: where it agrees with the twist, the distance is
        taken from it.
        """
        stamp_ns = int(stamp_ns)
        try:
            commands = self._open_loop.repeats
            twist = read_twist(self.scale * v, omega, variances, self.config, commands)
            again = partial(self.add_odometry, stamp_ns, v, omega, variances, pose)
            self._timeline.require_order(stamp_ns, ODOMETRY, self._history, again)
            self._require_place(stamp_ns, ODOMETRY)
            scaled = self._path_pose(stamp_ns, v, omega, pose)
        except DataError as error:
            self.counts[f'odometry: {error}'] += 1
            return str(error)
        self.counts['odometry: used'] += 1
        self._open_loop.add(twist.v, twist.omega)
        driven = self._history.add((stamp_ns, ODOMETRY), OdometryEvent(stamp_ns, twist, scaled))
        if driven.odometry.stamp_ns == stamp_ns:
            for clock in self._camera, self._images:
                clock.add_odometry(stamp_ns, driven.counted_rad)
        return ''

    def _path_pose(
        self, stamp_ns: int, v: float, omega: float, pose: Sequence[float] | Array | None
    ) -> Pose | None:
        """The pose of a message in the scale of the map; None for one without, or without an
        orientation, and while poses lead along two paths in turn. Raises DataError for a single
        message without pose and twist.
        """
        posed = pose is not None and all(map(math.isfinite, pose))
        empty = not (posed or v or omega) and self._history.newest.odometry.pose is not None
        was_empty = self._was_empty
        self._was_empty = empty
        if empty and not was_empty:
            raise DataError('neither pose nor twist')
        if pose is None or not posed:
            return None
        x, y, yaw = map(float, pose)
        self._orientation.add(stamp_ns * 1e-9, yaw, omega)
        if not self._orientation.is_filled:
            return None
        self._paths.add(stamp_ns * 1e-9, (x, y, yaw), v, omega)
        if self._paths.aside:
            self.counts['odometry: pose beside the path'] += self._paths.aside
            self.counts['odometry: used'] -= self._paths.aside
        return None if self._paths.in_turn else (self.scale * x, self.scale * y, yaw)

    def add_measurement(self, stamp_ns: int, value: ArrayLike, covariance: ArrayLike) -> Update:
        """Fuse a position (2,) or pose (3,) from an image of a stamp, with its covariance.

        A heading that is NaN or less certain than inputs.YAW_STD_LIMIT is left out. Zero covariance
        means unknown. The filter does not start from a pose so uncertain that it would be LOST.
        The stamp of the update is by the clock of the odometry.
        """
        again = partial(self.add_measurement, stamp_ns, value, covariance)
        stamp_ns = int(stamp_ns) - self._images.offset_ns
        try:
            fused, noise = read_measurement(value, covariance, self.config.measurement_factor)
            self._timeline.require_order(stamp_ns, MEASUREMENT, self._history, again)
            clock = self._camera.clock_at(stamp_ns)
            taken_ns = stamp_ns - clock.delay_ns  # by the clock of the odometry
            around = self._history.before(taken_ns), self._history.before(stamp_ns)
            # Needed by the fault "all stamped on reception, with stalls".
            if clock.delay_ns and stalled(*around, taken_ns, stamp_ns):
                taken_ns = stamp_ns  # all messages were late: the order of the stamps says more
            self._require_place(taken_ns, MEASUREMENT)
            late = Quantity(clock.delay_ns * 1e-9 - self._expected_s, clock.std_s)
        except DataError as error:
            self.counts[f'measurement: {error}'] += 1
            return Update(stamp_ns, False, math.nan, math.nan, str(error))
        event = MeasurementEvent(taken_ns, fused, noise, late, clock.turn_factor)
        update = self._history.add((taken_ns, MEASUREMENT), event).memory.update
        assert update is not None
        self.counts[f'measurement: {update.reason}'] += 1
        if update.d2 <= update.threshold:
            self._nis = self._nis[0] + update.d2 / len(fused), self._nis[1] + 1
        return update._replace(stamp_ns=stamp_ns)

    def add_turned(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take how far images have turned, from any start, at an image's stamp; NaN is left out.

        The turns of images and odometry together show by how much the camera's stamps are late;
        images are then fused where they were taken.
        """
        if stamp_ns <= 0 or not math.isfinite(yaw_rad) or self.waited_s:
            return
        counted_ns = odometry_ns(self._history)
        if counted_ns is not None:
            finder = self._images.add_heading(int(stamp_ns), yaw_rad, counted_ns)
            if finder is not None:
                self._camera = finder
                self._expected_s = 0.0
                text = clock_difference(self._images.offset_ns)
                self.counts[f'images: {text}; taken into account'] += 1
        self._camera.add_heading(int(stamp_ns) - self._images.offset_ns, yaw_rad)

    def expect(self, rig: Rig) -> None:
        """Take a rig as prior; estimates since the start stay, as a delay shown by turns."""
        self._rig, self._ekf = rig, Ekf(self.config, self.correlation, rig)
        self.scale = rig.wheel_scale.value * self.config.odometry_scale
        delay_s = rig.camera_delay.value
        if abs(delay_s) * 1e9 <= DELAY_LIMIT_NS and not self._camera.clock.is_estimated:
            self._expected_s = delay_s
            self._camera = CameraClockFinder(_CLOCK_MEMORY, CameraClock(delay_s, assumed=True))
        belief = self._history.newest
        prior = self._ekf.blank(0)
        # The pose of odometry jumps to the new scale: forget the one before.
        belief = belief._replace(odometry=belief.odometry._replace(pose=None))
        if not belief.located:
            belief = belief._replace(mean=prior.mean, covariance=prior.covariance)
        self._go_on(belief)

    def _require_place(self, stamp_ns: int, kind: int) -> None:
        """Raise DataError when a stamp cannot be used; start anew when the clock went back."""
        if self._waiting is not None and stamp_ns > 0:
            self._begin(stamp_ns)
        try:
            self._timeline.require_place(stamp_ns, kind, self._history)
        except ClockWentBack:
            self.counts['clock went back'] += 1
            self.reset()
            if self._waiting is not None:
                self._begin(stamp_ns)

    def _begin(self, stamp_ns: int) -> None:
        """Place a waiting pose at the time of the first message."""
        assert self._waiting is not None
        given_ns = self._history.newest_ns
        if given_ns is None or not 0 <= stamp_ns - given_ns <= ODOMETRY_TIMEOUT_S * 1e9:
            self._history = self._fresh(self._ekf.blank(0))
            self._history.add((stamp_ns, POSE), PoseEvent(stamp_ns, *self._waiting))
        self._waiting = None

    # Outputs.

    @property
    def camera_clock(self) -> CameraClock:
        """By how much images are stamped late, as far as turns have shown it."""
        return self._camera.clock

    @property
    def odometry_in_turn(self) -> bool:
        """Whether poses of the odometry lead along two paths in turn, as of two publishers."""
        return self._paths.in_turn

    @property
    def nis(self) -> float:
        """Mean normalized innovation squared inside the gate, over its expectation: 1 is right."""
        total, count = self._nis
        return total / count if count else math.nan

    @property
    def state(self) -> State | None:
        """The estimate at the newest message; None before there is any."""
        return self._at(self._newest.stamp_ns)

    def at(self, stamp_ns: int) -> State | None:
        """The estimate at a stamp: predicted beyond the newest message, recalled within history.

        None before the start, and for stamps older than the history.
        """
        stamp_ns = int(stamp_ns)
        if self._history.newest_ns is None or not self._history.reaches(stamp_ns):
            return self.state if stamp_ns == self._newest.stamp_ns else None
        return self._at(stamp_ns)

    def _at(self, stamp_ns: int) -> State | None:
        """If odometry repeats commands, the robot is where it was one delay ago."""
        # test_the_estimate_is_where_commands_led_a_camera_delay_ago
        robot_ns = stamp_ns
        delay_ns = self._camera.clock.delay_ns if self._open_loop.repeats else 0
        if 0 < abs(delay_ns) <= DELAY_LIMIT_NS and self._history.reaches(stamp_ns - delay_ns):
            robot_ns -= delay_ns
        state = self._ekf.coast(self._history.before(robot_ns), robot_ns).state
        return state and state._replace(stamp_ns=stamp_ns)

    @property
    def _newest(self) -> Belief:
        """The belief at the stamp of the newest message."""
        newest = self._history.newest
        newest_ns = self._history.newest_ns
        return self._ekf.coast(newest, newest_ns) if newest_ns else newest

    @property
    def health(self) -> Health:
        """The health of the estimate by the last images."""
        belief = self._history.newest
        judged = newest_new(belief.memory.images), belief.path.placed_m
        if self._judged is None or self._judged[0] != judged:
            self._judged = judged, health_of(belief.path, belief.memory.images)
        return self._judged[1]

    @property
    def status(self) -> Status:
        """How far the estimate at the newest message can be trusted, and why not further."""
        newest = self._newest
        clock = self._camera.clock
        health = self.health._replace(waited_s=self.waited_s)
        status = status_of(newest, newest.state, health, self.config)
        of_clocks = self._timeline.problems
        if abs(clock.delay_ns) > DELAY_LIMIT_NS:
            late = 'late' if clock.delay_s > 0 else 'early'
            size = f'{abs(clock.delay_s):.1f} s {late}'
            of_clocks.append(f'images are stamped {size}: synchronize the clocks')
        if of_clocks and self.waited_s:
            of_clocks = [] if health.is_busy else [busy(self.waited_s)]
        doubts = of_clocks
        if self.odometry_in_turn:
            doubts.append('odometry leads along two paths in turn: its poses are not used')
        if self.lacking:
            doubts.append(self.lacking)
        return status.with_reasons([], doubts)
