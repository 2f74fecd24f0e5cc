# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What one source of motion measured, as another one saw it: one fit for scale, delay and drift.

In a window [s, e] source b moves as a did, by another clock and with another scale:

    y(s, e) = k [A(c(e)) - A(c(s))] + n,    c(t) = t - tau - rho t

for sums A of the turns, or ways, of a. The delay tau and the drift rho are those at which both
correlate best, with clipped steps: first on a grid, then refined without what does not fit. The
likelihood of what is left, with Student's noise, decides whether there is a drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import optimize

from sfa_localization.data.events import CLOCK_RANGE_S
from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.run import Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, quantile, surprise
from sfa_localization.motion.dead_reckoning import without_pause
from sfa_localization.motion.sources import (
    ALIKE,
    ENOUGH,
    EQUAL,
    GYRO,
    IMAGES,
    LATE_S,
    POSE,
    TWIST,
    Drift,
    Pair,
    Source,
)

DELAYS_S = np.linspace(-CLOCK_RANGE_S, CLOCK_RANGE_S, 51)
"""Those that are searched."""
FAR = 3.0
"""Steps beyond so many times the typical one are clipped, and errors beyond so many standard
deviations take no part."""
DELAY_STD_MAX_S = 0.06
"""A delay is certain if the delays that fit nearly as well scatter by less than this."""
RATE_MAX = 0.02
"""Clocks of cameras are up to 1 % fast."""
GAIN = 6.0
"""Least gain of log-likelihood by a drift: of 91 sources of right drives, 32 of them with slip of
real wheels, none gains more than 3.5."""
LEAST_STD = 0.005
"""rad, of the turns of a window, as images show them at best."""
EXPLAINED = 0.5
"""A camera follows the robot if a model of this leaves at most this share of the variance that the
best delay leaves: 0.02 to 0.5 for lags of 0.3 s and more, at least 0.9 for right drives."""
# Windows are lengthened until half of the motion is in windows with _STEP (rad, m) or more.
_WINDOWS_S = 0.19 * 2.0 ** np.arange(4)
_STEP = 0.1
_WINDOWS_MAX = 1000
_PAUSE_S = 1.0
# First steps around the best of the grid, s, and that of its rates over the whole drive.
_STEP_S = 0.02
_RATE_STEP_S = 0.3
# Neighboring windows err alike.
_ALIKE_WINDOWS = 3
# Models of a camera that follows: lag, s, largest rate, rad/s, and turn that it ignores, rad.
_FOLLOWERS = np.array(
    [*product((0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0), (np.inf, 0.4, 0.2), (0.0,))][1:]
    + [(0.0, np.inf, ignored) for ignored in (0.1, 0.2, 0.4, 0.8)]
)
_FOLLOWER_STEP_S = 0.05


class _Clock(NamedTuple):
    """The likeliest delay, s, in the middle of the drive, and rate; correlation and scale then; of
    the windows, residuals (M,), their robust standard deviation, and which fit, or move and fit.
    """

    delay_s: float
    rate: float
    correlation: float
    scale: float
    residual: Array
    std: float
    fits: Mask
    moves: Mask


