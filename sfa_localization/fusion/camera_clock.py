# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""By how much the camera's stamps are late, and how far the robot turns for each turn counted.

Images and odometry both measure turns: the delay is the lag of those between images behind those of
the odometry, the factor their ratio. No map is needed: it works from the first turns on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfa_localization.data.events import (
    CLOCK_JUMP_NS,
    CLOCK_RANGE_S,
    ODOMETRY,
    merge_by_stamp,
    whole_leap,
)
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Odometry, Stamps

NEAR_NS = 150_000_000
"""Headings of images nearer in time are left out: the turns between them are too small."""
SIGNIFICANT_STDS = 2.5
"""Standard deviations that a delay must exceed before it is compensated."""
_STEP_S = 0.02
_GRID = np.arange(-round(CLOCK_RANGE_S / _STEP_S), round(CLOCK_RANGE_S / _STEP_S) + 1) * _STEP_S
# pairs with longer ones between are left out
_PAIR_NS = 1_000_000_000
_PAUSE_NS = 500_000_000
# An estimate applies to images stamped so much later, whichever message came first.
_IN_TRANSIT_NS = 1_000_000_000
_REMEMBERED_NS = 10_000_000_000
_FACTORS: Array = np.exp(np.linspace(-0.75, 0.75, 11))
"""True over counted turns: tracks skid, by half at most."""
_SIGNED: Array = np.concatenate([_FACTORS, -_FACTORS])[:, None]  # columns may grow either way
_WINDOW_NS = round(CLOCK_RANGE_S * 1e9) + 100_000_000
# Residuals beyond _OUTLIER times _SCALE_RAD are mismatches, and clipped; delays whose costs differ
# by less than _ALIKE fit equally well.
_SCALE_RAD = 0.05
_OUTLIER = 4.0
_ALIKE = 1.0
# Smaller turns, rad, and fewer do not show how well images and odometry agree.
_TURN_RAD = 0.05
_TURNS_MIN = 10
# Neighboring pairs err alike: on a slow curve, things near the camera look like turns for seconds.
_CAUTION = 4.0
_SCALE_MIN_RAD = 1e-3
_STD_MAX_S = 0.06
_FAR_NS = 2 * _WINDOW_NS
_ARRIVALS = 10
"""What arrives so far ahead, or behind, is of another clock, if so many images in a row are."""
_MEAN_OF_NORMAL = 0.798  # of |x|: sqrt(2 / pi)


@dataclass(frozen=True, slots=True)
class CameraClock:
    """`delay_s` by which images are stamped later than odometry, with its standard deviation, and
    the `turn_factor`: true over counted turns.

    0 with infinite standard deviation until a turn has begun and ended. An `assumed` delay is used
    even where it is smaller than its standard deviation.
    """

    delay_s: float = 0.0
    std_s: float = np.inf
    assumed: bool = False
    turn_factor: Quantity = Quantity(1.0, np.inf)

    @property
    def is_estimated(self) -> bool:
        """Whether the delay is assumed, or the drive shows it at all."""
        return self.assumed or bool(np.isfinite(self.std_s))

    @property
    def delay_ns(self) -> int:
        """What to subtract from the images' stamps: 0 for a delay that is not significant."""
        significant = self.assumed or abs(self.delay_s) > SIGNIFICANT_STDS * self.std_s
        return round(self.delay_s * 1e9) if significant else 0


