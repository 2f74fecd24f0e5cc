# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Record a bag with a simulated robot."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.commands.options import add_settings, destination, numbers, settings
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.run import Odometry
from sfa_localization.filtering import odometry_arrays, read_odometry_table, read_truth
from sfa_localization.simulation.settings import SimulationConfig

if TYPE_CHECKING:
    from sfa_localization.simulation.drive import Drive

WRITES = 'a bag with images, odometry, turn rates and the ground truth'
EXAMPLES = """\
  simulate bags/coverage --trajectory coverage --seed 1
  simulate bags/test --trajectory test --seed 2 --compressed
  simulate bags/tiny --area 8x8 --length 30 --images panorama --size 300x30
  simulate bags/half_real --poses truth.tum --odometry odom.csv --area 12x14

TRUTH: TUM lines, or stamp_s,x_m,y_m,yaw_rad, with the garden's center at 0, 0.
ODOM.csv: stamp_s,v_mps,omega_radps[,var_v,var_omega]"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bag, panorama size and every setting of the simulation."""
    parser.add_argument('out', type=Path, metavar='OUT_BAG', help='folder of the bag to write')
    parser.add_argument('--size', type=numbers, help='columns x rows of --images panorama [600x60]')
    parser.add_argument(
        '--compressed',
        action='store_const',
        dest=destination(SimulationConfig, 'compression'),
        const='jpeg',
        default=argparse.SUPPRESS,
        help='short for --compression jpeg',
    )
    parser.add_argument(
        '--poses', type=Path, metavar='TRUTH', help='drive these true poses of a real robot'
    )
    parser.add_argument(
        '--odometry', type=Path, metavar='ODOM.csv', help='the odometry that it measured there'
    )
    add_settings(parser, SimulationConfig)


def run(arguments: argparse.Namespace) -> int:
    """Simulate; print the number of images and the duration."""
    from sfa_localization.simulation.drive import simulate

    config = settings(SimulationConfig, arguments)
    panorama = _panorama(arguments.size)
    given = _given_drive(arguments.poses, arguments.odometry, config)
    drive = simulate(config, arguments.out, panorama, progress=True, given=given)
    seconds = (drive.truth.stamps_ns[-1] - drive.truth.stamps_ns[0]) * 1e-9
    print(f'{arguments.out}: {len(drive.image_stamps_ns)} images in {seconds:.0f} s')
    return 0


def _given_drive(poses: Path | None, log: Path | None, config: SimulationConfig) -> Drive | None:
    """The drive of two logs; None where neither is given."""
    if poses is None and log is None:
        return None
    if poses is None or log is None:
        raise ConfigError('--poses and --odometry: give both, the true poses and what was measured')
    from sfa_localization.simulation.given_drive import given_drive

    stamps, twists, variances = odometry_arrays(read_odometry_table(log))
    odometry = Odometry(stamps, np.zeros((len(stamps), 3)), twists, variances)
    return given_drive(read_truth(poses), odometry, config)


def _panorama(size: tuple[float, ...] | None) -> PanoramaConfig:
    if size is None:
        return PanoramaConfig()
    if len(size) != 2:
        raise ConfigError('--size: give columns x rows, as in 300x30')
    return PanoramaConfig.from_mapping({'width': int(size[0]), 'height': int(size[1])}, '--size')
