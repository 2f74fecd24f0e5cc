# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that drift, and cameras that follow the robot's turns: what no constant delay explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.run import Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, outlier_factor, surprise
from sfa_localization.metric.motion_samples import OUTLIER
from sfa_localization.metric.motion_sources import (
    ENOUGH,
    EQUAL,
    GRID,
    GYRO,
    IMAGES,
    LATE_S,
    POSE,
    TWIST,
    Source,
    compare,
    in_windows,
    typical,
)

EXPLAINED = 0.5
"""A camera follows the robot if a model of this leaves at most this share of the variance that the
best delay leaves: 0.02 to 0.5 for lags of 0.3 s and more, at least 0.9 for right drives."""
_RATE_STD = 0.005
"""Of the rates of clocks that drift: those of cameras are up to 1 % fast."""
_BEGIN_S = 50.0
"""Time before and after the middle of the turns in which a drift is fitted first: a clock that is
1 % fast gains less than a turn lasts."""
_STEADY = 1e-9  # of the rate of a clock that does not drift
_PARTS, _ROUNDS, _SETTLED = 12, 20, 1e-5
_STEP_S, _SLIGHT_RAD = 0.05, 1e-3
_REACH = 0.3, _RATE_STD  # of one step: the largest change of the delay, s, and of its rate
# Models of a camera that follows: lag, s, largest rate, rad/s, and turn that it ignores, rad.
_FOLLOWERS = np.array(
    [*product((0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0), (np.inf, 0.4, 0.2), (0.0,))][1:]
    + [(0.0, np.inf, ignored) for ignored in (0.1, 0.2, 0.4, 0.8)]
)


Fit = tuple[float, float, float]
"""Scale, delay, s, and rate of a delay."""


@dataclass(frozen=True, slots=True)
class Drift:
    """A clock that is `delay_s` late at a stamp of its own, and gains `rate` s in each second."""

    at_ns: int
    delay_s: float
    rate: float

    def late_ns(self, stamps_ns: Stamps) -> Stamps:
        """By how much its stamps (N,) are late."""
        late_ns = self.delay_s * 1e9 + self.rate * (stamps_ns - self.at_ns)
        return np.round(late_ns).astype(np.int64)

    def __str__(self) -> str:
        return f'{abs(self.rate) * 100:#.2g} % {"fast" if self.rate > 0 else "slow"}'


def drift(a: Source, b: Source) -> Drift | None:
    """How the clock of `b` drifts against that of `a`, by their turns; None where nothing shows a
    drift, or it matters less than a delay of LATE_S.

    It is fitted where the sources are most alike, and then to more and more windows, which it leads
    near the right delay. Its standard deviation is that of fits that leave out parts of the drive.
    """
    chosen = in_windows(a, b, 'turns')
    if chosen is None:
        return None
    slow, fast, windows_ns = chosen
    sign = 1 if slow is a else -1
    every = _Turns(fast, windows_ns, slow.moved(windows_ns, 'turns'), windows_ns[0, 0])
    if not every.turned[-1] >= ENOUGH['turns']:  # also turns that are unknown
        return None
    part = (_PARTS * every.turned / every.turned[-1]).astype(int).clip(0, _PARTS - 1)
    centers_ns = [every.windows_ns[part >= k][0, 0] for k in range(_PARTS)]
    begins = [replace(every, at_ns=at_ns).within(_BEGIN_S).begin() for at_ns in centers_ns]
    best = max(range(_PARTS), key=lambda k: begins[k][1])
    every, (fit, _), radius_s = replace(every, at_ns=centers_ns[best]), begins[best], _BEGIN_S
    while radius_s < 2 * float(np.abs(every.seconds).max()):
        fit = every.within(radius_s).fitted(fit)
        radius_s *= 2
    rates = [every.where(part != k).fitted(fit)[2] for k in range(_PARTS)]
    std = float(np.sqrt(np.mean((np.array(rates) - fit[2]) ** 2) * (_PARTS - 1)))
    delay_s, rate = sign * fit[1], sign * fit[2]
    certain = abs(rate) > OUTLIER * std and every.better(fit) > OUTLIER**2 / 2
    if not certain or abs(rate) * np.ptp(every.seconds) < LATE_S:
        return None
    at_ns = int(every.at_ns)
    if slow is a:  # fitted over the time of `a`
        at_ns, rate = at_ns + round(delay_s * 1e9), rate / (1 + rate)
    return Drift(at_ns, delay_s, rate)


