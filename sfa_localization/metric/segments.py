# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry cut into segments: short pieces that are rigid, and links between them.

A segment carries its own odometry path as complex numbers (x + i y), so that image m of segment n
lies at o_n + z_n q_nm for an unknown origin o_n and an unknown direction z_n = exp(i alpha_n). On a
straight line q_nm is the distance d_nm of section 3.1 of the paper.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import compress, pairwise

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Count, Odometry, Stamps, Trajectory, YawRate
from sfa_localization.keyframes.closures import Closures
from sfa_localization.keyframes.offsets import Offsets
from sfa_localization.metric.measured_points import MeasuredPoints
from sfa_localization.metric.mount import Mount
from sfa_localization.motion.dead_reckoning import TURN_SLIDE, OdometryTrack, Way, summed
from sfa_localization.motion.settings import SegmentConfig

PIECE_LENGTH_M = 3.0
"""Longest piece of any drive: long enough for several images, short enough to be rigid."""
PIECE_STD_M = 0.1
"""Largest odometry error inside a piece: about the error of one image."""
LINE_LENGTH_MIN_M = 2.0
LINE_BEND_MAX_RAD = np.deg2rad(8.0)
"""Straight lines are longer than the first, and end where the heading changes by the second."""
SPEED_MIN_MPS = 0.01
TURN_RATE_MAX_RADPS = 0.2
"""A slower robot stands, and one that turns faster does not drive a straight line."""
IMAGES_MIN = 3
"""Fewest images of a segment: two determine its origin and direction, the third tests them."""
IMAGE_STEP_MAX_M = 1.5
"""Longest distance without an image inside a segment."""
IMAGE_STEP_MIN_M = 0.01
IMAGE_TURN_MIN_RAD = np.deg2rad(3.0)
"""An image repeats the one before if the robot moved and turned by less between them."""
BIAS_PERIOD_S = 60.0
"""The yaw-rate bias of odometry is constant for about this long: floors and tires change it."""
DISTANCE_NOISE = 0.01
"""m per square root of m: random error of the driven distance, usual for wheel encoders."""
YAW_SLIP = 0.005
"""rad per rad: error of a turn, usual for a differential drive."""
# Speed and turn rate are means over so many s.
_SMOOTHING_S = 0.3


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
    """(M,) seconds since the time of the reference heading: drift of `headings`."""
    path_drift: Complex
    """(M,) meters per rad/s: drift of `path`."""
    start: Array
    """(3,) odometry pose of the frame: x m, y m, yaw rad in the odometry frame."""
    turn_rad: float = np.nan
    """Turn to the next segment's reference heading; NaN where unknown."""
    turn_variance: float = np.nan
    """rad^2, without the bias."""
    turn_time_s: float = np.nan
    """Seconds between the reference headings: drift of `turn_rad`."""
    displacement: complex = complex(np.nan, np.nan)
    """Displacement to the next segment's origin in this segment's frame; NaN where unknown."""
    displacement_variance: float = np.nan
    """m^2 per axis, without the bias."""
    displacement_drift: complex = complex(np.nan, np.nan)
    """m per rad/s: drift of `displacement`."""
    run: int = 0
    """Number of the run; nothing links two runs."""
    since_start_s: float = 0.0
    """From the start of the run's odometry to the first image."""
    period: int = 0
    """Number of its period of BIAS_PERIOD_S, over all runs: each has a yaw-rate bias."""

    @property
    def linked(self) -> bool:
        """Whether odometry leads on to the next segment."""
        return bool(np.isfinite(self.turn_rad))


