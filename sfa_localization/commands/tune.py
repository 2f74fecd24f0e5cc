# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from bags."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands.options import (
    TOPIC_OPTIONS,
    add_settings,
    add_topics,
    recipe,
    require_same_panorama,
    settings,
)
from sfa_localization.config import load_changes, write_config
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.tuning import TuneConfig, read_drives, tune

EXAMPLES = """\
  tune bags/test --model model.npz --output tuned.yaml
  tune bags/a bags/b --model model.npz --method grid --output tuned.yaml

The default method needs no ground truth. Variances are in m^2, rad^2, (m/s)^2 and (rad/s)^2."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bags, model, parameter files, method and topics."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG')
    parser.add_argument('--model', type=Path, required=True, help='file of the trained model')
    parser.add_argument('--config', type=Path, help='parameter file to start from')
    parser.add_argument('--output', type=Path, required=True, help='parameter file to write')
    add_settings(parser, TuneConfig)
    add_topics(parser, *TOPIC_OPTIONS)


def run(arguments: argparse.Namespace) -> int:
    """Tune; write the file, print what changed and the cost."""
    from sfa_localization.place_model import PlaceModel

    method, model = settings(TuneConfig, arguments), PlaceModel.load(arguments.model)
    require_same_panorama(arguments.config, model.panorama)
    reading = dataclasses.replace(recipe(arguments), panorama=model.panorama)
    config = settings(FilterConfig, arguments, arguments.config)
    watch = settings(WatchConfig, arguments, arguments.config)
    grid, progress = method.method == 'grid', sys.stderr.isatty()
    drives = read_drives(arguments.bags, model, reading, grid, progress, watch)
    best = tune(drives, config, method, progress)
    values = dataclasses.asdict(config), dataclasses.asdict(best.config)
    found = {name: value for name, value in values[1].items() if value != values[0][name]}
    changes = load_changes(arguments.config) if arguments.config else {}
    changes['ekf_node'] = {**changes.get('ekf_node', {}), **found}
    write_config(arguments.output, changes)
    for name, value in found.items():
        print(f'{name}: {value:.4g} (was {values[0][name]:.4g})')
    unit = 'm mean error' if grid else 'negative log-likelihood per component'
    print(f'{arguments.output}: {best.cost:.4f} {unit}')
    return 0
