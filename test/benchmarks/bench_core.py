# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Time of `locate()` and of a filter step on one core: `python bench_core.py MODEL.npz BAG`."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from sfa_localization.bags.drives import read_drive
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.place_model import PlaceModel

START_NS, STEP_NS = 1_700_000_000_000_000_000, 20_000_000
SPEED, TURN_RATE, VARIANCES = 0.8, 0.3, (4e-4, 1e-4)
"""Odometry (m/s, rad/s) of a circle."""
COVARIANCE = np.diag([0.04, 0.04, 0.0025])
"""Of the pose of each image."""


def images_and_poses(bag: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the panoramas (N, H, W, 3) of a bag, and the poses (N, 3) of the odometry there."""
    with tempfile.TemporaryDirectory() as folder:
        run = read_drive(bag, Path(folder))
        images = np.array(run.panoramas.read(0, len(run.panoramas)))
    return images, run.odometry.trajectory.at(run.panoramas.stamps_ns)


def locate_ms(model: PlaceModel, images: np.ndarray) -> float:
    """Return the median CPU time of `locate()`, in ms."""
    times = []
    with one_core():
        for image in images:
            start = time.thread_time()
            model.locate(image)
            times.append(time.thread_time() - start)
    return 1e3 * float(np.median(times))


def filter_step_us(steps: int = 500, rounds: int = 5) -> float:
    """Return the CPU time of one odometry message and one image pose, in us; best of the rounds."""
    yaw = TURN_RATE * STEP_NS * 1e-9 * np.arange(1, steps + 1)
    circle = [np.sin(yaw), 1 - np.cos(yaw)] * np.array([[SPEED / TURN_RATE]])
    noise = np.random.default_rng(1).multivariate_normal(np.zeros(3), COVARIANCE / 4, steps)
    poses, times = np.vstack([circle, yaw]).T + noise, []
    for _ in range(rounds):
        fused = PoseFilter()
        fused.set_pose(START_NS, np.zeros(3), COVARIANCE)
        start = time.thread_time()
        for k, pose in enumerate(poses, 1):
            stamp_ns = START_NS + k * STEP_NS
            fused.add_odometry(stamp_ns, SPEED, TURN_RATE, VARIANCES)
            fused.add_measurement(stamp_ns, pose, COVARIANCE)
        times.append(time.thread_time() - start)
    return 1e6 * min(times) / steps


if __name__ == '__main__':
    model, bag = PlaceModel.load(Path(sys.argv[1])), Path(sys.argv[2])
    images, _ = images_and_poses(bag)
    print(json.dumps({'locate_ms': locate_ms(model, images), 'filter_step_us': filter_step_us()}))
