# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is in a bag, what is wrong with it, and whether it is enough to train on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import KINDS, Bag
from sfa_localization.bags.run_loader import ODOMETRY_TOLERANCE_S
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.topic_stream import Stream
from sfa_localization.camera.panorama import looks_like_panorama
from sfa_localization.data.errors import BagError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image, Odometry, Stamps
from sfa_localization.data.settings import Settings, setting

PANORAMA, OMNIDIRECTIONAL, FISHEYE = 'panorama', 'omnidirectional', 'fisheye'
DUAL_FISHEYE, ORDINARY = 'dual fisheye', 'ordinary camera'
SECTORS = 6
SAMPLE_SIDE = 640
STILL_M = 0.02
GRID = 100
DARK = 12.0


@dataclass(frozen=True, slots=True)
class InspectionConfig(Settings):
    """What a drive needs to be enough to train on."""

    min_pictures: int = setting(300, 'pictures with odometry', low=1)
    max_spacing: float = setting(
        0.5, 'way between pictures (90th percentile)', unit='m', low=0.01, high=100.0
    )
    reach: float = setting(
        1.0, 'ground this near to a picture is covered', unit='m', low=0.01, high=100.0
    )
    min_covered: float = setting(0.65, 'share of the area that is covered', low=0.0, high=1.0)
    min_directions: int = setting(3, 'line directions, of six, driven along', low=1, high=6)
    max_lost: float = setting(0.1, 'share of pictures that cannot be used', low=0.0, high=1.0)
    max_gap: float = setting(
        2.0, 'pause of a topic that is worth telling', unit='s', low=0.0, high=1e6
    )
    samples: int = setting(16, 'pictures on the contact sheet', low=1, high=400)


@dataclass
class TopicReport:
    """One topic: `problems` are sentences; stamps are the senders' where they gave one."""

    name: str
    kind: str
    count: int
    stamps_ns: Stamps
    problems: list[str] = field(default_factory=list)

    @property
    def rate_hz(self) -> float:
        """Messages per second, by the median of their distances; 0 for less than two."""
        if len(self.stamps_ns) < 2:
            return 0.0
        return float(1e9 / max(np.median(np.diff(self.stamps_ns)), 1))

    @property
    def largest_gap_s(self) -> float:
        """Longest time between two messages."""
        return float(np.diff(self.stamps_ns).max() * 1e-9) if len(self.stamps_ns) > 1 else 0.0

    def as_text(self) -> str:
        """Lines for a terminal."""
        kind = self.kind.rsplit('/', 1)[-1] or 'unknown type'
        line = f'  {self.name} ({kind}): {self.count} messages, {self.rate_hz:.1f} Hz'
        return '\n'.join([line, *(f'    problem: {problem}' for problem in self.problems)])

    def as_dict(self) -> dict[str, Any]:
        known = len(self.stamps_ns) > 0
        return {
            'type': self.kind,
            'count': self.count,
            'first_stamp_ns': int(self.stamps_ns[0]) if known else None,
            'last_stamp_ns': int(self.stamps_ns[-1]) if known else None,
            'rate_hz': round(self.rate_hz, 3),
            'largest_gap_s': round(self.largest_gap_s, 3),
            'problems': self.problems,
        }


@dataclass
class Pictures:
    """A topic of pictures: size, guessed geometry, and a few of them, spread over the drive."""

    topic: str
    stamps_ns: Stamps
    width: int
    height: int
    geometry: str
    samples: list[Image]

    def as_dict(self) -> dict[str, Any]:
        size = {'width': self.width, 'height': self.height}
        return {'topic': self.topic, **size, 'geometry': self.geometry}


@dataclass
class Drive:
    """Where the robot went by its odometry, and where pictures were taken."""

    topic: str
    odometry: Odometry
    places: Array
    """Poses (M, 3) of the pictures that have odometry."""

    def as_text(self) -> str:
        """A line for a terminal."""
        told = self.as_dict()
        return (
            f'  drive: {told["length_m"]:.0f} m by {told["topic"]}, {told["pictures"]} pictures '
            f'over {told["area_m2"]:.0f} m2, {told["spacing_m"]:.2f} m apart, '
            f'along {told["directions"]} of {SECTORS} directions'
        )

    def as_dict(self) -> dict[str, Any]:
        return {
            'topic': self.topic,
            'length_m': round(way(self.odometry.poses), 2),
            'pictures': len(self.places),
            'area_m2': round(area(self.places), 2),
            'spacing_m': round(spacing(self.places), 3),
            'directions': directions(self.places),
        }


