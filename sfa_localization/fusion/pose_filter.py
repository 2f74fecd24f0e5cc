# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The filter: odometry drives a CTRV extended Kalman filter, images correct it at their stamp.

One class serves the live node, the command line and the evaluation. What it believes after any
set of messages depends on their stamps, not on the order or the pace in which they came, as long
as none is older than HISTORY_S.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.fusion import motion
from sfa_localization.fusion.arrivals import Arrivals
from sfa_localization.fusion.belief import Belief, Event, OdometryEvent, PoseEvent, Update
from sfa_localization.fusion.camera_clock import CameraClock, CameraClockFinder
from sfa_localization.fusion.history import History
from sfa_localization.fusion.inputs import read_measurement, read_pose, read_twist
from sfa_localization.fusion.lateness import CLEARED, SUSPECTED
from sfa_localization.fusion.motion import BIAS, State, V
from sfa_localization.fusion.predict import COAST_S, ODOMETRY_TIMEOUT_S
from sfa_localization.fusion.rules import Rules
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import Level, Status, status_of
from sfa_localization.fusion.turn_watch import Seen, TurnWatch
from sfa_localization.fusion.update import measurement_event

__all__ = ['Level', 'PoseFilter', 'State', 'Status', 'Update']

HISTORY_S = 5.0
"""How late a measurement may come: many times what any camera, network and model take."""
TIME_JUMP_S = 60.0
"""A stamp this far ahead needs AHEAD_COUNT like it: one alone is a damaged message."""
AHEAD_COUNT = 3
"""So many images in a row beyond the history are no accident: their clock is another one. They are
used where no odometry comes between them, which then has ended."""
_BLIND = 2
"""So many unusable images in a row are no flicker: the camera is covered, or in the dark."""
BACKWARD_COUNT = 5
"""Odometry messages in a row that are too late until the clock is taken to have gone back."""
AGAIN_NS = 300_000_000
"""Time that odometry has to cover once more until the clock is taken to have gone back."""
DELAY_LIMIT_NS = 500_000_000
"""Largest delay of the camera's stamps, either way, that is compensated."""
# Image pairs, some minutes of them, over which the camera's clock is averaged: clocks drift.
_CLOCK_MEMORY = 1000.0
# Standard deviation, s, of a delay learned with the model: clocks differ from day to day.
_EXPECTED_STD_S = 0.05
# More motion than twice that of the speed, and this, is that of longer than the stamps say.
_STALL_M, _STALL_RAD = 0.05, 0.05
_ODOMETRY, _POSE, _MEASUREMENT = range(3)


