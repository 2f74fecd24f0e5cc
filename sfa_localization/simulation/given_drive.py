# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A real robot's drive in the simulated garden: its true poses, and the odometry it measured."""

from __future__ import annotations

import numpy as np

from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, Stamps, Trajectory, integrate
from sfa_localization.simulation.drive import START_NS, Drive
from sfa_localization.simulation.settings import SimulationConfig

POSE_GAP_S = 0.5
"""No image is taken where the true poses pause for longer: the robot may be anywhere between."""


def given_drive(truth: Trajectory, odometry: Odometry, config: SimulationConfig) -> Drive:
    """The drive of poses (N, 3) in frame `world` and of measured twists (M, 2); no images are made.

    The poses of `odometry` are not read: they follow from its twists, from zero on. Images are
    taken every `images_every` m and every `images_every_turn` degrees. Stamps before the first
    simulated drive's, such as seconds from zero, are shifted there. Raises DataError where poses
    and odometry do not overlap, ConfigError where a pose is outside of the area.
    """
    finite = np.isfinite(truth.poses).all(1)
    truth = Trajectory(truth.stamps_ns[finite], truth.poses[finite])
    if len(truth) == 0:
        raise DataError('the poses have no numbers: x, y and yaw are needed')
    inside = (np.abs(truth.poses[:, :2]) <= np.array(config.area) / 2).all(1)
    if not inside.all():
        reach = 2 * np.abs(truth.poses[:, :2]).max(0)
        raise ConfigError(
            f'{np.count_nonzero(~inside)} poses are outside of the area of the garden: give an '
            f'--area of at least {np.ceil(reach[0]):.0f}x{np.ceil(reach[1]):.0f}'
        )
    shift = max(0, START_NS - int(min(truth.stamps_ns[0], odometry.stamps_ns[0])))
    truth = Trajectory(truth.stamps_ns + shift, truth.poses)
    stamps = odometry.stamps_ns + shift
    images = _image_stamps(truth, config)
    images = images[(images >= stamps[0]) & (images <= stamps[-1])]
    if len(images) < 2:
        raise DataError('poses and odometry overlap for fewer than two images: check their clocks')
    poses = integrate(stamps, odometry.twists)
    return Drive(truth, Odometry(stamps, poses, odometry.twists, odometry.variances), None, images)


def _image_stamps(truth: Trajectory, config: SimulationConfig) -> Stamps:
    """Stamps of poses far enough from that of the image before; sums would count their jitter."""
    steady = truth.covers(truth.stamps_ns + 1, round(POSE_GAP_S * 1e9))
    turn = np.radians(config.images_every_turn)
    chosen, last = [0], truth.poses[0]
    for i in np.flatnonzero(steady):
        x, y, yaw = truth.poses[i] - last
        if np.hypot(x, y) >= config.images_every or abs(wrap_angle(yaw)) >= turn:
            chosen.append(int(i))
            last = truth.poses[i]
    return np.asarray(truth.stamps_ns[chosen])
