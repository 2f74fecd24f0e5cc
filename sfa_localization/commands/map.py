# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write the driven ground of a model as a map for Nav2."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sfa_localization.commands import options
from sfa_localization.data.files import write_bytes
from sfa_localization.mapping.settings import GroundConfig

WRITES = 'MAP.yaml and MAP.pgm, which nav2_map_server reads'
EXAMPLES = """\
  map garden.npz --output garden.yaml
  map garden.npz --output garden.yaml --width 0.6"""
# gray levels of map_saver: the second is occupied by 0.19608
_FREE = 254
_UNKNOWN = 205
_YAML = """\
image: {image}
mode: trinary
resolution: {cell:g}
origin: [{x:.4f}, {y:.4f}, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the model, the output, and the sizes of robot and cells."""
    parser.add_argument('model', type=Path, metavar='MODEL.npz')
    parser.add_argument('--output', type=Path, required=True, metavar='MAP.yaml')
    options.add_settings(parser, GroundConfig)


def run(arguments: argparse.Namespace) -> int:
    """Write both files: free where the robot drove in training, unknown elsewhere."""
    from sfa_localization.place_model import PlaceModel

    output = arguments.output
    image = arguments.output.with_suffix('.pgm')
    options.require_output(output, [arguments.model], '.yaml')
    options.require_output(image, [arguments.model], '.pgm')
    config = options.settings(GroundConfig, arguments)
    cells = PlaceModel.load(arguments.model).ground.cells(config)
    height, width = cells.driven.shape
    x, y = cells.corner
    gray = np.where(cells.driven[::-1], _FREE, _UNKNOWN).astype(np.uint8)
    write_bytes(image, f'P5\n{width} {height}\n255\n'.encode() + gray.tobytes())
    write_bytes(output, _YAML.format(image=image.name, cell=config.cell, x=x, y=y).encode())
    print(f'{output}, {image}: written; the robot drove on {cells.area_m2:.0f} m2')
    return 0
