# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Load a bag as a run: its panoramas on disk, joined to the odometry of the drive, in one pass."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.bags import decoding
from sfa_localization.bags.motion_arrays import StampedValues, to_trajectory, to_yaw_rate
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.bags.topic_stream import Stream
from sfa_localization.camera.panorama import looks_like_panorama
from sfa_localization.camera.watch import FrozenWatch
from sfa_localization.data.errors import BagError, MessageError
from sfa_localization.data.messages import read_yaw_rate
from sfa_localization.data.run import Image, Odometry, PanoramaArray, Run, Stamps

logger = logging.getLogger(__name__)
Unwrap = Callable[[Image], Image]
Progress = Callable[[int, int], None]
ODOMETRY_TOLERANCE_S = 0.5
"""An image is used when odometry lies this near on both sides (s): interpolating over a longer
pause would invent a path."""


def load_run(
    path: Path | str,
    *,
    topics: TopicNames | None = None,
    unwrap: Unwrap | None = None,
    cache: Path,
    progress: Progress | None = None,
    want_truth: bool = False,
    strict: bool = False,
    config: BagConfig | None = None,
    odometry_tolerance_s: float = ODOMETRY_TOLERANCE_S,
    distinct: bool = False,
) -> Run:
    """Read a drive in one pass; its images go to a file in the folder `cache`, which is yours.

    `unwrap` makes panoramas of images that are none yet. `progress` is called with the numbers of
    images (done, total). Without `want_truth` no topic of true poses is even opened. Images
    farther than `odometry_tolerance_s` from odometry (0: outside all of it), or of another size
    than the first, are skipped and counted; where only `distinct` ones are wanted, also those that
    repeat the one before, which was taken elsewhere. Raises BagError.
    """
    names = topics or TopicNames()
    with Bag(path, strict=strict, config=config) as bag:
        image_topic = bag.find('image', names.image)
        streams = _other_streams(bag, names, want_truth)
        try:
            with PanoramaFile(Path(cache), bag.path.name) as file:
                images = bag.stream(image_topic, _panorama_maker(file, unwrap, distinct))
                values = _read(bag, images, streams, file, progress)
                odometry = bag.to_odometry(streams['odometry'], values['odometry'])
                panoramas = _joined(bag, images, file, odometry, odometry_tolerance_s)
        except OSError as error:
            raise BagError(f'{cache}: no space for the images: {error.strerror}') from None
        for problem in bag.problems:
            logger.warning('%s: %s', path, problem)
    counts = {use: s.tally.count for use, s in {'images': images, **streams}.items()}
    yaw_rate = to_yaw_rate(values['imu']) if values.get('imu') else None
    truth = to_trajectory(values['ground_truth']) if values.get('ground_truth') else None
    return Run(bag.path.name, panoramas, odometry, yaw_rate, truth, counts)


