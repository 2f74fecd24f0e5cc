# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras around the robot in a bag, and their yaws by its images and odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sfa_localization.bags import decoding
from sfa_localization.bags.drives import ReadingRecipe
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.surround_topics import PATIENCE, SurroundStream, cameras_of, topics_like
from sfa_localization.bags.topic_stream import clock_offset
from sfa_localization.camera.joining import Joined
from sfa_localization.camera.lens_report import fitting_panorama
from sfa_localization.camera.sectors import visible_elevations
from sfa_localization.camera.surround import Surround
from sfa_localization.camera.yaws import Shown, YawComparison, Yaws, pairs
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array
from sfa_localization.data.progress import progress_over
from sfa_localization.data.run import Image

R = TypeVar('R', bound=ReadingRecipe)
TITLE = 'compare the cameras'


def with_cameras(bag: Path, recipe: R) -> R:
    """The recipe with the cameras around the robot whose images a bag has on several topics, and
    the elevations that they see; the same for one camera. Raises BagError.
    """
    with Bag(bag, config=recipe.bag) as opened:
        odometry = opened.find('odometry', recipe.topics.odometry)
        cameras = cameras_of(opened, recipe.topics.image, odometry)
    if not cameras:
        return recipe
    camera = recipe.camera
    if camera.is_described or camera.mask_file or any(camera.mount_rpy):
        raise CameraError(
            f'{bag}: camera_model, calibration_file, mount_rpy and mask_file are of one camera: '
            'leave them out, as several have camera_info and /tf_static; blind_sectors hide parts'
        )
    panorama = fitting_panorama(recipe.panorama, visible_elevations(cameras))
    return replace(recipe, surround=cameras, panorama=panorama)


def yaws_of(bag: Path, recipe: ReadingRecipe, progress: bool = False) -> Yaws:
    """How the cameras of a recipe are turned in a drive; only the images of pairs are decoded.

    Nothing is known where it has only panoramas. Raises BagError for a bag without their images or
    odometry.
    """
    with Bag(bag, config=recipe.bag) as opened:
        if not topics_like(opened, recipe.topics.image, recipe.surround):
            return Yaws({})
    comparison = YawComparison(recipe.surround, recipe.panorama)
    times, poses = _times(bag, recipe)
    stamps_ns = np.array([joined.stamp_ns for joined in times])
    chosen = pairs(stamps_ns, poses)
    shown = _shown(bag, recipe, times, poses, chosen, comparison, progress)
    fit = [(one, other) for one, other in chosen if one in shown and other in shown]
    sightings = [
        sighting
        for number, (one, other) in enumerate(fit)
        for sighting in comparison.sightings(number, shown[one], shown[other])
    ]
    return comparison.fit(sightings)


def first_panorama(bag: Path, recipe: ReadingRecipe) -> tuple[Image, Surround]:
    """The first panorama of the cameras of a recipe, and what made it. Raises BagError."""
    with Bag(bag, config=recipe.bag) as opened:
        topics = topics_like(opened, recipe.topics.image, recipe.surround)
        around = Surround(recipe.surround, recipe.panorama, recipe.camera.blind_sectors, PATIENCE)
        stream = SurroundStream(opened, topics, around, around.compose)
        read = opened.read(stream.cameras.values())
        return next((image, around) for used, _, image in read if used is stream.panoramas)


def _times(bag: Path, recipe: ReadingRecipe) -> tuple[list[Joined], Array]:
    """The stamps of the images of one time, without the images, and the poses (N, 3) then."""
    with Bag(bag, config=recipe.bag) as opened:
        topics = topics_like(opened, recipe.topics.image, recipe.surround)
        around = Surround(recipe.surround, recipe.panorama, patience=PATIENCE)
        stream = SurroundStream(opened, topics, around, lambda joined: joined)
        for camera in stream.cameras.values():
            camera.images = None
            camera.convert = lambda message: None
        odometry = opened.stream(
            opened.find('odometry', recipe.topics.odometry), decoding.odometry_of
        )
        times = []
        for read, stamp_ns, value in opened.read([*stream.cameras.values(), odometry]):
            if read is stream.panoramas:
                times.append(value)
            elif read is odometry:
                odometry.values.append((stamp_ns, value))
        path = opened.to_odometry(odometry, odometry.values).trajectory
        ahead_ns, _ = clock_offset('images', stream.panoramas, odometry)
    stamps_ns = np.array([joined.stamp_ns for joined in times], np.int64) - ahead_ns
    return times, path.at(stamps_ns)


def _shown(
    bag: Path,
    recipe: ReadingRecipe,
    times: Sequence[Joined],
    poses: Array,
    chosen: Sequence[tuple[int, int]],
    comparison: YawComparison,
    progress: bool,
) -> dict[int, Shown]:
    """What the cameras show at the chosen times, by their numbers."""
    numbers = sorted({number for pair in chosen for number in pair})
    wanted = {
        (name, at): number for number in numbers for name, (at, _) in times[number].images.items()
    }
    missing = {number: len(times[number].images) for number in numbers}
    images: dict[int, dict[str, Image]] = {number: {} for number in numbers}
    shown = {}
    with Bag(bag, config=recipe.bag) as opened:
        names = {}
        streams = []
        for name, topic in topics_like(opened, recipe.topics.image, recipe.surround).items():
            stream = opened.stream(topic, lambda image: image, required=False)
            stream.wanted = {at for of, at in wanted if of == name}.__contains__
            names[stream.topic] = name
            streams.append(stream)
        read = opened.read(streams) if wanted else iter(())
        for stream, at, image in progress_over(read, TITLE, len(wanted), visible=progress):
            number = wanted.get((names[stream.topic], at))
            if number is None:
                continue
            images[number][names[stream.topic]] = image
            if len(images[number]) == missing[number]:
                shown[number] = comparison.shown(poses[number], images.pop(number))
    return shown
