# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that drift, and cameras that follow the robot's turns: what no constant delay explains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD
from sfa_localization.metric.motion_samples import OUTLIER
from sfa_localization.metric.motion_sources import GRID, LATE_S, Source, compare, in_windows

EXPLAINED = 0.5
"""The camera follows the robot if a model of this leaves at most this share of the variance that
the best delay leaves: 0.02 to 0.5 for lags of 0.3 s and more, 0.9 and more for right drives."""
_RATE_STD = 0.005
"""Of clocks that drift: those of cameras run up to 1 % fast."""
_BEGIN_S = 50.0
"""Half the time, around the middle of the turns, in which a drift is found first: in it, a clock
that is 1 % fast gains no more than a turn lasts."""
_STEP_S = 0.05  # of the derivatives by the delay, and of the motion of a camera that follows
_ROUNDS = 8
_LAGS_S, _FASTEST_RAD_S = (0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0), (np.inf, 0.4, 0.2)
_DEAD_BANDS_RAD = 0.1, 0.2, 0.4, 0.8


@dataclass(frozen=True, slots=True)
class Drift:
    """A clock that is `delay_s` late at a stamp of its own, and gains `rate` s in each second."""

    at_ns: int
    delay_s: float
    rate: float

    def delay_ns(self, stamps_ns: Stamps) -> Stamps:
        """By how much its stamps (N,) are late."""
        gained = self.rate * (stamps_ns - self.at_ns)
        return np.round(self.delay_s * 1e9 + gained).astype(np.int64)

    def __str__(self) -> str:
        return f'{abs(self.rate):.2%} {"fast" if self.rate > 0 else "slow"}'.replace('%', ' %')


def drift(a: Source, b: Source) -> Drift | None:
    """How the clock of `b` drifts against that of `a`, by their turns; None for an insignificant
    drift, or one that matters as little as a delay of LATE_S.

    The turns of one source between delayed stamps are fitted to those of the other by scale, delay
    and rate, first of the windows around the middle of the turns, then farther and farther.
    """
    windows = in_windows(a, b, 'turns')
    if windows is None:
        return None
    slow, fast, edges_ns = windows
    turns = slow.moved(edges_ns, 'turns')
    middle_ns = edges_ns.mean(1)
    turned = np.cumsum(np.abs(turns))
    at_ns = int(middle_ns[np.searchsorted(turned, turned[-1] / 2)])
    fit = _Fit(fast, edges_ns, turns, (middle_ns - at_ns) * 1e-9, 1.0 if slow is a else -1.0)
    delay_s, rate, std = fit.widened()
    if abs(rate) < OUTLIER * std or abs(rate) * np.ptp(fit.seconds) < LATE_S:
        return None
    if slow is a:  # fitted over the time of `a`
        at_ns, rate = at_ns + round(delay_s * 1e9), rate / (1 + rate)
    return Drift(at_ns, delay_s, rate)


@dataclass(frozen=True, slots=True)
class _Fit:
    """`turns` (M,) rad of the slow source in windows `edges_ns` (M, 2), at `seconds` (M,) from the
    middle of all turns; the `fast` source is late with `sign` 1, or the slow one with -1.
    """

    fast: Source
    edges_ns: Stamps
    turns: Array
    seconds: Array
    sign: float

    def widened(self) -> tuple[float, float, float]:
        """Delay, s, in the middle, rate, and standard deviation of the rate."""
        radius, whole = _BEGIN_S, float(np.abs(self.seconds).max())
        near = np.abs(self.seconds) <= radius
        errors = [self._residual(near, delay, 0.0, scale) for delay, scale in product(GRID, (1, -1))]
        best = int(np.argmin([np.minimum(np.abs(error), 0.2).sum() for error in errors]))
        fit = float(GRID[best // 2]), 0.0, np.inf
        while True:
            fit = self._refined(np.abs(self.seconds) <= radius, *fit[:2])
            if radius >= whole:
                return fit
            radius *= 2

    def _moved(self, rows: Array, delay_s: float, rate: float) -> Array:
        delays_s = self.sign * (delay_s + rate * self.seconds[rows])
        shift_ns = np.round(delays_s * 1e9).astype(np.int64)
        return self.fast.moved(self.edges_ns[rows] + shift_ns[:, None], 'turns')
