# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the images turn as the odometry does, and when: the odds of every delay between both.

Images that are stamped late, a queue that lags behind, a video that loops or runs slowly: on a
smooth curve all of them lie on the odometry's path, meters away from the robot. What shows them is
that the robot turned at another time. A Bayes filter holds the probability of each delay, and of
images that have nothing to do with the odometry. It forgets by evidence, not by time: on a straight
line, which shows no delay, it keeps what it found for minutes. `CameraClockFinder` measures a delay
that lasts; this one watches for any that is not compensated; `lateness` does so by poses.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.pace import STANDING, TOLERATED_S, Pace

EARLIEST_S, LATEST_S = -1.5, 6.0
"""Delays that are distinguished; those beyond look like images without relation to the odometry."""
_STEP_S = 0.1
_DELAYS: Array = np.arange(EARLIEST_S / _STEP_S, LATEST_S / _STEP_S + 0.5) * _STEP_S
_NOW = int(np.argmin(np.abs(_DELAYS)))
_IN_TIME = np.abs(_DELAYS) <= TOLERATED_S
_NEAR = np.append(_IN_TIME, False)
_NEAR_COUNT = int(_NEAR.sum())
_CLOSE = np.abs(_DELAYS) <= 1.0
_EXPECTED_S = 0.3
"""Where the delay is expected at the start: synchronized clocks, and a camera's latency."""
_SURPRISE = 1e-2
"""Probability of anything else at the start."""
_BREAK, _HEAL = 1e-4, 2e-3
"""Probabilities that images in time come to any other delay at once, and the reverse: where nothing
shows a delay for long, it is rather none."""
_STAY = 1 - np.where(_NEAR, _BREAK, _HEAL)
_DRIFT = 0.1
"""Probability that a delay moves by a step, as of clocks that drift and videos that run slowly,
where the robot turns so that it would show."""
_PER_S = 0.15
"""All three are probabilities per so much time between the images of a pair."""
_CLEAR = 0.8
"""1/s: by how much, for each second between its images, a pair in a curve distinguishes delays."""
DOUBT = 0.3
"""Probability of any other delay where images have just moved the estimate."""
_SUGGESTED, _ACQUITTED = 0.95, 1e-2
"""Probability of a delay that something else than turns suggests, and what is left of it."""
_ALIKE = 0.5
"""What a pair counts where all that come are weighed for one delay."""
_LEAST_RAD, _MOST_RAD, _START_RAD = 0.008, 0.1, 0.010
"""Standard deviation of a turn between two images against the odometry's: limits and start. Below a
half degree the noise of the odometry itself would decide between delays."""
_LEARNING = 0.03  # relative change of that standard deviation per pair
_MEDIAN = 0.6745  # of the absolute value of a standard normal variable
_GAIN = 0.05
"""Standard deviation, relative, of turns by wheels: they slip, and their track is not exact."""
_NOISY = 1.25
"""Turns by odometry that differ between delays by this part of that standard deviation are half
noise, which on a straight line would decide."""
_JITTER_S = 0.02
"""Standard deviation of images' stamps."""
_MISMATCH, _MISMATCH_RAD = 0.05, 0.3
"""Share of pairs whose turn is wrong, and by how much: something covers a part of the image."""
_UNRELATED_RAD, _UNRELATED_STDS, _UNRELATED_SHARE = 0.05, 2.0, 0.5
"""Turns of images that have nothing to do with the odometry differ by so much per pair, by so many
of the standard deviations of turns that have, and by such a share of what the robot turns."""
_SMOOTH_S = 0.2
"""Turns of robots that drive last longer."""
_ACCELERATION = 0.3
"""rad/s^2: how fast a turn rate changes, for times of which no odometry has come yet."""
_NEAR_NS, _FARTHEST_NS = 150_000_000, 4_000_000_000
"""Closer images turn too little; between farther ones the odometry is not good for a turn."""
_APART_NS, _APART_M = 750_000_000, 0.75
"""Images that are farther apart in time or on the way show other sides of near things, which shifts
them as a turn does: their turn is that of the headings in the map."""
_OWN = 0.25
"""Share of the variances of headings in the map that neighboring images have not in common."""
_SOON_NS, _FINALLY_NS = 300_000_000, round(-EARLIEST_S * 1e9)
"""A pair counts after so long, with odometry that goes on as before where images may be early; and
for good when all of the odometry is there."""
_PAUSE_NS = 500_000_000
_REMEMBERED_NS = round((LATEST_S + 4.0) * 1e9)


