# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lens of a camera, learned from the images and the odometry of a bag."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from sfa_localization.bags import decoding
from sfa_localization.bags.drives import ReadingRecipe
from sfa_localization.bags.motion_arrays import stamps_of
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.topic_stream import clock_offset
from sfa_localization.camera.learned_lens import LearnedLens, learn_lens
from sfa_localization.camera.lens_guess import LensGuess
from sfa_localization.camera.panorama import looks_like_panorama
from sfa_localization.camera.point_tracks import PointTracker, Tracks, chosen_images
from sfa_localization.data.errors import CameraError
from sfa_localization.data.progress import progress_over
from sfa_localization.data.run import Image, Stamps, Trajectory
from sfa_localization.data.statistics import evenly

TITLE = 'learn the lens'
_SAMPLES = 16  # images from all over the drive: they show the rim, and what does not change


def lens_of(bag: Path, recipe: ReadingRecipe, progress: bool = False) -> LearnedLens | None:
    """The lens that the drive shows, whatever the recipe's camera; None for panoramas.

    Raises BagError for a bag without images or odometry, and CameraError naming the bag where the
    drive does not show the lens.
    """
    try:
        if _shows_panoramas(bag, recipe):
            return None
        stamps_ns, odometry = _stamps(bag, recipe)
        samples = _samples(bag, recipe, stamps_ns)
        guess = LensGuess.of(samples)
        stretches = chosen_images(stamps_ns, odometry)
        tracker = PointTracker(guess.cameras, samples)
        tracks = _tracks(bag, recipe, odometry, tracker, stretches, progress)
        return learn_lens(tracks, odometry, guess, samples)
    except CameraError as error:
        raise CameraError(f'{bag}: {error}') from None


def _shows_panoramas(bag: Path, recipe: ReadingRecipe) -> bool:
    """Whether the first image is one."""
    with Bag(bag, config=recipe.bag) as opened:
        shapes = (image.shape[:2] for _, image in opened.images(recipe.topics.image))
        return any(looks_like_panorama(*shape) for shape in islice(shapes, 1))


def _stamps(bag: Path, recipe: ReadingRecipe) -> tuple[Stamps, Trajectory]:
    """The stamps (N,) of the images, and the odometry by their clock."""
    with Bag(bag, config=recipe.bag) as opened:
        images = opened.stamps(opened.find('image', recipe.topics.image))
        name = opened.find('odometry', recipe.topics.odometry)
        odometry = opened.stream(name, decoding.odometry_of)
        opened.collect([images, odometry])
        path = opened.to_odometry(odometry, odometry.values).trajectory
        ahead_ns, _ = clock_offset('images', images, odometry)
        return stamps_of(images.values), Trajectory(path.stamps_ns + ahead_ns, path.poses)


def _samples(bag: Path, recipe: ReadingRecipe, stamps_ns: Stamps) -> list[Image]:
    """Images of one size from all over the drive."""
    wanted = set(stamps_ns[evenly(len(stamps_ns), _SAMPLES)].tolist())
    with Bag(bag, config=recipe.bag) as opened:
        images = [image for _, image in opened.images(recipe.topics.image, wanted.__contains__)]
    return [image for image in images if image.shape == images[0].shape]


def _tracks(
    bag: Path,
    recipe: ReadingRecipe,
    odometry: Trajectory,
    tracker: PointTracker,
    stretches: dict[int, int],
    progress: bool,
) -> Tracks:
    """The points in the images of `stretches`, numbers by stamp."""
    last = None
    with Bag(bag, config=recipe.bag) as opened:
        images = opened.images(recipe.topics.image, stretches.__contains__)
        for stamp_ns, image in progress_over(images, TITLE, len(stretches), visible=progress):
            if image.shape[:2] != tracker.size:
                continue
            if stretches[stamp_ns] != last:
                tracker.interrupt()
            last = stretches[stamp_ns]
            tracker.add(stamp_ns, image, odometry.at(np.array([stamp_ns]))[0])
    return tracker.tracks()