class PanoramaFile:
    """Context manager that writes images of one size to a new file in `folder`.

    The file is removed when an error ends the block.
    """

    def __init__(self, folder: Path, name: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        handle, path = tempfile.mkstemp('.panoramas', f'{name}-', folder)
        self._file, self._path = os.fdopen(handle, 'wb'), Path(path)
        self._stamps: list[int] = []
        self._shape: tuple[int, ...] | None = None

    def __enter__(self) -> PanoramaFile:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._file.close()
        if kind is not None:
            self._path.unlink(missing_ok=True)

    @property
    def stamps_ns(self) -> Stamps:
        """Stamps of the images so far."""
        return np.array(self._stamps, np.int64)

    def check_size(self, image: Image) -> Image:
        """The image itself. Raises MessageError when its size is not that of the first."""
        self._shape = self._shape or image.shape
        if image.shape != self._shape:
            height, width = self._shape[:2]
            raise MessageError(f'size is not {width}x{height} like the first image')
        return image

    def add(self, stamp_ns: int, image: Image) -> None:
        """Append an image of that size."""
        self._file.write(np.ascontiguousarray(image).data)
        self._stamps.append(stamp_ns)

    def finish(self, keep: NDArray[np.bool_]) -> PanoramaArray:
        """The images marked in `keep` (N,), memory-mapped; the file shrinks to them."""
        self._file.close()
        shape = (len(self._stamps), *(self._shape or ()))
        kept = np.flatnonzero(keep)
        images = np.memmap(self._path, np.uint8, 'r+', shape=shape)
        for target, source in enumerate(kept):
            if target != source:
                images[target] = images[source]
        images.flush()
        size = images[:1].nbytes * len(kept)
        del images
        os.truncate(self._path, size)
        mapped = np.memmap(self._path, np.uint8, 'r', shape=(len(kept), *shape[1:]))
        return PanoramaArray(self.stamps_ns[kept], mapped)


def _other_streams(bag: Bag, topics: TopicNames, want_truth: bool) -> dict[str, Stream]:
    """The topics beside the images that make a run, by their use."""
    streams = {'odometry': bag.odometry_stream(topics.odometry)}
    if topics.imu or _has_imu(bag):
        streams['imu'] = bag.stream(bag.find('imu', topics.imu), read_yaw_rate)
        streams['imu'].required = bool(topics.imu)
    if want_truth:
        name = bag.find('ground_truth', topics.ground_truth)
        streams['ground_truth'] = bag.stream(name, decoding.pose_of)
    return streams


def _has_imu(bag: Bag) -> bool:
    """Whether a gyroscope was recorded; topics that are all empty are only warned of."""
    found = [topic for topic in bag.topics.values() if topic.kind == decoding.IMU]
    if found and not any(topic.count for topic in found):
        names = ', '.join(topic.name for topic in found)
        logger.warning('%s: no message on %s: continuing without gyroscope', bag.path, names)
        return False
    return bool(found)


def _panorama_maker(
    file: PanoramaFile, unwrap: Unwrap | None, distinct: bool
) -> Callable[[Any], Image]:
    """What makes panoramas of one size of messages; it raises LocalizationError."""
    watch = FrozenWatch() if distinct else None

    def panorama(message: Any) -> Image:
        image = decoding.image_of(message)
        if unwrap is not None and not looks_like_panorama(*image.shape[:2]):
            image = unwrap(image)
        if watch is not None and not watch.add(image):
            raise MessageError('image repeats the one before')
        return file.check_size(image)

    return panorama


def _read(
    bag: Bag,
    images: Stream,
    streams: dict[str, Stream],
    file: PanoramaFile,
    progress: Progress | None,
) -> dict[str, StampedValues]:
    """Read all in one pass, the images into the file; return the values of the other streams."""
    values: dict[str, StampedValues] = {use: [] for use in streams}
    uses = {id(stream): use for use, stream in streams.items()}
    total = bag.topics[images.topic].count
    for stream, stamp_ns, value in bag.read([images, *streams.values()]):
        if stream is not images:
            values[uses[id(stream)]].append((stamp_ns, value))
            continue
        file.add(stamp_ns, value)
        if progress is not None:
            progress(images.received, total)
    return values


def _joined(
    bag: Bag, images: Stream, file: PanoramaFile, odometry: Odometry, tolerance_s: float
) -> PanoramaArray:
    """The images with odometry near enough on both sides. Raises BagError where none has."""
    keep = odometry.trajectory.covers(file.stamps_ns, int(tolerance_s * 1e9))
    lost = int(np.count_nonzero(~keep))
    near = f'within {tolerance_s:g} s' if tolerance_s else 'before and after'
    images.tally.withdraw(f'no odometry {near}', lost)
    if not keep.any():
        raise BagError(f'{bag.path}: none of {lost} images of {images.topic} has odometry {near}; '
                       'are both stamped by one clock (stamp_source: receive)?')  # fmt: skip
    return file.finish(keep)
