# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The contents of a bag, its problems, and whether it is enough to train on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from sfa_localization.bags import decoding
from sfa_localization.bags.drives import ODOMETRY_TOLERANCE_S
from sfa_localization.bags.reader import KINDS, Bag
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.topic_stream import Stream
from sfa_localization.camera.calibration import MirrorCircles, find_circles
from sfa_localization.camera.panorama import looks_like_panorama
from sfa_localization.camera.turns import VisualGyro
from sfa_localization.camera.watch import FrozenWatch
from sfa_localization.data.errors import BagError, CameraError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image, Odometry, Stamps
from sfa_localization.data.settings import Settings, setting
from sfa_localization.fusion.camera_clock import CameraClock, camera_clock
from sfa_localization.fusion.pose_filter import DELAY_LIMIT_NS
from sfa_localization.metric.drive_check import ROUTE, is_one_route
from sfa_localization.metric.segments import PIECE_LENGTH_M

PANORAMA, EQUIRECTANGULAR, ORDINARY = 'panorama', 'equirectangular', 'ordinary camera'
MIRROR, FISHEYE, DUAL_FISHEYE = 'mirror', 'fisheye', 'dual fisheye'
# Parameters of omnicam_node to start from; a strip needs none.
_CALIBRATE = 'calibration_file: camera.yaml  # by: sfa_localization calibrate {bag}'
_OUTPUTS = '--output camera.yaml --check check.png'
_ENTRIES = {
    MIRROR: f'{_CALIBRATE} {_OUTPUTS}',
    FISHEYE: f'{_CALIBRATE} --model fisheye --field-of-view 185 {_OUTPUTS}',
    DUAL_FISHEYE: 'calibration_file: camera.yaml  # with camera_model: dual_fisheye',
    EQUIRECTANGULAR: 'camera_model: equirectangular',
    PANORAMA: 'camera_model: panorama',
}
SAMPLES, SAMPLE_SIDE = 16, 640
"""Images on the contact sheet, and their longer side (pixels)."""
SECTORS = 6
"""Line directions that are distinguished, of 30 degrees each."""
# What a drive needs: directions, each with a share of the path (with fewer the shape of the map
# remains ambiguous), and a share of the area (below it whole regions are extrapolated).
MIN_DIRECTIONS, MIN_SHARE, MIN_COVERED = 3, 0.05, 0.65
MAX_LOST = 0.1  # share of images that may lack odometry: more means that clocks are wrong
MAX_GAP_S = 2.0  # longest pause of a topic that is not reported
EVEN, EVEN_SHARE = 3.0, 0.9  # a topic keeps time where this share of intervals is that usual
REPEATED = 0.05  # share of images that repeat the one before that is worth a word
STANDING_M = 0.02  # images nearer to each other were taken standing
GRID = 100  # points per axis at which coverage is evaluated: steps of 1 % of the area's extent
DARK = 12.0  # mean gray level of 255 below which an image is dark
DELAY_SHOWN_S = 0.02  # a smaller delay of the camera is within the period of usual odometry
# Of an unrolled circle; the inner third shows the robot or the camera itself.
_RADII, _ANGLES, _INNER = 30, 400, 10


@dataclass(frozen=True, slots=True)
class InspectionConfig(Settings):
    """Requirements on a drive to train on."""

    min_pictures: int = setting(300, 'images with odometry that are needed', low=1)
    max_spacing: float = setting(
        0.5, 'distance between images (90th percentile)', unit='m', low=0.01, high=100.0
    )
    reach: float = setting(
        1.0, 'ground this near to an image is covered', unit='m', low=0.01, high=100.0
    )