@dataclass
class BagReport:
    """All that was found out about a bag; `lacks` tells why it is not enough to train on.

    `error` is why it cannot be read at all.
    """

    path: str
    error: str = ''
    topics: list[TopicReport] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    pictures: Pictures | None = None
    drive: Drive | None = None
    lacks: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            'path': self.path,
            'error': self.error,
            'topics': {topic.name: topic.as_dict() for topic in self.topics},
            'problems': self.problems,
            'notes': self.notes,
            'pictures': self.pictures.as_dict() if self.pictures else None,
            'drive': self.drive.as_dict() if self.drive else None,
            'enough_to_train_on': not (self.lacks or self.error),
            'lacks': self.lacks,
        }

    def as_text(self) -> str:
        """Lines for a terminal."""
        if self.error:
            return f'error: {self.error}'
        lines = [self.path, *(topic.as_text() for topic in self.topics)]
        if self.pictures is not None:
            seen = self.pictures
            lines.append(f'  pictures: {seen.width}x{seen.height}, {seen.geometry}')
        if self.drive is not None:
            lines.append(self.drive.as_text())
        lines += [f'  problem: {problem}' for problem in self.problems]
        lines += [f'  note: {note}' for note in self.notes]
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
    """Look through a bag once. Raises BagError when nothing in it can be read."""
    config, topics = config or InspectionConfig(), topics or TopicNames()
    report = BagReport(str(path))
    with Bag(path, strict=strict, config=bag_config) as bag:
        image, odometry = (
            _found(bag, kind, name, report)
            for kind, name in (('image', topics.image), ('odometry', topics.odometry))
        )
        looks = _Looks(bag, image, odometry, config)
        looks.read()
        report.topics = looks.topics(config)
        report.problems, report.notes = bag.problems, bag.recording.notes
        report.pictures = looks.pictures()
        report.drive = looks.drive(report.pictures)
    report.lacks += lacks(report, config)
    return report


def _found(bag: Bag, kind: str, name: str, report: BagReport) -> str:
    """The topic of a kind, or '' with the reason among what the bag lacks."""
    try:
        return bag.find(kind, name)
    except BagError as error:
        report.lacks.append(str(error).removeprefix(f'{bag.path}: '))
        return ''


