# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether all sources tell the same motion of a drive: images, odometry pose and twist, gyroscope.

Of each pair, the turns (and the way) in short windows are compared by regression of one on the
other, over a grid of delays: the sign, the scale, the delay and the correlation show which source
is mirrored, has another unit, runs by another clock, or shows something else. No map is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.geometry import Array, Mask, relative, wrap_angle
from sfa_localization.data.run import Odometry, Stamps, YawRate
from sfa_localization.data.statistics import MEDIAN_TO_STD, parabola_peak, quantile
from sfa_localization.metric.dead_reckoning import summed

IMAGES, POSE, TWIST, GYRO = 'images', 'odometry pose', 'odometry twist', 'gyroscope'
MAP = 'map'
LONGEST_S = 2.5
"""Clocks farther apart are not recognized."""
ALIKE, UNLIKE = 0.7, 0.3
"""Two sources with a correlation above the first show the same motion (half of the variance), those
below the second do not: between them, nothing is said."""
ENOUGH = {'turns': 2 * np.pi, 'way': 2.0}
"""Turned (rad) or driven (m) in sum: less does not show how well two sources agree."""
LOCKED = 0.4
"""Images that turn by less than this share do not turn with the robot; skidding wheels turn twice
as far as it does."""
EQUAL = 1.5
"""A larger factor between two sources is none of sampling or of a loosely calibrated wheel."""
WHOLE, CERTAIN = 1.15, 0.95
"""Panoramas that turn as the robot does, with a correlation of at least the second, and by another
factor than this, do not show a whole turn; those that do were found to be within 3 %."""
UNIT = 1.2
"""A scale within this factor of that between two units is taken for it."""
LATE_S = 0.05
"""A smaller delay is within the period of usual messages."""
# Windows last from _SHORTEST_S until half of the motion lies in windows with _STEP (rad, m) or
# more, at most _LONGEST_WINDOW_S; none crosses a pause.
_SHORTEST_S, _LONGEST_WINDOW_S, _STEP, _PAUSE_S = 0.19, 3.0, 0.1, 1.0
_GRID = np.arange(-50, 51) * (LONGEST_S / 50)
# A step beyond so many usual ones is an outlier, and counts as that.
_OUTLIER = 3.0
# More windows tell nothing new.
_WINDOWS = 3000
# A delay is known where delays that fit about as well spread by less, s (of a quarter of them).
_STD_MAX_S = 0.06
# m of way over which a map is compared with odometry: much more than images err in it.
_STRETCH_M = 10.0


@dataclass(frozen=True, slots=True)
class Source:
    """What one source tells of a drive at increasing stamps (N,): the sum of its turns, rad, and
    of its way ahead, m; None where it tells nothing of them.
    """

    name: str
    stamps_ns: Stamps
    turned: Array | None
    driven: Array | None = None

    @property
    def period_s(self) -> float:
        """Between messages, as usual."""
        return float(np.median(np.diff(self.stamps_ns))) * 1e-9

    def sums(self, what: str) -> Array | None:
        return self.turned if what == 'turns' else self.driven


def sources_of(
    odometry: Odometry, images: tuple[Stamps, Array] | None = None, gyro: YawRate | None = None
) -> list[Source]:
    """The sources of a drive; those that say nothing are left out.

    `images` are their stamps (N,) and the headings (N,) rad that their shifts add up to.
    """
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    half, seconds = step[:, 2] / 2, np.diff(odometry.stamps_ns) * 1e-9
    ahead = step[:, 0] * np.cos(half) + step[:, 1] * np.sin(half)
    v, omega = (odometry.twists[1:] * seconds[:, None]).T
    found = [Source(POSE, odometry.stamps_ns, summed(wrap_angle(step[:, 2])), summed(ahead))]
    # What is always 0 is not filled in.
    filled = [summed(twist) if twist.any() else None for twist in (omega, v)]
    found.append(Source(TWIST, odometry.stamps_ns, *filled))
    if gyro is not None:
        areas = (gyro.omega[1:] + gyro.omega[:-1]) / 2 * np.diff(gyro.stamps_ns) * 1e-9
        found.append(Source(GYRO, gyro.stamps_ns, summed(areas)))
    if images is not None:
        found.append(Source(IMAGES, images[0], np.unwrap(images[1])))
    return [one for one in found if len(one.stamps_ns) > 2]