@dataclass
class TopicReport:
    """One topic: `problems` are sentences; stamps are those of the sender where it set them.

    `recorded` is the count of the bag's metadata or index; what can be read of it has a stamp.
    """

    name: str
    kind: str
    recorded: int
    stamps_ns: Stamps
    problems: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Messages that can be read."""
        return len(self.stamps_ns)

    @property
    def unreadable(self) -> bool:
        """Whether messages were recorded, and none can be read."""
        return self.recorded > 0 and self.count == 0

    @property
    def rate_hz(self) -> float:
        """Messages per second, by the median of their intervals; 0 for fewer than two."""
        steps = np.diff(self.stamps_ns)
        return float(1e9 / max(np.median(steps), 1)) if len(steps) else 0.0

    @property
    def largest_gap_s(self) -> float:
        """Longest time between two messages."""
        return float(np.diff(self.stamps_ns).max(initial=0) * 1e-9)

    @property
    def pauses(self) -> bool:
        """Whether messages come evenly but for a pause: a topic may speak only on change."""
        steps = np.diff(self.stamps_ns)
        even = len(steps) and np.mean(steps <= EVEN * np.median(steps)) >= EVEN_SHARE
        return bool(even and self.largest_gap_s > max(MAX_GAP_S, 5 / max(self.rate_hz, 1e-9)))

    def as_dict(self) -> dict[str, Any]:
        stamps = self.stamps_ns.tolist()
        return {
            'type': self.kind,
            'count': self.count,
            'recorded': self.recorded,
            'first_stamp_ns': stamps[0] if stamps else None,
            'last_stamp_ns': stamps[-1] if stamps else None,
            'rate_hz': round(self.rate_hz, 3),
            'largest_gap_s': round(self.largest_gap_s, 3),
            'problems': self.problems,
        }


@dataclass
class ImageTopic:
    """A topic of images: size, guessed geometry, and samples from all over the drive.

    `seen` is what shows the geometry.
    """

    topic: str
    width: int
    height: int
    geometry: str
    seen: str
    stamps_ns: Stamps
    samples: list[Image]

    def entry(self, bag: str) -> str:
        """The parameter that describes the camera of a bag to omnicam_node; '' if none does."""
        needed = self.geometry in _ENTRIES and not looks_like_panorama(self.height, self.width)
        return _ENTRIES[self.geometry].format(bag=bag) if needed else ''

    def as_dict(self) -> dict[str, Any]:
        names = ('topic', 'width', 'height', 'geometry', 'seen')
        return {name: getattr(self, name) for name in names}


@dataclass
class DrivenPath:
    """The path of the robot by its odometry, and the poses (M, 3) of images with odometry.

    `clock` says by how much images are stamped late, as far as turns show it.
    """

    topic: str
    odometry: Odometry
    places: Array
    clock: CameraClock

    def clock_text(self) -> str:
        """What turns show about the clocks; '' where they show nothing."""
        delay_s = self.clock.delay_s
        if not self.clock.known or abs(delay_s) < DELAY_SHOWN_S:
            return 'images and odometry agree' if self.clock.known else ''
        late = 'late' if delay_s > 0 else 'early'
        corrected = abs(self.clock.delay_ns) <= DELAY_LIMIT_NS
        remedy = 'train and the filter correct it' if corrected else 'synchronize the clocks'
        return f'images are stamped {abs(delay_s):.2f} s {late}: {remedy}'

    def as_dict(self) -> dict[str, Any]:
        return {
            'topic': self.topic,
            'length_m': round(path_length(self.odometry.poses), 2),
            'pictures': len(self.places),
            'area_m2': round(hull_area(self.places), 2),
            'spacing_m': round(spacing(self.places), 3),
            'directions': directions(self.places),
            'camera_delay_s': round(self.clock.delay_s, 3) if self.clock.known else None,
        }


@dataclass
class BagReport:
    """All findings about a bag; `lacks` are the reasons why it is not enough to train on.

    `error` is the reason why it cannot be read at all.
    """

    path: str
    error: str = ''
    topics: list[TopicReport] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    images: ImageTopic | None = None
    drive: DrivenPath | None = None
    lacks: list[str] = field(default_factory=list)

    @property
    def facts(self) -> dict[str, str]:
        """Camera, drive and clocks, in words."""
        facts = {}
        if self.images is not None:
            images = self.images
            facts['images'] = f'{images.width}x{images.height}, {images.geometry}: {images.seen}'
        if self.drive is not None:
            found = self.drive.as_dict()
            facts['drive'] = (
                f'{found["length_m"]:.0f} m by {found["topic"]}, {found["pictures"]} images over '
                f'{found["area_m2"]:.0f} m2, {found["spacing_m"]:.2f} m apart, '
                f'along {found["directions"]} of {SECTORS} directions'
            )
            facts |= {'clocks': text} if (text := self.drive.clock_text()) else {}
        return facts

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            'path': self.path,
            'error': self.error,
            'topics': {topic.name: topic.as_dict() for topic in self.topics},
            'problems': self.problems,
            'notes': self.notes,
            'pictures': self.images.as_dict() if self.images else None,
            'drive': self.drive.as_dict() if self.drive else None,
            'enough_to_train_on': not (self.lacks or self.error),
            'lacks': self.lacks,
        }

    def as_text(self) -> str:
        """Lines for a terminal."""
        if self.error:
            return f'error: {self.error}'
        lines = [self.path]
        for topic in self.topics:
            kind = topic.kind.rsplit('/', 1)[-1] or 'unknown type'
            count = f'{topic.count} messages, {topic.rate_hz:.1f} Hz'
            lines.append(f'  {topic.name} ({kind}): {count}')
            lines += [f'    problem: {problem}' for problem in topic.problems]
        lines += [f'  {name}: {fact}' for name, fact in self.facts.items()]
        lines += [f'  problem: {problem}' for problem in self.problems]
        lines += [f'  note: {note}' for note in self.notes]
        if entry := self.images and self.images.entry(self.path):
            lines += ['  start my_localization.yaml with:', '    /**/omnicam_node:']
            lines += ['      ros__parameters:', f'        {entry}']
        lines += [f'  not enough to train on: {lack}' for lack in self.lacks]
        return '\n'.join(lines if self.lacks else [*lines, '  enough to train on'])


def inspect(
    path: Path | str,
    *,
    topics: TopicNames | None = None,
    config: InspectionConfig | None = None,
    bag_config: BagConfig | None = None,
    strict: bool = False,
) -> BagReport:
    """Read a bag once and report on it. Raises BagError when nothing in it can be read."""
    config, topics = config or InspectionConfig(), topics or TopicNames()
    report = BagReport(str(path))
    with Bag(path, strict=strict, config=bag_config) as bag:
        image = _found(bag, 'image', topics.image, report)
        survey = _Survey(bag, image, _found(bag, 'odometry', topics.odometry, report))
        report.topics = [survey.topic(stream) for stream in survey.streams]
        report.images = survey.images()
        report.drive = survey.drive()
        report.problems, report.notes = bag.problems, bag.recording.notes
    if report.drive is not None and _one_route(report.drive.places):
        report.notes.append(ROUTE)
    report.lacks += [] if report.lacks else lacks(report, config)
    return report


def _found(bag: Bag, kind: str, name: str, report: BagReport) -> str:
    """The topic of a kind, or '' with the reason among what the bag lacks."""
    try:
        return bag.find(kind, name)
    except BagError as error:
        report.lacks.append(str(error).removeprefix(f'{bag.path}: '))
        return ''


class _Survey:
    """One pass over all topics of a bag."""

    def __init__(self, bag: Bag, image: str, odometry: str) -> None:
        # None where there is none: damaged bags also have topics without a name.
        self._bag, self._image, self._odometry = bag, image or None, odometry
        self._driven = odometry.partition(':')[0] or None
        self._values: dict[str, list[tuple[int, Any]]] = {name: [] for name in bag.topics}
        self._gyro, self._frozen, self._repeats = VisualGyro(), FrozenWatch(), 0
        self._sizes: Counter[tuple[int, ...]] = Counter()
        self._samples: list[Image] = []
        self._every = max(bag.topics[image].count // SAMPLES, 1) if image else 1
        self.streams = [self._stream(name) for name in bag.topics]
        for stream, stamp_ns, value in bag.read(self.streams):
            self._values[stream.topic].append((stamp_ns, value))

    def _stream(self, name: str) -> Stream:
        if name == self._driven:
            stream = self._bag.stream(self._odometry, decoding.odometry_of)
            stream.required = False
            return stream
        if name == self._image:
            return self._bag.any_stream(name, self._sample)
        image = self._bag.topics[name].kind in KINDS['image'].found
        return self._bag.any_stream(name, _checked if image else lambda message: None)

    def _sample(self, message: Any) -> float:
        """Decode an image; keep its size, and every so often the image itself.

        Returns how far images have turned so far, rad.
        """
        image = decoding.image_of(message)
        self._repeats += not self._frozen.add(image)
        if self._sizes.total() % self._every == 0 and len(self._samples) < SAMPLES:
            self._samples.append(_small(image))
        self._sizes[image.shape[:2]] += 1
        return self._gyro.add(_unrolled(image))

    def _stamps(self, name: str | None) -> Stamps:
        return np.array([stamp for stamp, _ in self._values.get(name or '', ())], np.int64)

    def topic(self, stream: Stream) -> TopicReport:
        topic = self._bag.topics[stream.topic]
        report = TopicReport(topic.name, topic.kind, topic.count, self._stamps(topic.name))
        report.problems = list(self._problems(stream, report))
        return report

    def _problems(self, stream: Stream, report: TopicReport) -> Iterator[str]:
        for reason, number in stream.tally.count.skipped.items():
            yield f'{number} of {report.recorded} messages: {reason}'
        if report.recorded == 0:
            yield 'no messages'
        if report.pauses:
            yield f'pause of {report.largest_gap_s:.1f} s'
        if stream.topic != self._image:
            return
        if len(self._sizes) > 1:
            yield f'images of several sizes: {", ".join(f"{w}x{h}" for h, w in self._sizes)}'
        if self._repeats > REPEATED * report.recorded:
            yield f'{self._repeats} of {report.recorded} images repeat the one before'

    def images(self) -> ImageTopic | None:
        if not self._samples or self._image is None:
            return None
        ((height, width), _), *_ = self._sizes.most_common(1)
        alike = [s for s in self._samples if s.shape == self._samples[0].shape]
        stamps = self._stamps(self._image)
        return ImageTopic(self._image, width, height, *guess_geometry(alike), stamps, self._samples)

    def drive(self) -> DrivenPath | None:
        """The path, and the delay of the camera's clock at images in the order of their stamps."""
        if self._driven is None or not self._values[self._driven]:
            return None
        stream = next(one for one in self.streams if one.topic == self._driven)
        odometry = self._bag.to_odometry(stream, self._values[self._driven])
        turned = sorted(self._values.get(self._image or '', ())) if self._image else []
        stamps = np.array([stamp for stamp, _ in turned], np.int64)
        clock = camera_clock(odometry, stamps, [yaw for _, yaw in turned])
        near = stamps[odometry.trajectory.covers(stamps, int(ODOMETRY_TOLERANCE_S * 1e9))]
        return DrivenPath(self._odometry, odometry, odometry.trajectory.at(near), clock)