class PoseFilter:
    """Fuses odometry with positions (2,) or poses (3,) in the map; see FilterConfig.

    `correlation` is how the errors of neighboring images correlate. `counts` holds what became of
    all messages. No message raises; what is unusable is counted.
    """

    def __init__(
        self, config: FilterConfig | None = None, correlation: ErrorCorrelation | None = None
    ) -> None:
        self.config = config or FilterConfig()
        self.correlation = correlation or ErrorCorrelation()
        self.counts: Counter[str] = Counter()
        self._nis = 0.0, 0
        self._camera = CameraClockFinder(_CLOCK_MEMORY)
        self._watch, self._off = TurnWatch(), False
        self._arrivals = Arrivals()
        self._rules = Rules(self.config, self.correlation)
        self._history = self._fresh(self._rules.recovery.blank(0))
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
        self.config, self.correlation = config or self.config, correlation or self.correlation
        if (self.config, self.correlation) != before:
            belief, newest_ns = self._history.newest, self._history.newest_ns
            self._rules = Rules(self.config, self.correlation)
            self._history = self._fresh(belief, newest_ns)

    def _forget(self) -> None:
        # Stamps may start anew; the camera's delay stays what it was.
        self._camera = CameraClockFinder(_CLOCK_MEMORY, self._camera.clock)
        self._watch.forget_time()
        self._history = self._fresh(self._rules.recovery.blank(0))
        self._suspect_late(Arrivals())
        self._backward = 0
        self._again = _NEVER
        self._ahead = (0, 0)
        self._apart = (0, 0)
        self._alone = 0
        self._unusable_ns = self._unusable = 0
        self._waiting: tuple[Array, Array] | None = None
        if self.config.initial_pose:
            self._waiting = np.array(self.config.initial_pose), self._initial_covariance()

    def _fresh(self, start: Belief, start_ns: int | None = None) -> History[Event, Belief]:
        return History(round(HISTORY_S * 1e9), start, self._rules.step, start_ns)

    def _initial_covariance(self) -> Array:
        position, yaw = self.config.initial_position_std, self.config.initial_yaw_std
        return np.diag(np.square([position, position, yaw]))

    # Inputs.

    def set_pose(self, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike | None = None) -> None:
        """Set the pose (3,) in the map at a stamp; covariance (3, 3), or the configured one.

        A stamp that does not fit those of the messages, before or after, gives way to theirs.
        Raises DataError for a pose or covariance that cannot be one.
        """
        given = self._initial_covariance() if covariance is None else covariance
        value, checked = read_pose(pose, given)
        self.counts['pose set'] += 1
        newest = self._history.newest_ns
        if newest is None or self._waiting is not None:
            self._forget()
            self._waiting = value, checked
        else:
            near = abs(stamp_ns - newest) <= COAST_S * 1e9
            stamp_ns = stamp_ns if near and self._history.reaches(stamp_ns) else newest
        self._place_pose(int(stamp_ns), value, checked)

    def _place_pose(self, stamp_ns: int, pose: Array, covariance: Array) -> None:
        self._history.add((stamp_ns, _POSE), PoseEvent(stamp_ns, pose, covariance))

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
        odometry's own, x m, y m, yaw rad in any frame: where it agrees with the twist, the distance
        is taken from it.
        """
        stamp_ns = int(stamp_ns)
        try:
            twist = read_twist(v, omega, variances, self.config)
            self._require_place(stamp_ns, _ODOMETRY)
            self._notice_again(stamp_ns)
        except DataError as error:
            self.counts[f'odometry: {error}'] += 1
            return str(error)
        self.counts['odometry: used'] += 1
        self._alone = self._unusable_ns = 0
        event = OdometryEvent(stamp_ns, twist, _finite(pose))
        driven = self._history.add((stamp_ns, _ODOMETRY), event)
        self._camera.add_odometry(stamp_ns, driven.omega)
        speed, bias = driven.mean[[V, BIAS]].tolist()
        self._watch.add_odometry(stamp_ns, speed, driven.omega - bias)
        self._judge_time()
        return ''

    def add_measurement(self, stamp_ns: int, value: ArrayLike, covariance: ArrayLike) -> Update:
        """Fuse a position (2,) or pose (3,) from an image of a stamp, with its covariance.

        A heading that is NaN or less certain than inputs.YAW_STD_LIMIT is left out. Zero covariance
        means unknown. The filter does not start from a pose so uncertain that it would be LOST.
        """
        stamp_ns = int(stamp_ns)
        try:
            fused, noise = self._read(stamp_ns, value, covariance)
            taken_ns = self._taken(stamp_ns)
            self._note_apart(taken_ns)
            self._require_place(taken_ns, _MEASUREMENT)
            self._note_arrival(taken_ns)
        except DataError as error:
            self.counts[f'measurement: {error}'] += 1
            return Update(stamp_ns, False, math.nan, math.nan, str(error))
        self._unusable = 0
        if len(fused) == 3:
            self._watch.add_seen(Seen(stamp_ns, float(fused[2]), float(noise[2, 2])))
        noise = noise + self._time_noise(taken_ns, stamp_ns, fused)
        # What arrives late is suspected of its arrival alone: that contradicts no motion.
        apart = self._off and not self._arrivals.late_s
        event = measurement_event(taken_ns, fused, noise, self.correlation.share, apart)
        update = self._history.add((taken_ns, _MEASUREMENT), event).memory.update
        assert update is not None
        if update.reason == 'restarted elsewhere':
            self._watch.doubt()
            self._judge_time()
        self.counts[f'measurement: {update.reason}'] += 1
        if update.d2 <= update.threshold:
            self._nis = self._nis[0] + update.d2 / len(fused), self._nis[1] + 1
        return update._replace(stamp_ns=stamp_ns)

    def add_turned(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take how far images have turned, from any start, at an image's stamp; NaN is left out.

        The turns of images and odometry together show by how much the camera's stamps are late;
        images are then fused where they were taken.
        """
        if stamp_ns > 0 and math.isfinite(yaw_rad):
            self._camera.add_heading(int(stamp_ns), yaw_rad)
            self._watch.add_heading(int(stamp_ns), yaw_rad)

    def expect_delay(self, delay_s: float) -> None:
        """Begin with the camera's delay of the training drives; turns under way overrule it."""
        if abs(delay_s) * 1e9 <= DELAY_LIMIT_NS and not self._camera.clock.known:
            self._camera.expect(CameraClock(delay_s, _EXPECTED_STD_S, True))

    def _note_arrival(self, taken_ns: int) -> None:
        """Suspect images that arrive late, by the odometry, of being stamped early."""
        odometry_ns, arrivals = self._history.newest.odometry_ns, self._arrivals
        if odometry_ns is not None:
            self._suspect_late(arrivals.after((odometry_ns - taken_ns) * 1e-9))

    def _suspect_late(self, arrivals: Arrivals) -> None:
        before_s, self._arrivals = self._arrivals.late_s, arrivals
        if arrivals.late_s == before_s:
            return
        if before_s > 0:
            self._watch.acquit(-before_s)
        if arrivals.late_s > 0:
            self._watch.suspect(-arrivals.late_s)
        self._judge_time()

    def _judge_time(self) -> None:
        """Whether images are likely of another time; once they were, until that is unlikely."""
        limit = CLEARED if self._off else SUSPECTED
        self._off = self._watch.apart(self._compensated_s) > limit

    def _read(self, stamp_ns: int, value: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
        try:
            return read_measurement(value, covariance, self.config.measurement_factor)
        except DataError:
            self._unusable_ns = max(stamp_ns, self._unusable_ns)
            self._unusable += 1
            raise

    def _taken(self, stamp_ns: int) -> int:
        """When an image was taken, on the clock of the odometry."""
        if stamp_ns <= 0:
            return stamp_ns
        delay_ns = self._camera.clock_at(stamp_ns).delay_ns
        if abs(delay_ns) > DELAY_LIMIT_NS:
            raise DataError('clocks of camera and odometry are more than 0.5 s apart')
        taken_ns = max(stamp_ns - delay_ns, 1)
        return stamp_ns if self._stalled_between(taken_ns, stamp_ns) else taken_ns

    def _stalled_between(self, taken_ns: int, stamp_ns: int) -> bool:
        """Whether the odometry of a delay shows far more motion than it takes, after a silence in
        which it shows far less, as where a network that stalled hands over all at once: then the
        order of the stamps says more than the delay.
        """
        a, b = self._history.before(taken_ns), self._history.before(stamp_ns)
        if b.odometry_ns is None or b.odometry_ns <= taken_ns:
            return False
        delay_s, silent_s = (stamp_ns - taken_ns) * 1e-9, (taken_ns - a.stamp_ns) * 1e-9
        moved = math.dist(a.dead_reckoned[:2], b.dead_reckoned[:2])
        turned = abs(motion.wrap(b.dead_reckoned[2] - a.dead_reckoned[2]))
        pairs = (moved, _STALL_M, a.twist.v, b.twist.v), (turned, _STALL_RAD, a.omega, b.omega)
        return any(
            way > 2 * max(abs(before), abs(after)) * delay_s + jump
            or abs(before) * silent_s > way + jump
            for way, jump, before, after in pairs
        )

    def _time_noise(self, taken_ns: int, stamp_ns: int, value: Array) -> Array:
        """Covariance that a moving robot's pose has because the image's time is uncertain."""
        std_s = self._camera.clock_at(stamp_ns).std_s
        twist = self._history.before(taken_ns).twist
        if not math.isfinite(std_s):
            return np.zeros((len(value), len(value)))
        if len(value) == 2:
            return np.eye(2) * (std_s * twist.v) ** 2
        yaw = float(value[2])
        moved = np.array([twist.v * math.cos(yaw), twist.v * math.sin(yaw), twist.omega])
        return np.outer(moved, moved) * std_s**2

    # Outputs.

    @property
    def camera_clock(self) -> CameraClock:
        """By how much images are stamped late, as far as turns have shown it."""
        return self._camera.clock

    @property
    def nis(self) -> float:
        """Normalized innovation squared over its expectation, of all measurements inside the gate:
        1 where covariances are right; NaN before any.
        """
        total, count = self._nis
        return total / count if count else math.nan

    @property
    def state(self) -> State | None:
        """The estimate at the newest message; None before there is any."""
        return self._spread(self._history.newest)

    def at(self, stamp_ns: int) -> State | None:
        """The estimate at a stamp: predicted beyond the newest message, recalled within history.

        None before the start, and for stamps older than the history.
        """
        stamp_ns = int(stamp_ns)
        if self._history.newest_ns is None or not self._history.reaches(stamp_ns):
            return self.state if stamp_ns == self._history.newest.stamp_ns else None
        before = self._history.before(stamp_ns)
        return self._spread(self._rules.prediction.coast(before, stamp_ns))

    def _spread(self, belief: Belief) -> State | None:
        """The estimate, less certain by how far the robot moves while images may be off in time."""
        state, late = belief.state, belief.lateness
        off_s = self._watch.error_s(self._compensated_s) if self._off else 0.0
        if late is not None and late.suspected:
            off_s = max(off_s, late.error_s)
        if state is None or off_s == 0.0:
            return state
        v, omega = state.twist.tolist()
        covariance = state.covariance.copy()
        covariance[:3, :3] += np.diag(np.square([v * off_s, v * off_s, omega * off_s]))
        return replace(state, covariance=covariance)

    @property
    def _compensated_s(self) -> float:
        """The delay by which stamps of images are corrected."""
        delay_ns = self._camera.clock.delay_ns
        return delay_ns * 1e-9 if abs(delay_ns) <= DELAY_LIMIT_NS else 0.0

    @property
    def status(self) -> Status:
        """How far the estimate at the newest message can be trusted, and why not further.

        While the odometry is silent, images that cannot be used show how time goes on.
        """
        newest = self._history.newest
        if 0 < self._unusable_ns - newest.stamp_ns <= TIME_JUMP_S * 1e9:
            newest = self._rules.prediction.coast(newest, self._unusable_ns)
        status = status_of(newest, self._camera.clock, self.config, DELAY_LIMIT_NS)
        reasons = [why for why in self._apart_in_time() if why not in status.reasons]
        if self._unusable >= _BLIND:
            reasons.append(f'{self._unusable} images in a row are unusable')
        if not reasons:
            return status
        level = Level.DEGRADED if status.level is Level.LOCALISED else status.level
        return Status(level, (*status.reasons, *reasons))

    def _apart_in_time(self) -> list[str]:
        """How images and odometry are apart in time, beyond what `CameraClock` measures."""
        if self._again.among > 1:
            return ['odometry is stamped with times that it had passed: did the clock go back?']
        count, apart_ns = self._apart
        if count >= AHEAD_COUNT:
            where = 'ahead of' if apart_ns > 0 else 'behind'
            apart = f'{abs(apart_ns) * 1e-9:.0f} s'
            return [
                f'images are stamped {apart} {where} the odometry: are the clocks synchronized?'
            ]
        if abs(self._camera.clock.delay_ns) > DELAY_LIMIT_NS:
            return []
        late = self._history.newest.lateness
        if late is not None and late.suspected:
            return [late.problem]
        return [self._watch.problem(self._compensated_s)] if self._off else []

    # Whether a message can be placed in time.

    def _require_place(self, stamp_ns: int, rank: int) -> None:
        """Raise DataError when a stamp cannot be used; start anew when the clock went back."""
        if stamp_ns <= 0:
            raise DataError('zero or negative stamp')
        if self._waiting is not None:
            self._begin(stamp_ns)
        newest = self._history.newest_ns
        if newest is None:
            return
        if stamp_ns > newest + TIME_JUMP_S * 1e9:
            self._require_others_ahead(stamp_ns)
        elif self._keeps_time(rank):
            self._ahead = (0, 0)
        if rank == _MEASUREMENT and self._history.newest.odometry_ns is not None:
            self._require_same_clock(stamp_ns, newest)
        if stamp_ns <= newest and not self._history.reaches(stamp_ns):
            self._behind('too old', stamp_ns, rank)
        elif stamp_ns <= newest and self._history.holds((stamp_ns, rank)):
            self._behind('duplicate stamp', stamp_ns, rank)
        elif self._keeps_time(rank):
            self._backward = 0

    def _keeps_time(self, rank: int) -> bool:
        """Whether messages of this rank show what time it is: odometry, where there is any."""
        return rank == _ODOMETRY or self._history.newest.odometry_ns is None

    def _begin(self, stamp_ns: int) -> None:
        """Place a waiting pose at the time of the first message."""
        assert self._waiting is not None
        given = self._history.newest_ns
        if given is None or not 0 <= stamp_ns - given <= ODOMETRY_TIMEOUT_S * 1e9:
            self._history = self._fresh(self._rules.recovery.blank(0))
            self._place_pose(stamp_ns, *self._waiting)
        self._waiting = None

    def _require_others_ahead(self, stamp_ns: int) -> None:
        """One stamp far ahead is an error; several in a row that agree are a pause."""
        last, count = self._ahead
        near = abs(stamp_ns - last) <= TIME_JUMP_S * 1e9
        self._ahead = (stamp_ns, count + 1 if near else 1)
        if self._ahead[1] < AHEAD_COUNT:
            raise DataError('stamp far ahead')
        self._ahead = (0, 0)
        self.counts['gap in time'] += 1

    def _require_same_clock(self, stamp_ns: int, newest_ns: int) -> None:
        """An image far ahead, of another clock, would make all odometry that follows too old."""
        if stamp_ns > newest_ns + HISTORY_S * 1e9:
            self._alone += 1
            if self._alone < AHEAD_COUNT:
                raise DataError('stamp ahead of the odometry')

    def _note_apart(self, stamp_ns: int) -> None:
        """Count images in a row beyond the history, and note how far from the newest message."""
        newest = self._history.newest_ns
        apart_ns = 0 if newest is None or stamp_ns <= 0 else stamp_ns - newest
        beyond = abs(apart_ns) > HISTORY_S * 1e9
        self._apart = (self._apart[0] + 1, apart_ns) if beyond else (0, 0)

    def _behind(self, reason: str, stamp_ns: int, rank: int) -> None:
        """Odometry that comes late time and again means that the clock went back: start anew."""
        if self._keeps_time(rank):
            self._backward += 1
        if self._backward < BACKWARD_COUNT:
            raise DataError(reason)
        self._go_back(stamp_ns)

    def _notice_again(self, stamp_ns: int) -> None:
        """Odometry that covers once more, in order, what other odometry covered before it, means
        that the clock went back; what fills a hole, or comes out of order, was held up.
        """
        newest_ns, again = self._history.newest.odometry_ns, self._again
        if newest_ns is None or stamp_ns > newest_ns:
            self._again = _NEVER
        elif stamp_ns < again.last_ns or again is _NEVER:
            self._again = _Again(0, stamp_ns, stamp_ns)
        else:
            passed = (self._history.before(stamp_ns).odometry_ns or 0) > again.last_ns
            self._again = _Again(again.among + passed, again.first_ns, stamp_ns)
            if self._again.among >= BACKWARD_COUNT and stamp_ns - again.first_ns >= AGAIN_NS:
                self._go_back(stamp_ns)

    def _go_back(self, stamp_ns: int) -> None:
        """Start anew, at a stamp, on a clock that went back."""
        self.counts['clock went back'] += 1
        self.reset()
        if self._waiting is not None:
            self._begin(stamp_ns)


class _Again(NamedTuple):
    """Odometry in a row that is no newer than what came before it: how many of its messages lie
    among those, and the first and last stamp.
    """

    among: int
    first_ns: int
    last_ns: int


_NEVER = _Again(0, 0, 0)


def _finite(pose: Sequence[float] | Array | None) -> tuple[float, float, float] | None:
    """A pose in plain numbers, if there is a usable one."""
    if pose is None or not all(map(math.isfinite, pose)):
        return None
    x, y, yaw = map(float, pose)
    return x, y, yaw
