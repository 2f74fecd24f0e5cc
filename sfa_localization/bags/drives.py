# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Read drives as runs by a recipe: panoramas on disk, joined to odometry, each bag in one pass."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfa_localization.bags import decoding
from sfa_localization.bags.motion_arrays import StampedValues, to_points, to_trajectory, to_yaw_rate
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.static_transforms import camera_place
from sfa_localization.bags.topic_stream import Stream
from sfa_localization.camera.leveling import LeveledPanoramas, tilts_at
from sfa_localization.camera.panorama import Unwrapper, looks_like_panorama
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.camera.watch import FrozenWatch
from sfa_localization.data.errors import BagError, DataError, MessageError, ModelError
from sfa_localization.data.files import replaced_mode
from sfa_localization.data.messages import read_tilt, read_yaw_rate
from sfa_localization.data.progress import progress_bar
from sfa_localization.data.run import Image, PanoramaArray, Panoramas, Run, Stamps
from sfa_localization.data.sphere import Sphere

ODOMETRY_TOLERANCE_S = 0.5
"""An image is used when odometry lies this near on both sides (s): interpolating over a longer
pause would invent a path."""
SAME_IMAGE_NS = 1_000_000
"""Stamps this near to each other are those of one image: no camera takes a thousand a second."""
logger = logging.getLogger(__name__)
R = TypeVar('R', bound='ReadingRecipe')