class _Windows:
    """Sources `a` and `b` in M windows between messages of the slower of them."""

    def __init__(self, what: str, a: Source, slow: Source, fast: Source, windows: Stamps) -> None:
        self.what = what
        self.fast = fast
        self.windows = windows
        self.steps = slow.moved(windows, what)
        self.a_is_slow = slow is a
        self.middle_ns = int(windows.mean())
        self.seconds = (windows[:, 0] - self.middle_ns) * 1e-9
        steps = np.array(self.at(0.0))
        # Noise adds up while nothing moves, and that of images may be large.
        sure = [each.name != IMAGES for each in ((slow, fast) if self.a_is_slow else (fast, slow))]
        size = np.abs(steps[sure])
        self.motion = float((size * (size > _STEP / 2)).sum(1).max())
        limit = np.array([typical(each) for each in steps])
        # Shifts between images may err by any angle.
        self.limit = limit if all(sure) else np.minimum(limit, 2 * limit[::-1])

    @classmethod
    def of(cls, a: Source, b: Source, what: str) -> _Windows | None:
        """None where both measured too little motion at the same time."""
        slow, fast = sorted((a, b), key=lambda source: -source.period_s)
        if what not in slow.sums or what not in fast.sums:
            return None
        for length_s in _WINDOWS_S:
            windows = _between_messages(slow, fast, length_s)
            if not len(windows):
                return None
            if typical(slow.moved(windows, what)) >= _STEP:
                break
        compared = cls(what, a, slow, fast, windows)
        return compared if compared.motion >= ENOUGH[what] else None

    def at(self, delay_s: Array | float, rate: float = 0.0) -> tuple[Array, Array]:
        """The motion (..., M) of `a` and of `b`, which is late by the delays (..., 1) s in the
        middle of the drive and gains `rate` s in each second.
        """
        late_s = delay_s + rate * self.seconds
        late_ns = np.round(late_s * 1e9).astype(np.int64)[..., None]
        shifted = self.windows + (late_ns if self.a_is_slow else -late_ns)
        moving = self.fast.moved(shifted, self.what)
        fixed = np.broadcast_to(self.steps, moving.shape)
        return (fixed, moving) if self.a_is_slow else (moving, fixed)

    def clipped(self, delay_s: Array | float, rate: float = 0.0) -> tuple[Array, Array]:
        """The motion as `at` this delay and rate, without outliers."""
        x, y = self.at(delay_s, rate)
        bounds = FAR * self.limit
        return np.clip(x, -bounds[0], bounds[0]), np.clip(y, -bounds[1], bounds[1])

    def correlations(self, fits: Mask, delay_s: Array | float, rate: float = 0.0) -> Array:
        """Correlations (...) at delays (..., 1), by the windows (M,) that fit."""
        x, y = self.clipped(delay_s, rate)
        product, power, other = ((each * fits).sum(-1) for each in (x * y, x * x, y * y))
        return np.asarray(np.abs(product) / np.sqrt(np.maximum(power * other, 1e-30)))

    def fitted(self, rates: Array) -> _Clock:
        """The likeliest clock near one of the rates (R,); that with no drift for one rate."""
        fits = np.ones(len(self.steps), bool)
        lines = np.array([self.correlations(fits, DELAYS_S[:, None], rate) for rate in rates])
        row, column = np.unravel_index(int((lines - 1e-6 * np.abs(DELAYS_S)).argmax()), lines.shape)
        start = np.array([DELAYS_S[column], rates[row]])[: len(rates)]
        size = np.array([_STEP_S, _STEP_S / np.ptp(self.seconds)])[: len(rates)]
        for _ in range(2):
            best = optimize.minimize(
                lambda clock, fits: -float(self.correlations(fits, *clock)),
                start, fits, 'Nelder-Mead',
                options={'initial_simplex': start + np.vstack([0 * size, np.diag(size)])},
            )  # fmt: skip
            start = best.x
            clock = self._clock(fits, *start.tolist())
            fits = clock.fits
        return clock

    def _clock(self, fits: Mask, delay_s: float, rate: float = 0.0) -> _Clock:
        """What a delay and a rate leave, which were the likeliest by windows (M,)."""
        x, y = self.at(delay_s, rate)
        # The least sum of |y - scale x|.
        scale = quantile(y / np.where(x == 0, 1.0, x), 0.5, np.abs(x))
        residual = np.abs(y - scale * x)
        moves = np.abs(x) > self.limit[0] / 4
        std = MEDIAN_TO_STD * float(np.median(residual[moves])) if moves.any() else np.inf
        correlation = float(self.correlations(fits, delay_s, rate))
        fits = residual <= max(FAR * std, self.limit[1] / 2)
        return _Clock(delay_s, rate, correlation, scale, residual, std, fits, moves & fits)

    def is_certain(self, clock: _Clock) -> bool:
        """Whether no other delays fit as well: within one standard deviation of the best."""
        correlations = self.correlations(clock.fits, DELAYS_S[:, None], clock.rate)
        best = correlations.max()
        chance = (1 - best**2) / np.sqrt(max(clock.moves.sum(), 1))
        as_good = DELAYS_S[correlations >= best - chance - 1e-3]
        inside = abs(clock.delay_s) < DELAYS_S[-2]
        return bool(inside and np.ptp(as_good) / 4 < DELAY_STD_MAX_S)


def typical(x: Array) -> float:
    """The step of x (N,) so that half of the motion is in steps as large, or larger ones: standing
    does not count.
    """
    return quantile(np.abs(x), 0.5, np.abs(x))


