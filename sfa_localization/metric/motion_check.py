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
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.geometry import Array, Complex, relative, wrap_angle
from sfa_localization.data.odometry_steps import JUMP, NOISE
from sfa_localization.data.run import Odometry, Run, Stamps, YawRate
from sfa_localization.data.statistics import MEDIAN_TO_STD, quantile
from sfa_localization.metric.breaks import Textures, contradicted, parted
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
ASIDE, SLIGHT_TURN = 0.25, 1.0
"""So much of the way ahead no robot slips sideways while it turns by less than this, rad, in a
second, nor does one whose frame is off its axle; twice that is no slip at all."""
ASKEW, UNEVEN = np.deg2rad(1.0), np.deg2rad(10.0)
"""A heading that lies farther beside the way, as of a gyroscope that is mounted askew, is corrected
where half of the ways lie less than the second from it: those of wheels that slip do not."""
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
    runs: Sequence[Run],
    seen: Sequence[Sequence[float]],
    force: bool = False,
    textures: Sequence[NDArray[np.int8] | None] = (),
) -> tuple[tuple[Run, ...], tuple[MotionCheck, ...]]:
    """Drives to learn from, corrected, and what their sources of motion tell.

    `seen` are the headings (N,) rad that the images of each run show, and `textures` (N, rows,
    columns) small ones of these, to find breaks by. Raises DataError for what
    cannot be right, of which `force` only warns.
    """
    checks = []
    for run, headings, views in zip(runs, seen, textures or [None] * len(runs), strict=True):
        stamps_ns = run.panoramas.stamps_ns
        shown = stamps_ns, np.asarray(headings, float)
        given = None if views is None else (stamps_ns, views)
        check = check_motion(run.odometry, shown, run.yaw_rate, views=given)
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
    views: Textures | None = None,
) -> MotionCheck:
    """Compare all sources of a drive: see `sources_of`.

    `views` are stamps (N,) of images that repeat none, and their small textures; see breaks.py. Of
    images that are no `panoramas` yet, nobody knows which way around they turn, and how far.
    """
    sources = sources_of(odometry, images, gyro)
    impossible = list(_impossible(sources))
    check = MotionCheck([], odometry, gyro, list(impossible))
    if not impossible:
        _correct_poses(check)
        sources = sources_of(check.odometry, images, gyro)
    pairs = [compare(*two, what) for what in ('turns', 'way') for two in combinations(sources, 2)]
    check.pairs = [pair for pair in pairs if pair]
    shown = check.pair(POSE, IMAGES)
    if images is not None and not panoramas and shown and shown.scale < 0:
        return check_motion(odometry, (images[0], -images[1]), gyro, panoramas, views)
    _judge_way(check)
    if not impossible:
        _judge_axes(check)
        _judge_turns(check)
        _judge_clocks(check)
        if views is not None:
            late_ns = round(shown.late_s * 1e9) if shown else 0
            check.odometry, texts = contradicted(check.odometry, views[0] - late_ns, views[1])
            check.corrected += texts
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


def _ahead(odometry: Odometry) -> Complex:
    """The way of each second, m, along (real) and to the left of the mean heading in it, of those
    with little turn: a chord shows where the robot was heading, where that turned by little.
    """
    stamps, poses = odometry.stamps_ns, odometry.poses
    at = np.flatnonzero(np.diff((stamps - stamps[0]) // 1_000_000_000, prepend=-1))
    step = relative(poses[at[:-1]], poses[at[1:]])
    chord = (step[:, 0] + 1j * step[:, 1]) * np.exp(-0.5j * step[:, 2])
    whole = odometry.part[at[:-1]] == odometry.part[at[1:]]
    return np.asarray(chord[whole & (np.abs(chord) > JUMP) & (np.abs(step[:, 2]) < SLIGHT_TURN)])


def _correct_poses(check: MotionCheck) -> None:
    """Join or cut where poses jump, and turn them along their way."""
    for change in parted, _straightened:
        check.odometry, text = change(check.odometry)
        check.corrected += [text] if text else []


def _straightened(odometry: Odometry) -> tuple[Odometry, str]:
    """Odometry that heads along its way, ahead or back, and a sentence; '' for no change."""
    way = _ahead(odometry)
    if np.abs(way).sum() < ENOUGH['way']:
        return odometry, ''
    beside = np.angle(way * np.where(way.real < 0, -1, 1))
    off = quantile(beside, 0.5, np.abs(way))
    spread = MEDIAN_TO_STD * quantile(np.abs(beside - off), 0.5, np.abs(way))
    chance = NOISE * spread / np.sqrt(len(way))
    if not max(ASKEW, chance) < abs(off) < np.pi / 4 or spread > UNEVEN:
        return odometry, ''
    poses = odometry.poses.copy()
    poses[:, 2] = wrap_angle(poses[:, 2] + off)
    text = (
        f'the heading of the pose lies {np.rad2deg(abs(off)):.1f} degrees beside its way: corrected'
    )
    return replace(odometry, poses=poses), text


def _judge_axes(check: MotionCheck) -> None:
    """Whether poses drive ahead or back, second by second, as wheels do."""
    way = _ahead(check.odometry)
    ahead, aside = np.abs(way.real).sum(), np.abs(way.imag).sum()
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