class Pair(NamedTuple):
    """Two images and the turn between them, rad, with its variance beside the usual one."""

    start_ns: int
    stop_ns: int
    turn: float
    variance: float = 0.0


class Seen(NamedTuple):
    """The heading in the map, rad, that an image of a known place shows, and its variance."""

    stamp_ns: int
    yaw: float
    variance: float


class TurnWatch:
    """Feed it turn rates and the headings that images add up to; ask how far apart they are."""

    def __init__(self) -> None:
        expected = np.abs(_DELAYS) < _EXPECTED_S + _STEP_S / 2
        odds = np.where(expected, 1 / expected.sum(), _SURPRISE / len(_DELAYS))
        odds = np.append(odds, _SURPRISE)
        self._settled: Array = odds / odds.sum()
        self._odds = self._settled
        self._std = _START_RAD
        self._lasting = False
        self._pace = Pace()
        self.forget_time()

    def forget_time(self) -> None:
        """Stamps start anew; what is known about the delay stays."""
        self._stamps: deque[int] = deque()
        self._yaws: deque[float] = deque()
        self._silent: deque[float] = deque()
        self._pairs: deque[Pair] = deque()
        self._counted = 0
        self._last: tuple[int, float] | None = None
        self._seen: Seen | None = None

    def add_odometry(self, stamp_ns: int, v: float, omega: float) -> None:
        """Take a speed m/s and a turn rate rad/s, without bias, held since those before; skip late
        ones.
        """
        gap = stamp_ns - self._stamps[-1] if self._stamps else 1
        if gap <= 0:
            return
        self._pace.add(v, omega, gap * 1e-9)
        paused = gap if gap > _PAUSE_NS else 0
        self._yaws.append((self._yaws[-1] + omega * gap * 1e-9) if self._yaws else 0.0)
        self._silent.append((self._silent[-1] if self._silent else 0.0) + paused * 1e-9)
        self._stamps.append(stamp_ns)
        while self._stamps[0] < stamp_ns - _REMEMBERED_NS:
            for kept in (self._stamps, self._yaws, self._silent):
                kept.popleft()
        self._weigh(stamp_ns)

    def add_heading(self, stamp_ns: int, yaw_rad: float) -> None:
        """Take the heading that a `VisualGyro` has added up at an image's stamp."""
        last = self._last
        gap = stamp_ns - last[0] if last else _APART_NS
        if 0 <= gap < _NEAR_NS:
            return
        if last and 0 < gap < self._apart_ns:
            self._pairs.append(Pair(last[0], stamp_ns, float(wrap_angle(yaw_rad - last[1]))))
        self._last = stamp_ns, yaw_rad

    def add_seen(self, seen: Seen) -> None:
        """Take the heading in the map that an image shows: that of slow cameras shows turns."""
        last, self._seen = self._seen, seen
        if last and self._apart_ns <= seen.stamp_ns - last.stamp_ns <= _FARTHEST_NS:
            turn = float(wrap_angle(seen.yaw - last.yaw))
            variance = _OWN * (last.variance + seen.variance)
            self._pairs.append(Pair(last.stamp_ns, seen.stamp_ns, turn, variance))

    def doubt(self) -> None:
        """Images have moved the estimate: perhaps they are of another time, once or many times."""
        apart = 1.0 - float(self._settled[_NEAR].sum())
        self._expect(max(DOUBT - apart, 0.0), np.full(len(self._odds), 1 / len(self._odds)))

    def suspect(self, delay_s: float) -> None:
        """Something else than turns suggests this delay, which lasts: until turns deny it, it is
        likely.
        """
        self._lasting = True
        self._expect(_SUGGESTED, _there(delay_s))

    def acquit(self, delay_s: float) -> None:
        """Nothing suggests this delay any more but turns, if they do."""
        self._lasting = False
        left = np.where(_there(delay_s) > 0, _ACQUITTED, 1.0)
        self._settled = self._settled * left / (self._settled @ left)
        self._odds = self._odds * left / (self._odds @ left)

    @property
    def tolerated_s(self) -> float:
        """Delays within this around the one that is compensated are small for this robot."""
        return self._pace.tolerated_s

    def apart(self, compensated_s: float) -> float:
        """Probability that images are off by more than is tolerated from a compensated delay."""
        near = np.abs(_DELAYS - compensated_s) <= self.tolerated_s
        return 1.0 - float(self._odds[:-1][near].sum())

    def error_s(self, compensated_s: float) -> float:
        """Root mean square of the time by which images are off; unrelated ones by any."""
        square = (_DELAYS - compensated_s) ** 2
        far = np.where(np.abs(_DELAYS - compensated_s) > self.tolerated_s, square, 0.0)
        return math.sqrt(float(self._odds[:-1] @ far + self._odds[-1] * square.mean()))

    def problem(self, compensated_s: float) -> str:
        """How images and odometry are most likely apart in time."""
        best = int(np.argmax(self._odds))
        off_s = 0.0 if best == len(_DELAYS) else float(_DELAYS[best]) - compensated_s
        if abs(off_s) <= self.tolerated_s:
            return 'images and odometry turn differently'
        late = 'late' if off_s > 0 else 'early'
        return f'images are stamped {abs(off_s):.1f} s {late}, or delayed: synchronize the clocks'

    @property
    def _apart_ns(self) -> int:
        """The time between images from which their turn is that of the headings in the map."""
        return min(_APART_NS, round(_APART_M / max(self._pace.v, STANDING) * 1e9))

    def _weigh(self, now_ns: int) -> None:
        """The odds by now: from pairs for good, and from those that are not complete yet."""
        settled = False
        while self._pairs and self._pairs[0].stop_ns + _FINALLY_NS <= now_ns:
            pair, settled = self._pairs.popleft(), True
            residual, std = self._residuals(pair)
            self._settled = self._after(self._settled, pair, residual, std)
            self._learn(residual)
        count = sum(pair.stop_ns + _SOON_NS <= now_ns for pair in self._pairs)
        if settled or count != self._counted:
            self._counted, self._odds = count, self._settled
            for pair in list(self._pairs)[:count]:
                self._odds = self._after(self._odds, pair, *self._residuals(pair))

    def _expect(self, share: float, odds: Array) -> None:
        """Of all probability, lay a share out by these odds."""
        self._settled = (1 - share) * self._settled + share * odds
        self._odds = (1 - share) * self._odds + share * odds

    def _after(self, odds: Array, pair: Pair, residual: Array, std: Array) -> Array:
        """The odds after a pair, before the next one; of a delay that lasts, neighboring pairs
        err alike.
        """
        if self._lasting:
            return _weighed(odds, pair.turn, residual, std, _ALIKE)
        seconds = (pair.stop_ns - pair.start_ns) * 1e-9
        odds = _weighed(odds, pair.turn, residual, std)
        drift = _DRIFT * min(_shown(residual, std) / (_CLEAR * seconds), 1.0)
        for _ in range(max(round(seconds / _PER_S), 1)):
            odds = _moved(odds, drift)
        return odds

    def _residuals(self, pair: Pair) -> tuple[Array, Array]:
        """By which the turn differs from the odometry's, and its standard deviation, by delay.

        NaN where the odometry was silent, or had not begun.
        """
        stamps, newest = self._stamps, self._stamps[-1]
        times: Array = np.asarray((np.array(stamps, np.int64) - newest) * 1e-9, float)
        yaws, silent = np.array(self._yaws), np.array(self._silent)
        start, stop = (pair.start_ns - newest) * 1e-9, (pair.stop_ns - newest) * 1e-9
        rate = self._newest_rate(times, yaws)
        paused = np.interp(stop - _DELAYS, times, silent) - np.interp(
            start - _DELAYS, times, silent
        )
        seen = (start - _DELAYS >= times[0]) & (paused <= 0)
        driven = _at(stop - _DELAYS, times, yaws, rate) - _at(start - _DELAYS, times, yaws, rate)
        driven = _beyond_noise(driven, seen, _NOISY * self._std)
        unknown = np.maximum(stop - _DELAYS, 0.0)
        std = np.sqrt(
            self._std**2
            + pair.variance
            + (_GAIN * driven) ** 2
            + 2 * (_JITTER_S * driven / (stop - start)) ** 2
            + (_ACCELERATION * unknown * (stop - start)) ** 2
        )
        return np.where(seen, wrap_angle(pair.turn - driven), np.nan), std

    @staticmethod
    def _newest_rate(times: Array, yaws: Array) -> float:
        """The mean turn rate of the newest messages."""
        first = max(len(times) - 6, 0)
        return float((yaws[-1] - yaws[first]) / max(times[-1] - times[first], 1e-3))

    def _learn(self, residual: Array) -> None:
        """How well turns agree usually, where they are related at all."""
        best = int(np.argmax(self._settled))
        if best == len(_DELAYS) or not math.isfinite(residual[best]):
            return
        larger = abs(residual[best]) > _MEDIAN * self._std
        std = self._std * math.exp(_LEARNING if larger else -_LEARNING)
        self._std = min(max(std, _LEAST_RAD), _MOST_RAD)


