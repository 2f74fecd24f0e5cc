# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry cut into segments: short pieces inside which it can be trusted, and links between.

A segment carries its own odometry path as complex numbers (x + i y), so that a picture m of
segment n lies at o_n + z_n q_nm for an unknown origin o_n and an unknown direction |z_n| = 1.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, relative, wrap_angle
from sfa_localization.data.run import Count, Odometry, Stamps, Trajectory, YawRate, differences
from sfa_localization.metric.settings import SegmentConfig

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

logger = logging.getLogger(__name__)

# A gyroscope is compared with wheels that have turned this much, rad^2 in steps of a second, and
# must then agree within this factor: skidding wheels are off by two, degrees by 57.
_TURNS_TO_JUDGE = 1.0
_GYRO_RATIO = 5.0
_PERIODS = 2.5
# Jumps of yaw between two odometry messages, beyond what the twist explains: a reset.
_YAW_JUMP_RAD = 0.5
# Yaw rates are averaged over this long before they are compared with a threshold.
_SMOOTHING_S = 0.3


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of a drive, in its own frame: origin at its first picture, x along its reference.

    The reference heading is the first picture's, or a straight line's mean. Errors of a constant
    yaw-rate bias b are known to first order: true = measured - b * drift.
    """

    images: Indices
    """(M,) indices of the run's pictures."""
    path: Complex
    """(M,) places in metres, path[0] = 0; real, the driven distance, on a straight line."""
    headings: Array
    """(M,) rad from the reference heading."""
    times_s: Array
    """(M,) seconds since the time of the reference heading: drift of `headings` per bias."""
    path_drift: Complex
    """(M,) metres per rad/s: drift of `path`."""
    start: Array
    """(3,) odometry pose of the frame: x m, y m, yaw rad in the odometry frame."""
    turn_rad: float = np.nan
    """Signed turn to the next segment's reference heading; NaN where unknown."""
    turn_variance: float = np.nan
    """rad^2, without the bias."""
    turn_time_s: float = np.nan
    """Seconds between the reference headings: drift of `turn_rad`."""
    displacement: complex = complex(np.nan, np.nan)
    """Next segment's origin in this frame, metres; NaN where unknown."""
    displacement_variance: float = np.nan
    """m^2 per axis, without the bias."""
    displacement_drift: complex = complex(np.nan, np.nan)
    """Metres per rad/s: drift of `displacement`."""
    run: int = 0
    """Which of the joined runs it belongs to."""

    @property
    def length_m(self) -> float:
        """Driven length between the pictures."""
        return float(np.abs(np.diff(self.path)).sum())

    @property
    def linked(self) -> bool:
        """Whether odometry leads on to the next segment."""
        return bool(np.isfinite(self.turn_rad))


@dataclass(frozen=True, slots=True)
class Segments:
    """Segments in driving order, and what became of the pictures and the odometry."""

    items: tuple[Segment, ...]
    images: Count = field(default_factory=Count)
    odometry: Count = field(default_factory=Count)

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Segment]:
        return iter(self.items)

    def __getitem__(self, index: int) -> Segment:
        return self.items[index]


def cut(
    odometry: Odometry,
    image_stamps_ns: Stamps,
    config: SegmentConfig,
    yaw_rate: YawRate | None = None,
) -> Segments:
    """Cut a drive into segments at the pictures' stamps (N,).

    `config.segments` names the cutter: 'straight' keeps lines between turns on the spot, by
    translational and angular velocity, as the paper does; 'any' cuts the whole drive into pieces
    bounded by length and by accumulated odometry error. Pictures without odometry, standing
    still, or in too short a piece are left out and counted in the result's `images`.

    Raises DataError when no segment is left.
    """
    track = _track(odometry, config, yaw_rate)
    stamps = np.asarray(image_stamps_ns, np.int64)
    skipped: dict[str, int] = {}
    views = _views(track, stamps, skipped)
    views = _thinned(views, config, skipped)
    groups = (_lines if config.segments == 'straight' else _pieces)(track, views, config, skipped)
    items = [_segment(views, group, config.segments == 'straight') for group in groups]
    if not items:
        raise DataError(_nothing_left(len(stamps), skipped, config))
    linked = [
        *(_link(views, a, b, x, y, config) for a, b, x, y in _pairs(items, groups)),
        items[-1],
    ]
    used = sum(len(item.images) for item in items)
    return Segments(tuple(linked), Count(used, skipped), track.count)


