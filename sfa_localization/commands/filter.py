# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fuse logs of odometry and positions without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfa_localization.commands import options
from sfa_localization.data.errors import DataError
from sfa_localization.fusion.settings import FilterConfig

WRITES = 'poses in the format of TUM, which evo reads, and beside them a file of their covariances'
EXAMPLES = """\
  filter odom.csv positions.csv --output poses.tum
  filter odom.csv gps.csv --config localization.yaml --output poses.tum

ODOM.csv: stamp_s,v_mps,omega_radps[,var_v,var_omega]
POSITIONS.csv: stamp_s,x_m,y_m[,var_x,var_y][,var_xy][,yaw_rad,var_yaw]
Seconds (or stamp_ns), meters, radians; variances in their squares; empty or 0: unknown.
A heading without its variance is not used."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add tables, parameter file and output."""
    parser.add_argument('odometry', type=Path, metavar='ODOM.csv')
    parser.add_argument('positions', type=Path, metavar='POSITIONS.csv')
    parser.add_argument('--config', type=Path, help='parameter file; section ekf_node is read')
    parser.add_argument(
        '--output', type=Path, required=True, help='TUM file to write; covariances beside it'
    )


def run(arguments: argparse.Namespace) -> int:
    """Filter; print what was skipped, rejected and written."""
    from sfa_localization import filtering

    read = arguments.odometry, arguments.positions, arguments.config
    options.require_output(arguments.output, read, '.tum', '.txt')
    beside = arguments.output.with_suffix('.covariance.csv')
    options.require_output(beside, read, '.csv')
    odometry = filtering.read_table(arguments.odometry, filtering.ODOMETRY)
    positions = filtering.read_table(arguments.positions, filtering.POSITIONS)
    config = options.settings(FilterConfig, arguments)
    result = filtering.run_filter(odometry, positions, config, progress=True)
    for table in (odometry, positions):
        if table.skipped:
            count = len(table.skipped)
            first = table.skipped[0]
            which = f'left out, the first is line {first}'
            print(f'{table.source}: {count} rows without a stamp or number {which}')
    for reason, count in sorted(result.counts.items()):
        print(f'{reason}: {count}')
    print(': '.join([result.status.level.name, '; '.join(result.status.reasons)]).rstrip(': '))
    if len(result.poses) == 0:
        raise DataError(
            'the filter never started: positions without heading need some meters of motion; '
            'or set initial_pose in the parameter file of --config'
        )
    filtering.write(result, arguments.output, beside)
    rows = len(odometry.stamps_ns)
    print(f'{arguments.output}: {len(result.poses)} poses of {rows} odometry rows')
    return 0
