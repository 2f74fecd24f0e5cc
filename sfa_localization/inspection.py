# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The contents of a bag, its problems, and whether it is enough to train on."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from sfa_localization.bags import decoding
from sfa_localization.bags.drives import ODOMETRY_TOLERANCE_S, ReadingRecipe, unwrapper_of
from sfa_localization.bags.lens_drive import lens_of
from sfa_localization.bags.motion_arrays import stamps_of, to_yaw_rate
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.surround_topics import PATIENCE, SurroundStream, cameras_of, topics_of
from sfa_localization.bags.topic_stream import Stream, by_one_clock
from sfa_localization.camera import body, kinds, lens_report, surround
from sfa_localization.camera.joining import Joined
from sfa_localization.camera.leveling import leaning
from sfa_localization.camera.panorama import looks_like_panorama
from sfa_localization.camera.sectors import MountedCamera, visible_elevations
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.camera.turns import VisualGyro
from sfa_localization.camera.watch import FrozenWatch, frozen
from sfa_localization.data.errors import BagError, LocalizationError, MessageError
from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.messages import read_tilt, read_yaw_rate
from sfa_localization.data.run import Image, Odometry, Stamps
from sfa_localization.data.settings import Settings, setting
from sfa_localization.data.statistics import evenly
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.inputs import OpenLoop
from sfa_localization.keyframes.closures import STRETCH_M, Textures, driven
from sfa_localization.keyframes.leveling import tilt_pairs
from sfa_localization.keyframes.texture import channels, quantized, texture
from sfa_localization.mapping.drive_check import ROUTE, is_single_route
from sfa_localization.metric.points import stops
from sfa_localization.metric.segments import PIECE_LENGTH_M
from sfa_localization.motion.check import MotionCheck, check_motion
from sfa_localization.motion.sources import IMAGES, POSE, late

SAMPLES = 16
SAMPLE_SIDE = 640
"""Number of images on the contact sheet, and their longer side (pixels)."""
SECTORS = 6
"""Number of driving directions, of 30 degrees each; forth and back are the same."""
# A drive needs directions, each with a share of the path, or the shape of the map is ambiguous, and
# a covered share of the area, or the map is extrapolated over whole regions.
MIN_DIRECTIONS = 3
MIN_SHARE = 0.05
MIN_COVERED = 0.65
MOVED_M = 1.0  # a shorter drive covers no area
MAX_WITHOUT_ODOMETRY = 0.1  # share of images; more means that the clocks differ
MAX_GAP_S = 2.0  # longer pauses of a topic are reported
# a topic is periodic if this share of intervals is below 3 medians
EVEN = 3.0
EVEN_SHARE = 0.9
MAX_REPEATED = 0.05  # share of images that repeat the last one; more are reported
STANDING_M = 0.02  # between images of a robot that stands
GRID = 100  # points per axis at which coverage is evaluated
TILT_PAIRS = 50  # that show the tilt of the ground
DARK = 12.0  # mean gray level of 255 below which an image is dark

