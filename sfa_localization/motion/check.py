# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which sources of a drive's motion are faulty, which of them are corrected, and what to change.

Where sources disagree, the minority is reported as faulty; pose and twist, both of the wheels, have
one vote together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.geometry import Array, Complex, Indices, relative, wrap_angle
from sfa_localization.data.odometry_steps import JUMP, NOISE
from sfa_localization.data.run import Odometry, Run, Stamps, YawRate
from sfa_localization.data.statistics import MEDIAN_TO_STD, quantile
from sfa_localization.motion.breaks import StampedTextures, contradicted, parted
from sfa_localization.motion.fit import compare, drift_sentences, drifts, following
from sfa_localization.motion.gyro import cleaned, smoothed
from sfa_localization.motion.sources import (
    CERTAIN,
    ENOUGH,
    EQUAL,
    GYRO,
    HEAD,
    IMAGES,
    POSE,
    TWIST,
    Drift,
    Pair,
    Source,
    late,
    sources_of,
    unit,
)

SKIDDING = 5.0
"""Skidding wheels are off by a factor of two: more is another unit, axis or source."""
WHOLE_BY_GYRO = 1.03
"""Panoramas that show a whole turn turn 1.000 to 1.008 times as far as gyroscopes; 15 degrees less
are 1.04."""
FASTEST_MPS = 30.0
"""A faster robot publishes other units than meters."""
SIDEWAYS = 0.25
SLIGHT_TURN = 1.0
"""Largest sideways share of the motion below the second value, rad/s, even for a base frame off the
axle; twice as much is a wrong heading, not slip."""
ASKEW = np.deg2rad(1.0)
UNEVEN = np.deg2rad(10.0)
"""A heading that deviates by more than this from the direction of motion (a gyroscope mounted
askew) is corrected if its scatter is below the second value; slipping wheels scatter more."""
# Fewer stamps, in all and in each second, do not show their unit.
_STAMPS_MIN = 20
_STAMPS_MIN_PER_S = 3
_UNITS = ((1, 'nothing'), (1_000, 'milliseconds'), (1_000_000, 'microseconds'))
_STABILIZED = 'switch stabilization off (direction lock, FlowState, horizon lock)'
ODOMETRY = 'odometry'
_REMEDIES = {
    (IMAGES, 'turns', 'alike'): 'switch direction lock and stabilization off, and record one '
    'omnidirectional camera',
    (IMAGES, 'turns', 'sign'): 'set `clockwise` of the panorama, or `mirrored` of the calibration',
    (IMAGES, 'turns', 'scale'): 'a panorama shows all around once, so that a full turn shifts it '
    'by its width; or is the track of the wheels too wide?',
    (ODOMETRY, 'turns', 'sign'): 'swap left and right wheel',
    (ODOMETRY, 'turns', 'alike'): 'do the wheels skid?',
    (ODOMETRY, 'turns', 'scale'): 'do the wheels skid?',
    (POSE, 'turns', ''): 'correct its orientation',
    (TWIST, 'turns', ''): 'correct twist.angular.z, in rad/s',
    ('', 'way', 'alike'): 'is the heading of the pose right?',
    ('', 'way', 'sign'): 'correct the sign of twist.linear.x, or the heading of the pose',
    ('', 'way', 'scale'): 'publish m and m/s',
}
"""What to change where a source, or any, differs from the others by this kind, or by any."""


@dataclass
class MotionCheck:
    """Comparisons of a drive's sources, `odometry` and `gyro` as corrected, the drift of the
    images' clock, and sentences: on what is `wrong`, was `corrected`, or is worth noting.
    """

    pairs: list[Pair]
    odometry: Odometry
    gyro: YawRate | None
    wrong: list[str] = field(default_factory=list)
    corrected: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    image_drift: Drift | None = None
    timing: list[str] = field(default_factory=list)
    """Those of the sentences that are about drifting clocks, and images that follow the robot."""

    def pair(self, a: str, b: str, what: str = 'turns') -> Pair | None:
        """The comparison of b with a."""
        return next((p for p in self.pairs if (p.a, p.b, p.what) == (a, b, what)), None)

    @property
    def confirmed(self) -> bool:
        """Whether another device turns like the wheels, or the images turn like the gyroscope."""
        alike = [
            pair
            for pair in self.pairs
            if pair.what == 'turns' and not any(map(pair.differs, ('alike', 'sign', 'scale')))
        ]
        devices = [{pair.a, pair.b} - {TWIST} for pair in alike]
        return {POSE, IMAGES} in devices or any(GYRO in each and len(each) > 1 for each in devices)

    def run(self, recorded: Run) -> Run:
        """The compared drive with its corrected odometry, gyroscope and clock of the images."""
        run = replace(recorded, odometry=self.odometry, yaw_rate=self.gyro)
        if self.image_drift is None:
            return run
        stamps_ns = run.panoramas.stamps_ns
        stamps_ns = stamps_ns - self.image_drift.late_ns(stamps_ns)
        panoramas = replace(run.panoramas, stamps_ns=stamps_ns)  # type: ignore[type-var]
        return replace(run, panoramas=panoramas)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        rows = [dict(zip(HEAD, pair.row(), strict=True)) for pair in self.pairs]
        sentences = {name: getattr(self, name) for name in ('wrong', 'corrected', 'notes')}
        return {'pairs': rows, **sentences}

    def as_text(self) -> list[str]:
        """Lines for a terminal: the table of pairs, corrections and notes."""
        rows = [HEAD, *(pair.row() for pair in self.pairs)] if self.pairs else []
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = ['  '.join(map(str.ljust, row, widths)).rstrip() for row in rows]
        corrected = [f'corrected: {text}' for text in self.corrected]
        return [*table, *corrected, *(f'note: {text}' for text in self.notes)]