class _Looks:
    """One pass over all topics of a bag."""

    def __init__(self, bag: Bag, image: str, odometry: str, config: InspectionConfig) -> None:
        self._bag, self._image, self._odometry = bag, image, odometry
        self._stamps: dict[str, list[int]] = {name: [] for name in bag.topics}
        self._motion: list[tuple[int, Any]] = []
        self._sizes: dict[tuple[int, ...], int] = {}
        self._samples: list[Image] = []
        self._streams: list[Stream] = []
        count = bag.topics[image].count if image else 0
        self._every = max(count // config.samples, 1)
        self._wanted = config.samples

    def read(self) -> None:
        self._streams = [self._stream(name) for name in self._bag.topics]
        for stream, stamp_ns, value in self._bag.read(self._streams):
            self._stamps[stream.topic].append(stamp_ns)
            if stream.topic == self._odometry.partition(':')[0]:
                self._motion.append((stamp_ns, value))

    def _stream(self, name: str) -> Stream:
        if name == self._odometry.partition(':')[0]:
            stream = self._bag.stream(self._odometry, decoding.odometry_of)
            stream.required = False
            return stream
        if name == self._image:
            return self._bag.any_stream(name, self._look)
        if self._bag.topics[name].kind in KINDS['image'].found:
            return self._bag.any_stream(name, decoding.image_of)
        return self._bag.any_stream(name, lambda message: None)

    def _look(self, message: Any) -> None:
        """Decode a picture; remember its size, and some pictures themselves."""
        image = decoding.image_of(message)
        seen = sum(self._sizes.values())
        self._sizes[image.shape[:2]] = self._sizes.get(image.shape[:2], 0) + 1
        if seen % self._every == 0 and len(self._samples) < self._wanted:
            self._samples.append(_small(image))

    def topics(self, config: InspectionConfig) -> list[TopicReport]:
        reports = []
        for stream in self._streams:
            topic = self._bag.topics[stream.topic]
            stamps = np.array(self._stamps[topic.name], np.int64)
            report = TopicReport(topic.name, topic.kind, topic.count, stamps)
            report.problems = list(self._problems(stream, report, config))
            reports.append(report)
        return reports

    def _problems(
        self, stream: Stream, report: TopicReport, config: InspectionConfig
    ) -> Iterator[str]:
        for reason, number in stream.tally.count.skipped.items():
            yield f'{number} of {report.count} messages: {reason}'
        if report.count == 0:
            yield 'no messages'
        if report.largest_gap_s > max(config.max_gap, 5 / max(report.rate_hz, 1e-9)):
            yield f'pause of {report.largest_gap_s:.1f} s'
        if stream.topic == self._image and len(self._sizes) > 1:
            sizes = ', '.join(f'{w}x{h}' for h, w in self._sizes)
            yield f'pictures of several sizes: {sizes}'

    def pictures(self) -> Pictures | None:
        if not self._samples:
            return None
        height, width = max(self._sizes, key=lambda size: self._sizes[size])
        same = [s for s in self._samples if s.shape == self._samples[0].shape]
        stamps = np.array(self._stamps[self._image], np.int64)
        return Pictures(self._image, stamps, width, height, guess_geometry(same), self._samples)

    def drive(self, pictures: Pictures | None) -> Drive | None:
        if not self._motion:
            return None
        stream = next(s for s in self._streams if s.topic == self._odometry.partition(':')[0])
        odometry = self._bag.to_odometry(stream, self._motion)
        stamps = pictures.stamps_ns if pictures else np.zeros(0, np.int64)
        tolerance = int(ODOMETRY_TOLERANCE_S * 1e9)
        near = stamps[odometry.trajectory.covers(stamps, tolerance)]
        return Drive(self._odometry, odometry, odometry.trajectory.at(near))


def _small(image: Image) -> Image:
    scale = SAMPLE_SIDE / max(image.shape[:2])
    if scale >= 1:
        return image.copy()
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def guess_geometry(samples: Sequence[Image]) -> str:
    """What kind of camera took pictures (H, W, 3) of one size, by their shape and dark parts."""
    height, width = samples[0].shape[:2]
    if looks_like_panorama(height, width):
        return PANORAMA
    grey = np.stack([sample.mean(-1) for sample in samples])
    if abs(width / height - 2) < 0.02:
        return DUAL_FISHEYE if _dark_corners(grey[:, :, : width // 2]) else PANORAMA
    if not _dark_corners(grey):
        return ORDINARY
    return OMNIDIRECTIONAL if _still_center(grey) else FISHEYE


def _dark_corners(grey: Array) -> bool:
    """Whether the light falls into a circle: pictures (N, H, W) with black corners."""
    brightest, side = grey.max(0), max(min(grey.shape[1:]) // 20, 1)
    ends = (slice(None, side), slice(-side, None))
    corners = [np.median(brightest[rows, columns]) for rows in ends for columns in ends]
    return bool(max(corners) < max(DARK, 0.15 * np.median(grey)))


def _still_center(grey: Array) -> bool:
    """Whether the middle shows the camera itself: it changes much less than what is around it."""
    height, width = grey.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    radius = np.hypot(rows - height / 2, columns - width / 2) / (min(height, width) / 2)
    change = grey.std(0) if len(grey) > 1 else np.abs(grey[0] - grey[0].mean())
    inner, ring = change[radius < 0.12].mean(), change[(radius > 0.4) & (radius < 0.8)].mean()
    return bool(inner < 0.4 * ring)


def way(poses: Array) -> float:
    """Length in metres of the path through poses (N, 3)."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def area(places: Array) -> float:
    """Area in m2 of the convex hull of places (N, >= 2)."""
    try:
        return float(ConvexHull(places[:, :2]).volume)
    except (QhullError, ValueError):  # too few places, or all on a line
        return 0.0


def covered(places: Array, reach_m: float) -> float:
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
    """Way in metres between neighbouring pictures, 90th percentile, of those taken driving."""
    steps = np.hypot(*np.diff(places[:, :2], axis=0).T)
    steps = steps[steps > STILL_M]
    return float(np.percentile(steps, 90)) if len(steps) else 0.0


def directions(places: Array) -> int:
    """How many of six line directions (30 degrees each, of 180) hold 5 % of the way or more."""
    steps = np.diff(places[:, :2], axis=0)
    length = np.hypot(steps[:, 0], steps[:, 1])
    angle = np.arctan2(steps[:, 1], steps[:, 0]) % np.pi
    sector = np.minimum(angle / np.pi * SECTORS, SECTORS - 1).astype(int)
    share = np.bincount(sector, length, SECTORS) / max(length.sum(), 1e-9)
    return int((share >= 0.05).sum())


def lacks(report: BagReport, config: InspectionConfig) -> list[str]:
    """Why a bag is not enough to train on, each with the remedy; nothing when it is."""
    if report.pictures is None or report.drive is None:
        return [] if report.lacks else ['neither pictures nor odometry could be read']
    places, taken = report.drive.places, len(report.pictures.stamps_ns)
    return [
        *_lacks_of_pictures(report.pictures, len(places), taken, config),
        *(_lacks_of_drive(places, config) if len(places) > 1 else ()),
    ]


def _lacks_of_pictures(
    pictures: Pictures, used: int, taken: int, config: InspectionConfig
) -> Iterator[str]:
    if used < config.min_pictures:
        yield f'{used} pictures with odometry are few: drive until there are {config.min_pictures}'
    if used < (1 - config.max_lost) * taken:
        yield (
            f'{taken - used} of {taken} pictures have no odometry nearby: '
            'record both all the time, stamped by one clock'
        )
    if pictures.geometry == ORDINARY:
        yield 'the pictures do not look around: an omnidirectional camera is needed'
    if float(np.mean([sample.mean() for sample in pictures.samples])) < DARK:
        yield 'the pictures are dark: open the lens or wait for daylight'


def _lacks_of_drive(places: Array, config: InspectionConfig) -> Iterator[str]:
    gap, share = spacing(places), covered(places, config.reach)
    if way(places) < 1.0:
        yield 'the robot did not move: drive it over the area'
        return
    if gap > config.max_spacing:
        yield f'pictures are {gap:.2f} m apart: drive slower or record more of them'
    if share < config.min_covered:
        yield (
            f'{share:.0%} of the area lie within {config.reach:g} m of a picture: '
            'cross what is left out'
        )
    if directions(places) < config.min_directions:
        yield (
            f'driven along {directions(places)} of {SECTORS} directions: '
            'cross the area along, across and diagonally'
        )