class CameraClockFinder:
    """Compares the turns between images with those of the odometry, as both come in.

    `memory` is the number of image pairs after which an old one counts little; clocks drift.
    `start` is the estimate before any other.
    """

    def __init__(self, memory: float = np.inf, start: CameraClock | None = None) -> None:
        self._keep = 1.0 - 1.0 / memory
        self._start = start or CameraClock()
        self._estimates: deque[tuple[int, CameraClock]] = deque([(0, self._start)])
        self._driven: deque[tuple[int, float]] = deque()
        self._last: tuple[int, float] | None = None
        self._pairs: deque[tuple[int, int, float]] = deque()
        self._sums = _Sums(*np.zeros((7, len(_SIGNED), len(_GRID))))

    @property
    def clock(self) -> CameraClock:
        """The newest estimate."""
        return self._estimates[-1][1]

    def clock_at(self, stamp_ns: int) -> CameraClock:
        """The estimate that applies to an image of this stamp."""
        for since_ns, clock in reversed(self._estimates):
            if since_ns + _IN_TRANSIT_NS <= stamp_ns:
                return clock
        return self._estimates[0][1]

    def add_odometry(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take the heading by dead reckoning at a stamp; late stamps are skipped."""
        if self._driven:
            last_ns, last_yaw = self._driven[-1]
            if stamp_ns <= last_ns:
                return
            yaw_rad = last_yaw + float(wrap_angle(yaw_rad - last_yaw))
        self._driven.append((stamp_ns, yaw_rad))
        while self._pairs and self._pairs[0][1] + _WINDOW_NS <= stamp_ns:
            self._compare(*self._pairs.popleft())
        oldest = (self._pairs[0][0] if self._pairs else stamp_ns - _PAIR_NS) - 2 * _WINDOW_NS
        while len(self._driven) > 2 and self._driven[1][0] < oldest:
            self._driven.popleft()

    def add_heading(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take the heading that a `VisualGyro` has added up at an image's stamp."""
        if self._last is not None:
            span_ns = stamp_ns - self._last[0]
            turn = float(wrap_angle(yaw_rad - self._last[1]))
            if 0 <= span_ns < NEAR_NS:
                return
            if 0 < span_ns < _PAIR_NS:
                self._pairs.append((self._last[0], stamp_ns, turn))
        self._last = stamp_ns, yaw_rad

    def _compare(self, start_ns: int, stop_ns: int, turn: float) -> None:
        """Add a pair of images to all sums, once odometry surrounds it by any delay."""
        first = start_ns - _WINDOW_NS
        last = stop_ns + _WINDOW_NS
        stamps_ns, yaw = map(np.array, zip(*self._driven, strict=True))
        pauses_ns = stamps_ns[1:][np.diff(stamps_ns) > _PAUSE_NS]
        if first < stamps_ns[0] or np.any((first <= pauses_ns) & (pauses_ns <= last)):
            return
        seconds = (stamps_ns - start_ns) * 1e-9
        span = (stop_ns - start_ns) * 1e-9
        counted = np.interp(span - _GRID, seconds, yaw) - np.interp(-_GRID, seconds, yaw)
        pairs = zip(self._sums, _Sums.of_pair(turn, counted), strict=True)
        self._sums = _Sums(*(self._keep * total + new for total, new in pairs))
        estimate = self._sums.estimate()
        if estimate.is_estimated:
            self._estimates.append((last, self._at_start(estimate)))
        while len(self._estimates) > 2 and self._estimates[1][0] < last - _REMEMBERED_NS:
            self._estimates.popleft()

    def _at_start(self, estimate: CameraClock) -> CameraClock:
        """An estimate with the delay that was assumed at the start, if it agrees with that."""
        start = self._start
        differs = abs(estimate.delay_s - start.delay_s) > SIGNIFICANT_STDS * estimate.std_s
        if differs or not start.assumed:
            return estimate
        std_s = min(start.std_s, estimate.std_s)
        return CameraClock(start.delay_s, std_s, True, estimate.turn_factor)


class _Sums(NamedTuple):
    """Sums over pairs of images, by signed factor and delay (F, D)."""

    cost: Array
    power: Array
    """Curvature of the cost by the delay."""
    square: Array
    pull: Array
    """Curvature and slope of the cost by the factor."""
    turns: Array
    size: Array
    error: Array
    """Of pairs with turns their number, their size, rad, and their residuals, rad."""

    @classmethod
    def of_pair(cls, turn: float, counted: Array) -> _Sums:
        """Of one pair with this turn, rad, and that of the odometry by delays (D,)."""
        driven = _SIGNED * counted
        signed = np.asarray(wrap_angle(turn - driven)) / _SCALE_RAD
        residual = np.abs(signed)
        turning = (np.abs(driven) > _TURN_RAD).astype(float)
        limited: Array = np.minimum(residual, _OUTLIER)
        near = residual < _OUTLIER
        return cls(
            limited,
            # The derivative of a turn by the delay is the difference of the turn rates at its ends.
            near * np.gradient(driven, _STEP_S, axis=1) ** 2,
            near * counted**2,
            near * signed * _SCALE_RAD * np.sign(_SIGNED) * counted,
            turning,
            turning * np.abs(driven),
            turning * limited * _SCALE_RAD,
        )

    def estimate(self) -> CameraClock:
        """The delay of the least cost, unless it lies at the border or the turns do not fix it."""
        side, best = np.unravel_index(int(np.argmin(self.cost)), self.cost.shape)
        turns = self.turns[side, best]
        error = self.error[side, best]
        is_clear = turns >= _TURNS_MIN and error <= self.size[side, best] / 2
        if not is_clear or not 0 < best < len(_GRID) - 1:
            return CameraClock()
        scale = max(error / turns / _MEAN_OF_NORMAL, _SCALE_MIN_RAD)
        std = _CAUTION * scale / np.sqrt(max(self.power[side, best], 1e-12))
        # While a robot turns steadily, many delays fit nearly as well as the best.
        alike = _GRID[self.cost[side] <= self.cost[side, best] + _ALIKE]
        std = max(std, float(np.ptp(alike)) / 4)
        if std > _STD_MAX_S:
            return CameraClock()
        delay_s = float(_GRID[best] + _STEP_S * _lowest(*self.cost[side, best - 1 : best + 2]))
        square = max(float(self.square[side, best]), 1e-12)
        factor = abs(float(_SIGNED[side, 0])) + float(self.pull[side, best]) / square
        turn_factor = Quantity(factor, float(_CAUTION * scale / np.sqrt(square)))
        return CameraClock(delay_s, float(std), False, turn_factor)


def _lowest(below: float, least: float, above: float) -> float:
    """Where two slopes meet, in the minimum of a sum of absolute values: -0.5 to 0.5 steps."""
    steepest = max(below - least, above - least)
    return (below - above) / (2 * steepest) if steepest > 0 else 0.0


class ImageClock:
    """How far ahead of the odometry images are stamped, `offset_ns`, if farther than turns show.

    The order of arrival shows it: images come soon after odometry of their time. It is used as soon
    as the turns of images that are stamped so agree with those of the odometry.
    """

    def __init__(self, memory: float) -> None:
        self.offset_ns = 0
        self._memory = memory
        self._ahead_ns: deque[int] = deque(maxlen=_ARRIVALS)
        self._supposed: tuple[int, CameraClockFinder] | None = None

    def add_odometry(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take the heading by dead reckoning."""
        if self._supposed:
            self._supposed[1].add_odometry(stamp_ns, yaw_rad)

    def add_heading(
        self, stamp_ns: int, yaw_rad: float, odometry_ns: int
    ) -> CameraClockFinder | None:
        """Take the heading at an image's stamp; return the new finder if an offset is confirmed."""
        self._ahead_ns.append(stamp_ns - odometry_ns)
        ahead_ns = np.array(self._ahead_ns) - self.offset_ns
        if len(ahead_ns) < _ARRIVALS or np.ptp(ahead_ns) > _IN_TRANSIT_NS:
            return None
        if -CLOCK_JUMP_NS < np.median(ahead_ns) < _FAR_NS:  # queues may delay images
            self._supposed = None
            return None
        if self._supposed is None:
            offset_ns = whole_leap(float(np.median(self._ahead_ns)))
            offset_ns = offset_ns if abs(offset_ns) > _FAR_NS else 0
            self._supposed = offset_ns, CameraClockFinder(self._memory)
        offset_ns, finder = self._supposed
        finder.add_heading(stamp_ns - offset_ns, yaw_rad)
        if not finder.clock.is_estimated:
            return None
        self.offset_ns = offset_ns
        self._supposed = None
        return finder


def camera_clock(odometry: Odometry, stamps_ns: Stamps, headings: Iterable[float]) -> CameraClock:
    """The delay of a recorded camera whose images, at stamps (N,), show these headings, rad.

    `headings` are what `camera.turns.headings` measures between the images; their sign may be
    either, because the one that agrees better with the odometry is taken.
    """
    finder = CameraClockFinder()
    image_headings = iter(headings)
    for stamp_ns, kind, i in merge_by_stamp(odometry.stamps_ns, stamps_ns):
        if kind == ODOMETRY:
            finder.add_odometry(stamp_ns, float(odometry.poses[i, 2]))
        else:
            finder.add_heading(stamp_ns, next(image_headings))
    return finder.clock