def check_motion(
    odometry: Odometry,
    images: tuple[Stamps, Array] | None = None,
    gyro: YawRate | None = None,
    panoramas: bool = True,
    views: StampedTextures | None = None,
    commands: bool = False,
) -> MotionCheck:
    """Compare all sources of a drive: see `sources_of`, and `contradicted` for the `views`.

    Turns of images that are no `panoramas` yet have an unknown direction and scale. Odometry that
    repeats `commands` is followed by the robot.
    """
    check = MotionCheck([], odometry, gyro, [*_impossible(sources_of(odometry, images, gyro))])
    if not (impossible := bool(check.wrong)):
        images = _repaired(check, images)
    sources = sources_of(check.odometry, images, check.gyro)
    pairs = [compare(a, b, what) for what in ('turns', 'way') for a, b in combinations(sources, 2)]
    check.pairs = [pair for pair in pairs if pair]
    turns = check.pair(POSE, IMAGES)
    if images is not None and not panoramas and turns and turns.scale < 0:
        return check_motion(odometry, (images[0], -images[1]), gyro, panoramas, views, commands)
    _judge(check, 'way')
    if not impossible:
        _judge_axes(check)
        _judge_following(check, sources, commands)
        _judge(check, 'turns')
        _judge_clocks(check)
        _judge_breaks(check, views)
    of_images = [text for text in check.wrong if text.startswith(IMAGES)]
    if images is not None and not (of_images or any(IMAGES in (p.a, p.b) for p in check.pairs)):
        check.notes.append('images: too few of them, or turns, to tell whether they are mirrored')
    if not panoramas:
        check.notes += of_images
        check.wrong = [text for text in check.wrong if text not in of_images]
    return check


def _judge_breaks(check: MotionCheck, views: StampedTextures | None) -> None:
    """Break the odometry where the images contradict it."""
    if views is None:
        return
    turns = check.pair(POSE, IMAGES)
    clock = check.image_drift or Drift(0, turns.late_s if turns else 0.0, 0.0)
    taken_ns = views[0] - clock.late_ns(views[0])
    check.odometry, texts = contradicted(check.odometry, taken_ns, views[1])
    check.corrected += texts


def _judge_width(check: MotionCheck) -> None:
    """Whether panoramas show a whole turn, by a gyroscope that turns alike."""
    pair = check.pair(GYRO, IMAGES)
    if pair is None or pair.correlation < CERTAIN or pair.differs('scale'):
        return
    factor = abs(pair.scale)
    if not 1 / WHOLE_BY_GYRO < factor < WHOLE_BY_GYRO:
        check.notes.append(
            f'{IMAGES} turn {factor:.2f} times as far as the {GYRO}: let the width of panoramas '
            f'show all around once, not {360 / factor:.0f} degrees; of several cameras, check the '
            'focal lengths in camera_info'
        )


def _impossible(sources: Sequence[Source]) -> Iterator[str]:
    """Stamps in other units, and speeds that no robot reaches in a tenth of its seconds."""
    for source in sources:
        problem = _stamp_problem(source.stamps_ns)
        at = _seconds(source.stamps_ns)
        if problem and source.name != TWIST:
            yield f'{source.name}: {problem}'
        elif not problem and 'way' in source.sums and len(at) > 1:
            time_s = np.maximum(np.diff(source.stamps_ns[at]) * 1e-9, 0.1)
            speed = np.percentile(np.abs(np.diff(source.sums['way'][at])) / time_s, 90)
            if speed > FASTEST_MPS:
                yield f'{source.name} drives at {speed:.3g} m/s: publish meters, not millimeters'