@dataclass(frozen=True, slots=True)
class _Turns:
    """`turns` (M,) rad of one source in windows (M, 2) ns, and the `other` source, which is late by
    a line: a delay, s, at a stamp, and a rate.
    """

    other: Source
    windows_ns: Stamps
    turns: Array
    at_ns: int
    rate_std: float = _RATE_STD

    @property
    def seconds(self) -> Array:
        """(M,) from the stamp to each window."""
        return np.asarray((self.windows_ns[:, 0] - self.at_ns) * 1e-9)

    @property
    def turned(self) -> Array:
        """Turns (M,) up to each window, in either direction."""
        return np.cumsum(np.abs(self.turns))

    def where(self, chosen: Mask) -> _Turns:
        """The chosen (M,) windows."""
        return replace(self, windows_ns=self.windows_ns[chosen], turns=self.turns[chosen])

    def within(self, radius_s: float) -> _Turns:
        """The windows so near to the stamp."""
        return self.where(np.abs(self.seconds) <= radius_s)

    def begin(self) -> tuple[Fit, float]:
        """The best constant delay, and the sum of the squared turns that it explains."""
        limit = 3 * typical(self.turns)
        shifted = np.array([self._shifted(delay_s, 0.0) for delay_s in GRID.tolist()])
        product_sum, power = (
            shifted @ np.clip(self.turns, -limit, limit),
            (shifted**2).sum(1) + 1e-9,
        )
        explained = product_sum**2 / power
        best = int(np.argmax(explained))
        return (float(product_sum[best] / power[best]), float(GRID[best]), 0.0), explained[best]

    def fitted(self, fit: Fit) -> Fit:
        """Scale, delay and rate by least squares without outliers, from near ones."""
        for _ in range(_ROUNDS):
            before, fit = fit, self._step(*fit)
            if np.allclose(fit, before, rtol=0.0, atol=_SETTLED):
                break
        return fit

    def _step(self, scale: float, delay_s: float, rate: float) -> Fit:
        """Scale, delay and rate after a step of Gauss and Newton."""
        turned = self._shifted(delay_s, rate)
        later, sooner = (self._shifted(delay_s + by, rate) for by in (_STEP_S, -_STEP_S))
        slope = (later - sooner) / (2 * _STEP_S)
        error = self.turns - scale * turned
        std = self._std(error)
        weight = 1 / (outlier_factor((error / std) ** 2) * std**2)
        design = np.column_stack([turned, slope, slope * self.seconds])
        prior = np.diag([0.0, 0.0, 1 / (self.rate_std * max(abs(scale), 0.1)) ** 2])
        normal = (design.T * weight) @ design + prior + 1e-9 * np.eye(3)
        scale, *change = np.linalg.solve(normal, design.T @ (weight * self.turns)).tolist()
        size = np.copysign(max(abs(scale), 0.1), scale)
        step_s, step = np.clip(np.divide(change, size), *np.outer((-1, 1), _REACH)).tolist()
        return scale, delay_s + step_s, rate + step

    def _std(self, error: Array) -> float:
        """Standard deviation, rad, of the errors (M,) of turns that stand out."""
        moving = np.abs(self.turns) >= typical(self.turns) / 4
        return MEDIAN_TO_STD * float(np.median(np.abs(error[moving]))) + _SLIGHT_RAD

    def better(self, fit: Fit) -> float:
        """Logarithm of the ratio of likelihoods of a fit and of the best constant delay."""
        scale, *steady = replace(self, rate_std=_STEADY).fitted((fit[0], fit[1], 0.0))
        errors = [self.turns - k * self._shifted(*line) for k, *line in ((scale, *steady), fit)]
        std = self._std(errors[1])
        constant, drifting = (surprise((error / std) ** 2, 1).sum() for error in errors)
        return float(constant - drifting)

    def _shifted(self, delay_s: float, rate: float) -> Array:
        """Turns (M,) of the other source in the windows, later by the line."""
        late_ns = np.round((delay_s + rate * self.seconds) * 1e9).astype(np.int64)
        return self.other.moved(self.windows_ns + late_ns[:, None], 'turns')


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
    if images is None:
        return ''
    best, least = -1, EXPLAINED
    for number, source in enumerate(reversed(others)):
        direct, models = compare(source, images), _followers(source)
        if direct is None or not direct.correlation < 1:
            return ''
        pairs = [compare(model, images) for model in (models[best:][:1] if number else models)]
        left = [1 - pair.correlation**2 if pair else 1.0 for pair in pairs]
        if min(left) > least * (1 - direct.correlation**2):
            return ''
        best = best if number else int(np.argmin(left))
        # Wheels with bursts of slip look smoothed before and after; no camera turns in advance.
        pair = pairs[0 if number else best]
        if others[-1].name != GYRO and pair and (pair.delay_s or 0.0) < -LATE_S:
            return ''
    if best < 0:
        return ''
    lag_s, fastest, ignored = _FOLLOWERS[best].tolist()
    how = [f'with a lag of {lag_s:g} s'] if lag_s else []
    how += [f'at {fastest:g} rad/s at most'] if np.isfinite(fastest) else []
    how += [f'beyond {np.rad2deg(ignored):.0f} degrees only'] if ignored else []
    return ' and '.join(how)


def _followers(source: Source) -> list[Source]:
    """What cameras show that follow the turns of a source by each model of _FOLLOWERS."""
    lag_s, fastest, ignored = _FOLLOWERS.T
    with np.errstate(divide='ignore'):
        share = -np.expm1(-_STEP_S / lag_s)
    span_s = float(source.stamps_ns[-1] - source.stamps_ns[0]) * 1e-9
    seconds = np.arange(0.0, span_s + _STEP_S, _STEP_S)
    at_s = (source.stamps_ns - source.stamps_ns[0]) * 1e-9
    yaw = np.interp(seconds, at_s, source.sums['turns'])
    shown = np.tile(yaw[0], (len(yaw), len(lag_s)))
    for k in range(1, len(yaw)):
        behind = yaw[k] - shown[k - 1]
        pulled = (behind - np.clip(behind, -ignored, ignored)) * share
        shown[k] = shown[k - 1] + np.clip(pulled, -fastest * _STEP_S, fastest * _STEP_S)
    stamps_ns = source.stamps_ns[0] + np.round(seconds * 1e9).astype(np.int64)
    return [replace(source, stamps_ns=stamps_ns, sums={'turns': turns}) for turns in shown.T]