@dataclass(frozen=True, slots=True)
class Segments:
    """Segments in driving order, the images and odometry messages used, the loop closures between
    the images, with and without offsets, the corrected way of each run, measured points, and the
    camera's place on the robot: segments are paths of the camera.
    """

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

    `config.segments` is 'straight' for lines between turns on the spot, as in the paper, or 'any'
    for the whole drive in pieces of bounded length and odometry error. Images without odometry, of
    a standing robot, or in too short a piece are left out and counted in `Segments.images`.

    Raises DataError if no segment remains.
    """
    skipped = Counter[str]()
    straight = config.segments == 'straight'
    poses = ImagePoses.on(track, np.asarray(image_stamps_ns, np.int64), skipped)
    poses = _without_standstill(poses, skipped)
    candidates = _lines(poses, track, skipped) if straight else _pieces(poses)
    least_m = LINE_LENGTH_MIN_M if straight else 2 * IMAGE_STEP_MIN_M
    long = [len(g) >= IMAGES_MIN and np.ptp(poses.length[g]) >= least_m for g in candidates]
    groups = list(compress(candidates, long))
    skipped['in too short a segment'] += sum(map(len, candidates)) - sum(map(len, groups))
    if not groups:
        remedy = (
            'drive straight lines with turns on the spot, or use segments: any'
            if straight
            else 'check that odometry and images share a clock and that the robot drives'
        )
        reasons = ', '.join(f'{n} {why}' for why, n in (+skipped).items()) or 'none at all'
        images = f'{len(image_stamps_ns)} images ({reasons})'
        raise DataError(f'no segment of odometry among {images}: {remedy}')
    items = [_segment(poses, group, straight) for group in groups]
    for n, (group, following) in enumerate(pairwise(groups)):
        items[n] = _linked(poses, items[n], items[n + 1], int(group[0]), int(following[0]))
    used = sum(len(item.images) for item in items)
    return Segments(tuple(items), Count(used, dict(+skipped)), track.count)


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
    used = 0
    skipped = Counter[str]()
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


@dataclass(frozen=True, slots=True)
class ImagePoses:
    """The odometry at the M images that have any, a row each: see OdometryTrack."""

    images: Indices
    time_s: Array
    place: Complex
    yaw: Array
    part: Indices
    length: Array
    turned: Array
    noise: Array
    """rad^2, the variance of yaw without a bias."""
    moment: Complex
    """Integral of t dp, s m, of the camera's place p: a bias of the yaw rate acts on it."""
    bridged: Array
    """(K, 2) m^2 and rad^2, the variances of the way and the yaw in bridged pauses."""

    @classmethod
    def on(cls, track: OdometryTrack, stamps: Stamps, skipped: Counter[str]) -> ImagePoses:
        """Interpolated at the images' stamps (N,); those outside or in a break are counted."""
        inside = (stamps >= track.stamps_ns[0]) & (stamps <= track.stamps_ns[-1])
        images = np.flatnonzero(inside)
        before = np.searchsorted(track.stamps_ns, stamps[images], 'right') - 1
        after = np.searchsorted(track.stamps_ns, stamps[images], 'left')
        unbroken = track.part[before] == track.part[after]
        skipped['without odometry'] += int((~inside).sum())
        skipped['in a break of odometry'] += int((~unbroken).sum())
        images = images[unbroken]
        x, y, yaw = Trajectory(track.stamps_ns, track.poses).at(stamps[images]).T
        time_s = (stamps[images] - track.stamps_ns[0]) * 1e-9
        seconds = track.seconds
        return cls(
            images=images,
            time_s=time_s,
            place=x + 1j * y + track.lever * np.exp(1j * yaw),
            yaw=np.interp(time_s, seconds, track.yaw),
            part=track.part[before[unbroken]],
            length=np.interp(time_s, seconds, track.length),
            turned=np.interp(time_s, seconds, track.turned),
            noise=np.interp(time_s, seconds, track.yaw_variance),
            moment=np.interp(time_s, seconds, _moment(track)),
            bridged=np.column_stack([np.interp(time_s, seconds, sums) for sums in track.bridged.T]),
        )

    def take(self, keep: Mask) -> ImagePoses:
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def turn_variance(self, first: int, last: int) -> float:
        """Of the turn between two images, rad^2."""
        slip = YAW_SLIP * (self.turned[last] - self.turned[first])
        return float(self.noise[last] - self.noise[first] + slip**2)

    def place_variance(self, first: int, last: int) -> float:
        """Of the displacement between two images, m^2 per axis: distance, yaw, sliding wheels."""
        length = float(self.length[last] - self.length[first])
        slide = TURN_SLIDE * float(self.turned[last] - self.turned[first])
        yaw = self.turn_variance(first, last)
        bridged = float(self.bridged[last, 0] - self.bridged[first, 0])
        return DISTANCE_NOISE**2 * length + yaw * length**2 / 3 + slide**2 + bridged

    def drift(self, first: int, rows: Indices, heading: float, time_s: float) -> Complex:
        """What a yaw-rate bias of 1 rad/s adds to the path from image `first`, in a frame whose
        heading was right at `time_s`; to first order."""
        moment, path = (values[rows] - values[first] for values in (self.moment, self.place))
        return np.asarray(1j * (moment - time_s * path) * np.exp(-1j * heading))


def _without_standstill(poses: ImagePoses, skipped: Counter[str]) -> ImagePoses:
    """Leave out images that repeat the one before, as of a robot that stands still."""
    keep = np.ones(len(poses.images), bool)
    last = 0
    for i in range(1, len(keep)):
        moved = abs(poses.place[i] - poses.place[last]) >= IMAGE_STEP_MIN_M
        turned = abs(poses.yaw[i] - poses.yaw[last]) >= IMAGE_TURN_MIN_RAD
        keep[i] = moved or turned or poses.part[i] != poses.part[last]
        last = i if keep[i] else last
    skipped['standing still'] += int((~keep).sum())
    return poses.take(keep)


