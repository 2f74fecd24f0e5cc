# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry cut into segments: short pieces inside which it can be trusted, and links between.

A segment carries its own odometry path as complex numbers (x + i y), so that image m of segment n
lies at o_n + z_n q_nm for an unknown origin o_n and an unknown direction z_n = exp(i alpha_n). On a
straight line q_nm is the distance d_nm of section 3.1 of the paper.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Count, Odometry, Stamps, Trajectory, YawRate
from sfa_localization.keyframes.closures import Closures
from sfa_localization.keyframes.offsets import Offsets
from sfa_localization.metric.dead_reckoning import (
    LENGTH,
    MOMENT,
    TURNED,
    YAW_VARIANCE,
    OdometryTrack,
    Way,
    seconds_since_start,
    summed,
    tally,
)
from sfa_localization.metric.measured_points import MeasuredPoints
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.settings import SegmentConfig

PIECE_LENGTH_M = 3.0
"""Longest piece of any drive: long enough to contain several images, short enough to be rigid."""
PIECE_STD_M = 0.1
"""Largest odometry error inside a piece: about what one image is worth."""
LINE_LENGTH_MIN_M = 2.0
"""Shorter straight lines have no direction worth a segment."""
LINE_BEND_MAX_RAD = np.deg2rad(8.0)
"""Change of heading at which a straight line ends."""
IMAGES_MIN = 3
"""Fewest images of a segment: two determine its origin and direction, the third tests them."""
IMAGE_STEP_MAX_M = 1.5
"""Longest distance without an image inside a segment."""
IMAGE_STEP_MIN_M = 0.01
IMAGE_TURN_MIN_RAD = np.deg2rad(3.0)
"""Images closer to the one before, and turned less, repeat it: the robot hardly moves."""
BIAS_PERIOD_S = 60.0
"""The yaw-rate bias of odometry is constant for about this long: floors and tires change it."""
SPEED_MIN_MPS = 0.01
TURN_RATE_MIN_RADPS = 0.2
"""A robot that is slower, or turns faster, does not drive a straight line."""
DISTANCE_NOISE = 0.01
"""m per square root of m: random error of the driven distance, usual for wheel encoders."""
YAW_SLIP = 0.005
"""rad per rad: error of a turn, usual for a differential drive."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of a drive, in its own frame: origin at its first image, x along its reference.

    The reference heading is that of the first image, or the mean of a straight line. The error by a
    constant yaw-rate bias b is linear in it: true = measured - b * drift.
    """

    images: Indices
    """(M,) indices of the images of the run."""
    path: Complex
    """(M,) meters, path[0] = 0; on a straight line real: the distance d of the paper."""
    headings: Array
    """(M,) rad from the reference heading."""
    times_s: Array
    """(M,) seconds since the time of the reference heading: drift of `headings` per bias."""
    path_drift: Complex
    """(M,) meters per rad/s: drift of `path`."""
    start: Array
    """(3,) odometry pose of the frame: x m, y m, yaw rad in the odometry frame."""
    turn_rad: float = np.nan
    """Signed turn to the next segment's reference heading; NaN where unknown."""
    turn_variance: float = np.nan
    """rad^2, without the bias."""
    turn_time_s: float = np.nan
    """Seconds between the reference headings: drift of `turn_rad`."""
    displacement: complex = complex(np.nan, np.nan)
    """Next segment's origin in this frame, meters; NaN where unknown."""
    displacement_variance: float = np.nan
    """m^2 per axis, without the bias."""
    displacement_drift: complex = complex(np.nan, np.nan)
    """Meters per rad/s: drift of `displacement`."""
    run: int = 0
    """Which of the joined runs it belongs to."""
    since_start_s: float = 0.0
    """Seconds from the start of the run's odometry to the first image."""
    period: int = 0
    """Which of the `BIAS_PERIOD_S` of the joined runs it belongs to: each has a yaw-rate bias."""

    @property
    def linked(self) -> bool:
        """Whether odometry leads on to the next segment."""
        return bool(np.isfinite(self.turn_rad))


