# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Read bags as runs: panoramas on disk and odometry, in one pass."""

from __future__ import annotations

import functools
import itertools
import logging
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfa_localization.bags import decoding
from sfa_localization.bags.motion_arrays import stamps_of, to_points, to_trajectory, to_yaw_rate
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.satellite_fixes import in_plane
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.static_transforms import lever_arm
from sfa_localization.bags.surround_topics import PATIENCE, SurroundStream, topics_like
from sfa_localization.bags.topic_stream import Item, Stream, Used, by_one_clock
from sfa_localization.camera.joining import Joined
from sfa_localization.camera.leveling import LeveledPanoramas, tilts_at
from sfa_localization.camera.panorama import Unwrapper, looks_like_panorama
from sfa_localization.camera.sectors import MountedCamera
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.camera.surround import Surround
from sfa_localization.camera.watch import FrozenWatch, frozen
from sfa_localization.data.errors import BagError, DataError, MessageError, ModelError
from sfa_localization.data.files import replaced_mode
from sfa_localization.data.geometry import Mask
from sfa_localization.data.messages import read_tilt, read_yaw_rate
from sfa_localization.data.progress import progress_bar
from sfa_localization.data.run import (
    Image,
    Origin,
    PanoramaArray,
    Panoramas,
    Points,
    Run,
    Stamps,
    Trajectory,
)
from sfa_localization.data.sphere import Sphere

ODOMETRY_TOLERANCE_S = 0.5
"""An image is used when odometry before and after it is this near (s); poses are not interpolated
over a longer pause."""
_SAME_IMAGE_NS = 1_000_000  # stamps of one image differ by less
_WARM_UP_NS = 3_000_000_000  # of images beside a panorama: exposures and periods are known then
logger = logging.getLogger(__name__)
R = TypeVar('R', bound='ReadingRecipe')


