# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a drive's sources of motion, what of it is corrected, and what to change.

Where sources differ, those are to blame that fewer devices agree with; the wheels are one device.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.geometry import Array, Mask, relative, wrap_angle
from sfa_localization.data.run import Odometry, Run, Stamps, YawRate
from sfa_localization.data.statistics import MEDIAN_TO_STD
from sfa_localization.metric.dead_reckoning import summed
from sfa_localization.metric.motion_sources import (
    ENOUGH,
    EQUAL,
    GYRO,
    HEAD,
    IMAGES,
    POSE,
    TWIST,
    Pair,
    Source,
    compare,
    late,
    sources_of,
    unit,
)

logger = logging.getLogger(__name__)

SKIDDING = 5.0
"""Wheels that skid are off by two: a larger factor is that of another unit, axis or source."""
FASTEST_MPS = 30.0
"""Robots on the ground are slower: numbers beyond are not in meters."""
JUMP, ACCELERATION = 0.05, 5.0
"""A pose that moves so much (m, rad) beyond what its motion before and after, and this change of
speed (m/s^2, rad/s^2), explain has jumped: wheels do not."""
ASIDE, SLIGHT_TURN = 0.25, 1.0
"""So much of the way ahead no robot slips sideways while it turns by less than this, rad, in a
second, nor does one whose frame is off its axle; twice that is no slip at all."""
NOISE = 6.0
"""Standard deviations of noisy wheels that a jump exceeds, too."""
# s around a step in which its usual speed is measured.
_AROUND_S = 0.5
# Stamps, in all and in each second, of which the unit can be told.
_STAMPS_MIN, _STAMPS_MIN_PER_S = 20, 3
_IMAGES_REMEDIES = {
    'alike': 'switch direction lock and stabilization off, and record one omnidirectional camera',
    'sign': 'set `clockwise` of the panorama, or `mirrored` of the calibration',
    'scale': 'a panorama shows all around once, so that a full turn shifts it by its width; or is '
    'the track of the wheels too wide?',
}


@dataclass
class MotionCheck:
    """What the sources of a drive tell of each other, in sentences: what cannot be right (`wrong`),
    what is `corrected` in `odometry` and `gyro`, and what is worth a word (`notes`).
    """

    pairs: list[Pair]
    odometry: Odometry
    gyro: YawRate | None
    wrong: list[str] = field(default_factory=list)
    corrected: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def pair(self, a: str, b: str, what: str = 'turns') -> Pair | None:
        """The comparison of b with a."""
        return next((p for p in self.pairs if (p.a, p.b, p.what) == (a, b, what)), None)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        rows = [dict(zip(HEAD, pair.row(), strict=True)) for pair in self.pairs]
        said = {name: getattr(self, name) for name in ('wrong', 'corrected', 'notes')}
        return {'pairs': rows, **said}

    def as_text(self) -> list[str]:
        """Lines for a terminal: the table of pairs, and the sentences but for what is wrong."""
        rows = [HEAD, *(pair.row() for pair in self.pairs)] if self.pairs else []
        wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = ['  '.join(map(str.ljust, row, wide)).rstrip() for row in rows]
        said = [f'corrected: {text}' for text in self.corrected]
        return [*table, *said, *(f'note: {text}' for text in self.notes)]


def check_drives(
    runs: Sequence[Run], seen: Sequence[Sequence[float]], force: bool = False
) -> tuple[tuple[Run, ...], tuple[MotionCheck, ...]]:
    """Drives to learn from, corrected, and what their sources of motion tell.

    `seen` are the headings (N,) rad that the images of each run show. Raises DataError for what
    cannot be right, of which `force` only warns.
    """
    checks = []
    for run, headings in zip(runs, seen, strict=True):
        shown = run.panoramas.stamps_ns, np.asarray(headings, float)
        check = check_motion(run.odometry, shown, run.yaw_rate)
        for text in check.corrected + check.notes + (check.wrong if force else []):
            logger.warning('%s: %s', run.name, text)
        if check.wrong and not force:
            raise DataError(f'{run.name}: {"; ".join(check.wrong)} (train --force goes on)')
        checks.append(check)
    corrected = tuple(
        replace(run, odometry=check.odometry, yaw_rate=check.gyro)
        for run, check in zip(runs, checks, strict=True)
    )
    return corrected, tuple(checks)