def _beyond_noise(driven: Array, seen: NDArray[np.bool_], noise: float) -> Array:
    """Turns by delay, rad, drawn to their mean where those `seen` differ by noise alone."""
    mean, differ = (driven[seen].mean(), driven[seen].std()) if seen.any() else (0.0, 0.0)
    return np.asarray(mean + (driven - mean) / (1 + (noise / max(differ, 1e-9)) ** 4))


def _weighed(odds: Array, turn: float, residual: Array, std: Array, power: float = 1.0) -> Array:
    """Bayes: the odds after a pair that leaves these residuals, its likelihood to a power."""
    now = residual[_NOW]
    if not math.isfinite(now):
        return odds
    mismatch = _density(residual, _MISMATCH_RAD)
    fits = (1 - _MISMATCH) * _density(residual, std) + _MISMATCH * mismatch
    turned = abs(float(wrap_angle(turn - now)))
    wide = max(_UNRELATED_RAD, _UNRELATED_STDS * float(std[_NOW]), _UNRELATED_SHARE * turned)
    unrelated = 0.8 * _density(now, wide) + 0.2 * mismatch[_NOW]
    # Of times without odometry nothing is known.
    fits = np.append(np.where(np.isfinite(fits), fits, unrelated), unrelated)
    weighed = odds * fits**power
    return np.asarray(weighed / weighed.sum())