def join(parts: Sequence[Segments], offsets: Sequence[int]) -> Segments:
    """Segments of several runs as one; run k's pictures start at index offsets[k]."""
    items: list[Segment] = []
    for number, (part, offset) in enumerate(zip(parts, offsets, strict=True)):
        items += [replace(s, images=s.images + offset, run=number) for s in part]
    return Segments(
        tuple(items), _sum(part.images for part in parts), _sum(part.odometry for part in parts)
    )


def assignment(segments: Segments, count: int) -> Indices:
    """The segment of each of `count` pictures (count,); -1 for a picture of none."""
    owner = np.full(count, -1, np.int64)
    for number, segment in enumerate(segments):
        owner[segment.images] = number
    return owner


def _sum(counts: Iterator[Count]) -> Count:
    used, skipped = 0, dict[str, int]()
    for count in counts:
        used += count.used
        for reason, number in count.skipped.items():
            skipped[reason] = skipped.get(reason, 0) + number
    return Count(used, skipped)


def _nothing_left(pictures: int, skipped: dict[str, int], config: SegmentConfig) -> str:
    reasons = ', '.join(f'{number} {reason}' for reason, number in skipped.items()) or 'none at all'
    remedy = (
        'drive straight lines with turns on the spot, or use segments: any'
        if config.segments == 'straight'
        else 'check that odometry and pictures share a clock and that the robot drives'
    )
    return f'no segment of odometry among {pictures} pictures ({reasons}): {remedy}'


@dataclass(frozen=True, slots=True)
class _Track:
    """Dead reckoning at the odometry's stamps, with what it accumulates along the way."""

    stamps_ns: Stamps
    poses: Array
    yaw: Array
    speed: Array
    turn_rate: Array
    part: Indices
    sums: Array
    count: Count


# Columns of the accumulated sums: driven metres, radians turned either way, yaw variance, and
# the two parts of the moment of time, integral of t dp, that a yaw-rate bias acts on.
_LENGTH, _TURNED, _YAW_VARIANCE, _MOMENT = 0, 1, 2, slice(3, 5)


@dataclass(frozen=True, slots=True)
class _Views:
    """The odometry at the pictures that have any."""

    images: Indices
    time_s: Array
    place: Complex
    yaw: Array
    part: Indices
    sums: Array

    def take(self, keep: NDArray[np.bool_]) -> _Views:
        return _Views(*(getattr(self, name)[keep] for name in self.__slots__))


def _track(odometry: Odometry, config: SegmentConfig, yaw_rate: YawRate | None) -> _Track:
    kept, skipped = _sound(odometry)
    stamps, poses = odometry.stamps_ns[kept], np.array(odometry.poses[kept], float)
    twists = _twists(stamps, poses, odometry.twists[kept])
    breaks = _breaks(stamps, poses, twists, config, skipped)
    variances = np.where(odometry.variances[kept, 1] > 0, odometry.variances[kept, 1], 0.0)
    yaw = np.unwrap(poses[:, 2])
    gyro = None if config.yaw_source == 'odometry' else _usable_gyro(yaw_rate)
    if gyro is not None:
        turns, variances = _gyro_turns(stamps, yaw, variances, ~breaks, gyro, config, skipped)
        measured = yaw[0] + np.concatenate([[0.0], np.cumsum(turns)])
        poses, yaw = _turned(poses, yaw, measured), measured
        twists = np.column_stack([twists[:, 0], np.gradient(yaw, _seconds(stamps))])
    elif config.yaw_source == 'gyro':
        raise DataError('yaw_source is gyro, but there is no yaw rate: name the imu topic')
    sums = _sums(stamps, poses, yaw, variances, config)
    rate = _smoothed(_seconds(stamps), twists[:, 1])
    part = np.concatenate([[0], np.cumsum(breaks)])
    count = Count(int(kept.sum()), skipped)
    return _Track(stamps, poses, yaw, np.abs(twists[:, 0]), rate, part, sums, count)


def _seconds(stamps_ns: Stamps) -> Array:
    return np.asarray((stamps_ns - stamps_ns[0]) * 1e-9)