def check_motion(
    odometry: Odometry,
    images: tuple[Stamps, Array] | None = None,
    gyro: YawRate | None = None,
    panoramas: bool = True,
) -> MotionCheck:
    """Compare all sources of a drive: see `sources_of`.

    Of images that are no `panoramas` yet, nobody knows which way around they turn, and how far.
    """
    sources = sources_of(odometry, images, gyro)
    impossible, jumps = list(_impossible(sources)), ''
    if not impossible:
        odometry, jumps = without_jumps(odometry)
        sources = sources_of(odometry, images, gyro)
    turns = [compare(a, b, 'turns') for a, b in combinations(sources, 2)]
    way = [compare(a, b, 'way') for a, b in combinations(sources, 2)]
    check = MotionCheck([pair for pair in turns + way if pair], odometry, gyro)
    shown = check.pair(POSE, IMAGES)
    if images is not None and not panoramas and shown and shown.scale < 0:
        return check_motion(odometry, (images[0], -images[1]), gyro, panoramas)
    check.corrected += [jumps] if jumps else []
    check.wrong += impossible
    _judge_way(check)
    if not impossible:
        _judge_axes(check)
        _judge_turns(check)
        _judge_clocks(check)
    if images is not None and not any(IMAGES in (pair.a, pair.b) for pair in check.pairs):
        check.notes.append('images: too few of them, or turns, to tell whether they are mirrored')
    if not panoramas:
        check.notes += [text for text in check.wrong if text.startswith('images')]
        check.wrong = [text for text in check.wrong if not text.startswith('images')]
    return check


def _impossible(sources: Sequence[Source]) -> Iterator[str]:
    """What no robot does, whatever it is compared with."""
    for source in sources:
        problem = stamp_problem(source.stamps_ns)
        if problem and source.name != TWIST:
            yield f'{source.name}: {problem}'
        elif not problem and (speed := _speed(source)) > FASTEST_MPS:
            yield f'{source.name} drives at {speed:.3g} m/s: publish meters, not millimeters'


