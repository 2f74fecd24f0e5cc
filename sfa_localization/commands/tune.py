# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from bags."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict, replace
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
from sfa_localization.data.errors import DataError
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.tuning import TUNED, TuneConfig

if TYPE_CHECKING:
    from sfa_localization.tuning import Validation

WRITES = 'a parameter file with the noise parameters that were found'
EXAMPLES = """\
  tune bags/test --model model.npz --output tuned.yaml
  tune bags/a bags/b --model model.npz --method grid --output tuned.yaml

The default method needs no ground truth. Variances are in m^2, rad^2, (m/s)^2 and (rad/s)^2.
Of several drives each is left out once, of one each half, to judge on it what was found on the
others: where that is worse than before, the settings stay. `filter` learns the noise of logs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add drives, model, parameter files, method and topics."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='drives to tune on')
    parser.add_argument('--model', type=Path, required=True, help='file of the trained model')
    parser.add_argument('--config', type=Path, help='parameter file to start from')
    parser.add_argument('--output', type=Path, required=True, help='parameter file to write')
    add_settings(parser, TuneConfig)
    add_topics(parser, *TOPIC_OPTIONS)


def run(arguments: argparse.Namespace) -> int:
    """Tune; write the file, print what changed and the cost."""
    from sfa_localization import tuning
    from sfa_localization.place_model import PlaceModel

    config = settings(FilterConfig, arguments, arguments.config)
    require_output(arguments.output, [*arguments.bags, arguments.model], '.yaml', '.yml')
    changes = load_changes(arguments.config) if arguments.config else {}
    require_defaults(arguments.output, changes, TUNED)
    model, how = PlaceModel.load(arguments.model), settings(TuneConfig, arguments)
    require_same_panorama(arguments.config, model.panorama)
    reading = recipe(arguments)
    watch = settings(WatchConfig, arguments, arguments.config)
    grid = how.method == 'grid'
    drives = [tuning.read_drive(bag, model, reading, watch, grid) for bag in arguments.bags]
    best = tuning.tune(drives, config, how, progress=True)
    if not math.isfinite(best.cost):
        raise DataError('the filter fused nothing: give longer drives, of one clock')
    judged = tuning.validate(drives, config, how, progress=True)
    unit = 'm mean error' if grid else 'negative log-likelihood per component'
    print(_verdict(judged, unit))
    if judged is not None and not judged.better:
        best = replace(best, config=config)
    before, after = asdict(config), asdict(best.config)
    found = {name: value for name, value in after.items() if value != before[name]}
    changes['ekf_node'] = {**changes.get('ekf_node', {}), **found}
    write_config(arguments.output, changes)
    for name, value in found.items():
        print(f'{name}: {value:.4g} (was {before[name]:.4g})')
    print(f'{arguments.output}: {best.cost:.4f} {unit}')
    return 0


def _verdict(judged: Validation | None, unit: str) -> str:
    if judged is None:
        return 'not validated: too few images to leave some out'
    compared = f'{judged.after:.4f} against {judged.before:.4f} {unit}'
    if judged.better:
        return f'on what it did not see: {compared}'
    return f'worse on what it did not see: {compared}; the settings stay'