# Pairs of images at a place with different headings show the lever arm of the camera.
SAME_PLACE_M = 0.5
OTHER_HEADING_RAD = math.radians(30.0)
MIN_PAIRS = 10
COMPARED = 2000
NO_LEVER_ARM = (
    'no place is seen in two headings, so nothing shows where the camera sits on the robot: turn '
    'on the spot where you have been, or set camera_xy'
)


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
    """A topic with its `problems`, as sentences.

    `stamps_ns` are those of the readable messages, from their headers if they have one; `recorded`
    is the count of the bag's metadata or index.
    """

    name: str
    kind: str
    recorded: int
    stamps_ns: Stamps
    problems: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of readable messages."""
        return len(self.stamps_ns)

    @property
    def unreadable(self) -> bool:
        """Whether messages were recorded, but none can be read."""
        return self.recorded > 0 and self.count == 0

    @property
    def rate_hz(self) -> float:
        """Messages per second, by the median interval; 0 for fewer than two."""
        steps = np.diff(self.stamps_ns)
        return float(1e9 / max(np.median(steps), 1)) if len(steps) else 0.0

    @property
    def largest_gap_s(self) -> float:
        """Longest time between two messages."""
        return float(np.diff(self.stamps_ns).max(initial=0) * 1e-9)

    @property
    def pauses(self) -> bool:
        """Whether a periodic topic paused; others may be published on change only."""
        steps = np.diff(self.stamps_ns)
        even = len(steps) and np.mean(steps <= EVEN * np.median(steps)) >= EVEN_SHARE
        return bool(even and self.largest_gap_s > max(MAX_GAP_S, 5 / self.rate_hz))

    def as_dict(self) -> dict[str, Any]:
        first, last = self.stamps_ns[[0, -1]].tolist() if self.count else (None, None)
        return {
            'type': self.kind,
            'count': self.count,
            'recorded': self.recorded,
            'first_stamp_ns': first,
            'last_stamp_ns': last,
            'rate_hz': round(self.rate_hz, 3),
            'largest_gap_s': round(self.largest_gap_s, 3),
            'problems': self.problems,
        }


@dataclass
class BagReport:
    """All findings about a bag; `lacks` are the reasons why it is not enough to train on; for those
    `of_drive`, other drives may make up.

    `error` says why it cannot be read at all. `samples` are images from all over the drive,
    `camera` the kind of camera that they show, `lens` a sentence about its lens, which the settings
    describe or not (`is_described`). `cameras` is one about several that make a panorama;
    `image_topic` is the first of theirs. `drives` are the poses (M, 3) of images with `odometry` in
    each unbroken part of it, as corrected; `motion` compares odometry, images and gyroscope; `tilt`
    is that of the ground.
    """

    path: str
    error: str = ''
    topics: list[TopicReport] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    lacks: list[str] = field(default_factory=list)
    of_drive: list[str] = field(default_factory=list)
    image_topic: str = ''
    cameras: str = ''
    camera: kinds.CameraKind | None = None
    is_described: bool = False
    lens: str = ''
    lens_title: str = 'lens'
    samples: list[Image] = field(default_factory=list)
    odometry_topic: str = ''
    odometry: Odometry | None = None
    drives: list[Array] = field(default_factory=list)
    motion: MotionCheck | None = None
    tilt: str = ''

    @property
    def places(self) -> Array:
        """Poses (M, 3) of all images with odometry."""
        return np.concatenate([np.zeros((0, 3)), *self.drives])

    @property
    def sees_a_part(self) -> bool:
        """Whether the images do not seem to show all directions, and no lens is described."""
        return bool(self.camera and self.camera.lack) and not self.is_described

    @property
    def facts(self) -> dict[str, str]:
        """Sentences about camera, drive, stops and ground."""
        facts = {}
        if self.cameras:
            facts['cameras'] = self.cameras
        if self.camera is not None:
            facts['images'] = str(self.camera)
        if self.lens:
            facts[self.lens_title] = self.lens
        if self.odometry is not None:
            area = max(map(hull_area, self.drives), default=0.0)
            along = max(map(directions, self.drives), default=0)
            facts['drive'] = (
                f'{sum(map(path_length, self.drives)):.0f} m by {self.odometry_topic}, '
                f'{len(self.places)} images over {area:.0f} m2, '
                f'{spacing(self.places):.2f} m apart, '
                f'along {along} of {SECTORS} directions'
            )
            stops_s = (stops(self.odometry) - self.odometry.stamps_ns[0]) * 1e-9
            stood = [f'stop {k} at {a:.1f} to {b:.1f} s' for k, (a, b) in enumerate(stops_s, 1)]
            facts |= {'stood': ', '.join(stood)} if stood else {}
        if self.tilt:
            facts['ground'] = self.tilt
        return facts

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            'path': self.path,
            'error': self.error,
            'topics': {topic.name: topic.as_dict() for topic in self.topics},
            'problems': self.problems,
            'notes': self.notes,
            'facts': self.facts,
            'motion': self.motion.as_dict() if self.motion else None,
            'enough_to_train_on': not (self.lacks or self.error),
            'lacks': self.lacks,
            'drives': [drive.round(3).tolist() for drive in self.drives],
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
        lines += [f'  {line}' for line in self.motion.as_text()] if self.motion else []
        lines += [f'  problem: {problem}' for problem in self.problems]
        lines += [f'  note: {note}' for note in self.notes]
        lines += [f'  not enough to train on: {lack}' for lack in self.lacks]
        return '\n'.join(lines if self.lacks else [*lines, '  enough to train on'])


@one_core()
def inspect(
    path: Path | str,
    *,
    recipe: ReadingRecipe | None = None,
    config: InspectionConfig | None = None,
    strict: bool = False,
) -> BagReport:
    """Read a bag as training reads it by the `recipe`, and report on it. The lens of images that
    are no panoramas is learned, and compared with that which the recipe's camera describes.

    Raises BagError when nothing in it can be read, and CameraError for a lens that cannot be used.
    """
    recipe = recipe or ReadingRecipe()
    config = config or InspectionConfig()
    report = BagReport(str(path), is_described=recipe.camera.is_described)
    with Bag(path, strict=strict, config=recipe.bag) as bag:
        report.odometry_topic = _topic_of(bag, 'odometry', recipe.topics.odometry, report)
        cameras = _cameras_of(bag, recipe.topics.image, report)
        _Survey(bag, report, recipe, cameras).fill()
        report.problems = bag.problems
        report.notes += bag.recording.notes
    _see_lens(report, recipe)
    if path_length(report.places) >= MOVED_M:
        report.notes += [ROUTE] if is_route(report.places) else []
        report.notes += [] if headings_differ(report.places) else [NO_LEVER_ARM]
    if report.lacks:
        report.lacks += report.motion.wrong if report.motion else []
        return report
    report.of_drive = list(lacks_of_drives(report.drives, config))
    report.lacks = [*lacks(report, config), *report.of_drive]
    return report


def _see_lens(report: BagReport, recipe: ReadingRecipe) -> None:
    """Fill in the lens that the drive shows, or what is missing to see it."""
    if report.camera is None or report.sees_a_part or report.odometry is None or report.cameras:
        return
    try:
        lens = lens_of(Path(report.path), recipe)
    except LocalizationError as error:
        lacks = [] if recipe.camera.is_described else [str(error)]
        report.lacks += [lack.removeprefix(f'{report.path}: ') for lack in lacks]
        return
    if lens is None:
        return
    report.lens = lens_report.sentence(lens)
    report.notes += lens_report.advice(lens)
    if recipe.camera.is_described:
        report.lens_title = 'lens as the drive shows it, beside the described one'
        report.notes += lens_report.contradictions(
            lens, recipe.unwrapper.calibration, recipe.camera.name
        )


def _topic_of(bag: Bag, kind: str, name: str, report: BagReport) -> str:
    """The topic of a kind; '' if there is none, and the reason goes to `report.lacks`."""
    try:
        return bag.find(kind, name)
    except BagError as error:
        report.lacks.append(str(error).removeprefix(f'{bag.path}: '))
        return ''


def _cameras_of(bag: Bag, named: str, report: BagReport) -> tuple[MountedCamera, ...]:
    """The cameras around the robot whose images make a panorama; () for one, or without images."""
    try:
        cameras = cameras_of(bag, named, report.odometry_topic)
        topics = topics_of(bag, named).values() if cameras else [bag.find('image', named)]
    except BagError as error:
        report.lacks.append(str(error).removeprefix(f'{bag.path}: '))
        return ()
    report.image_topic = next(iter(topics))
    report.cameras = surround.sentence(cameras) if cameras else ''
    return cameras


class _View(NamedTuple):
    """What is kept of an image: the turn of the camera since the first image, rad, a small texture,
    None if it repeats the last image, and of some panoramas the local contrast.
    """

    yaw: float
    texture: NDArray[np.int8] | None
    contrast: NDArray[np.int8] | None


class _Survey:
    """One pass over all topics of a bag."""

    def __init__(
        self,
        bag: Bag,
        report: BagReport,
        recipe: ReadingRecipe,
        cameras: tuple[MountedCamera, ...],
    ) -> None:
        topics = recipe.topics
        clockwise = recipe.panorama.clockwise
        self._bag = bag
        self._report = report
        # The images of several cameras are panoramas already.
        described = replace(recipe, camera=CameraConfig()) if cameras else recipe
        self._unwrap = unwrapper_of(bag, report.image_topic, described)
        self._gyro = VisualGyro(clockwise)
        self._frozen = FrozenWatch()
        self._repeats = 0
        self._sizes: Counter[tuple[int, ...]] = Counter()
        self._sphere = PanoramaConfig(clockwise=clockwise).sphere
        self._rolls_and_pitches: list[tuple[float, float]] = []
        has_imu = bag.has('imu', topics.imu)
        imu = _topic_of(bag, 'imu', topics.imu, report) if has_imu else ''
        self._used = self._joined(cameras, topics.image) if cameras else dict[str, Stream]()
        single = '' if cameras else report.image_topic
        # Without a topic, '' is no name: in damaged bags, it can be one.
        for use, name, convert in (
            ('images', single, self._take),
            ('odometry', report.odometry_topic, decoding.odometry_of),
            ('imu', imu, self._yaw_rate),
        ):
            if name:
                self._used[use] = bag.stream(name, convert)
                self._used[use].required = False
        count = bag.topics[report.image_topic].count if report.image_topic else 0
        self._every = max(count // SAMPLES, 1)
        self._tilt_every = -(-count // body.IMAGES) or 1

    def _joined(self, cameras: tuple[MountedCamera, ...], named: str) -> dict[str, Stream]:
        """The stream of the panoramas of several cameras, and those of the cameras."""
        panorama = PanoramaConfig(clockwise=self._sphere.clockwise)
        panorama = lens_report.fitting_panorama(panorama, visible_elevations(cameras))
        around = surround.Surround(cameras, panorama, patience=PATIENCE)

        def take(images: Joined) -> _View:
            return self._take(around.compose(images))

        joined = SurroundStream(self._bag, topics_of(self._bag, named), around, take)
        return {'images': joined.panoramas, **joined.cameras}

    def fill(self) -> None:
        """Read the bag, and fill the report."""
        bag = self._bag
        report = self._report
        used = {stream.topic: stream for stream in self._used.values()}
        # Other images are decoded to detect damage, and not kept.
        streams = [
            used.get(name) or bag.stream(name, lambda _: None, required=False)
            for name in bag.topics
        ]
        bag.collect(streams)
        report.topics = [self._topic(stream) for stream in streams]
        if samples := report.samples:
            ((height, width), _), *_ = self._sizes.most_common(1)
            alike = [sample for sample in samples if sample.shape == samples[0].shape]
            report.camera = kinds.CameraKind(*kinds.guess_geometry(alike)[:2], width, height)
        odometry = self._used.get('odometry')
        if odometry is None or not odometry.values:
            return
        report.notes += by_one_clock(self._used)
        try:
            self._drive(bag.to_odometry(odometry, odometry.values))
        except BagError as error:
            report.lacks.append(str(error).removeprefix(f'{bag.path}: '))

    def _take(self, image: Image) -> _View:
        """Keep a sample of the images now and then, and what shows turns of each."""
        samples = self._report.samples
        number = self._sizes.total()
        size = image.shape[:2]
        self._sizes[size] += 1
        if number % self._every == 0 and len(samples) < SAMPLES:
            scale = min(SAMPLE_SIDE / max(size), 1.0)
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            samples.append(np.asarray(small, np.uint8))
        new = self._frozen.add(image)
        self._repeats += not new
        image = self._unrolled(image)
        yaw = self._gyro.add(image)
        chosen = number % self._tilt_every == 0 and looks_like_panorama(*image.shape[:2])
        contrast = quantized(texture(image)[None]) if chosen else None
        return _View(yaw, self._gyro.texture if new else None, contrast)

    def _unrolled(self, image: Image) -> Image:
        """The panorama of an image, as training makes it; without a description of the lens, an
        image that turns shift.
        """
        mounted = any(self._unwrap.camera.mount_rpy)
        if self._unwrap.model or (mounted and looks_like_panorama(*image.shape[:2])):
            return self._unwrap(image)
        return kinds.unrolled(image)

    def _yaw_rate(self, message: Any) -> tuple[float, float]:
        """Yaw rate and its variance from an Imu; roll and pitch are kept if it has them."""
        with contextlib.suppress(MessageError):
            self._rolls_and_pitches.append(read_tilt(message))
        return read_yaw_rate(message)

    def _topic(self, stream: Stream) -> TopicReport:
        topic = self._bag.topics[stream.topic]
        report = TopicReport(topic.name, topic.kind, topic.count, stamps_of(stream.values))
        report.problems = list(self._problems(stream, report))
        return report

    def _problems(self, stream: Stream, report: TopicReport) -> Iterator[str]:
        for reason, number in stream.skipped.items():
            yield f'{number} of {report.recorded} messages: {reason}'
        if report.recorded == 0:
            yield 'no messages'
        if report.pauses:
            yield f'pause of {report.largest_gap_s:.1f} s'
        if stream is not self._used.get('images'):
            return
        if len(self._sizes) > 1:
            yield f'images of several sizes: {", ".join(f"{w}x{h}" for h, w in self._sizes)}'
        if self._repeats > MAX_REPEATED * report.recorded:
            yield f'{self._repeats} of {report.recorded} images repeat the one before'

    def _drive(self, odometry: Odometry) -> None:
        """Fill in the path, the tilt, and the comparison with images and gyroscope."""
        report = self._report
        images = self._used['images'].values if 'images' in self._used else []
        stamps = stamps_of(images)
        views = [view for _, view in images]
        if self._rolls_and_pitches:
            tilt = np.degrees(np.std(self._rolls_and_pitches, 0).mean())
            report.tilt = f'tilts the robot by {tilt:.1f} degrees'
        report.motion = self._compared(odometry, stamps, views)
        self._see(odometry, stamps, views)
        near = stamps[odometry.trajectory.covers(stamps, int(ODOMETRY_TOLERANCE_S * 1e9))]
        broken = report.motion.odometry
        report.odometry = odometry
        part = broken.part[np.searchsorted(broken.stamps_ns[1:-1], near, 'right')]
        report.drives = np.split(broken.trajectory.at(near), np.flatnonzero(np.diff(part)) + 1)

    def _compared(self, odometry: Odometry, stamps: Stamps, views: Sequence[_View]) -> MotionCheck:
        """The comparison of odometry, gyroscope, and images at stamps (N,)."""
        camera = self._report.camera
        text = frozen(self._repeats, len(stamps))
        self._report.lacks += [text] if text else []
        turns = None
        described = bool(self._unwrap.model)
        if camera and (described or camera.shows_turns) and not text:
            turns = stamps, np.array([view.yaw for view in views])
        small = {row: view.texture for row, view in enumerate(views) if view.texture is not None}
        textures = (stamps[[*small]], np.stack([*small.values()])) if small else None
        gyro = to_yaw_rate(self._used['imu'].values) if 'imu' in self._used else None
        is_panorama = described or (camera is not None and camera.is_panorama)
        commands = OpenLoop.of(odometry.twists).repeats
        return check_motion(odometry, turns, gyro, is_panorama, textures, commands)

    def _see(self, odometry: Odometry, stamps: Stamps, views: Sequence[_View]) -> None:
        """Fill in what hides the view, and the tilt, by the local contrasts of some of the images
        at stamps (N,), where these are panoramas of one size.
        """
        contrasts = {row: v.contrast for row, v in enumerate(views) if v.contrast is not None}
        if len({contrast.shape for contrast in contrasts.values()}) != 1:
            return
        rows = np.array([*contrasts])
        textures = np.concatenate([*contrasts.values()])
        pair = self._report.motion and self._report.motion.pair(POSE, IMAGES)
        if not (pair and pair.independent):
            headings = odometry.trajectory.at(stamps[rows])[:, 2]
            light = channels(textures.shape[1])[0]
            robot = body.robot_in_view(textures[:, light], headings)
            self._report.notes += body.sentences(robot, self._sphere)
        images = Textures(textures, rows, np.zeros_like(rows), driven(odometry, stamps)[rows])
        self._report.tilt = self._report.tilt or self._camera_tilt(images)

    def _camera_tilt(self, images: Textures) -> str:
        """How the ground tilts the camera, by pairs of images."""
        pairs = tilt_pairs(images, self._sphere)
        if len(pairs.tilt) < TILT_PAIRS:
            return ''
        if pairs.leans:
            self._report.notes.append(leaning(pairs.lean.real, pairs.lean.imag))
            pairs = pairs.upright()
        squares = np.abs(pairs.tilts(np.zeros(len(images.images), complex))) ** 2
        tilt = math.degrees(math.sqrt(float(squares.mean()) / 2))  # along each axis
        return f'tilts the camera by at least {tilt:.1f} degrees'


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
    low = places[:, :2].min(0)
    high = places[:, :2].max(0)
    axes = [np.linspace(a, b, GRID) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    ground = grid[hull.find_simplex(grid) >= 0]
    distance, _ = cKDTree(places[:, :2]).query(ground)
    return float((distance <= reach_m).mean()) if len(ground) else 0.0


def spacing(places: Array) -> float:
    """90th percentile of the distance (m) between successive places (N, >= 2) while driving."""
    steps = np.hypot(*np.diff(places[:, :2], axis=0).T)
    steps = steps[steps > STANDING_M]
    return float(np.percentile(steps, 90)) if len(steps) else 0.0


def directions(places: Array) -> int:
    """Number of directions that have at least MIN_SHARE of the path through places (N, >= 2)."""
    steps = np.diff(places[:, :2], axis=0)
    length = np.hypot(steps[:, 0], steps[:, 1])
    angle = np.arctan2(steps[:, 1], steps[:, 0]) % np.pi
    sector = np.minimum(angle / np.pi * SECTORS, SECTORS - 1).astype(int)
    share = np.bincount(sector, length, SECTORS) / max(length.sum(), 1e-9)
    return int((share >= MIN_SHARE).sum())


def is_route(places: Array) -> bool:
    """Whether training will learn a route, not an area, from images at places (M, >= 2)."""
    return is_single_route(places[:, 0] + 1j * places[:, 1], PIECE_LENGTH_M)


def headings_differ(places: Array) -> bool:
    """Whether a robot came back to enough of its poses (N, 3) with another heading."""
    moved = np.hypot(*np.diff(places[:, :2], axis=0, prepend=places[:1, :2]).T)
    rows = evenly(len(places), COMPARED)
    driven = np.cumsum(moved)[rows]
    places = places[rows]
    first, last = cKDTree(places[:, :2]).query_pairs(SAME_PLACE_M, output_type='ndarray').T
    again = np.abs(driven[first] - driven[last]) >= STRETCH_M
    turned = np.abs(wrap_angle(places[first, 2] - places[last, 2])) >= OTHER_HEADING_RAD
    return int((again & turned).sum()) >= MIN_PAIRS


def sparse_lanes(share: float, reach_m: float) -> list[str]:
    """A sentence if a small share of the ground is near an image."""
    if share >= MIN_COVERED:
        return []
    return [
        f'{share:.0%} of the area lie within {reach_m:g} m of an image, as by lanes '
        f'{2 * reach_m / max(share, 0.01):.1f} m apart, and between lanes one image errs '
        f'by about a tenth of that: drive lanes {2 * reach_m:g} m apart'
    ]


def too_sparse(places: Array, most_m: float) -> list[str]:
    """A sentence if images at places (N, >= 2) are too far apart while driving."""
    gap = spacing(places)
    if gap <= most_m:
        return []
    return [f'images are {gap:.2f} m apart: drive slower or record more']


def lacks(report: BagReport, config: InspectionConfig) -> Iterator[str]:
    """The reasons why a bag cannot be trained on with any others, each with its remedy."""
    if report.camera is None or report.motion is None:
        parts = ('images', report.camera), ('odometry', report.motion)
        yield f'no {" and no ".join(name for name, part in parts if part is None)} could be read'
        return
    yield from report.motion.wrong
    pair = report.motion.pair(POSE, IMAGES)
    if pair and abs(pair.late_s) * 1e9 > DELAY_LIMIT_NS:
        yield f'images are stamped {late(pair.late_s)}: synchronize the clocks'
    used = len(report.places)
    (recorded,) = (topic.count for topic in report.topics if topic.name == report.image_topic)
    if used < (1 - MAX_WITHOUT_ODOMETRY) * recorded:
        yield (
            f'{recorded - used} of {recorded} images have no odometry nearby: '
            'record both all the time, stamped by one clock'
        )
    if report.sees_a_part:
        yield report.camera.lack
    if float(np.mean([sample.mean() for sample in report.samples])) < DARK:
        yield 'the images are dark: open the lens or wait for daylight'
    yield from too_sparse(report.places, config.max_spacing)


def lacks_of_drives(drives: Sequence[Array], config: InspectionConfig) -> Iterator[str]:
    """What drives with images at places (M, 3) lack together, each with its remedy.

    Each drive has a frame of its own, and how they lie to each other is unknown before training:
    only what the best arrangement lacks is named. One drive may cross the lanes of another: those
    of two days, along and across, gave a map of 0.06 m.
    """
    used = sum(map(len, drives))
    if 0 < used < config.min_pictures:
        yield f'{used} images with odometry are few: drive until there are {config.min_pictures}'
    if used and sum(map(path_length, drives)) < MOVED_M:
        yield 'the robot did not move: drive it over the area'
    areas = [places for places in drives if path_length(places) >= MOVED_M]
    if all(map(is_route, areas)):
        return
    covered = [hull_area(places) * covered_share(places, config.reach) for places in areas]
    yield from sparse_lanes(sum(covered) / max(map(hull_area, areas)), config.reach)
    if len(areas) == 1 and directions(areas[0]) < MIN_DIRECTIONS:
        yield (
            f'driven along {directions(areas[0])} of {SECTORS} directions: '
            'cross the area lengthwise, crosswise and diagonally'
        )


def lacks_together(reports: Sequence[BagReport], config: InspectionConfig) -> list[str]:
    """The reasons why bags are not enough to train one model on all of them."""
    names: dict[str, list[str]] = {}
    for report in reports:
        error = [report.error.removeprefix(f'{report.path}: ')] if report.error else []
        for lack in error or [lack for lack in report.lacks if lack not in report.of_drive]:
            names.setdefault(lack, []).append(report.path)
    texts = [f'{", ".join(paths)}: {lack}' for lack, paths in names.items()]
    images = [(r, topic) for r in reports for topic in r.topics if topic.name == r.image_topic]
    for (first, one), (second, other) in combinations(images, 2):
        if one.count and np.array_equal(one.stamps_ns, other.stamps_ns):
            texts.append(f'{first.path} and {second.path} are the same drive: name it once')
    sizes = {(r.camera.width, r.camera.height) for r in reports if r.camera}
    sizes = {size for size in sizes if looks_like_panorama(*size[::-1])}
    if len(sizes) > 1:
        listed = ', '.join(f'{width}x{height}' for width, height in sorted(sizes))
        texts.append(f'panoramas of different sizes ({listed}): train on one size')
    drives = [places for report in reports for places in report.drives]
    return [*texts, *lacks_of_drives(drives, config)]