@dataclass(frozen=True, slots=True)
class Segments:
    """Segments in driving order, how many images and odometry messages were used, the loop closures
    between their images, with and without offsets, how the way of each run was corrected, measured
    points beside them, and where the camera sits, whose places those of the segments are."""

    items: tuple[Segment, ...]
    images: Count = field(default_factory=Count)
    odometry: Count = field(default_factory=Count)
    closures: Closures = field(default_factory=Closures.none)
    offsets: Offsets = field(default_factory=Offsets.none)
    ways: tuple[Way | None, ...] = (None,)
    points: MeasuredPoints | None = None
    mount: Mount = field(default_factory=Mount)

    def __len__(self) -> int:
        return len(self.items)

    @property
    def quality(self) -> dict[str, Any]:
        """Figures that are stored in the model."""
        return {'segments': len(self)}

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
    """Cut a drive, as `cut_track` its dead reckoning."""
    return cut_track(OdometryTrack.of(odometry, config, yaw_rate), image_stamps_ns, config)


def cut_track(track: OdometryTrack, image_stamps_ns: Stamps, config: SegmentConfig) -> Segments:
    """Cut dead reckoning into segments at the stamps of the drive's images (N,).

    `config.segments` names the cutter: 'straight' keeps lines between turns on the spot, by
    translational and angular velocity, as the paper does; 'any' cuts the whole drive into pieces
    bounded by length and by accumulated odometry error. Images without odometry, of a standing
    robot, or in too short a piece are left out and counted in `Segments.images`.

    Raises DataError when no segment is left.
    """
    skipped: dict[str, int] = {}
    poses = ImagePoses.on(track, np.asarray(image_stamps_ns, np.int64), skipped)
    poses = _without_standstill(poses, skipped)
    straight = config.segments == 'straight'
    groups = _lines(track, poses, skipped) if straight else _pieces(poses, skipped)
    items = [_segment(poses, group, straight) for group in groups]
    if not items:
        raise DataError(_nothing_left(len(image_stamps_ns), skipped, straight))
    firsts = [int(group[0]) for group in groups]
    for n in range(len(items) - 1):
        items[n] = _linked(poses, items[n], items[n + 1], firsts[n], firsts[n + 1])
    used = sum(len(item.images) for item in items)
    return Segments(tuple(items), Count(used, skipped), track.count)


