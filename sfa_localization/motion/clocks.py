# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that drift, and cameras that follow the robot's turns: what no constant delay explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.stats import linregress, theilslopes

from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.run import Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, parabola_peak
from sfa_localization.motion.sources import (
    ALIKE,
    EQUAL,
    FAR,
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
PART_RAD = 2.5
CHANCE = 1e-4
"""Turn of a part of the drive, whose delay is fitted on its own (in smaller ones, images at 3 Hz
show it within 0.1 s only), and the probability of a line by chance: none of 320 right drives has
such a line that matters."""
RATE_MAX = 0.02
"""Clocks of cameras are up to 1 % fast."""
# In fewer windows any delay fits; more parts take long.
_WINDOWS_MIN = 4
_PARTS_MIN = 4
_PARTS_MAX = 100
_ROUNDS = 4
_STEP_S = 0.05
_EXACT_S = 1e-3
# Models of a camera that follows: lag, s, largest rate, rad/s, and turn that it ignores, rad.
_FOLLOWERS = np.array(
    [*product((0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0), (np.inf, 0.4, 0.2), (0.0,))][1:]
    + [(0.0, np.inf, ignored) for ignored in (0.1, 0.2, 0.4, 0.8)]
)


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

    A line is fitted to the delays of the parts of the drive, by least squares of those that are
    near the line of Theil and Sen.
    """
    chosen = in_windows(a, b, 'turns')
    if chosen is None:
        return None
    slow, fast, windows_ns = chosen
    turns = slow.moved(windows_ns, 'turns')
    seconds = (windows_ns[:, 0] - windows_ns[0, 0]) * 1e-9
    if not np.abs(turns).sum() >= _PARTS_MIN * PART_RAD:  # also turns that are unknown
        return None
    line = _line_of_delays(turns, fast, windows_ns, seconds)
    if line is None or not LATE_S / seconds[-1] < abs(line[1]) < RATE_MAX:
        return None
    delay_s, rate = line
    at_ns = int(windows_ns[0, 0])
    if slow is a:  # the line is over the time of `a`
        return Drift(at_ns + round(delay_s * 1e9), delay_s, rate / (1 + rate))
    return Drift(at_ns, -delay_s, -rate)


def _line_of_delays(
    turns: Array, fast: Source, windows_ns: Stamps, seconds: Array
) -> tuple[float, float] | None:
    """The delay at first, s, and its rate, of the fast source behind `turns` (M,) rad in windows
    (M, 2) that begin at `seconds` (M,); None where too few parts agree, or a rate is by chance.
    """
    first = _parts(turns)
    at_s = np.add.reduceat(np.abs(turns) * seconds, first) / np.add.reduceat(np.abs(turns), first)
    more_s, near = _delays(turns, fast, windows_ns, first)
    if near.sum() < _PARTS_MIN:
        return None
    rate, delay_s, *_ = theilslopes(more_s[near], at_s[near])
    for _ in range(_ROUNDS):  # the line leads to delays beyond the grid
        late_ns = np.round((delay_s + rate * seconds) * 1e9).astype(np.int64)
        more_s, alike = _delays(turns, fast, windows_ns + late_ns[:, None], first)
        error = np.abs(more_s)
        near = alike & (error <= FAR * MEDIAN_TO_STD * np.median(error) + _EXACT_S)
        if near.sum() < _PARTS_MIN:
            return None
        line = linregress(at_s[near], (delay_s + rate * at_s + more_s)[near])
        rate = float(line.slope)
        delay_s = float(line.intercept)
    return None if line.pvalue > CHANCE else (delay_s, rate)


def _parts(turns: Array) -> Indices:
    """The first windows (K,) of parts of a drive that turn equally far, by the turns (M,) rad."""
    turned = np.cumsum(np.abs(turns))
    count = min(turned[-1] // PART_RAD, _PARTS_MAX)
    first = np.unique(np.ceil(turned / turned[-1] * count).clip(1), return_index=True)[1]
    return np.asarray(first[np.diff(first, prepend=-_WINDOWS_MIN) >= _WINDOWS_MIN])


def _delays(turns: Array, other: Source, windows_ns: Stamps, first: Indices) -> tuple[Array, Mask]:
    """Of parts that begin with the `first` (K,) of M windows: the delays (K,) s of another source
    at which its turns are most like `turns` (M,) rad, and whether they are alike then.
    """
    limit = FAR * typical(turns)
    delays_ns = np.round(GRID * 1e9).astype(np.int64)[:, None, None]
    moved = np.clip(other.moved(windows_ns + delays_ns, 'turns'), -limit, limit)
    turns = np.clip(turns, -limit, limit)
    product, power, own_power = (
        np.add.reduceat(x, first, axis=-1) for x in (moved * turns, moved**2, turns**2)
    )
    correlation = np.abs(product) / np.sqrt(power * own_power + 1e-12)
    rows = np.arange(len(first))
    best = correlation.argmax(0).clip(1, len(GRID) - 2)
    peak = parabola_peak(*(correlation[best + by, rows] for by in (-1, 0, 1)))
    return GRID[best] + peak * (GRID[1] - GRID[0]), correlation[best, rows] > ALIKE


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