def _sound(odometry: Odometry) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Messages with finite numbers and increasing stamps; why others are not."""
    finite = np.isfinite(odometry.poses).all(1) & np.isfinite(odometry.twists).all(1)
    stamps = np.where(finite, odometry.stamps_ns, np.iinfo(np.int64).min)
    before = np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(stamps)[:-1]])
    kept = finite & (stamps > before)
    if kept.sum() < 2:
        raise DataError('fewer than two sound odometry messages: check the odometry topic')
    reasons = {'not finite': int((~finite).sum()), 'out of order': int((finite & ~kept).sum())}
    return kept, {reason: number for reason, number in reasons.items() if number}


def _twists(stamps: Stamps, poses: Array, twists: Array) -> Array:
    """The messages' twists, or the poses' own where no message has any."""
    return twists if np.any(twists) else differences(stamps, poses)


def _breaks(
    stamps: Stamps, poses: Array, twists: Array, config: SegmentConfig, skipped: dict[str, int]
) -> NDArray[np.bool_]:
    """Mask (N - 1,) of the steps that odometry does not bridge: pauses and resets."""
    dt = np.diff(stamps) * 1e-9
    step = relative(poses[:-1], poses[1:])
    speed = np.maximum(np.abs(twists[:-1, 0]), np.abs(twists[1:, 0]))
    rate = np.maximum(np.abs(twists[:-1, 1]), np.abs(twists[1:, 1]))
    # Odometry that is always slow does not pause at each message.
    gap = dt > max(config.odometry_gap_max, _PERIODS * float(np.median(dt)))
    reset = np.hypot(step[:, 0], step[:, 1]) > speed * dt + config.odometry_jump_max
    reset |= np.abs(step[:, 2]) > rate * dt + _YAW_JUMP_RAD
    for reason, mask in (('pauses', gap), ('resets', reset & ~gap)):
        if mask.any():
            skipped[reason] = int(mask.sum())
    return np.asarray(gap | reset)


def _usable_gyro(yaw_rate: YawRate | None) -> YawRate | None:
    """The finite readings with increasing stamps; None where they are fewer than two."""
    if yaw_rate is None:
        return None
    omega = np.where(np.isfinite(yaw_rate.omega), yaw_rate.omega, np.nan)
    stamps = np.where(np.isfinite(omega), yaw_rate.stamps_ns, np.iinfo(np.int64).min)
    before = np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(stamps)[:-1]])
    kept = stamps > before
    if kept.sum() < 2:
        return None
    return YawRate(stamps[kept], omega[kept], np.nan_to_num(yaw_rate.variance[kept]))


def _gyro_turns(
    stamps: Stamps,
    yaw: Array,
    variances: Array,
    whole: NDArray[np.bool_],
    gyro: YawRate,
    config: SegmentConfig,
    skipped: dict[str, int],
) -> tuple[Array, Array]:
    """Turns (N - 1,) between the odometry's stamps, and the variances (N,) of their rate.

    The gyroscope's where it has readings all along a step, else the odometry's: less exact, but
    a gyroscope that pauses or ends says nothing of the turns since. The odometry's are then given
    the gyroscope's mean offset, so that one bias is left for the whole drive.
    """
    seconds, at = (gyro.stamps_ns - stamps[0]) * 1e-9, _seconds(stamps)
    areas = (gyro.omega[1:] + gyro.omega[:-1]) / 2 * np.diff(seconds)
    turns = np.diff(np.interp(at, seconds, np.concatenate([[0.0], np.cumsum(areas)])))
    wheels, dt = np.diff(yaw), np.diff(at)
    seen = _bridged(stamps, gyro.stamps_ns, round(config.odometry_gap_max * 1e9))
    both = seen & whole
    sign = _gyro_sign(turns[both], wheels[both], at[:-1][both], config)
    if sign == 0.0 or not both.any():
        _tally(skipped, 'without a usable gyroscope', whole)
        return wheels, variances
    _tally(skipped, 'in a gap of the gyroscope', whole & ~seen)
    turns *= sign
    offset = float((turns - wheels)[both].sum() / dt[both].sum())
    own = np.interp(at, seconds, np.maximum(gyro.variance, 0.0))
    own = np.where(np.append(seen, seen[-1]), own, variances)
    return np.where(seen, turns, wheels + offset * dt), own


def _bridged(stamps: Stamps, readings: Stamps, gap_ns: int) -> NDArray[np.bool_]:
    """Mask (N - 1,) of the steps between stamps (N,) along which readings (M,) never pause."""
    before = np.searchsorted(readings, stamps[:-1], 'right') - 1
    after = np.searchsorted(readings, stamps[1:], 'left')
    inside = (before >= 0) & (after < len(readings))
    pauses = np.concatenate([[0], np.cumsum(np.diff(readings) > gap_ns)])
    before, after = np.clip([before, after], 0, len(readings) - 1)
    return np.asarray(inside & (pauses[before] == pauses[after]))


def _gyro_sign(turns: Array, wheels: Array, at_s: Array, config: SegmentConfig) -> float:
    """1, or -1 for a gyroscope mounted upside down, or 0 for one that measures something else.

    Compared over whole seconds with the turns of the wheels, where these turn at all.
    """
    second = np.unique(np.floor(at_s), return_inverse=True)[1]
    ours, theirs = (np.bincount(second, values) for values in (turns, wheels))
    power = float(theirs @ theirs)
    if config.yaw_source == 'gyro' or power < _TURNS_TO_JUDGE:
        return 1.0
    slope = float(ours @ theirs) / power
    if not 1 / _GYRO_RATIO < abs(slope) < _GYRO_RATIO:
        logger.warning(
            'the gyroscope turns %.2g times as far as the odometry: it is not used; check its '
            'axis and unit (rad/s), or trust it with yaw_source: gyro', slope
        )  # fmt: skip
        return 0.0
    if slope < 0:
        logger.warning('the gyroscope turns opposite to the odometry: taken as upside down')
    return float(np.sign(slope))


def _turned(poses: Array, yaw: Array, measured: Array) -> Array:
    """The same wheel steps driven with another yaw (N,)."""
    step = np.diff(poses[:, 0] + 1j * poses[:, 1])
    middle = (yaw[:-1] + yaw[1:]) / 2
    step = step * np.exp(1j * ((measured[:-1] + measured[1:]) / 2 - middle))
    place = poses[0, 0] + 1j * poses[0, 1] + np.concatenate([[0.0], np.cumsum(step)])
    return np.column_stack([place.real, place.imag, wrap_angle(measured)])


def _sums(
    stamps: Stamps, poses: Array, yaw: Array, variances: Array, config: SegmentConfig
) -> Array:
    """Running sums (N, 5): see the columns' names above."""
    t = _seconds(stamps)
    step = np.diff(poses[:, 0] + 1j * poses[:, 1])
    moment = step * (t[1:] + t[:-1]) / 2
    dt = np.diff(t)
    told = variances[:-1] * dt**2
    noise = np.where(told > 0, told, config.yaw_noise**2 * dt)
    columns = [np.abs(step), np.abs(np.diff(yaw)), noise, moment.real, moment.imag]
    return np.vstack([np.zeros(5), np.cumsum(np.column_stack(columns), axis=0)])