def _shown(residual: Array, std: Array) -> float:
    """How well a pair distinguishes close delays: the variance of its turns over that of one."""
    differs = float(np.std(residual[_CLOSE])) / float(std[_NOW])
    return differs**2 if math.isfinite(differs) else 0.0


def _moved(odds: Array, drift: float) -> Array:
    """The odds _PER_S later: delays drift, begin and end."""
    later = drift * (odds[:-2] - odds[1:-1])
    drifted = odds.copy()
    drifted[:-2] -= later
    drifted[1:-1] += later
    good = float(drifted[:-1][_IN_TIME].sum())
    moved = drifted * _STAY + _BREAK * good / len(drifted)
    moved[_NEAR] += _HEAL * (1 - good) / _NEAR_COUNT
    return np.asarray(moved / moved.sum())


def _there(delay_s: float) -> Array:
    """Odds that are even near a delay, or near the earliest that is distinguished."""
    near = np.abs(_DELAYS - max(delay_s, EARLIEST_S)) <= _EXPECTED_S
    return np.append(near / near.sum(), 0.0)


def _at(times: Array, known: Array, yaws: Array, rate: float) -> Array:
    """Heading at times (N,), going on at a rate beyond the last one that is known.

    The mean of three: noise of the odometry differs between delays, and would decide.
    """
    near = np.concatenate([times - _SMOOTH_S, times, times + _SMOOTH_S])
    yaw = np.interp(near, known, yaws) + rate * np.maximum(near - known[-1], 0.0)
    return np.asarray(yaw.reshape(3, -1).mean(axis=0))


def _density(residual: Array | float, std: Array | float) -> Array:
    """Of a normal distribution, up to a factor."""
    return np.asarray(np.exp(-0.5 * np.square(np.asarray(residual) / std)) / std)