def _between_messages(slow: Source, fast: Source, length_s: float) -> Stamps:
    """Windows (M, 2) ns between stamps of the slow source; whatever the delay, neither pauses."""
    edges = slow.stamps_ns[:: int(np.ceil(length_s / slow.period_s))]
    windows = np.column_stack([edges[:-1], edges[1:]])
    reach = round(CLOCK_RANGE_S * 1e9)
    for source, margin in ((slow, 0), (fast, reach)):
        pause_s = max(_PAUSE_S, 3 * source.period_s)
        begin = windows[:, 0] - margin
        end = windows[:, 1] + margin
        windows = windows[without_pause(begin, end, source.stamps_ns, pause_s)]
    return windows[:: len(windows) // _WINDOWS_MAX + 1]


def compare(a: Source, b: Source, what: str = 'turns') -> Pair | None:
    """Compare two sources; None where they measured too little motion at the same time."""
    windows = _Windows.of(a, b, what)
    if windows is None:
        return None
    clock = windows.fitted(np.zeros(1))
    period_s = max(source.period_s for source in (a, b) if source.name != IMAGES)
    delay_s = clock.delay_s if windows.is_certain(clock) else None
    return Pair(what, a.name, b.name, clock.scale, delay_s, clock.correlation, period_s)


def drift(a: Source, b: Source) -> Drift | None:
    """How the clock of `b` drifts against that of `a`, by their turns; None where nothing shows a
    drift, or it matters less than a delay of LATE_S.
    """
    windows = _Windows.of(a, b, 'turns')
    if windows is None:
        return None
    span_s = float(np.ptp(windows.seconds))
    clock = windows.fitted(np.arange(-RATE_MAX, RATE_MAX, _RATE_STEP_S / span_s))
    std = max(clock.std, LEAST_STD)
    with_drift, without = (
        surprise((each.residual / std) ** 2, 1).sum() / _ALIKE_WINDOWS
        for each in (clock, windows.fitted(np.zeros(1)))
    )
    matters = LATE_S / span_s < abs(clock.rate) < RATE_MAX
    if clock.correlation < ALIKE or without - with_drift < GAIN or not matters:
        return None
    middle_ns = windows.middle_ns
    if windows.a_is_slow:  # the rate is over the time of `a`
        at_ns = middle_ns + round(clock.delay_s * 1e9)
        return Drift(at_ns, clock.delay_s, clock.rate / (1 + clock.rate))
    return Drift(middle_ns, clock.delay_s, clock.rate)


def drifts(sources: Sequence[Source]) -> dict[str, Drift]:
    """By name, the clocks that drift against that of the odometry, by its pose and by its twist."""
    turning = [source for source in sources if 'turns' in source.sums]
    wheels = [source for source in turning if source.name in (POSE, TWIST)]
    drifting = {}
    for source in turning:
        if source not in wheels:
            against = [drift(wheel, source) for wheel in wheels]
            if against[0] and all(one and one.rate * against[0].rate > 0 for one in against):
                drifting[source.name] = against[0]
    return drifting


def drift_sentences(drifting: dict[str, Drift]) -> list[str]:
    """Which clocks run at another rate: that of the odometry, where all others differ alike."""
    rates = [each.rate for each in drifting.values()]
    if (
        len(rates) > 1
        and min(rates) * max(rates) > 0
        and min(map(abs, rates)) * EQUAL > max(map(abs, rates))
    ):
        each = next(iter(drifting.values()))
        drifting = {'odometry': replace(each, rate=-each.rate)}
    return [
        f'{name}: {"their" if name == IMAGES else "its"} clock runs {each}: taken into account'
        for name, each in drifting.items()
    ]


def following(sources: Sequence[Source]) -> str:
    """How images follow the turns of the robot, in words; '' if they turn with it.

    A camera that follows explains them much better than any delay, by each source of turns.
    """
    images = next((source for source in sources if source.name == IMAGES), None)
    others = [one for one in sources if one.name != IMAGES and 'turns' in one.sums]
    if images is None or not others:
        return ''
    models = _FOLLOWERS
    for source in reversed(others):
        direct = compare(source, images)
        if direct is None:
            return ''
        pairs = [compare(shown, images) for shown in _followers(source, models)]
        explained = np.array([pair.correlation**2 if pair else 0.0 for pair in pairs])
        best = int(explained.argmax())
        models = models[best : best + 1]
        pair = pairs[best]
        # Wheels with bursts of slip look smoothed before and after; no camera turns in advance.
        early = others[-1].name != GYRO and pair and (pair.delay_s or 0.0) < -LATE_S
        if early or not 1 - explained[best] < EXPLAINED * (1 - direct.correlation**2):
            return ''
    lag_s, fastest, ignored = models[0].tolist()
    how = [f'with a lag of {lag_s:g} s'] if lag_s else []
    how += [f'at {fastest:g} rad/s at most'] if np.isfinite(fastest) else []
    how += [f'beyond {np.rad2deg(ignored):.0f} degrees only'] if ignored else []
    return ' and '.join(how)


def _followers(source: Source, models: Array) -> list[Source]:
    """What cameras show that follow the turns of a source by each of the models (K, 3)."""
    lag_s, fastest, ignored = models.T
    with np.errstate(divide='ignore'):
        share = -np.expm1(-_FOLLOWER_STEP_S / lag_s)
    span_s = float(source.stamps_ns[-1] - source.stamps_ns[0]) * 1e-9
    seconds = np.arange(0.0, span_s + _FOLLOWER_STEP_S, _FOLLOWER_STEP_S)
    at_s = (source.stamps_ns - source.stamps_ns[0]) * 1e-9
    yaw = np.interp(seconds, at_s, source.sums['turns'])
    most = fastest * _FOLLOWER_STEP_S
    shown = np.tile(yaw[0], (len(yaw), len(lag_s)))
    for k in range(1, len(yaw)):
        behind = yaw[k] - shown[k - 1]
        pulled = (behind - np.clip(behind, -ignored, ignored)) * share
        shown[k] = shown[k - 1] + np.clip(pulled, -most, most)
    stamps_ns = source.stamps_ns[0] + np.round(seconds * 1e9).astype(np.int64)
    return [replace(source, stamps_ns=stamps_ns, sums={'turns': turns}) for turns in shown.T]