@dataclass(frozen=True, slots=True)
class Pair:
    """What source `b` tells compared with `a`: `scale` times as much (negative: the other way
    around), `delay_s` later, where `delay_known`, with this `correlation` (0 to 1).
    """

    what: str
    a: str
    b: str
    scale: float
    delay_s: float
    delay_known: bool
    correlation: float
    period_s: float
    """Of the slower one of both, images left out: a mean rate is late by half of it."""

    @property
    def late_s(self) -> float:
        """By how much `b` is stamped later; 0 where that is not known, or too little to matter."""
        least = max(LATE_S, self.period_s)
        return self.delay_s if self.delay_known and abs(self.delay_s) > least else 0.0

    @property
    def independent(self) -> bool:
        """Whether `b` does not move with `a`: what is near still moves in images held by a lock."""
        locked = self.b == IMAGES and abs(self.scale) < LOCKED
        return self.correlation < UNLIKE or locked

    def differs(self, kind: str) -> bool:
        """Whether the sources differ: they are not ALIKE, turn opposite, or not equally far."""
        if kind == 'alike':
            return self.correlation < ALIKE or self.independent
        if kind == 'sign':
            return self.scale < 0
        limit = WHOLE if self.b == IMAGES and self.correlation >= CERTAIN else EQUAL
        return not 1 / limit < abs(self.scale) < limit

    def sentence(self) -> str:
        """What it means, in words."""
        verb = {'turns': 'turns', 'way': 'drives'}[self.what]
        if self.differs('alike'):
            return 'not alike' if self.independent else 'hardly alike'
        parts = ['the other way around'] if self.scale < 0 else []
        if self.differs('scale'):
            parts.append(f'{abs(self.scale):.3g} times as far{unit(self)}')
        if self.late_s:
            parts.append(late(self.late_s))
        return f'{self.b} {verb} {", ".join(parts)}' if parts else 'alike'

    def row(self) -> tuple[str, ...]:
        """Cells of a table; see HEAD."""
        delay = f'{round(self.delay_s, 2) + 0.0:.2f}' if self.delay_known else ''
        names = f'{self.b} by {self.a}'
        numbers = f'{self.scale:.3g}', delay, f'{self.correlation:.2f}'
        return names, self.what, *numbers, self.sentence()


HEAD = ('compared', 'by', 'scale', 'delay (s)', 'correlation', 'this means')


def late(seconds: float) -> str:
    """A delay in words."""
    return f'{abs(seconds):.2f} s {"late" if seconds > 0 else "early"}'


def unit(pair: Pair) -> str:
    """The unit that explains a scale, in words; '' if none does."""
    factors = {'turns': {180 / np.pi: 'degrees'}, 'way': {1e3: 'millimeters', 1e2: 'centimeters'}}
    for factor, name in factors[pair.what].items():
        for source, scale in ((pair.b, abs(pair.scale)), (pair.a, 1 / max(abs(pair.scale), 1e-9))):
            if 1 / UNIT < scale / factor < UNIT:
                return f' ({source} in {name}?)'
    return ''


def compare(a: Source, b: Source, what: str = 'turns') -> Pair | None:
    """Compare two sources; None where they show too little motion at the same time."""
    slow, fast = sorted((a, b), key=lambda one: -one.period_s)
    if slow.sums(what) is None or fast.sums(what) is None:
        return None
    for length_s in _SHORTEST_S * 2.0 ** np.arange(5):
        windows = _windows(slow, fast, length_s)
        fixed = _moved(slow, windows, what)
        if _usual(fixed) >= _STEP or not len(windows) or 2 * length_s > _LONGEST_WINDOW_S:
            break
    if not len(windows):
        return None
    # Where `b` is late, it tells later what `a` has told.
    delays = (_GRID if slow is a else -_GRID)[:, None, None]
    moving = _moved(fast, windows + np.round(delays * 1e9).astype(np.int64), what)
    fixed = np.broadcast_to(fixed, moving.shape)
    x, y = (fixed, moving) if slow is a else (moving, fixed)
    period_s = max(one.period_s for one in (a, b) if one.name != IMAGES)
    found = _fitted(what, a.name, b.name, x, y)
    return found and replace(found, period_s=period_s)


