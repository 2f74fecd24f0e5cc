# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fuse logs of odometry and positions without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfa_localization.commands.options import destination, require_output, settings
from sfa_localization.data.errors import DataError
from sfa_localization.data.run import Trajectory
from sfa_localization.fusion.settings import FilterConfig

if TYPE_CHECKING:
    from sfa_localization.filtering import Filtered, Table

WRITES = 'poses in the format of TUM, and beside them a file of their covariances'
EXAMPLES = """\
  filter odom.csv positions.csv --output poses.tum
  filter odom.csv gps.csv --config localization.yaml --initial-pose 0 0 1.57 \\
      --output poses.tum

ODOM.csv: stamp_s,v_mps,omega_radps[,var_v,var_omega]
POSITIONS.csv: stamp_s,x_m,y_m[,var_x,var_y][,var_xy][,yaw_rad,var_yaw]
TRUTH: TUM lines, or stamp_s,x_m,y_m,yaw_rad.
Seconds, meters, radians; variances in their squares; empty or 0: unknown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add tables, parameter file, initial pose and output."""
    parser.add_argument('odometry', type=Path, metavar='ODOM.csv')
    parser.add_argument('positions', type=Path, metavar='POSITIONS.csv')
    parser.add_argument('--config', type=Path, help='parameter file; section ekf_node is read')
    parser.add_argument(
        '--initial-pose',
        dest=destination(FilterConfig, 'initial_pose'),
        nargs=3,
        type=float,
        metavar=('X', 'Y', 'YAW'),
        default=argparse.SUPPRESS,
        help='initial pose (m, m, rad), where it is known',
    )
    parser.add_argument(
        '--smooth', action='store_true', help='use later positions too, for poses after the drive'
    )
    parser.add_argument(
        '--output', type=Path, required=True, help='TUM file to write; covariances beside it'
    )
    parser.add_argument(
        '--truth', type=Path, metavar='TRUTH.tum', help='true poses to compare with'
    )


def run(arguments: argparse.Namespace) -> int:
    """Filter; print what was skipped, rejected and written."""
    from sfa_localization import filtering

    read = arguments.odometry, arguments.positions, arguments.config, arguments.truth
    require_output(arguments.output, read, '.tum', '.txt')
    beside = arguments.output.with_suffix('.covariance.csv')
    require_output(beside, read, '.csv')
    truth = filtering.read_truth(arguments.truth) if arguments.truth else None
    odometry = filtering.read_odometry_table(arguments.odometry)
    positions = filtering.read_position_table(arguments.positions)
    config = settings(FilterConfig, arguments, arguments.config)
    result = filtering.run_filter(
        odometry, positions, config, progress=True, smooth=arguments.smooth
    )
    _print_counts(odometry, positions, result)
    if len(result.poses) == 0:
        raise DataError(
            'the filter never started: positions without heading need some meters of motion; '
            'or give --initial-pose X Y YAW'
        )
    filtering.write_tum(arguments.output, result.stamps_ns, result.poses)
    filtering.write_covariances(beside, result.stamps_ns, result.covariances)
    if truth is not None:
        print(_judgement(truth, result))
    waited = f', {result.before_start} rows before the start' if result.before_start else ''
    print(f'{arguments.output}: {len(result.poses)} poses{waited}')
    return 0


def _print_counts(odometry: Table, positions: Table, result: Filtered) -> None:
    for name, table in (('odometry rows', odometry), ('position rows', positions)):
        for reason, count in sorted(table.skipped.items()):
            print(f'{name}: {reason}: {count}')
    for reason, count in sorted(result.counts.items()):
        print(f'{reason}: {count}')
    print(': '.join([result.status.level.name, '; '.join(result.status.reasons)]).rstrip(': '))


def _judgement(truth: Trajectory, result: Filtered) -> str:
    from sfa_localization.evaluation import calibration, score

    found = Trajectory(result.stamps_ns, result.poses)
    errors = score(truth, found)
    if not errors['n']:
        return 'truth and poses have no time in common'
    shares = calibration(truth, found, np.eye(2), result.covariances)
    return (
        f'error: mean {errors["mean"]:.3f} m, 95th percentile {errors["p95"]:.3f} m; '
        f'heading: mean {errors["yaw_deg"]["mean"]:.1f} deg\n'
        f'inside 95 % regions: {shares["within_95"]:.1%} of the positions, '
        f'{shares["yaw_within_95"]:.1%} of the headings; NIS {result.nis:.2f}'
    )
