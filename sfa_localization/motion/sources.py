# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether all sources of motion agree on a drive: images, odometry pose and twist, gyroscope.

Two sources are compared by their turns, or their ways, in short windows: one is regressed on the
other over a grid of delays. Scale, delay and correlation show whether a source is mirrored, has
another unit, runs by another clock or measures another motion. No map is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfa_localization.data.geometry import Array, relative, wrap_angle
from sfa_localization.data.run import Odometry, Stamps, YawRate
from sfa_localization.motion.dead_reckoning import summed

IMAGES = 'images'
POSE = 'odometry pose'
TWIST = 'odometry twist'
GYRO = 'gyroscope'
MAP = 'map'
ALIKE = 0.7
UNLIKE = 0.3
"""Sources correlated by more than the first measure the same motion (half of the variance); below
the second they are independent. Between them nothing is certain."""
ENOUGH = {'turns': 2 * np.pi, 'way': 2.0}
"""Least sum of turns (rad) or way (m) for a comparison."""
LOCKED = 0.4
"""Images that turn by less than this share are stabilized by the camera; skidding wheels turn twice
as far as the robot."""
EQUAL = 1.5
"""A ratio of two sources beyond this factor is neither sampling nor calibration; within this factor
of a ratio of units, the units explain it."""
WHOLE = 1.15
CERTAIN = 0.95
"""The stricter limit for images whose correlation exceeds the second: panoramas that show a whole
turn were within 3 %."""
LATE_S = 0.05
"""Smaller delays are within the period of usual messages."""
# Distance, m, over which maps and odometry are compared: many times the error of one image.
_STRETCH_M = 10.0


