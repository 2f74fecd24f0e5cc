# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from bags."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands import options
from sfa_localization.config import load_changes, write_config
from sfa_localization.fusion.settings import FilterConfig

WRITES = 'a parameter file with the tuned noise parameters'
EXAMPLES = """\
  tune bags/test --model model.npz --output tuned.yaml
  tune bags/a bags/b --model model.npz --method grid --output tuned.yaml

The default method needs no ground truth; grid, the search of the paper, does. Variances are in
m^2, rad^2, (m/s)^2 and (rad/s)^2. Check the result on another
drive by `evaluate --config tuned.yaml`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add drives, model, parameter files, method and topics."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='drives to tune on')
    parser.add_argument('--model', type=Path, required=True, help='file of the trained model')
    parser.add_argument('--config', type=Path, help='parameter file to start from')
    parser.add_argument('--output', type=Path, required=True, help='parameter file to write')
    parser.add_argument('--method', choices=('likelihood', 'grid'), default='likelihood')
    options.add_topics(parser, 'image', 'odometry', 'imu', 'ground_truth')


def run(arguments: argparse.Namespace) -> int:
    """Tune; write the file, print what changed and the cost."""
    from sfa_localization import tuning
    from sfa_localization.place_model import PlaceModel

    options.require_new(arguments.output)
    config = options.settings(FilterConfig, arguments)
    changes = load_changes(arguments.config) if arguments.config else {}
    model = PlaceModel.load(arguments.model)
    grid = arguments.method == 'grid'
    options.require_same_panorama(arguments.config, model.panorama)
    reading = options.recipe(arguments)
    watch = options.settings(WatchConfig, arguments)
    search = tuning.tune_by_likelihood
    cost = tuning.likelihood_cost
    if grid:
        search = tuning.tune_by_grid
        cost = tuning.error_cost
    drives = [tuning.read_drive(bag, model, reading, watch, grid) for bag in arguments.bags]
    best = search(drives, config)
    before = asdict(config)
    after = asdict(best)
    tuned = {name: value for name, value in after.items() if value != before[name]}
    changes.setdefault('ekf_node', {}).update(tuned)
    write_config(arguments.output, changes)
    for name, value in tuned.items():
        print(f'{name}: {value:.4g} (was {before[name]:.4g})')
    unit = 'm mean error' if grid else 'negative log-likelihood'
    print(f'{arguments.output}: {cost(drives, best):.4f} {unit}, before {cost(drives, config):.4f}')
    return 0