@dataclass(frozen=True, slots=True)
class ReadingRecipe:
    """How a bag becomes a run of panoramas.

    Images farther than `odometry_tolerance_s` from odometry are left out (0: images before or after
    all of it), and with `distinct` also repetitions of the previous image. Fixes of a satellite
    receiver count from the `origin`, or the first fix without one. Images are those of the `lens`,
    where the camera describes no other, or those of several cameras around the robot, `surround`.
    """

    topics: TopicNames = field(default_factory=TopicNames)
    bag: BagConfig = field(default_factory=BagConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    panorama: PanoramaConfig = field(default_factory=PanoramaConfig)
    odometry_tolerance_s: float = ODOMETRY_TOLERANCE_S
    distinct: bool = False
    origin: Origin | None = None
    lens: LensCalibration | None = None
    surround: tuple[MountedCamera, ...] = ()

    @property
    def unwrapper(self) -> Unwrapper:
        """Makes panoramas of images of the camera."""
        lens = None if self.camera.is_described else self.lens
        return Unwrapper(self.camera, self.panorama, lens)


def as_live(
    recipe: R,
    panorama: PanoramaConfig,
    lens: LensCalibration | None = None,
    surround: tuple[MountedCamera, ...] = (),
) -> R:
    """The recipe to read a drive with a model's panorama, lens and cameras, as the nodes do: the
    filter also fuses images far from any odometry.
    """
    topics = replace(recipe.topics, points_topic='')
    live = replace(recipe, topics=topics, panorama=panorama, lens=lens, surround=surround)
    return replace(live, odometry_tolerance_s=0.0)


def image_folder(output: Path) -> Path:
    """The folder of `output`, for temporary files. Raises ModelError if it cannot be written."""
    try:
        replaced_mode(output)
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ModelError(f'{output}: cannot be written: {error.strerror or error}') from None
    return output.parent


def read_drives(
    bags: Sequence[Path],
    cache: Path,
    recipe: ReadingRecipe,
    progress: bool = False,
    *,
    strict: bool = False,
) -> tuple[Run, ...]:
    """Read different drives for training, with panoramas of one size and without repetitions.

    Raises BagError or DataError.
    """
    given = replace(recipe, distinct=True)
    drives = list[Run]()
    for bag in bags:
        drives.append(read_drive(bag, cache, given, progress, strict=strict))
        given = replace(given, origin=drives[-1].origin)
    runs = tuple(drives)
    for (_, other), (bag, run) in itertools.combinations(zip(bags, runs, strict=True), 2):
        if _same_recording(run, other):
            raise DataError(
                f'{bag}: the same drive as {other.name}: name each drive once, because images '
                'held out to check the map must not be learned from a copy'
            )
    if len({run.panoramas.shape for run in runs}) > 1:
        sizes = ', '.join(f'{r.name}: {r.panoramas.shape[1]}x{r.panoramas.shape[0]}' for r in runs)
        raise DataError(f'the bags hold panoramas of different sizes ({sizes}): train on one size')
    height, width, _ = runs[0].panoramas.shape
    asked = recipe.panorama
    usual = PanoramaConfig()
    if (asked.width, asked.height) not in {(width, height), (usual.width, usual.height)}:
        logger.warning(
            '%s: its panoramas are %dx%d and stay so: width and height (%dx%d) are for images of '
            'a camera', runs[0].name, width, height, asked.width, asked.height,
        )  # fmt: skip
    return runs


def _same_recording(run: Run, other: Run) -> bool:
    """Whether all stamps and the image in the middle are equal."""
    if not np.array_equal(run.panoramas.stamps_ns, other.panoramas.stamps_ns):
        return False
    middle = len(run.panoramas) // 2
    image, other_image = (drive.panoramas.read(middle, middle + 1) for drive in (run, other))
    return np.array_equal(image, other_image)


def read_drive(
    path: Path | str,
    cache: Path,
    recipe: ReadingRecipe | None = None,
    progress: bool = False,
    *,
    want_truth: bool = False,
    strict: bool = False,
) -> Run:
    """Read one bag in one pass; its panoramas are stored in `cache`.

    Only with `want_truth` a topic of true poses is opened. Images of another size than the first
    are skipped and counted. Raises BagError.
    """
    recipe = recipe or ReadingRecipe()
    with Bag(path, strict=strict, config=recipe.bag) as bag:
        images = _images_of(bag, recipe)
        try:
            stored = _PanoramaFile(Path(cache), images, recipe.distinct)
            streams = images.streams(bag, stored.panorama)
            streams |= _other_streams(bag, recipe, want_truth)
            wheels = streams['odometry']
            images.follow(wheels)
            _collect(bag, streams, stored, progress)
            odometry = bag.to_odometry(wheels, wheels.values)
            for text in by_one_clock(streams):
                logger.warning('%s: %s', bag.path, text)
            panoramas = _covered(streams, stored, odometry.trajectory, recipe)
        except OSError as error:
            raise BagError(f'{cache}: no space for the images: {error.strerror}') from None
        origin, points = _measured(bag, streams, recipe.origin)
        camera = images.place(bag, wheels.topic)
    for problem in bag.problems:
        logger.warning('%s: %s', path, problem)
    counts = {use: stream.count for use, stream in streams.items()}
    yaw_rate = to_yaw_rate(streams['imu'].values) if 'imu' in streams else None
    truth = to_trajectory(streams['ground_truth'].values) if want_truth else None
    seen = images.seen
    motion = (odometry, yaw_rate, truth)
    lacking = tuple(stored.lacking)
    return Run(bag.path.name, panoramas, *motion, points, counts, camera, origin, seen, lacking)


def _measured(
    bag: Bag, streams: dict[str, Stream], origin: Origin | None
) -> tuple[Origin | None, Points | None]:
    """The origin of fixes, and measured points; fixes become places in the plane of the origin."""
    lever = None
    for use in ('points', 'ground_truth'):
        stream = streams.get(use)
        if stream and bag.topics[stream.topic].kind == decoding.FIX:
            origin = origin or stream.values[0][1][:2]
            stream.values = in_plane(stream.values, origin)
            if use == 'points':
                lever = lever_arm(bag, stream.topic, streams['odometry'].topic)
    points = to_points(streams['points'].values, lever or 0j) if 'points' in streams else None
    return origin, points


def unwrapper_of(bag: Bag, topic: str, recipe: ReadingRecipe) -> Unwrapper:
    """What makes panoramas of the images of a topic. Those of omnicam_node, which publishes its
    info, are mounted and masked already. Raises CameraError for a lens that cannot be used.
    """
    unwrapper = recipe.unwrapper
    unwrapper.check()
    if f'{topic.removesuffix("/compressed")}/info' not in bag.topics:
        return unwrapper
    masked = CameraConfig(blind_sectors=recipe.camera.blind_sectors)
    return Unwrapper(masked, recipe.panorama)


class _OneCamera:
    """The images of one camera of a bag, and their panoramas."""

    lacking = ''

    def __init__(self, bag: Bag, recipe: ReadingRecipe) -> None:
        self._topic = bag.find('image', recipe.topics.image)
        self.total = bag.topics[self._topic].count
        self._unwrap = unwrapper_of(bag, self._topic, recipe)
        self._kept: tuple[int, ...] = ()
        self._size = 0, 0

    def streams(self, bag: Bag, convert: Callable[[Any], Any]) -> dict[str, Stream]:
        """The stream of panoramas, which `convert` makes of images."""
        return {'images': bag.stream(self._topic, convert)}

    def follow(self, odometry: Stream) -> None:
        """Take no part in the odometry."""

    def unused(self, streams: Mapping[str, Stream]) -> None:
        """Count nothing more than its stream does."""

    @property
    def seen(self) -> Mask | None:
        """The pixels (H, W) that the camera sees, if any are hidden."""
        return self._unwrap.seen(self._size)

    def place(self, bag: Bag, odometry_topic: str) -> complex | None:
        """The place of the camera, ahead + i left, m, if the bag contains it."""
        return lever_arm(bag, self._topic, odometry_topic)

    def panorama(self, image: Image) -> Image:
        """The panorama of an image. Raises LocalizationError."""
        size = image.shape[0], image.shape[1]
        if looks_like_panorama(*size):
            if not self._kept:
                self._unwrap = self._unwrap.keeping_size(size)
            elif size != self._kept[:2]:
                height, width = self._kept[:2]
                raise MessageError(f'size is not {width}x{height} like the first image')
        panorama = self._unwrap(image)
        self._size = size
        self._kept = self._kept or panorama.shape
        return panorama


class _SeveralCameras:
    """The images of several cameras of a bag, by their topics, and the panoramas of all."""

    def __init__(self, bag: Bag, recipe: ReadingRecipe, topics: Mapping[str, str]) -> None:
        camera = recipe.camera
        self._surround = Surround(recipe.surround, recipe.panorama, camera.blind_sectors, PATIENCE)
        self._surround.check()
        self._compares = not recipe.distinct  # in training yaws are measured beforehand
        self._topics = topics
        self.total = max(bag.topics[topic].count for topic in topics.values())

    def streams(self, bag: Bag, convert: Callable[[Any], Any]) -> dict[str, Stream]:
        """The stream of panoramas, and those of the cameras, by their uses."""
        joined = SurroundStream(bag, self._topics, self._surround, convert)
        cameras = {f'images of {name}': stream for name, stream in joined.cameras.items()}
        return {'images': joined.panoramas, **cameras}

    def follow(self, odometry: Stream) -> None:
        """Correct the different times of images by the odometry, and compare cameras by it."""
        odometry.passes = functools.partial(self._turned, odometry)

    def _turned(self, odometry: Stream, item: Item) -> list[Used]:
        pose, twist = item.value
        if twist is not None:
            self._surround.add_turn_rate(item.stamp_ns, float(twist[1]))
        if pose is not None and self._compares:
            self._surround.add_pose(item.stamp_ns, np.array(pose))
        return [(odometry, item.stamp_ns, item.value)]

    def unused(self, streams: Mapping[str, Stream]) -> None:
        """Count the images of cameras that no panorama shows."""
        for name, reasons in self._surround.unused.items():
            if stream := streams.get(f'images of {name}'):
                stream.used -= sum(reasons.values())
                for reason, number in reasons.items():
                    stream.skipped.add(reason, number)

    @property
    def seen(self) -> Mask | None:
        """The pixels (H, W) that most panoramas show, if any are hidden."""
        return self._surround.seen

    def place(self, bag: Bag, odometry_topic: str) -> complex:
        """The place of the panoramas, ahead + i left, m."""
        return self._surround.place

    @property
    def lacking(self) -> str:
        """What is wrong with cameras for too long, as on panorama/troubles."""
        return '; '.join(self._surround.problems)

    def panorama(self, images: Joined) -> Image:
        """The panorama of the images of one time. Raises CameraError."""
        panorama = self._surround.compose(images)
        self._surround.finish()
        return panorama


def _images_of(bag: Bag, recipe: ReadingRecipe) -> _OneCamera | _SeveralCameras:
    """The camera of a bag, or its several cameras if the recipe has some. Raises BagError."""
    named = recipe.topics.image
    topics = topics_like(bag, named, recipe.surround) if recipe.surround else {}
    return _SeveralCameras(bag, recipe, topics) if topics else _OneCamera(bag, recipe)


class _PanoramaFile:
    """Makes panoramas of images of a bag, and stores them in a temporary file; `distinct` ones
    only, where that is wanted.
    """

    def __init__(self, folder: Path, images: _OneCamera | _SeveralCameras, distinct: bool) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - as long as the run
        self.images = images
        self._watch = FrozenWatch() if distinct else None
        self.repeats = 0
        self.lacking: list[str] = []
        self._shape: tuple[int, ...] = ()

    def panorama(self, images: Any) -> tuple[Image, str]:
        """The panorama of an image, or of the images of one time, and which cameras it has lacked
        for too long. Raises LocalizationError.
        """
        panorama = self.images.panorama(images)
        if self._watch is not None and not self._watch.add(panorama):
            self.repeats += 1
            raise MessageError('image repeats the one before')
        self._shape = panorama.shape
        return panorama, self.images.lacking

    def add(self, image: Image, lacking: str) -> None:
        """Append a panorama."""
        self._file.write(np.ascontiguousarray(image).data)
        self.lacking.append(lacking)

    def finish(self, stamps_ns: Stamps, keep: NDArray[np.bool_]) -> PanoramaArray:
        """The panoramas marked in `keep` (N,), moved to the beginning of the file."""
        self._file.flush()
        images = np.memmap(self._file, np.uint8, 'r+', shape=(len(keep), *self._shape))
        kept = np.flatnonzero(keep)
        for target, source in enumerate(kept):
            images[target] = images[source]
        self.lacking = [self.lacking[number] for number in kept]
        return PanoramaArray(stamps_ns[kept], images[: len(kept)], self._file)


def _other_streams(bag: Bag, recipe: ReadingRecipe, want_truth: bool) -> dict[str, Stream]:
    """The other topics of a run, by their use."""
    topics = recipe.topics
    name = bag.find('odometry', topics.odometry)
    streams = {'odometry': bag.stream(name, decoding.odometry_of)}
    silent = [topic.name for topic in bag.topics.values() if topic.kind == decoding.IMU]
    if bag.has('imu', topics.imu):
        name = bag.find('imu', topics.imu)
        streams['imu'] = bag.stream(name, read_yaw_rate, required=bool(topics.imu))
    elif silent:
        names = ', '.join(silent)
        logger.warning('%s: no message on %s: continuing without gyroscope', bag.path, names)
    if recipe.camera.level_by_imu:
        streams['orientation'] = bag.stream(bag.find('imu', topics.imu), read_tilt)
    if topics.points_topic:
        name = bag.find('points_topic', topics.points_topic)
        streams['points'] = bag.stream(name, decoding.place_of)
    if want_truth:
        name = bag.find('ground_truth', topics.ground_truth)
        streams['ground_truth'] = bag.stream(name, decoding.true_pose_of)
    return streams


def _collect(bag: Bag, streams: dict[str, Stream], stored: _PanoramaFile, progress: bool) -> None:
    """Store the images, and read the values of all streams. Raises BagError for the images of a
    frozen camera.
    """
    images = streams['images']
    total = stored.images.total
    with progress_bar(f'read {bag.path.name}', total, visible=progress) as bar:

        def keep(panorama: tuple[Image, str]) -> None:
            stored.add(*panorama)
            bar.update(images.received - bar.n)

        images.keep = keep
        bag.collect(stream for stream in streams.values() if stream.topic in bag.topics)
    stored.images.unused(streams)
    if text := frozen(stored.repeats, stored.repeats + len(images.values)):
        raise BagError(f'{bag.path}: {images.topic}: {text}')


def _covered(
    streams: dict[str, Stream], stored: _PanoramaFile, path: Trajectory, recipe: ReadingRecipe
) -> Panoramas:
    """The panoramas near the odometry, leveled where that is wanted; the others are counted.

    Raises BagError where no image has odometry, and where none can be leveled.
    """
    images = streams['images']
    near_s = recipe.odometry_tolerance_s
    stamps_ns = stamps_of(images.values)
    covered = path.covers(stamps_ns, int(near_s * 1e9))
    lost = int(np.count_nonzero(~covered))
    near = f'within {near_s:g} s' if near_s else 'before and after'
    if lost:
        images.skipped.add(f'no odometry {near}', lost)
    images.used -= lost
    if not covered.any():
        raise BagError(
            f'{images.bag}: none of {lost} images of {images.topic} has odometry {near}; '
            'are both stamped by one clock (stamp_source: receive)?'
        )
    panoramas = stored.finish(stamps_ns, covered)
    imu = streams.get('orientation')
    return _leveled(panoramas, imu, recipe.panorama.sphere) if imu else panoramas


def _leveled(panoramas: Panoramas, imu: Stream, sphere: Sphere) -> Panoramas:
    """The panoramas as omnicam_node levels them. Raises BagError where none can be leveled."""
    measured = np.array([tilt for _, tilt in imu.values])
    image_tilts = tilts_at(panoramas.stamps_ns, stamps_of(imu.values), measured)
    lost = int(np.isnan(image_tilts).any(axis=1).sum())
    missing = f'{imu.bag}: {imu.topic} has no orientation near {lost} of {len(panoramas)} images'
    if lost == len(panoramas):
        raise BagError(f'{missing}: are both stamped by one clock (stamp_source: receive)?')
    if lost:
        logger.warning('%s: these are not leveled', missing)
    return LeveledPanoramas.of(panoramas, np.nan_to_num(image_tilts), sphere)


def images_at(bag: Path, stamps_ns: Collection[int], recipe: ReadingRecipe) -> dict[int, Image]:
    """Images (H, W, 3) of a bag, or panoramas of its several cameras, by stamps within a
    millisecond of theirs. Raises BagError.
    """
    images: dict[int, Image] = {}
    with Bag(bag, config=recipe.bag) as opened:
        for stamp_ns, image in _near(opened, stamps_ns, recipe) if stamps_ns else ():
            images |= {at: image for at in stamps_ns if abs(at - stamp_ns) <= _SAME_IMAGE_NS}
            if len(images) == len(stamps_ns):
                break
    return images


def _near(
    bag: Bag, stamps_ns: Collection[int], recipe: ReadingRecipe
) -> Iterator[tuple[int, Image]]:
    """Stamps and images, or panoramas of several cameras near the given stamps."""
    images = _images_of(bag, recipe)
    if isinstance(images, _OneCamera):
        yield from bag.images(recipe.topics.image)
        return
    panoramas, *cameras = images.streams(bag, images.panorama).values()
    wanted = np.array([*stamps_ns], np.int64)
    for camera in cameras:
        camera.wanted = lambda at: bool(np.abs(wanted - at).min() < _WARM_UP_NS)
    for stream, stamp_ns, image in bag.read(cameras):
        if stream is panoramas:
            yield stamp_ns, image