@dataclass(frozen=True, slots=True)
class Source:
    """What one source measured at increasing stamps (N,): `sums` (N,) of 'turns', rad, and of the
    'way' ahead, m, or of one of them.
    """

    name: str
    stamps_ns: Stamps
    sums: dict[str, Array]

    @property
    def period_s(self) -> float:
        """Mean time between messages, which may come in bundles."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 / (len(self.stamps_ns) - 1)

    def moved(self, windows: Stamps, what: str) -> Array:
        """The motion (...) in windows (..., 2) ns."""
        start = self.stamps_ns[0]
        seconds = (self.stamps_ns - start) * 1e-9
        at = np.interp((windows - start) * 1e-9, seconds, self.sums[what])
        return np.asarray(np.diff(at)[..., 0])


def sources_of(
    odometry: Odometry, images: tuple[Stamps, Array] | None = None, gyro: YawRate | None = None
) -> list[Source]:
    """The sources of a drive that have more than two messages.

    `images` are their stamps (N,) and headings (N,) rad: the sums of the shifts between them.
    """
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    half = step[:, 2] / 2
    seconds = np.diff(odometry.stamps_ns) * 1e-9
    ahead = step[:, 0] * np.cos(half) + step[:, 1] * np.sin(half)
    # Drivers leave at 0 what they do not measure.
    rates = zip(('way', 'turns'), (odometry.twists[1:] * seconds[:, None]).T, strict=True)
    twist = {what: summed(moved) for what, moved in rates if moved.any()}
    pose = {'turns': summed(wrap_angle(step[:, 2])), 'way': summed(ahead)}
    sources = [Source(POSE, odometry.stamps_ns, pose), Source(TWIST, odometry.stamps_ns, twist)]
    if gyro is not None:
        areas = (gyro.omega[1:] + gyro.omega[:-1]) / 2 * np.diff(gyro.stamps_ns) * 1e-9
        sources.append(Source(GYRO, gyro.stamps_ns, {'turns': summed(areas)}))
    if images is not None:
        sources.append(Source(IMAGES, images[0], {'turns': np.unwrap(images[1])}))
    return [source for source in sources if len(source.stamps_ns) > 2]


@dataclass(frozen=True, slots=True)
class Pair:
    """Source `b` compared with `a` by `what`: `scale` times as much (negative: opposite), `delay_s`
    later (None: uncertain), with a `correlation` from 0 to 1.
    """

    what: str
    a: str
    b: str
    scale: float
    delay_s: float | None
    correlation: float
    period_s: float = 0.0
    """Of the slower source, without images: a mean rate is late by half of it."""

    @property
    def late_s(self) -> float:
        """The delay of `b`; 0 if it is uncertain, or too small to matter."""
        least = max(LATE_S, self.period_s)
        return self.delay_s if self.delay_s is not None and abs(self.delay_s) > least else 0.0

    @property
    def independent(self) -> bool:
        """Whether `b` does not move with `a`. Images of a stabilized camera correlate a little, by
        the parallax of near things.
        """
        locked = self.b == IMAGES and abs(self.scale) < LOCKED
        return self.correlation < UNLIKE or locked

    def differs(self, kind: str) -> bool:
        """Whether the two differ in this: they are not 'alike', or differ by 'sign' or 'scale'."""
        if kind == 'alike':
            return self.correlation < ALIKE or self.independent
        if kind == 'sign':
            return self.scale < 0
        limit = WHOLE if self.b == IMAGES and self.correlation >= CERTAIN else EQUAL
        return not 1 / limit < abs(self.scale) < limit

    def row(self) -> tuple[str, ...]:
        """Cells of a table with the columns HEAD."""
        delay = '' if self.delay_s is None else f'{round(self.delay_s, 2) + 0.0:.2f}'
        numbers = f'{self.scale:.3g}', delay, f'{self.correlation:.2f}'
        return f'{self.b} by {self.a}', self.what, *numbers, self._meaning()

    def _meaning(self) -> str:
        if self.differs('alike'):
            return 'not alike' if self.independent else 'hardly alike'
        parts = ['the other way around'] if self.scale < 0 else []
        if self.differs('scale'):
            parts.append(f'{abs(self.scale):.3g} times as far{unit(self)}')
        if self.late_s:
            parts.append(late(self.late_s))
        turns = 'turn' if self.b == IMAGES else 'turns'
        verb = turns if self.what == 'turns' else 'drives'
        return f'{self.b} {verb} {", ".join(parts)}' if parts else 'alike'


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


HEAD = ('compared', 'by', 'scale', 'delay (s)', 'correlation', 'this means')


def late(seconds: float) -> str:
    """A delay in words."""
    return f'{abs(seconds):.2f} s {"late" if seconds > 0 else "early"}'


def unit(pair: Pair) -> str:
    """The unit that explains a scale, in words; '' if none does."""
    factors = {'turns': {180 / np.pi: 'degrees'}, 'way': {1e3: 'millimeters', 1e2: 'centimeters'}}
    for factor, name in factors[pair.what].items():
        for source, scale in ((pair.b, abs(pair.scale)), (pair.a, 1 / max(abs(pair.scale), 1e-9))):
            if 1 / EQUAL < scale / factor < EQUAL:
                return f' ({source} in {name}?)'
    return ''


def compare_map(odometry: Odometry, stamps_ns: Stamps, poses: Array) -> Pair | None:
    """The way of the images (M,) of a drive by the map, compared with that of the odometry.

    `poses` (M, 3) are x m, y m and yaw rad by the images alone. None for too short a drive.
    """
    driven = odometry.trajectory.at(stamps_ns)
    part = odometry.part[np.searchsorted(odometry.stamps_ns[1:-1], stamps_ns, 'right')]
    way = summed(np.hypot(*np.diff(driven[:, :2], axis=0).T))
    last = np.searchsorted(way, way + min(_STRETCH_M, way[-1] / 4))
    first = np.flatnonzero(last < len(way))
    first = first[part[first] == part[last[first]]]
    if way[-1] < ENOUGH['way'] or not len(first):
        return None
    # Displacements (K,) in the frame of the robot at their start.
    x, y = (
        (path[last[first], 0] - path[first, 0] + 1j * (path[last[first], 1] - path[first, 1]))
        * np.exp(-1j * path[first, 2])
        for path in (driven, poses)
    )
    product = np.vdot(x, y)
    power = max(float(np.vdot(x, x).real), 1e-12)
    correlation = float(np.abs(product) / np.sqrt(max(power * np.vdot(y, y).real, 1e-12)))
    return Pair('way', POSE, MAP, float(product.real) / power, None, correlation)
