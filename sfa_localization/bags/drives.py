# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Read the drives of a training or evaluation as runs, by a recipe: topics, camera, panorama."""

from __future__ import annotations

import fcntl
import glob
import logging
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sfa_localization.bags.reader import Bag
from sfa_localization.bags.run_loader import ODOMETRY_TOLERANCE_S, load_run
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.data.errors import DataError, ModelError
from sfa_localization.data.files import replaced_mode
from sfa_localization.data.progress import progress_bar
from sfa_localization.data.run import Image, Run

SAME_IMAGE_NS = 1_000_000
"""Stamps this near to each other are those of one image: no camera takes a thousand a second."""
_LOCK = 'lock'
logger = logging.getLogger(__name__)
R = TypeVar('R', bound='ReadingRecipe')


@dataclass(frozen=True, slots=True)
class ReadingRecipe:
    """Everything that decides how a bag becomes a run of panoramas."""

    topics: TopicNames = field(default_factory=TopicNames)
    bag: BagConfig = field(default_factory=BagConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    panorama: PanoramaConfig = field(default_factory=PanoramaConfig)


@contextmanager
def image_cache(output: Path) -> Iterator[Path]:
    """A folder beside `output` for decoded images; also clears those that killed runs left.

    Raises ModelError when it cannot be made, or `output` not be written in the end.
    """
    name = f'.{output.name}.cache-'
    try:
        replaced_mode(output)
        output.parent.mkdir(parents=True, exist_ok=True)
        for stale in output.parent.glob(f'{glob.escape(name)}*'):
            _clear_unused(stale)
        folder = Path(tempfile.mkdtemp(prefix=name, dir=output.parent))
        lock = _lock(folder, os.O_CREAT)
    except OSError as error:
        raise ModelError(f'{output}: cannot be written: {error.strerror or error}') from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _lock(folder: Path, flags: int = 0) -> int:
    """A handle that locks the folder until it is closed, or its process ends.

    Raises OSError where another process has it.
    """
    handle = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | flags, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise
    return handle


def _clear_unused(folder: Path) -> None:
    """Remove a cache whose process has ended; one without a lock is just being made."""
    try:
        lock = _lock(folder)
    except OSError:
        return
    shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)


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
    runs = tuple(
        read_drive(bag, cache, recipe, progress, strict=strict, distinct=True) for bag in bags
    )
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
    bag: Path,
    cache: Path,
    recipe: ReadingRecipe,
    progress: bool = False,
    *,
    want_truth: bool = False,
    strict: bool = False,
    odometry_tolerance_s: float = ODOMETRY_TOLERANCE_S,
    distinct: bool = False,
) -> Run:
    """Read one bag as a run of panoramas; raw camera images are unwrapped. Raises BagError."""
    with progress_bar(f'read {Path(bag).name}', shown=progress) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return load_run(
            bag,
            topics=recipe.topics,
            unwrap=Unwrapper(recipe.camera, recipe.panorama),
            cache=cache,
            progress=show,
            want_truth=want_truth,
            strict=strict,
            config=recipe.bag,
            odometry_tolerance_s=odometry_tolerance_s,
            distinct=distinct,
        )


def images_at(bag: Path, stamps_ns: Collection[int], recipe: ReadingRecipe) -> dict[int, Image]:
    """The camera's images (H, W, 3) of a bag at some stamps, by these stamps.

    Those that are not within SAME_IMAGE_NS of an image are left out. Raises BagError.
    """
    wanted = sorted(stamps_ns)
    found: dict[int, Image] = {}
    if not wanted:
        return {}
    with Bag(bag, config=recipe.bag) as opened:
        for stamp_ns, image in opened.images(recipe.topics.image):
            found |= {at: image for at in wanted if abs(at - stamp_ns) <= SAME_IMAGE_NS}
            if len(found) == len(wanted):
                break
    return found


def as_live(recipe: R, panorama: PanoramaConfig) -> R:
    """The recipe to read a drive with a model's panorama, as the nodes do.

    Read it with `odometry_tolerance_s` 0: training leaves out images far from any odometry, but
    the filter fuses them too.
    """
    return replace(recipe, panorama=panorama)