def _smoothed(seconds: Array, values: Array) -> Array:
    """Moving average over a fixed time, by the running integral."""
    total = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(seconds))])
    low = np.clip(seconds - _SMOOTHING_S / 2, seconds[0], seconds[-1])
    high = np.clip(seconds + _SMOOTHING_S / 2, seconds[0], seconds[-1])
    area = np.interp(high, seconds, total) - np.interp(low, seconds, total)
    return np.asarray(area / np.maximum(high - low, 1e-9))


def _views(track: _Track, stamps: Stamps, skipped: dict[str, int]) -> _Views:
    """Odometry interpolated at the pictures; those outside it or in a break are counted."""
    inside = (stamps >= track.stamps_ns[0]) & (stamps <= track.stamps_ns[-1])
    before = np.searchsorted(track.stamps_ns, stamps, 'right') - 1
    after = np.searchsorted(track.stamps_ns, stamps, 'left')
    before, after = np.clip([before, after], 0, len(track.stamps_ns) - 1)
    whole = track.part[before] == track.part[after]
    _tally(skipped, 'without odometry', ~inside)
    _tally(skipped, 'in a break of odometry', inside & ~whole)
    images = np.flatnonzero(inside & whole)
    poses = Trajectory(track.stamps_ns, track.poses).at(stamps[images])
    t, own = _seconds(track.stamps_ns), (stamps[images] - track.stamps_ns[0]) * 1e-9
    sums = np.column_stack([np.interp(own, t, column) for column in track.sums.T])
    place = poses[:, 0] + 1j * poses[:, 1]
    yaw = np.interp(own, t, track.yaw)
    return _Views(images, own, place, yaw, track.part[before[images]], sums.reshape(-1, 5))