def _seconds(stamps_ns: Stamps) -> Indices:
    """The first row of each second of stamps (N,)."""
    return np.flatnonzero(np.diff((stamps_ns - stamps_ns[0]) // 1_000_000_000, prepend=-1))


def _stamp_problem(stamps_ns: Stamps) -> str:
    """Which unit the nanoseconds of stamps (N,) have instead, in words; '' if they are right."""
    second, part = np.divmod(stamps_ns, 1_000_000_000)
    if len(second) < max(_STAMPS_MIN, _STAMPS_MIN_PER_S * len(np.unique(second))):
        return ''
    name = next((name for limit, name in _UNITS if part.max() < limit), '')
    remedy = 'correct the driver, or set stamp_source: receive'
    return f'nanosec of its stamps holds {name}: {remedy}' if name else ''


def _ahead(odometry: Odometry) -> Complex:
    """The way of each second, m, along (real) and to the left of its mean heading. Seconds with
    much turn are left out: their chord does not show the heading.
    """
    at = _seconds(odometry.stamps_ns)
    step = relative(odometry.poses[at[:-1]], odometry.poses[at[1:]])
    chord = (step[:, 0] + 1j * step[:, 1]) * np.exp(-0.5j * step[:, 2])
    whole = odometry.part[at[:-1]] == odometry.part[at[1:]]
    return np.asarray(chord[whole & (np.abs(chord) > JUMP) & (np.abs(step[:, 2]) < SLIGHT_TURN)])


def _straightened(odometry: Odometry) -> tuple[Odometry, str]:
    """Odometry that heads along its way, forward or backward, and a sentence; '' if it did."""
    way = _ahead(odometry)
    if np.abs(way).sum() < ENOUGH['way']:
        return odometry, ''
    bearing = np.angle(way * np.where(way.real < 0, -1, 1))
    off = quantile(bearing, 0.5, np.abs(way))
    spread = MEDIAN_TO_STD * quantile(np.abs(bearing - off), 0.5, np.abs(way))
    chance = NOISE * spread / np.sqrt(len(way))
    if not max(ASKEW, chance) < abs(off) < np.pi / 4 or spread > UNEVEN:
        return odometry, ''
    poses = odometry.poses.copy()
    poses[:, 2] = wrap_angle(poses[:, 2] + off)
    degrees = np.rad2deg(abs(off))
    text = f'the heading of the pose lies {degrees:.1f} degrees beside its way: corrected'
    return replace(odometry, poses=poses), text


def _judge_axes(check: MotionCheck) -> None:
    """Whether poses move along their heading, as wheels do."""
    way = _ahead(check.odometry)
    ahead = np.abs(way.real).sum()
    sideways = np.abs(way.imag).sum()
    if sideways > max(ENOUGH['way'], SIDEWAYS * ahead):
        text = f'{POSE} drives {sideways:.3g} m sideways and {ahead:.3g} m ahead: correct its '
        text += 'heading and axes (x ahead, y to the left, yaw counterclockwise)'
        (check.wrong if sideways > 2 * SIDEWAYS * ahead else check.notes).append(text)


def _repaired(
    check: MotionCheck, images: tuple[Stamps, Array] | None
) -> tuple[Stamps, Array] | None:
    """Correct odometry that jumps or heads aside; stamp the images, and `check.gyro`, by its clock
    where theirs drifts; leave out faulty samples of the gyroscope, or all of them.
    """
    for change in parted, _straightened:
        check.odometry, text = change(check.odometry)
        check.corrected += [text] if text else []
    gyro = None if check.gyro is None else smoothed(check.gyro)
    drifting = drifts(sources_of(check.odometry, images, gyro))
    check.timing += drift_sentences(drifting)
    check.corrected += check.timing
    if check.gyro is not None and GYRO in drifting:
        stamps_ns = check.gyro.stamps_ns
        stamps_ns = stamps_ns - drifting[GYRO].late_ns(stamps_ns)
        check.gyro = replace(check.gyro, stamps_ns=stamps_ns)
    check.image_drift = drifting.get(IMAGES)
    if images is not None and check.image_drift is not None:
        images = images[0] - check.image_drift.late_ns(images[0]), images[1]
    check.gyro, text = cleaned(check.odometry, images, check.gyro)
    check.corrected += [text] if text else []
    return images


def _judge_following(check: MotionCheck, sources: Sequence[Source], commands: bool) -> None:
    """Report images that follow the robot; their turns then show nothing else. The robot itself
    follows `commands`, which the odometry may repeat.
    """
    how = following([one for one in sources if not commands or one.name in (IMAGES, GYRO)])
    if how:
        text = f"{IMAGES} follow the robot's turns {how}: {_STABILIZED}"
        check.wrong.append(text)
        check.timing.append(text)
        check.pairs = [pair for pair in check.pairs if IMAGES not in (pair.a, pair.b)]


def _judge(check: MotionCheck, what: str) -> None:
    """Report the minority for each kind of difference of the turns, or of the way."""
    pairs = [pair for pair in check.pairs if pair.what == what]
    names = {name for pair in pairs for name in (pair.a, pair.b)}
    for kind in ('alike', 'sign', 'scale'):
        groups = _groups(pairs, kind, names)
        for minority in groups[1:]:
            between = [p for p in pairs if {p.a, p.b} & minority and {p.a, p.b} & groups[0]]
            if between:
                _report(check, kind, minority, groups[0], between[0])
            names -= minority if kind == 'alike' else set()


def _groups(pairs: Sequence[Pair], kind: str, names: set[str]) -> list[set[str]]:
    """Sources that agree with each other; the group of most devices, or of the pose, first."""
    groups = [{name} for name in names]
    for pair in pairs:
        if {pair.a, pair.b} <= names and not pair.differs(kind):
            joined = [group for group in groups if group & {pair.a, pair.b}]
            groups = [group for group in groups if group not in joined] + [set().union(*joined)]
    return sorted(groups, key=lambda group: (-_devices(group), POSE not in group, min(group)))


def _devices(group: set[str]) -> int:
    return len({'wheels' if name in (POSE, TWIST) else name for name in group})


def _report(check: MotionCheck, kind: str, group: set[str], others: set[str], pair: Pair) -> None:
    """Report how a group of sources differs from the others, by one `pair` of both."""
    factor = abs(pair.scale) if pair.b in group else 1 / max(abs(pair.scale), 1e-9)
    how = {
        'alike': 'independently of' if pair.independent else 'unlike',
        'sign': 'opposite to',
        'scale': f'{factor:.3g} times as far{unit(pair)} as',
    }[kind]
    verb = 'drives' if pair.what == 'way' else 'turn' if group == {IMAGES} else 'turns'
    text = f'{_listed(group)} {verb} {how} {_listed(others)}'
    if GYRO in group:
        _correct_gyro(check, kind, text, factor)
        return
    faulty = _faulty(group)
    remedy = _remedy(faulty, pair.what, kind)
    wrong = kind == 'sign' or (kind == 'scale' and not 1 / SKIDDING < factor < SKIDDING)
    if pair.what == 'turns' and faulty == IMAGES:
        # Skidding wheels turn farther than the robot does.
        images_err = factor > 1 or _devices(others) > 1
        wrong = {'alike': pair.independent, 'sign': True, 'scale': images_err}[kind]
        if kind == 'sign' and _devices(others) == 1:
            remedy += f', or {_REMEDIES[ODOMETRY, "turns", "sign"]}'
    elif pair.what == 'turns' and kind == 'alike':
        wrong = faulty != ODOMETRY
    (check.wrong if wrong else check.notes).append(f'{text}: {remedy}')


def _faulty(group: set[str]) -> str:
    """The source, or both of the wheels, to change in a group that differs."""
    if group >= {POSE, TWIST}:
        return ODOMETRY
    return next(name for name in (POSE, TWIST, IMAGES) if name in group)


def _remedy(faulty: str, what: str, kind: str) -> str:
    """What to change where a source differs from the others by its turns or way."""
    rows = (faulty, what, kind), (faulty, what, ''), ('', what, kind)
    return next(_REMEDIES[row] for row in rows if row in _REMEDIES)


def _listed(group: set[str]) -> str:
    """The names of sources, in words."""
    wheels = [ODOMETRY] if {POSE, TWIST} <= group else sorted(group & {POSE, TWIST})
    return ' and '.join([*wheels, *sorted(group - {POSE, TWIST})])


def _correct_gyro(check: MotionCheck, kind: str, text: str, factor: float) -> None:
    """Mirror, convert or leave out the gyroscope."""
    if check.gyro is None:
        return
    omega = check.gyro.omega
    variance = check.gyro.variance
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
    """Correct the stamps of the gyroscope; the training corrects those of images."""
    _judge_width(check)
    if check.gyro is not None and not check.odometry.trajectory.covers(check.gyro.stamps_ns).any():
        check.corrected.append(f'{GYRO}: stamped by another clock than the odometry; left out')
        check.gyro = None
    for name in (GYRO, IMAGES):
        pair = check.pair(POSE, name)
        if pair is None or pair.differs('alike') or not pair.late_s:
            continue
        late_ns = round(pair.late_s * 1e9)
        if name == IMAGES and abs(late_ns) > DELAY_LIMIT_NS:
            continue  # reported as a lack of its own
        if name == GYRO and check.gyro is not None:
            check.gyro = replace(check.gyro, stamps_ns=check.gyro.stamps_ns - late_ns)
        check.corrected.append(f'{name}: stamped {late(pair.late_s)}; taken into account')
