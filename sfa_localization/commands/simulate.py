# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Record a bag with a simulated robot."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.commands import options
from sfa_localization.data.errors import ConfigError
from sfa_localization.simulation.settings import SimulationConfig

WRITES = 'a bag with images, odometry, turn rates and the ground truth'
EXAMPLES = """\
  simulate bags/coverage --trajectory coverage --seed 1
  simulate bags/test --trajectory test --seed 2 --compression jpeg
  simulate bags/around --cameras 4 --camera-fov 100 --camera-radius 0.2 --compression jpeg
  simulate bags/two_fisheyes --cameras 2 --camera-fov 190 --camera-radius 0.1
  simulate bags/tiny --area 8x8 --length 30 --images panorama --size 300x30"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bag, panorama size and every setting of the simulation."""
    parser.add_argument('out', type=Path, metavar='OUT_BAG', help='folder of the bag to write')
    parser.add_argument('--size', type=options.numbers, help='of panoramas, in pixels [600x60]')
    options.add_settings(parser, SimulationConfig)


def run(arguments: argparse.Namespace) -> int:
    """Simulate; print the number of images and the duration."""
    from sfa_localization.simulation.drive import simulate

    config = options.settings(SimulationConfig, arguments)
    drive = simulate(config, arguments.out, _panorama(arguments.size), progress=True)
    seconds = (drive.truth.stamps_ns[-1] - drive.truth.stamps_ns[0]) * 1e-9
    print(f'{arguments.out}: {len(drive.image_stamps_ns)} images in {seconds:.0f} s')
    return 0


def _panorama(size: tuple[float, ...] | None) -> PanoramaConfig:
    if size is None:
        return PanoramaConfig()
    if len(size) != 2:
        raise ConfigError('--size: give columns x rows, as in 300x30')
    return PanoramaConfig.from_mapping({'width': int(size[0]), 'height': int(size[1])}, '--size')