def _judge_axes(check: MotionCheck) -> None:
    """Whether poses drive ahead or back, second by second, as wheels do."""
    stamps, poses = check.odometry.stamps_ns, check.odometry.poses
    at = np.flatnonzero(np.diff((stamps - stamps[0]) // 1_000_000_000, prepend=-1))
    step = relative(poses[at[:-1]], poses[at[1:]])
    chord = (step[:, 0] + 1j * step[:, 1]) * np.exp(-0.5j * step[:, 2])
    # A chord shows where the robot was heading, where that turned by little.
    counted = chord[(np.abs(chord) > JUMP) & (np.abs(step[:, 2]) < SLIGHT_TURN)]
    ahead, aside = np.abs(counted.real).sum(), np.abs(counted.imag).sum()
    if aside > max(ENOUGH['way'], ASIDE * ahead):
        text = f'{POSE} drives {aside:.3g} m sideways and {ahead:.3g} m ahead: correct its heading'
        text += ' and axes (x ahead, y to the left, yaw counterclockwise)'
        (check.wrong if aside > 2 * ASIDE * ahead else check.notes).append(text)


def stamp_problem(stamps_ns: Stamps) -> str:
    """What is wrong with the unit of stamps (N,), in words; '' for nothing."""
    second, part = np.divmod(stamps_ns, 1_000_000_000)
    if len(second) < max(_STAMPS_MIN, _STAMPS_MIN_PER_S * len(np.unique(second))):
        return ''
    units = ((1, 'nothing'), (1_000, 'milliseconds'), (1_000_000, 'microseconds'))
    wrong = next((name for limit, name in units if part.max() < limit), '')
    remedy = 'correct the driver, or set stamp_source: receive'
    return f'nanosec of its stamps holds {wrong}: {remedy}' if wrong else ''


def _speed(source: Source) -> float:
    """Speed that is exceeded a tenth of the time, by whole seconds, m/s; 0 where none is shown."""
    if source.driven is None:
        return 0.0
    seconds = (source.stamps_ns - source.stamps_ns[0]) * 1e-9
    at = np.flatnonzero(np.diff(np.floor(seconds), prepend=-1.0))
    driven = np.diff(source.driven[at])
    speed = np.abs(driven) / np.maximum(np.diff(seconds[at]), 0.1)
    return float(np.percentile(speed, 90)) if len(speed) else 0.0


def _judge_way(check: MotionCheck) -> None:
    """Pose and twist of the odometry, by the way that they drive."""
    pair = check.pair(POSE, TWIST, 'way')
    if pair is None:
        return
    if pair.differs('alike'):
        check.notes.append(f'{TWIST} does not drive with {POSE}: is the heading of the pose right?')
    elif pair.differs('sign'):
        check.wrong.append(
            f'{TWIST} drives backwards where {POSE} drives ahead: correct the sign of '
            'twist.linear.x, or the heading of the pose'
        )
    elif pair.differs('scale'):
        text = f'{TWIST} drives {pair.scale:.3g} times as far as {POSE}{unit(pair)}'
        far = not 1 / SKIDDING < pair.scale < SKIDDING
        (check.wrong if far else check.notes).append(f'{text}: publish m and m/s')


def _judge_turns(check: MotionCheck) -> None:
    """Say of each way in which sources differ which of them do, and correct the gyroscope."""
    left = {name for pair in check.pairs if pair.what == 'turns' for name in (pair.a, pair.b)}
    for kind in ('alike', 'sign', 'scale'):
        camps = _camps(check.pairs, kind, left)
        for camp in camps[1:]:
            _blame(check, kind, camp, camps[0])
            left -= camp if kind == 'alike' else set()


def _camps(pairs: Sequence[Pair], kind: str, names: set[str]) -> list[set[str]]:
    """Groups of sources that do not differ in a way; that of most devices, or the pose, first."""
    camps = [{name} for name in names]
    for pair in pairs:
        if pair.what == 'turns' and {pair.a, pair.b} <= names and not pair.differs(kind):
            joined = [camp for camp in camps if camp & {pair.a, pair.b}]
            camps = [camp for camp in camps if camp not in joined] + [set().union(*joined)]
    return sorted(camps, key=lambda camp: (-_devices(camp), POSE not in camp, min(camp)))


def _devices(camp: set[str]) -> int:
    """Pose and twist come from the same wheels."""
    return len({'wheels' if name in (POSE, TWIST) else name for name in camp})


def _blame(check: MotionCheck, kind: str, camp: set[str], others: set[str]) -> None:
    """Say how a camp of sources differs from the others."""
    between = [
        pair
        for pair in check.pairs
        if pair.what == 'turns' and {pair.a, pair.b} & camp and {pair.a, pair.b} & others
    ]
    if not between:
        return
    pair = between[0]
    factor = abs(pair.scale) if pair.b in camp else 1 / max(abs(pair.scale), 1e-9)
    how = {
        'alike': 'independently of' if pair.independent else 'unlike',
        'sign': 'opposite to',
        'scale': f'{factor:.3g} times as far{unit(pair)} as',
    }[kind]
    verb = 'turn' if camp == {IMAGES} else 'turns'
    text = f'{_listed(camp)} {verb} {how} {_listed(others)}'
    far = kind == 'scale' and not 1 / SKIDDING < factor < SKIDDING
    if GYRO in camp:
        _correct(check, kind, text, factor)
        return
    if camp == {IMAGES}:
        remedy = _IMAGES_REMEDIES[kind]
        remedy += (
            ', or swap left and right wheel' if (kind, _devices(others)) == ('sign', 1) else ''
        )
        # Alone, wheels that skid turn farther than the robot does.
        blamed = factor > 1 or _devices(others) > 1
        wrong = {'alike': pair.independent, 'sign': True, 'scale': blamed}[kind]
    elif camp >= {POSE, TWIST}:
        remedy = 'swap left and right wheel' if kind == 'sign' else 'do the wheels skid?'
        wrong = kind == 'sign' or far
    else:
        remedy = 'correct its orientation' if POSE in camp else 'correct twist.angular.z, in rad/s'
        wrong = kind != 'scale' or far
    (check.wrong if wrong else check.notes).append(f'{text}: {remedy}')


def _listed(camp: set[str]) -> str:
    """Names of sources, in words."""
    wheels = sorted(camp & {POSE, TWIST})
    return ' and '.join(
        [*(['odometry'] if len(wheels) == 2 else wheels), *sorted(camp - {*wheels})]
    )


def _correct(check: MotionCheck, kind: str, text: str, factor: float) -> None:
    """Turn, convert or leave out the gyroscope."""
    if check.gyro is None:
        return
    omega, variance = check.gyro.omega, check.gyro.variance
    degree = np.pi / 180
    if kind == 'sign':
        check.corrected.append(f'{text}: taken as upside down')
        check.gyro = replace(check.gyro, omega=-omega)
    elif kind == 'scale' and 1 / EQUAL < factor * degree < EQUAL:
        check.corrected.append(f'{text}: converted from degrees')
        check.gyro = replace(check.gyro, omega=omega * degree, variance=variance * degree**2)
    elif kind == 'scale' and 1 / SKIDDING < factor < SKIDDING:
        check.notes.append(f'{text}: do the wheels skid?')
    else:
        check.corrected.append(f'{text}: left out; check its axis, unit (rad/s) and clock')
        check.gyro = None


def _judge_clocks(check: MotionCheck) -> None:
    """Correct the stamps of the gyroscope; those of images are corrected by the training."""
    if check.gyro is not None and not check.odometry.trajectory.covers(check.gyro.stamps_ns).any():
        check.corrected.append(f'{GYRO}: stamped by another clock than the odometry; left out')
        check.gyro = None
    for name in (GYRO, IMAGES):
        pair = check.pair(POSE, name)
        if pair is None or pair.differs('alike') or not pair.late_s:
            continue
        if name == IMAGES and abs(pair.late_s) * 1e9 > DELAY_LIMIT_NS:
            continue  # clocks that are so far apart are a reason of their own to stop
        if name == GYRO and check.gyro is not None:
            stamps = check.gyro.stamps_ns - round(pair.late_s * 1e9)
            check.gyro = replace(check.gyro, stamps_ns=stamps)
        check.corrected.append(f'{name}: stamped {late(pair.late_s)}; taken into account')


def without_jumps(odometry: Odometry) -> tuple[Odometry, str]:
    """Odometry whose poses go on through jumps as before and after, and a sentence; '' for none."""
    if len(odometry.stamps_ns) < 3:
        return odometry, ''
    found, usual = _jumps(odometry.stamps_ns, odometry.poses)
    number = int(found.sum())
    if not number:
        return odometry, ''
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    far = float(np.hypot(*(step - usual)[found, :2].T).max())
    step = np.where(found[:, None], usual, step)
    yaw = odometry.poses[0, 2] + summed(step[:, 2])
    moved = (step[:, 0] + 1j * step[:, 1]) * np.exp(1j * yaw[:-1])
    x, y = odometry.poses[0, 0] + summed(moved.real), odometry.poses[0, 1] + summed(moved.imag)
    minutes = max((odometry.stamps_ns[-1] - odometry.stamps_ns[0]) / 60e9, 1.0)
    times = 'once' if number == 1 else f'{number} times'
    text = f'{POSE} jumps {times}, by up to {far:.2f} m: joined by its motion around'
    if number > minutes:  # not the reset of a driver
        text += '; if a localization corrects it, record the frame odom instead of map'
    return replace(odometry, poses=np.column_stack([x, y, wrap_angle(yaw)])), text


def _jumps(stamps: Stamps, poses: Array) -> tuple[Mask, Array]:
    """Mask (N - 1,) of the steps that the motion around them does not explain, and the steps
    (N - 1, 3) that it does.
    """
    step, dt = relative(poses[:-1], poses[1:]), np.diff(stamps) * 1e-9
    step[:, 2] = wrap_angle(step[:, 2])
    period = max(float(np.median(dt)), 1e-3)
    reach = max(_AROUND_S, 3 * period)
    at = (stamps[:-1] - stamps[0]) * 1e-9 + dt / 2
    first, last = np.searchsorted(at, at - reach), np.searchsorted(at, at + reach, 'right')
    values, found = np.column_stack([step, dt]), np.zeros(len(step), bool)
    # Messages may be stamped in bundles, or late: nobody knows how long a step took.
    unsure_s = float(np.percentile(np.abs(dt - period), 90))
    times = np.maximum(dt - unsure_s, 0.0)[:, None], (np.maximum(dt, period) + unsure_s)[:, None]
    # A jump is a single step: a robot that turns fast, or slips, does so for several.
    change = np.abs(np.diff(step, axis=0)).max(1)
    alone = np.minimum(np.append(np.inf, change), np.append(change, np.inf))
    for _ in range(2):
        kept = values * ~found[:, None]
        sums = np.vstack([np.zeros(4), np.cumsum(kept, axis=0)])
        around = sums[last] - sums[first] - kept
        speed = around[:, :3] / np.maximum(around[:, 3:], period)
        beyond = np.maximum(
            _beyond(step[:, :2], speed[:, :2], *times), _beyond(step[:, 2:], speed[:, 2:], *times)
        )
        noise = MEDIAN_TO_STD * float(np.median(np.abs(step - speed * dt[:, None])[:, :2].max(1)))
        allowed = JUMP + ACCELERATION * np.maximum(dt, period) ** 2 + NOISE * noise
        found = (dt < reach) & (around[:, 3] > 0) & (np.minimum(beyond, alone) > allowed)
    return found, speed * dt[:, None]


def _beyond(step: Array, speed: Array, shortest_s: Array, longest_s: Array) -> Array:
    """How far (N,) steps (N, K) lie from where a speed (N, K) leads in one of the times (N, 1)."""
    square = np.maximum((speed**2).sum(1, keepdims=True), 1e-12)
    time = np.clip((step * speed).sum(1, keepdims=True) / square, shortest_s, longest_s)
    return np.asarray(np.linalg.norm(step - speed * time, axis=1))