def _tally(skipped: dict[str, int], reason: str, mask: NDArray[np.bool_]) -> None:
    if mask.any():
        skipped[reason] = skipped.get(reason, 0) + int(mask.sum())


def _thinned(views: _Views, config: SegmentConfig, skipped: dict[str, int]) -> _Views:
    """Leave out pictures of a robot that stands still."""
    keep = np.ones(len(views.images), bool)
    turn_min = np.deg2rad(config.image_turn_min)
    last = 0
    for i in range(1, len(keep)):
        moved = abs(views.place[i] - views.place[last]) >= config.image_step_min
        turned = abs(views.yaw[i] - views.yaw[last]) >= turn_min
        keep[i] = moved or turned or views.part[i] != views.part[last]
        last = i if keep[i] else last
    _tally(skipped, 'standing still', ~keep)
    return views.take(keep)


def _lines(
    track: _Track, views: _Views, config: SegmentConfig, skipped: dict[str, int]
) -> list[Indices]:
    """Straight lines: driven, not turning, between turns on the spot."""
    seconds = _seconds(track.stamps_ns)
    rate = np.interp(views.time_s, seconds, np.abs(track.turn_rate))
    straight = rate < config.turn_rate_min
    straight &= np.interp(views.time_s, seconds, track.speed) >= config.speed_min
    _tally(skipped, 'turning or standing', ~straight)
    groups = _stretches(views, np.flatnonzero(straight), config)
    groups = [line for group in groups for line in _unbent(views, group, config)]
    return _long_enough(views, groups, config.line_length_min, config, skipped)


def _unbent(views: _Views, group: Indices, config: SegmentConfig) -> list[Indices]:
    """Split where the heading leaves that of the line's start."""
    lines, start = [], 0
    for i in range(1, len(group)):
        bend = abs(views.yaw[group[i]] - views.yaw[group[start]])
        turned = views.sums[group[i], _TURNED] - views.sums[group[i - 1], _TURNED]
        if bend > np.deg2rad(config.line_bend_max) or turned > np.pi / 4:
            lines.append(group[start:i])
            start = i
    return [*lines, group[start:]]


def _pieces(
    track: _Track, views: _Views, config: SegmentConfig, skipped: dict[str, int]
) -> list[Indices]:
    """Pieces of any drive, as even as the bounds on length and error allow."""
    groups = _stretches(views, np.arange(len(views.images)), config)
    pieces = [piece for group in groups for piece in _even(views, group, config)]
    return _long_enough(views, pieces, 2 * config.image_step_min, config, skipped)


def _stretches(views: _Views, chosen: Indices, config: SegmentConfig) -> list[Indices]:
    """Split the chosen pictures where odometry breaks or pictures are missing."""
    if len(chosen) == 0:
        return []
    far = np.diff(views.sums[chosen, _LENGTH]) > config.image_step_max
    ends = np.flatnonzero(far | (np.diff(views.part[chosen]) != 0)) + 1
    return list(np.split(chosen, ends))


def _even(views: _Views, group: Indices, config: SegmentConfig) -> list[Indices]:
    """As many pieces as the bounds demand, each with the same share of length and error."""
    wear = _wear(views, group, config)
    number = max(int(np.ceil(wear[-1] - 1e-9)), 1)
    owner = np.minimum(wear / max(wear[-1], 1e-9) * number, number - 1).astype(int)
    return [group[owner == k] for k in range(number) if (owner == k).any()]


def _wear(views: _Views, group: Indices, config: SegmentConfig) -> Array:
    """Driven so far (M,), in whole pieces: a piece is worn out by its length or by its error."""
    driven = np.diff(views.sums[group], axis=0)
    yaw = np.sqrt(driven[:, _YAW_VARIANCE]) * config.piece_length
    # Variances add up: the error of k equal steps is sqrt(k) times that of one.
    random = config.distance_noise**2 * driven[:, _LENGTH] + yaw**2 / 3
    turned = (config.turn_slide + config.yaw_slip * config.piece_length / 2) * driven[:, _TURNED]
    share = driven[:, _LENGTH] / config.piece_length
    worn = np.maximum(share, random / config.piece_std**2) + turned / config.piece_std
    return np.concatenate([[0.0], np.cumsum(worn)])


