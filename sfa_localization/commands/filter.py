# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fuse logs of odometry and positions without ROS."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sfa_localization.commands.options import settings
from sfa_localization.data.errors import DataError
from sfa_localization.fusion.settings import FilterConfig

EXAMPLES = """\
  filter odom.csv positions.csv --output poses.tum
  filter odom.csv gps.csv --config localization.yaml --initial-pose 0 0 1.57 \\
      --output poses.tum

ODOM.csv: stamp_s,v_mps,omega_radps[,var_v,var_omega]
POSITIONS.csv: stamp_s,x_m,y_m[,var_x,var_y][,var_xy][,yaw_rad,var_yaw]
Seconds, meters, radians; variances in their squares; empty: unknown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add tables, parameter file, initial pose and output."""
    parser.add_argument('odometry', type=Path, metavar='ODOM.csv')
    parser.add_argument('positions', type=Path, metavar='POSITIONS.csv')
    parser.add_argument('--config', type=Path, help='parameter file; section ekf_node is read')
    parser.add_argument(
        '--initial-pose',
        nargs=3,
        type=float,
        metavar=('X', 'Y', 'YAW'),
        help='initial pose (m, m, rad), where it is known',
    )
    parser.add_argument(
        '--smooth', action='store_true', help='use later positions too, for poses after the drive'
    )
    parser.add_argument('--output', type=Path, required=True, help='TUM file to write')


def run(arguments: argparse.Namespace) -> int:
    """Filter; print what was skipped, rejected and written."""
    from sfa_localization import filtering

    odometry = filtering.read_odometry_table(arguments.odometry)
    positions = filtering.read_position_table(arguments.positions)
    config = settings(FilterConfig, arguments, arguments.config)
    config, text = filtering.fitting_config(odometry, positions, config)
    if text:
        print(text)
    result = filtering.run_filter(
        odometry,
        positions,
        config,
        arguments.initial_pose,
        progress=sys.stderr.isatty(),
        smooth=arguments.smooth,
    )
    for name, table in (('odometry rows', odometry), ('position rows', positions)):
        for reason, count in sorted(table.skipped.items()):
            print(f'{name}: {reason}: {count}')
    for reason, count in sorted(result.counts.items()):
        print(f'{reason}: {count}')
    print(': '.join([result.status.level.name, '; '.join(result.status.reasons)]).rstrip(': '))
    if len(result.poses) == 0:
        raise DataError(
            'the filter never started: positions without heading need some meters of motion; '
            'or give --initial-pose X Y YAW'
        )
    filtering.write_tum(arguments.output, result.stamps_ns, result.poses)
    waited = f', {result.before_start} rows before the start' if result.before_start else ''
    print(f'{arguments.output}: {len(result.poses)} poses{waited}')
    return 0