def _lines(poses: ImagePoses, track: OdometryTrack, skipped: Counter[str]) -> list[Indices]:
    """Straight lines: driven, not turning, between turns on the spot."""
    half = _SMOOTHING_S / 2
    seconds = track.seconds
    window = np.clip([poses.time_s - half, poses.time_s + half], 0.0, seconds[-1])
    time_s = np.maximum(np.diff(window, axis=0)[0], 1e-9)
    speed, turn_rate = (
        np.abs(np.diff(np.interp(window, seconds, sums), axis=0)[0]) / time_s
        for sums in (track.length, track.yaw)
    )
    straight = (turn_rate < TURN_RATE_MAX_RADPS) & (speed >= SPEED_MIN_MPS)
    skipped['turning or standing'] += int((~straight).sum())
    lines: list[Indices] = []
    for group in _stretches(poses, np.flatnonzero(straight)):
        start = 0
        for i in range(1, len(group)):
            bend = abs(poses.yaw[group[i]] - poses.yaw[group[start]])
            turned = poses.turned[group[i]] - poses.turned[group[i - 1]]
            if bend > LINE_BEND_MAX_RAD or turned > np.pi / 4:
                lines.append(group[start:i])
                start = i
        lines.append(group[start:])
    return lines


def _pieces(poses: ImagePoses) -> list[Indices]:
    """Pieces of any drive, as even as the bounds on length and error allow."""
    pieces: list[Indices] = []
    for group in _stretches(poses, np.arange(len(poses.images))):
        wear = _wear(poses, group)
        number = max(int(np.ceil(wear[-1] - 1e-9)), 1)
        owner = np.minimum(wear / max(wear[-1], 1e-9) * number, number - 1).astype(int)
        pieces += np.split(group, np.flatnonzero(np.diff(owner)) + 1)
    return pieces


def _moment(track: OdometryTrack) -> Complex:
    """Integral of t dp, s m, of the camera's place p."""
    middle_s = (track.seconds[1:] + track.seconds[:-1]) / 2
    return summed(np.diff(track.place) * middle_s)


def _stretches(poses: ImagePoses, chosen: Indices) -> list[Indices]:
    """Split the chosen images where odometry breaks or images are missing."""
    far = np.diff(poses.length[chosen]) > IMAGE_STEP_MAX_M
    return np.split(chosen, np.flatnonzero(far | (np.diff(poses.part[chosen]) != 0)) + 1)


def _wear(poses: ImagePoses, group: Indices) -> Array:
    """Pieces (M,) that are used up since the first image, by length or by error."""
    length, turned, noise = (np.diff(x[group]) for x in (poses.length, poses.turned, poses.noise))
    limit = PIECE_STD_M**2
    # The heading's variance v moves the end of a length l by v l^2 / 3, which grows with l^3.
    # Variances add up: the error of k equal steps is sqrt(k) times that of one.
    random = DISTANCE_NOISE**2 * length / limit + np.cbrt(length**2 * noise / (3 * limit))
    slip = (TURN_SLIDE + YAW_SLIP * PIECE_LENGTH_M / 2) * turned
    return summed(np.maximum(length / PIECE_LENGTH_M, random) + slip / PIECE_STD_M)


def _segment(poses: ImagePoses, group: Indices, straight: bool) -> Segment:
    """One segment in its own frame."""
    place = poses.place[group]
    time = poses.time_s[group]
    yaw = poses.yaw[group]
    heading, time_s = (yaw.mean(), time.mean()) if straight else (yaw[0], time[0])
    path = (place - place[0]) * np.exp(-1j * heading)
    drift = poses.drift(int(group[0]), group, heading, time_s)
    if straight:
        # The driven distance, negative backwards.
        step = np.diff(path)
        path = summed(np.abs(step) * np.where(step.real < 0, -1.0, 1.0)).astype(complex)
        drift = np.zeros(len(group), complex)
    start = np.array([place[0].real, place[0].imag, heading])
    return Segment(
        poses.images[group],
        path,
        yaw - heading,
        time - time_s,
        drift,
        start,
        since_start_s=float(time[0]),
    )


def _linked(poses: ImagePoses, a: Segment, b: Segment, first: int, last: int) -> Segment:
    """Segment `a` with the turn and displacement to `b`, unless odometry breaks between them.

    `first` and `last` are the rows of their first images.
    """
    if poses.part[first] != poses.part[last]:
        return a
    time_a = poses.time_s[first] - a.times_s[0]
    time_b = poses.time_s[last] - b.times_s[0]
    drift = poses.drift(first, np.array([last]), float(a.start[2]), float(time_a))
    moved = poses.place[last] - poses.place[first]
    return replace(
        a,
        turn_rad=float(wrap_angle(b.start[2] - a.start[2])),
        turn_variance=max(poses.turn_variance(first, last), 1e-12),
        turn_time_s=float(time_b - time_a),
        displacement=complex(moved * np.exp(-1j * a.start[2])),
        displacement_variance=max(poses.place_variance(first, last), 1e-12),
        displacement_drift=complex(drift[0]),
    )