def _checked(message: Any) -> None:
    """Decode an image, which may be faulty, and forget it."""
    decoding.image_of(message)


def _small(image: Image) -> Image:
    scale = min(SAMPLE_SIDE / max(image.shape[:2]), 1.0)
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _unrolled(image: Image) -> Image:
    """An image in which a turn of the robot is a shift: a circle, unrolled about its center."""
    height, width = image.shape[:2]
    if looks_like_panorama(height, width) or abs(width / height - 2) < 0.02:
        return image
    center, reach = ((width - 1) / 2, (height - 1) / 2), min(height, width) / 2
    polar = cv2.warpPolar(image, (_RADII, _ANGLES), center, reach, cv2.INTER_LINEAR)
    return np.ascontiguousarray(polar[:, _INNER:].transpose(1, 0, 2))


def guess_geometry(samples: Sequence[Image]) -> tuple[str, str]:
    """The kind of camera that took images (H, W, 3) of one size, and what shows it."""
    height, width = samples[0].shape[:2]
    if looks_like_panorama(height, width):
        return PANORAMA, f'{width / height:.1f} times as wide as high'
    twice = abs(width / height - 2) < 0.02
    halves = np.arange(2) * (width // 2)
    if twice and all(_circles([s[:, at : at + height] for s in samples]) for at in halves):
        return DUAL_FISHEYE, 'two circles'
    if circles := None if twice else _circles(samples):
        if circles.hole is None:
            return FISHEYE, 'a circle'
        share = circles.hole.radius / circles.rim.radius
        return MIRROR, f'a circle, and the camera itself in its middle, {share:.0%} as wide'
    if width > height and _closes(samples):
        kind = EQUIRECTANGULAR if twice else PANORAMA
        return (
            kind,
            f'{width / height:.1f} times as wide as high, the right edge goes on at the left',
        )
    return ORDINARY, 'no circle, and edges that do not go on at the other side'


def _circles(samples: Sequence[Image]) -> MirrorCircles | None:
    try:
        return find_circles(samples)
    except CameraError:
        return None


def _closes(samples: Sequence[Image]) -> bool:
    """Whether the first column goes on where the last one ends: more than a half turn away."""
    gray = np.stack([sample.mean(-1) for sample in samples])

    def differs(columns: int) -> Array:
        return np.asarray(np.abs(gray - np.roll(gray, columns, axis=2)).mean((0, 1)))

    near, far = np.median(differs(1)), np.median(differs(gray.shape[2] // 2))
    return bool(differs(1)[0] < np.sqrt(near * far))


def path_length(poses: Array) -> float:
    """Length in meters of the path through poses (N, >= 2)."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def hull_area(places: Array) -> float:
    """Area in m2 of the convex hull of places (N, >= 2)."""
    try:
        return float(ConvexHull(places[:, :2]).volume)
    except (QhullError, ValueError):  # too few places, or all on a line
        return 0.0


def covered_share(places: Array, reach_m: float) -> float:
    """Share of the convex hull of places (N, >= 2) that lies within `reach_m` of one."""
    try:
        hull = Delaunay(places[:, :2])
    except (QhullError, ValueError):  # too few places, or all on a line
        return 0.0
    low, high = places[:, :2].min(0), places[:, :2].max(0)
    axes = [np.linspace(a, b, GRID) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    ground = grid[hull.find_simplex(grid) >= 0]
    distance, _ = cKDTree(places[:, :2]).query(ground)
    return float((distance <= reach_m).mean()) if len(ground) else 0.0


def spacing(places: Array) -> float:
    """Distance in meters of neighboring places (N, >= 2) while driving, 90th percentile."""
    steps = np.hypot(*np.diff(places[:, :2], axis=0).T)
    steps = steps[steps > STANDING_M]
    return float(np.percentile(steps, 90)) if len(steps) else 0.0


def directions(places: Array) -> int:
    """Number of line directions with MIN_SHARE of the path through places (N, >= 2) or more."""
    steps = np.diff(places[:, :2], axis=0)
    length = np.hypot(steps[:, 0], steps[:, 1])
    angle = np.arctan2(steps[:, 1], steps[:, 0]) % np.pi
    sector = np.minimum(angle / np.pi * SECTORS, SECTORS - 1).astype(int)
    share = np.bincount(sector, length, SECTORS) / max(length.sum(), 1e-9)
    return int((share >= MIN_SHARE).sum())


def _one_route(places: Array) -> bool:
    """Whether training will learn one route, and no area, from images at places (M, 3)."""
    moved = len(places) > 1 and path_length(places) >= 1.0
    return moved and is_one_route(places[:, 0] + 1j * places[:, 1], PIECE_LENGTH_M)


def lacks(report: BagReport, config: InspectionConfig) -> Iterator[str]:
    """The reasons why a bag is not enough to train on, each with the remedy."""
    images, drive = report.images, report.drive
    if images is None or drive is None:
        parts = ('images', images), ('odometry', drive)
        yield f'no {" and no ".join(name for name, part in parts if part is None)} could be read'
        return
    if abs(drive.clock.delay_ns) > DELAY_LIMIT_NS:
        yield drive.clock_text()
    used, recorded = len(drive.places), len(images.stamps_ns)
    if used < config.min_pictures:
        yield f'{used} images with odometry are few: drive until there are {config.min_pictures}'
    if used < (1 - MAX_LOST) * recorded:
        yield (
            f'{recorded - used} of {recorded} images have no odometry nearby: '
            'record both all the time, stamped by one clock'
        )
    if images.geometry == ORDINARY:
        yield (
            'the images do not show all directions: an omnidirectional camera is needed (one it '
            'is all the same: describe it with calibration_file)'
        )
    if float(np.mean([sample.mean() for sample in images.samples])) < DARK:
        yield 'the images are dark: open the lens or wait for daylight'
    yield from _lacks_of_drive(drive.places, config) if used > 1 else ()


def _lacks_of_drive(places: Array, config: InspectionConfig) -> Iterator[str]:
    gap, share = spacing(places), covered_share(places, config.reach)
    if path_length(places) < 1.0:
        yield 'the robot did not move: drive it over the area'
        return
    if gap > config.max_spacing:
        yield f'images are {gap:.2f} m apart: drive slower or record more of them'
    if _one_route(places):
        return
    if share < MIN_COVERED:
        yield (
            f'{share:.0%} of the area lie within {config.reach:g} m of an image: '
            'cross the remaining area'
        )
    if directions(places) < MIN_DIRECTIONS:
        yield (
            f'driven along {directions(places)} of {SECTORS} directions: '
            'cross the area lengthwise, crosswise and diagonally'
        )
