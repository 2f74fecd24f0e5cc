# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""For programs in Python: recorded drives as arrays, and panoramas of raw images."""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path

from sfa_localization.bags.drives import ReadingRecipe, as_live, read_drive
from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.data.run import Image, Run
from sfa_localization.place_model import PlaceModel


def read_bag(
    path: Path | str,
    model: PlaceModel | None = None,
    *,
    image_topic: str = '',
    odom_topic: str = '',
    imu_topic: str = '',
    ground_truth_topic: str = '',
    truth: bool = False,
) -> Run:
    """Read a bag of ROS 1 or ROS 2, without ROS, as arrays.

    Of the result, `panoramas.stamps_ns` (N,) are the stamps of the images, and
    `panoramas.read(start, stop)` are images (stop - start, H, W, 3) uint8 BGR;
    `odometry.stamps_ns` (M,), `odometry.poses` (M, 3) x m, y m, yaw rad, and `odometry.twists`
    (M, 2) m/s, rad/s are those of the wheels; `yaw_rate` is that of a gyroscope or None; with
    `truth`, `ground_truth.stamps_ns` (K,) and `ground_truth.poses` (K, 3) are the true poses.
    Images that are no panoramas become panoramas by the lens of the `model`. Topics are found by
    their types, or named.

    Raises BagError for a bag or topic that cannot be read, and CameraError for images of an unknown
    lens.
    """
    topics = TopicNames(
        image=image_topic, odometry=odom_topic, imu=imu_topic, ground_truth=ground_truth_topic
    )
    recipe = ReadingRecipe(topics)
    if model is not None:
        recipe = as_live(recipe, model.panorama, model.lens)
    return read_drive(path, Path(tempfile.gettempdir()), recipe, want_truth=truth)


def panorama(image: Image, model: PlaceModel) -> Image:
    """The panorama (H, W, 3) uint8 BGR that the model locates, of an image (rows, columns, 3) uint8
    BGR of the camera with which it was trained.

    Raises CameraError for anything else, also where the model was trained on recorded panoramas.
    """
    return _unwrapper(model.panorama, model.lens)(image)


@lru_cache(maxsize=8)
def _unwrapper(size: PanoramaConfig, lens: LensCalibration | None) -> Unwrapper:
    """The tables of a camera, which take a second to make."""
    return Unwrapper(CameraConfig(), size, lens)