def _long_enough(
    views: _Views,
    groups: list[Indices],
    length_min: float,
    config: SegmentConfig,
    skipped: dict[str, int],
) -> list[Indices]:
    kept = []
    for group in groups:
        length = views.sums[group[-1], _LENGTH] - views.sums[group[0], _LENGTH]
        if len(group) >= config.segment_images_min and length >= length_min:
            kept.append(group)
        else:
            skipped['in too short a segment'] = skipped.get('in too short a segment', 0) + len(
                group
            )
    return kept


def _segment(views: _Views, group: Indices, straight: bool) -> Segment:
    """One segment in its own frame."""
    place, time, yaw = views.place[group], views.time_s[group], views.yaw[group]
    weight = np.full(len(group), 1 / len(group)) if straight else np.eye(1, len(group))[0]
    reference, reference_time = float(weight @ yaw), float(weight @ time)
    path = (place - place[0]) * np.exp(-1j * reference)
    drift = _drift(views, group[0], group, reference, reference_time)
    if straight:
        path, drift = _distance(path), np.zeros(len(group), complex)
    start = np.array([place[0].real, place[0].imag, reference])
    images = np.asarray(views.images[group], np.int64)
    return Segment(images, path, yaw - reference, time - reference_time, drift, start)


def _distance(path: Complex) -> Complex:
    """Driven distance along a straight line, negative backwards."""
    step = np.diff(path)
    driven = np.abs(step) * np.where(step.real < 0, -1.0, 1.0)
    return np.asarray(np.concatenate([[0.0], np.cumsum(driven)]), complex)


def _drift(
    views: _Views, start: int, at: Indices, reference: float, reference_time: float
) -> Complex:
    """What a yaw-rate bias of 1 rad/s adds to the path from `start`, to first order."""
    moment = views.sums[:, _MOMENT] @ np.array([1.0, 1.0j])
    lever = moment[at] - moment[start] - reference_time * (views.place[at] - views.place[start])
    return np.asarray(1j * lever * np.exp(-1j * reference))


def _pairs(
    items: list[Segment], groups: list[Indices]
) -> Iterator[tuple[Segment, Segment, int, int]]:
    firsts = [int(group[0]) for group in groups]
    return zip(items[:-1], items[1:], firsts[:-1], firsts[1:], strict=True)


def _link(
    views: _Views, a: Segment, b: Segment, first: int, then: int, config: SegmentConfig
) -> Segment:
    """Segment `a` linked to the next one, `b`, unless odometry breaks between them."""
    if views.part[first] != views.part[then]:
        return a
    time = views.time_s[first] - a.times_s[0], views.time_s[then] - b.times_s[0]
    frame, reference_time = np.exp(-1j * a.start[2]), time[0]
    drift = _drift(views, first, np.array([then]), float(a.start[2]), float(reference_time))
    return replace(
        a,
        turn_rad=float(wrap_angle(b.start[2] - a.start[2])),
        turn_variance=max(_yaw_variance(views, first, then, config), 1e-12),
        turn_time_s=float(time[1] - time[0]),
        displacement=complex((views.place[then] - views.place[first]) * frame),
        displacement_variance=max(_place_variance(views, first, then, config), 1e-12),
        displacement_drift=complex(drift[0]),
    )


def _yaw_variance(views: _Views, first: int, then: int, config: SegmentConfig) -> float:
    """Of the turn between two pictures, rad^2."""
    change = views.sums[then] - views.sums[first]
    return float(change[_YAW_VARIANCE] + (config.yaw_slip * change[_TURNED]) ** 2)


def _place_variance(views: _Views, first: int, then: int, config: SegmentConfig) -> float:
    """Of the displacement between two pictures, m^2 per axis: distance, yaw and sliding wheels."""
    change = views.sums[then] - views.sums[first]
    length = float(change[_LENGTH])
    yaw = _yaw_variance(views, first, then, config)
    slide = (config.turn_slide * float(change[_TURNED])) ** 2
    return config.distance_noise**2 * length + yaw * length**2 / 3 + slide
