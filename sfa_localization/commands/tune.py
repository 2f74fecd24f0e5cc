# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from bags, or from logs without ROS."""

from __future__ import annotations

import argparse
import dataclasses
import math
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands.options import (
    TOPIC_OPTIONS,
    add_settings,
    add_topics,
    recipe,
    require_output,
    require_same_panorama,
    settings,
)
from sfa_localization.config import load_changes, require_defaults, write_config
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.run import Odometry, integrate
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.tuning import TUNED, TuneConfig

if TYPE_CHECKING:
    from sfa_localization.filtering import Table
    from sfa_localization.tuning import Outcome, TuningDrive, Validation

WRITES = 'a parameter file with the noise parameters that were found'
EXAMPLES = """\
  tune bags/test --model model.npz --output tuned.yaml
  tune bags/a bags/b --model model.npz --method grid --output tuned.yaml
  tune odom1.csv positions1.csv odom2.csv positions2.csv --output tuned.yaml

The default method needs no ground truth. Variances are in m^2, rad^2, (m/s)^2 and (rad/s)^2.
Of several drives each is left out once, of one each half, to judge on it what was found on the
others: where that is worse than before, the settings stay. CSV files are those of `filter`."""
_LEAST_ROWS = 20
"""Rows of a log, of which each half is filtered by itself."""
_LEARNED = ('measurement_factor', 'speed_std', 'rate_std', 'yaw_per_radian')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add drives, model, parameter files, method and topics."""
    parser.add_argument(
        'drives',
        nargs='+',
        type=Path,
        metavar='DRIVE',
        help='bags, or pairs ODOM.csv POSITIONS.csv',
    )
    parser.add_argument('--model', type=Path, help='file of the trained model, for bags')
    parser.add_argument('--config', type=Path, help='parameter file to start from')
    parser.add_argument('--output', type=Path, required=True, help='parameter file to write')
    add_settings(parser, TuneConfig)
    add_topics(parser, *TOPIC_OPTIONS)


def run(arguments: argparse.Namespace) -> int:
    """Tune; write the file, print what changed and the cost."""
    config = settings(FilterConfig, arguments, arguments.config)
    require_output(arguments.output, [*arguments.drives, arguments.model], '.yaml', '.yml')
    changes = load_changes(arguments.config) if arguments.config else {}
    require_defaults(arguments.output, changes, {*TUNED, *_LEARNED})
    tables = [path.suffix == '.csv' for path in arguments.drives]
    if any(tables):
        if not all(tables) or len(tables) % 2:
            raise DataError('give bags, or pairs of CSV files: ODOM.csv POSITIONS.csv')
        best, judged = _from_logs(arguments, config)
    else:
        best, judged = _from_bags(arguments, config)
    if not math.isfinite(best.cost):
        raise DataError('the filter fused nothing: give longer drives, of one clock')
    grid = settings(TuneConfig, arguments).method == 'grid'
    unit = 'm mean error' if grid else 'negative log-likelihood per component'
    print(_verdict(judged, unit))
    if judged is not None and not judged.better:
        best = dataclasses.replace(best, config=config)
    values = dataclasses.asdict(config), dataclasses.asdict(best.config)
    found = {name: value for name, value in values[1].items() if value != values[0][name]}
    changes['ekf_node'] = {**changes.get('ekf_node', {}), **found}
    write_config(arguments.output, changes)
    for name, value in found.items():
        print(f'{name}: {value:.4g} (was {values[0][name]:.4g})')
    print(f'{arguments.output}: {best.cost:.4f} {unit}')
    return 0


def _verdict(judged: Validation | None, unit: str) -> str:
    if judged is None:
        return 'not validated: too few images to leave some out'
    compared = f'{judged.after:.4f} against {judged.before:.4f} {unit}'
    if judged.better:
        return f'on what it did not see: {compared}'
    return f'worse on what it did not see: {compared}; the settings stay'


def _from_bags(
    arguments: argparse.Namespace, config: FilterConfig
) -> tuple[Outcome, Validation | None]:
    from sfa_localization import tuning
    from sfa_localization.place_model import PlaceModel

    if arguments.model is None:
        raise DataError('bags need --model MODEL.npz, which locates their images')
    method, model = settings(TuneConfig, arguments), PlaceModel.load(arguments.model)
    require_same_panorama(arguments.config, model.panorama)
    reading = dataclasses.replace(recipe(arguments), panorama=model.panorama)
    watch = settings(WatchConfig, arguments, arguments.config)
    grid, progress = method.method == 'grid', True
    drives = tuning.read_drives(arguments.drives, model, reading, grid, progress, watch)
    best = tuning.tune(drives, config, method, progress)
    parts = tuning.parts_of(drives)
    judged = tuning.validate(
        parts,
        config,
        lambda others: tuning.tune([parts[i] for i in others], config, method, progress).config,
        tuning.error_cost if grid else tuning.likelihood_cost,
    )
    return best, judged


def _from_logs(
    arguments: argparse.Namespace, config: FilterConfig
) -> tuple[Outcome, Validation | None]:
    """The mean of what each log shows by itself."""
    from sfa_localization import filtering, tuning

    if settings(TuneConfig, arguments).method == 'grid':
        raise DataError('the grid search needs bags with ground truth; use the likelihood')
    pairs = [
        (filtering.read_odometry_table(odometry), filtering.read_position_table(positions))
        for odometry, positions in zip(*[iter(arguments.drives)] * 2, strict=True)
    ]
    for path, table in zip(arguments.drives, chain(*pairs), strict=True):
        if len(table) < _LEAST_ROWS:
            raise DataError(
                f'{path}: {len(table)} rows that can be used: tuning takes at least {_LEAST_ROWS}'
            )
    best = _learned(pairs, config)
    parts = pairs if len(pairs) > 1 else filtering.halves(*pairs[0])
    drives = [_drive(*pair) for pair in parts]
    judged = tuning.validate(
        drives,
        config,
        lambda others: _learned([parts[i] for i in others], config),
        tuning.likelihood_cost,
    )
    cost = tuning.likelihood_cost([_drive(*pair) for pair in pairs], best)
    return tuning.Outcome(best, cost), judged


def _learned(pairs: list[tuple[Table, Table]], config: FilterConfig) -> FilterConfig:
    from sfa_localization import filtering, tuning

    fits = [filtering.fitted(*pair, config) for pair in pairs]
    fits = [fit for fit in fits if fit.fits]
    return tuning.middle([fit.config for fit in fits], _LEARNED) if fits else config


def _drive(odometry: Table, positions: Table) -> TuningDrive:
    """Tables as the tuner takes drives; positions whose errors are white."""
    from sfa_localization import filtering, tuning

    stamps_ns, twists, variances = filtering.odometry_arrays(odometry)
    values, covariances = filtering.position_arrays(positions)
    return tuning.TuningDrive(
        Odometry(stamps_ns, integrate(stamps_ns, twists), twists, variances),
        tuning.ImagePoses(positions.stamps_ns, values, covariances),
        correlation=ErrorCorrelation(0.0),
    )