@dataclass(frozen=True, slots=True)
class ReadingRecipe:
    """Everything that decides how a bag becomes a run of panoramas.

    Images farther than `odometry_tolerance_s` from odometry (0: outside all of it) are left out;
    where only `distinct` ones are wanted, also those that repeat the one before, which was taken
    elsewhere.
    """

    topics: TopicNames = field(default_factory=TopicNames)
    bag: BagConfig = field(default_factory=BagConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    panorama: PanoramaConfig = field(default_factory=PanoramaConfig)
    odometry_tolerance_s: float = ODOMETRY_TOLERANCE_S
    distinct: bool = False


def as_live(recipe: R, panorama: PanoramaConfig) -> R:
    """The recipe to read a drive with a model's panorama, as the nodes do: the filter also fuses
    images far from any odometry.
    """
    topics = replace(recipe.topics, points_topic='')
    return replace(recipe, topics=topics, panorama=panorama, odometry_tolerance_s=0.0)


def image_folder(output: Path) -> Path:
    """The folder of `output`, for decoded images: files without a name, gone with their process.

    Raises ModelError where `output` could not be written in the end.
    """
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
    """Read different drives to learn from, with panoramas of one size.

    Images that repeat the one before are left out. Raises BagError or DataError.
    """
    distinct = replace(recipe, distinct=True)
    runs = tuple(read_drive(bag, cache, distinct, progress, strict=strict) for bag in bags)
    for k, run in enumerate(runs):
        for other in runs[:k]:
            if _same_recording(run, other):
                raise DataError(
                    f'{bags[k]}: the same drive as {other.name}: name each drive once, because a '
                    'part that is left out to check the map must not be learned from its copy'
                )
    if len({run.panoramas.shape for run in runs}) > 1:
        sizes = ', '.join(f'{r.name}: {r.panoramas.shape[1]}x{r.panoramas.shape[0]}' for r in runs)
        raise DataError(f'the bags hold panoramas of different sizes ({sizes}): train on one size')
    _compare_size(runs[0], recipe.panorama)
    return runs


def _compare_size(run: Run, asked: PanoramaConfig) -> None:
    """Say where panoramas were recorded, so that a size that was asked for has no effect."""
    height, width, _ = run.panoramas.shape
    usual = PanoramaConfig()
    if (asked.width, asked.height) not in {(width, height), (usual.width, usual.height)}:
        logger.warning(
            '%s: its panoramas are %dx%d and stay so: width and height (%dx%d) are for images of '
            'a camera', run.name, width, height, asked.width, asked.height,
        )  # fmt: skip


def _same_recording(run: Run, other: Run) -> bool:
    """Whether all stamps and the image in the middle are equal."""
    if not np.array_equal(run.panoramas.stamps_ns, other.panoramas.stamps_ns):
        return False
    middle = len(run.panoramas) // 2
    one, two = (drive.panoramas.read(middle, middle + 1) for drive in (run, other))
    return np.array_equal(one, two)


def read_drive(
    path: Path | str,
    cache: Path,
    recipe: ReadingRecipe | None = None,
    progress: bool = False,
    *,
    want_truth: bool = False,
    strict: bool = False,
) -> Run:
    """Read one bag in one pass; camera images are unwrapped to panoramas, and lie in `cache`.

    Without `want_truth` no topic of true poses is even opened. Images of another size than the
    first are skipped and counted. Raises BagError.
    """
    recipe = recipe or ReadingRecipe()
    with Bag(path, strict=strict, config=recipe.bag) as bag:
        name = bag.find('image', recipe.topics.image)
        try:
            stored = _Images(Path(cache), recipe)
            streams = {'images': bag.stream(name, stored.panorama)}
            streams |= _other_streams(bag, recipe, want_truth)
            values = _read(bag, streams, stored, progress)
            odometry = bag.to_odometry(streams['odometry'], values['odometry'])
            stamps_ns, near_s = np.array(stored.stamps, np.int64), recipe.odometry_tolerance_s
            covered = odometry.trajectory.covers(stamps_ns, int(near_s * 1e9))
            _require_covered(streams['images'], covered, near_s)
            panoramas: Panoramas = stored.finish(stamps_ns, covered)
            if recipe.camera.level_by_imu:
                by, tilts = streams['orientation'], values['orientation']
                panoramas = _leveled(panoramas, by, tilts, recipe.panorama.sphere)
        except OSError as error:
            raise BagError(f'{cache}: no space for the images: {error.strerror}') from None
        camera = camera_place(bag, name, streams['odometry'].topic)
    for problem in bag.problems:
        logger.warning('%s: %s', path, problem)
    counts = {use: stream.count for use, stream in streams.items()}
    yaw_rate = to_yaw_rate(values['imu']) if values.get('imu') else None
    truth = to_trajectory(values['ground_truth']) if values.get('ground_truth') else None
    points = to_points(values['points']) if values.get('points') else None
    return Run(bag.path.name, panoramas, odometry, yaw_rate, truth, points, counts, camera)


class _Images:
    """Makes panoramas of one size, and stores them in a file without a name."""

    def __init__(self, folder: Path, recipe: ReadingRecipe) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - as long as the run
        self._unwrap = Unwrapper(recipe.camera, recipe.panorama)
        self._watch = FrozenWatch() if recipe.distinct else None
        self.stamps: list[int] = []
        self._shape: tuple[int, ...] = ()

    def panorama(self, message: Any) -> Image:
        """The panorama of a message. Raises LocalizationError."""
        image = decoding.image_of(message)
        if not looks_like_panorama(*image.shape[:2]):
            image = self._unwrap(image)
        if self._watch is not None and not self._watch.add(image):
            raise MessageError('image repeats the one before')
        self._shape = self._shape or image.shape
        if image.shape != self._shape:
            height, width = self._shape[:2]
            raise MessageError(f'size is not {width}x{height} like the first image')
        return image

    def add(self, stamp_ns: int, image: Image) -> None:
        """Append a panorama."""
        self._file.write(np.ascontiguousarray(image).data)
        self.stamps.append(stamp_ns)

    def finish(self, stamps_ns: Stamps, keep: NDArray[np.bool_]) -> PanoramaArray:
        """The panoramas marked in `keep` (N,), moved to the beginning of the file."""
        self._file.flush()
        images = np.memmap(self._file, np.uint8, 'r+', shape=(len(keep), *self._shape))
        kept = np.flatnonzero(keep)
        for target, source in enumerate(kept):
            if target != source:
                images[target] = images[source]
        return PanoramaArray(stamps_ns[kept], images[: len(kept)], self._file)


def _other_streams(bag: Bag, recipe: ReadingRecipe, want_truth: bool) -> dict[str, Stream]:
    """The topics beside the images that make a run, by their use."""
    topics = recipe.topics
    name = bag.find('odometry', topics.odometry)
    streams = {'odometry': bag.stream(name, decoding.odometry_of)}
    gyroscopes = [topic for topic in bag.topics.values() if topic.kind == decoding.IMU]
    if topics.imu or any(topic.count for topic in gyroscopes):
        streams['imu'] = bag.stream(bag.find('imu', topics.imu), read_yaw_rate)
        streams['imu'].required = bool(topics.imu)
    elif gyroscopes:
        names = ', '.join(topic.name for topic in gyroscopes)
        logger.warning('%s: no message on %s: continuing without gyroscope', bag.path, names)
    if recipe.camera.level_by_imu:
        streams['orientation'] = bag.stream(bag.find('imu', topics.imu), read_tilt)
    if topics.points_topic:
        name = bag.find('points_topic', topics.points_topic)
        streams['points'] = bag.stream(name, decoding.place_of)
    if want_truth:
        name = bag.find('ground_truth', topics.ground_truth)
        streams['ground_truth'] = bag.stream(name, decoding.pose_of)
    return streams


def _read(
    bag: Bag, streams: dict[str, Stream], stored: _Images, progress: bool
) -> dict[str, StampedValues]:
    """Store the images; return the values of the other streams by their use."""
    uses = {id(stream): use for use, stream in streams.items()}
    values: dict[str, StampedValues] = {use: [] for use in streams}
    total = bag.topics[streams['images'].topic].count
    with progress_bar(f'read {bag.path.name}', total, shown=progress) as bar:
        for stream, stamp_ns, value in bag.read(streams.values()):
            if stream is streams['images']:
                stored.add(stamp_ns, value)
                bar.update(stream.received - bar.n)
            else:
                values[uses[id(stream)]].append((stamp_ns, value))
    return values


def _leveled(panoramas: Panoramas, by: Stream, tilts: StampedValues, sphere: Sphere) -> Panoramas:
    """The panoramas as omnicam_node levels them. Raises BagError where none can be leveled."""
    stamps, known = (np.array(part) for part in zip(*sorted(tilts), strict=True))
    found = tilts_at(panoramas.stamps_ns, stamps, known)
    lost = int(np.isnan(found).any(axis=1).sum())
    missing = f'{by.bag}: {by.topic} has no orientation near {lost} of {len(panoramas)} images'
    if lost == len(panoramas):
        raise BagError(f'{missing}: are both stamped by one clock (stamp_source: receive)?')
    if lost:
        logger.warning('%s: they are not leveled by it', missing)
    return LeveledPanoramas(panoramas, np.nan_to_num(found), sphere)


def _require_covered(images: Stream, covered: NDArray[np.bool_], near_s: float) -> None:
    """Count the images without odometry. Raises BagError where none has some."""
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


def images_at(bag: Path, stamps_ns: Collection[int], recipe: ReadingRecipe) -> dict[int, Image]:
    """The camera's images (H, W, 3) of a bag at some stamps, by these stamps.

    Those that are not within SAME_IMAGE_NS of an image are left out. Raises BagError.
    """
    found: dict[int, Image] = {}
    with Bag(bag, config=recipe.bag) as opened:
        for stamp_ns, image in opened.images(recipe.topics.image) if stamps_ns else ():
            found |= {at: image for at in stamps_ns if abs(at - stamp_ns) <= SAME_IMAGE_NS}
            if len(found) == len(stamps_ns):
                break
    return found