def join(parts: Sequence[Segments], offsets: Sequence[int]) -> Segments:
    """Segments of several runs as one; the images of run k start at index offsets[k].

    Each run is divided into periods of a constant yaw-rate bias.
    """
    items: list[Segment] = []
    for number, (part, offset) in enumerate(zip(parts, offsets, strict=True)):
        minutes = [int(s.since_start_s // BIAS_PERIOD_S) for s in part]
        first = items[-1].period + 1 if items else 0
        periods = (first + np.unique(minutes, return_inverse=True)[1]).tolist()
        items += [
            replace(s, images=s.images + offset, run=number, period=period)
            for s, period in zip(part, periods, strict=True)
        ]
    return Segments(
        tuple(items), _sum(part.images for part in parts), _sum(part.odometry for part in parts)
    )


def _sum(counts: Iterable[Count]) -> Count:
    used, skipped = 0, Counter[str]()
    for count in counts:
        used += count.used
        skipped.update(count.skipped)
    return Count(used, dict(skipped))


def assignment(segments: Segments, count: int) -> Indices:
    """The segment of each of `count` images (count,); -1 for an image of none."""
    owner = np.full(count, -1, np.int64)
    for number, segment in enumerate(segments):
        owner[segment.images] = number
    return owner


def _nothing_left(images: int, skipped: dict[str, int], straight: bool) -> str:
    reasons = ', '.join(f'{n} {why}' for why, n in skipped.items()) or 'none at all'
    remedy = (
        'drive straight lines with turns on the spot, or use segments: any'
        if straight
        else 'check that odometry and images share a clock and that the robot drives'
    )
    return f'no segment of odometry among {images} images ({reasons}): {remedy}'


@dataclass(frozen=True, slots=True)
class ImagePoses:
    """The odometry at the M images that have any: a row each, as in OdometryTrack."""

    images: Indices
    time_s: Array
    place: Complex
    yaw: Array
    part: Indices
    sums: Array
    slide: float

    @classmethod
    def on(cls, track: OdometryTrack, stamps: Stamps, skipped: dict[str, int]) -> ImagePoses:
        """Interpolated at the images' stamps (N,); those outside or in a break are counted."""
        inside = (stamps >= track.stamps_ns[0]) & (stamps <= track.stamps_ns[-1])
        before = np.searchsorted(track.stamps_ns, stamps, 'right') - 1
        after = np.searchsorted(track.stamps_ns, stamps, 'left')
        before, after = np.clip([before, after], 0, len(track.stamps_ns) - 1)
        unbroken = track.part[before] == track.part[after]
        tally(skipped, 'without odometry', ~inside)
        tally(skipped, 'in a break of odometry', inside & ~unbroken)
        images = np.flatnonzero(inside & unbroken)
        poses = Trajectory(track.stamps_ns, track.poses).at(stamps[images])
        t, own = seconds_since_start(track.stamps_ns), (stamps[images] - track.stamps_ns[0]) * 1e-9
        sums = np.column_stack([np.interp(own, t, column) for column in track.sums.T])
        place = poses[:, 0] + 1j * poses[:, 1]
        yaw = np.interp(own, t, track.yaw)
        return cls(
            images, own, place, yaw, track.part[before[images]], sums.reshape(-1, 5), track.slide
        )

    def take(self, keep: Mask) -> ImagePoses:
        rows = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != 'slide'}
        return replace(self, **rows)

    def yaw_variance(self, first: int, last: int) -> float:
        """Of the turn between two images, rad^2."""
        change = self.sums[last] - self.sums[first]
        return float(change[YAW_VARIANCE] + (YAW_SLIP * change[TURNED]) ** 2)

    def place_variance(self, first: int, last: int) -> float:
        """Of the displacement between two images, m^2 per axis: distance, yaw, sliding wheels."""
        change = self.sums[last] - self.sums[first]
        length = float(change[LENGTH])
        yaw = self.yaw_variance(first, last)
        slide = (self.slide * float(change[TURNED])) ** 2
        return DISTANCE_NOISE**2 * length + yaw * length**2 / 3 + slide

    def drift(self, first: int, rows: Indices, heading: float, time_s: float) -> Complex:
        """What a yaw-rate bias of 1 rad/s adds to the path from image `first`, in a frame whose
        heading was right at `time_s`; to first order."""
        moment = self.sums[:, MOMENT] @ np.array([1.0, 1.0j])
        lever = moment[rows] - moment[first] - time_s * (self.place[rows] - self.place[first])
        return np.asarray(1j * lever * np.exp(-1j * heading))


def _without_standstill(poses: ImagePoses, skipped: dict[str, int]) -> ImagePoses:
    """Leave out images that repeat the one before, as of a robot that stands still."""
    keep = np.ones(len(poses.images), bool)
    last = 0
    for i in range(1, len(keep)):
        moved = abs(poses.place[i] - poses.place[last]) >= IMAGE_STEP_MIN_M
        turned = abs(poses.yaw[i] - poses.yaw[last]) >= IMAGE_TURN_MIN_RAD
        keep[i] = moved or turned or poses.part[i] != poses.part[last]
        last = i if keep[i] else last
    tally(skipped, 'standing still', ~keep)
    return poses.take(keep)


def _lines(track: OdometryTrack, poses: ImagePoses, skipped: dict[str, int]) -> list[Indices]:
    """Straight lines: driven, not turning, between turns on the spot."""
    seconds = seconds_since_start(track.stamps_ns)
    straight = np.interp(poses.time_s, seconds, np.abs(track.turn_rate)) < TURN_RATE_MIN_RADPS
    straight &= np.interp(poses.time_s, seconds, track.speed) >= SPEED_MIN_MPS
    tally(skipped, 'turning or standing', ~straight)
    groups = _stretches(poses, np.flatnonzero(straight))
    groups = [line for group in groups for line in _unbent(poses, group)]
    return _long_enough(poses, groups, LINE_LENGTH_MIN_M, skipped)


def _unbent(poses: ImagePoses, group: Indices) -> list[Indices]:
    """Split where the heading leaves that of the line's start."""
    lines, start = [], 0
    for i in range(1, len(group)):
        bend = abs(poses.yaw[group[i]] - poses.yaw[group[start]])
        turned = poses.sums[group[i], TURNED] - poses.sums[group[i - 1], TURNED]
        if bend > LINE_BEND_MAX_RAD or turned > np.pi / 4:
            lines.append(group[start:i])
            start = i
    return [*lines, group[start:]]


def _pieces(poses: ImagePoses, skipped: dict[str, int]) -> list[Indices]:
    """Pieces of any drive, as even as the bounds on length and error allow."""
    groups = _stretches(poses, np.arange(len(poses.images)))
    pieces = [piece for group in groups for piece in _even(poses, group)]
    return _long_enough(poses, pieces, 2 * IMAGE_STEP_MIN_M, skipped)


def _stretches(poses: ImagePoses, chosen: Indices) -> list[Indices]:
    """Split the chosen images where odometry breaks or images are missing."""
    if len(chosen) == 0:
        return []
    far = np.diff(poses.sums[chosen, LENGTH]) > IMAGE_STEP_MAX_M
    ends = np.flatnonzero(far | (np.diff(poses.part[chosen]) != 0)) + 1
    return list(np.split(chosen, ends))


def _even(poses: ImagePoses, group: Indices) -> list[Indices]:
    """As many pieces as the bounds demand, each with the same share of length and error."""
    wear = _wear(poses, group)
    number = max(int(np.ceil(wear[-1] - 1e-9)), 1)
    owner = np.minimum(wear / max(wear[-1], 1e-9) * number, number - 1).astype(int)
    return [group[owner == k] for k in range(number) if (owner == k).any()]


def _wear(poses: ImagePoses, group: Indices) -> Array:
    """Driven since the first image (M,), in pieces: each is used up by its length or its error."""
    driven = np.diff(poses.sums[group], axis=0)
    length, limit = driven[:, LENGTH], PIECE_STD_M**2
    # The heading's variance v moves the end of a length l by v l^2 / 3, which grows with l^3.
    yaw = np.cbrt(length**2 * driven[:, YAW_VARIANCE] / (3 * limit))
    # Variances add up: the error of k equal steps is sqrt(k) times that of one.
    random = DISTANCE_NOISE**2 * length / limit + yaw
    turned = (poses.slide + YAW_SLIP * PIECE_LENGTH_M / 2) * driven[:, TURNED]
    wear = np.maximum(length / PIECE_LENGTH_M, random) + turned / PIECE_STD_M
    return summed(wear)


def _long_enough(
    poses: ImagePoses, groups: list[Indices], length_min: float, skipped: dict[str, int]
) -> list[Indices]:
    kept = []
    for group in groups:
        length = poses.sums[group[-1], LENGTH] - poses.sums[group[0], LENGTH]
        if len(group) >= IMAGES_MIN and length >= length_min:
            kept.append(group)
        else:
            tally(skipped, 'in too short a segment', np.ones(len(group), bool))
    return kept


def _segment(poses: ImagePoses, group: Indices, straight: bool) -> Segment:
    """One segment in its own frame."""
    place, time, yaw = poses.place[group], poses.time_s[group], poses.yaw[group]
    weight = np.full(len(group), 1 / len(group)) if straight else np.eye(1, len(group))[0]
    heading, time_s = float(weight @ yaw), float(weight @ time)
    path = (place - place[0]) * np.exp(-1j * heading)
    drift = poses.drift(int(group[0]), group, heading, time_s)
    if straight:
        path, drift = _driven_distance(path), np.zeros(len(group), complex)
    start = np.array([place[0].real, place[0].imag, heading])
    images = np.asarray(poses.images[group], np.int64)
    since_start_s = float(time[0])
    return Segment(
        images, path, yaw - heading, time - time_s, drift, start, since_start_s=since_start_s
    )


def _driven_distance(path: Complex) -> Complex:
    """Driven distance along a straight line, negative backwards."""
    step = np.diff(path)
    driven = np.abs(step) * np.where(step.real < 0, -1.0, 1.0)
    return np.asarray(summed(driven), complex)


def _linked(poses: ImagePoses, a: Segment, b: Segment, first: int, last: int) -> Segment:
    """Segment `a` with the turn and displacement to `b`, unless odometry breaks between them.

    `first` and `last` are the rows of their first images.
    """
    if poses.part[first] != poses.part[last]:
        return a
    time_a, time_b = poses.time_s[first] - a.times_s[0], poses.time_s[last] - b.times_s[0]
    drift = poses.drift(first, np.array([last]), float(a.start[2]), float(time_a))
    moved = poses.place[last] - poses.place[first]
    return replace(
        a,
        turn_rad=float(wrap_angle(b.start[2] - a.start[2])),
        turn_variance=max(poses.yaw_variance(first, last), 1e-12),
        turn_time_s=float(time_b - time_a),
        displacement=complex(moved * np.exp(-1j * a.start[2])),
        displacement_variance=max(poses.place_variance(first, last), 1e-12),
        displacement_drift=complex(drift[0]),
    )
