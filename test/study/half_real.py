# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A real robot's drive in the simulated garden: its true poses, and the odometry it measured.

TRUTH: TUM lines, or stamp_s,x_m,y_m,yaw_rad, with the garden's center at 0, 0.
ODOM.csv: stamp_s,v_mps,omega_radps[,var_v,var_omega]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.commands.options import add_settings, numbers, settings
from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, Stamps, Trajectory, integrate
from sfa_localization.filtering import ODOMETRY, read_table
from sfa_localization.simulation.drive import START_NS, SimulatedDrive, record
from sfa_localization.simulation.garden import Garden
from sfa_localization.simulation.settings import SimulationConfig

SUMMARY = "a bag of a real robot's poses and odometry, with rendered images"
SETTINGS = (
    'world', 'seed', 'light', 'season', 'area', 'images', 'images_every', 'images_every_turn',
    'compression', 'storage', 'image_noise', 'illumination',
)  # fmt: skip
"""Settings of the simulation that apply to a given drive."""

POSE_GAP_S = 0.5
"""Longest pause of the true poses in which images are taken."""


def given_drive(truth: Trajectory, odometry: Odometry, config: SimulationConfig) -> SimulatedDrive:
    """The drive with poses (N, 3) in frame `world` and measured twists (M, 2), not yet rendered.

    The poses of `odometry` are integrated from its twists. Images are
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
    return SimulatedDrive(
        truth, Odometry(stamps, poses, odometry.twists, odometry.variances), None, images
    )


def _image_stamps(truth: Trajectory, config: SimulationConfig) -> Stamps:
    """Stamps of poses far enough from the last image; the length of the path includes jitter."""
    steady = truth.covers(truth.stamps_ns + 1, round(POSE_GAP_S * 1e9))
    turn = np.radians(config.images_every_turn)
    chosen, last = [0], truth.poses[0]
    for i in np.flatnonzero(steady):
        x, y, yaw = truth.poses[i] - last
        if np.hypot(x, y) >= config.images_every or abs(wrap_angle(yaw)) >= turn:
            chosen.append(int(i))
            last = truth.poses[i]
    return np.asarray(truth.stamps_ns[chosen])


def measured(log: Path) -> Odometry:
    """The odometry of a log; poses and missing variances are zero."""
    table = read_table(log, ODOMETRY)
    stamps, values = table.stamps_ns, np.nan_to_num(table.values)
    return Odometry(stamps, np.zeros((len(stamps), 3)), values[:, :2], values[:, 2:])


def read_truth(path: Path) -> Trajectory:
    """True poses: columns stamp_s,x_m,y_m,yaw_rad, or TUM lines. Raises DataError."""
    table = read_table(path, ('stamp_s', 'x_m', 'y_m', 'z', 'qx', 'qy', 'qz', 'qw', 'yaw_rad'))
    x, y, _, qx, qy, qz, qw, yaw = table.values.T
    turned = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    stamps, first = np.unique(table.stamps_ns, return_index=True)
    poses = np.column_stack([x, y, np.where(np.isfinite(yaw), yaw, turned)])
    return Trajectory(stamps, poses[first])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the bag, both logs, and settings of the simulation."""
    parser.description, parser.formatter_class = __doc__, argparse.RawDescriptionHelpFormatter
    parser.set_defaults(run=run)
    parser.add_argument('out', type=Path, metavar='OUT_BAG', help='folder of the bag to write')
    parser.add_argument('--poses', type=Path, required=True, metavar='TRUTH', help='true poses')
    parser.add_argument(
        '--odometry', type=Path, required=True, metavar='ODOM.csv', help='measured odometry'
    )
    parser.add_argument('--size', type=numbers, help='columns x rows of --images panorama')
    add_settings(parser, SimulationConfig, SETTINGS)


def run(arguments: argparse.Namespace) -> int:
    """Drive and render; print the number of images."""
    config, panorama = settings(SimulationConfig, arguments), PanoramaConfig()
    if arguments.size:
        width, height = map(int, arguments.size)
        panorama = PanoramaConfig(width=width, height=height)
    odometry = measured(arguments.odometry)
    made = given_drive(read_truth(arguments.poses), odometry, config)
    # Without trees, which the given path may cross.
    garden = Garden(config.world, config, open_lawn=True)
    record(made, garden, config, arguments.out, panorama, progress=True)
    print(f'{arguments.out}: {len(made.image_stamps_ns)} images')
    return 0