def _windows(slow: Source, fast: Source, length_s: float) -> Stamps:
    """Windows (M, 2) ns between stamps of the slow source, in no pause of either source whatever
    the delay.
    """
    stamps, edges = slow.stamps_ns, [0]
    following = np.searchsorted(stamps, stamps + round(length_s * 1e9))
    while following[edges[-1]] < len(stamps):
        edges.append(int(following[edges[-1]]))
    chosen = np.stack([stamps[edges[:-1]], stamps[edges[1:]]], 1)
    chosen = chosen[np.diff(chosen)[:, 0] < (length_s + _PAUSE_S) * 1e9]
    reach = round(LONGEST_S * 1e9)
    for one, margin in ((slow, 0), (fast, reach)):
        chosen = chosen[_unbroken(one.stamps_ns, chosen + np.array([-margin, margin]))]
    return np.asarray(chosen[:: len(chosen) // _WINDOWS + 1])


def _unbroken(stamps: Stamps, windows: Stamps) -> Mask:
    """Mask (M,) of the windows (M, 2) inside the stamps, without a pause."""
    steps = np.diff(stamps)
    pauses = np.flatnonzero(steps > max(_PAUSE_S * 1e9, 3 * np.median(steps)))
    begun = np.searchsorted(stamps[pauses], windows[:, 1])
    ended = np.searchsorted(stamps[pauses + 1], windows[:, 0], 'right')
    inside = (windows[:, 0] >= stamps[0]) & (windows[:, 1] <= stamps[-1])
    return np.asarray(inside & (begun == ended))


def _moved(source: Source, windows: Stamps, what: str) -> Array:
    """The motion in windows (..., 2) ns."""
    start = source.stamps_ns[0]
    sums = source.sums(what)
    assert sums is not None
    at = np.interp((windows - start) * 1e-9, (source.stamps_ns - start) * 1e-9, sums)
    return np.asarray(np.diff(at)[..., 0])


def _usual(x: Array) -> float:
    """The step in which half of the motion is done, or larger ones: standing does not matter."""
    return quantile(np.abs(x), 0.5, np.abs(x)) if len(x) else 0.0


def _fitted(what: str, a: str, b: str, x: Array, y: Array) -> Pair | None:
    """The best of the delays: x (D, M) against y (D, M)."""
    middle = len(_GRID) // 2
    # Noise adds up where nothing moves, and that of images may be large.
    steps = [np.abs(s[middle]) for s, name in ((x, a), (y, b)) if name != IMAGES]
    if max(s[s > _STEP / 2].sum() for s in steps) < ENOUGH[what]:
        return None
    limit = np.array([_usual(x[middle]), _usual(y[middle])])
    # Shifts of images may be wrong by any angle.
    limit = np.minimum(limit, 2 * limit[::-1]) if IMAGES in (a, b) else limit
    u, v = (np.clip(s, -_OUTLIER * q, _OUTLIER * q) for s, q in zip((x, y), limit, strict=True))
    kept = np.ones(x.shape[1], bool)
    for _ in range(2):
        alike = _cosines(u[:, kept], v[:, kept])
        best = int(np.argmax(alike - 1e-6 * np.abs(_GRID)))
        scale = _slope(x[best, kept], y[best, kept])
        # What is far beside the line says nothing of it.
        beside, moves = np.abs(y[best] - scale * x[best]), np.abs(u[best]) > limit[0] / 4
        usual = MEDIAN_TO_STD * float(np.median(beside[moves])) if moves.any() else np.inf
        kept = beside <= max(_OUTLIER * usual, limit[1] / 2)
    # As much as chance moves a correlation of so many windows with motion.
    chance = (1 - alike[best] ** 2) / np.sqrt(max(moves.sum(), 1))
    as_good = _GRID[alike >= alike[best] - chance - 1e-3]
    inside = 0 < best < len(_GRID) - 1
    known = inside and np.ptp(as_good) / 4 < _STD_MAX_S
    part = float(parabola_peak(*alike[best - 1 : best + 2])) if inside else 0.0
    delay_s = float(_GRID[best]) + part * (_GRID[1] - _GRID[0])
    return Pair(what, a, b, scale, delay_s, bool(known), float(alike[best]), 0.0)


def _cosines(u: Array, v: Array) -> Array:
    """Correlations (D,), without their sign, of rows (D, M) whose mean is no offset."""
    power = np.sqrt((u * u).sum(1) * (v * v).sum(1))
    found = np.divide(np.abs((u * v).sum(1)), power, out=np.zeros(len(u)), where=power > 0)
    return np.asarray(found)


def _slope(x: Array, y: Array) -> float:
    """k of the least sum of |y - k x|: the median of y / x, weighted by |x|."""
    moved = x != 0
    return quantile(y[moved] / x[moved], 0.5, np.abs(x[moved])) if moved.any() else 0.0


def compare_map(odometry: Odometry, stamps_ns: Stamps, poses: Array) -> Pair | None:
    """The way of the images (M,) of a drive, by the map, with that of the odometry.

    `poses` (M, 3) are their places in the map, m, by the images alone, and their yaw, rad. None for
    a drive that is too short.
    """
    driven = odometry.trajectory.at(stamps_ns)
    part = odometry.part[np.searchsorted(odometry.stamps_ns[1:-1], stamps_ns, 'right')]
    way = summed(np.hypot(*np.diff(driven[:, :2], axis=0).T))
    last = np.searchsorted(way, way + min(_STRETCH_M, way[-1] / 4))
    first = np.flatnonzero(last < len(way))
    first = first[part[first] == part[last[first]]]
    if way[-1] < ENOUGH['way'] or not len(first):
        return None
    x, y = (
        np.diff(places[np.stack([first, last[first]])], axis=0)[0] * np.exp(-1j * yaw[first])
        for places, yaw in ((one[:, 0] + 1j * one[:, 1], one[:, 2]) for one in (driven, poses))
    )
    together, power = np.vdot(x, y), float(np.vdot(x, x).real)
    alike = float(np.abs(together) / np.sqrt(max(power * np.vdot(y, y).real, 1e-12)))
    return Pair('way', POSE, MAP, float(together.real) / max(power, 1e-12), 0.0, False, alike, 0.0)
