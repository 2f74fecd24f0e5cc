# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Reproduce a published result in simulation: that of light and season, or that of a year."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from sfa_localization.commands.options import add_settings, settings
from sfa_localization.data.settings import Settings, setting

WRITES = 'in its folder bags, models, report.md and results'
EXAMPLES = """\
  reproduce light --quick
  reproduce year --quick
  reproduce light --world 12 --out light_of_world_12"""


@dataclass(frozen=True, slots=True)
class ReproduceConfig(Settings):
    """Which garden and drives a result is reproduced with."""

    world: int = setting(1, 'garden', low=0, high=2**63 - 1)
    seed: int = setting(1, 'drives and sensor errors; of each drive another', low=0, high=2**62)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the result, the folder and the settings."""
    parser.add_argument(
        'result',
        choices=('light', 'year'),
        help='light: train in one or two lights, test in every light and season; year: train '
        'once, then a drive a month, with and without updates of the model',
    )
    parser.add_argument(
        '--out',
        type=Path,
        metavar='DIR',
        help='folder to write, or one with the same settings to go on with [reproduce_RESULT]',
    )
    parser.add_argument(
        '--quick', action='store_true', help='a smaller garden, smaller images, fewer seasons'
    )
    add_settings(parser, ReproduceConfig)


def run(arguments: argparse.Namespace) -> int:
    """Reproduce; print the table."""
    if arguments.result == 'year':
        return _year(arguments)
    from sfa_localization.commands.light_matrix import FULL, QUICK, reproduce_light
    from sfa_localization.reports.light import table

    out = arguments.out or Path(f'reproduce_{arguments.result}')
    plan = QUICK if arguments.quick else FULL
    cells = reproduce_light(out, settings(ReproduceConfig, arguments), plan, progress=True)
    print(table(cells))
    return 0


def _year(arguments: argparse.Namespace) -> int:
    from sfa_localization.commands.year import QUICK_YEAR, YEAR, reproduce_year
    from sfa_localization.reports.year import table

    plan = QUICK_YEAR if arguments.quick else YEAR
    out = arguments.out or Path('reproduce_year')
    print(table(reproduce_year(out, settings(ReproduceConfig, arguments), plan, progress=True)))
    return 0
