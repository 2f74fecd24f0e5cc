# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Time of `locate()` and of a filter step on one core: `python bench_core.py MODEL.npz BAG`.

`python bench_core.py --long` runs a million filter steps, and prints the covariance's least
eigenvalue and the growth of the memory.
"""

from __future__ import annotations

import json
import math
import resource
import sys
import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sfa_localization.data.threads import one_core
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.place_model import PlaceModel

START_NS, STEP_NS = 1_700_000_000_000_000_000, 20_000_000
SPEED, TURN_RATE, VARIANCES = 0.8, 0.3, (4e-4, 1e-4)
"""Odometry (m/s, rad/s) of a circle."""
COVARIANCE = np.diag([0.04, 0.04, 0.0025])
"""Of the pose of each image."""


def images_of(bag: Path, count: int = 20) -> np.ndarray:
    """Return the first panoramas (count, H, W, 3) of a bag such as bags/sample_test."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        topics = [each for each in reader.connections if each.topic == '/panorama/compressed']
        messages = [
            store.deserialize_cdr(data, connection.msgtype)
            for connection, _, data in islice(reader.messages(topics), count)
        ]
    return np.stack([cv2.imdecode(message.data, cv2.IMREAD_COLOR) for message in messages])


def locate_ms(model: PlaceModel, images: np.ndarray) -> float:
    """Return the median CPU time of `locate()`, in ms."""
    times = []
    with one_core():
        for image in [*images] * 5:
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


def long_run(steps: int = 1_000_000) -> dict[str, float]:
    """Odometry at 50 Hz with an image at 5 Hz: the least eigenvalue, and the growth of memory."""
    fused = PoseFilter()
    fused.set_pose(START_NS, np.zeros(3), COVARIANCE)
    least, memory_kib = math.inf, 0
    for k in range(1, steps + 1):
        stamp_ns = START_NS + k * STEP_NS
        fused.add_odometry(stamp_ns, SPEED, TURN_RATE, VARIANCES)
        if k % 10 == 0:
            fused.add_measurement(stamp_ns, fused.state.pose, COVARIANCE)
        if k % 1000 == 0:
            covariance = fused.state.covariance
            assert np.array_equal(covariance, covariance.T)
            least = min(least, float(np.linalg.eigvalsh(covariance)[0]))
        if k == steps // 10:
            memory_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    growth_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kib
    return {'steps': steps, 'least_eigenvalue': least, 'memory_growth_mib': growth_kib / 1024}


if __name__ == '__main__':
    if '--long' in sys.argv:
        print(json.dumps(long_run()))
    else:
        model, images = PlaceModel.load(Path(sys.argv[1])), images_of(Path(sys.argv[2]))
        figures = {'locate_ms': locate_ms(model, images), 'filter_step_us': filter_step_us()}
        print(json.dumps(figures))
