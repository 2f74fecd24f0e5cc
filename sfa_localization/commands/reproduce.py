# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Reproduce published results: the paper's tables, figures, baselines, ablations, light, a year."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sfa_localization.commands.options import add_settings, settings
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.settings import Settings, setting

WRITES = 'in its folder bags, models, report.md and results'
EXAMPLES = """\
  reproduce all --quick
  reproduce simulator --seeds 5
  reproduce baselines bags/coverage bags/lines --test bags/test
  reproduce light --world 12 --out light_of_world_12
  reproduce year --quick"""
RESULTS = ('simulator', 'robot', 'baselines', 'ablations', 'light')
PAPER_RESULTS = RESULTS[:-1]
"""They share a folder, with drives and models."""


@dataclass(frozen=True, slots=True)
class ReproduceConfig(Settings):
    """Which gardens and drives a result is reproduced with."""

    world: int = setting(1, 'garden, the first of --seeds', low=0, high=2**63 - 1)
    seed: int = setting(1, 'drives and sensor errors; of each drive another', low=0, high=2**62)
    seeds: int = setting(
        1, 'gardens, each with drives of its own; ablations and light use the first',
        low=1, high=1000,
    )  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the result, the bags, the folder and the settings."""
    parser.add_argument(
        'result',
        choices=('all', *RESULTS, 'year'),
        help="simulator, robot: the paper's experiments; baselines: other features; ablations: "
        'this package without some of its parts; light: train in one, two or three lights, test '
        "in every light and season, beside image retrieval and the paper's recipe; all: these; "
        'year: train once, then a drive a month, with and without updates of the model',
    )
    parser.add_argument(
        'bags', nargs='*', type=Path, metavar='BAG', help='training drives of baselines'
    )
    parser.add_argument('--test', type=Path, metavar='BAG', help='drive to test baselines on')
    parser.add_argument(
        '--out',
        type=Path,
        metavar='DIR',
        help='folder to write, or one with the same settings to go on with [reproduce_light, '
        'reproduce_paper; with --quick reproduce_quick...]',
    )
    parser.add_argument(
        '--quick', action='store_true', help='a smaller garden, smaller images, fewer seasons'
    )
    add_settings(parser, ReproduceConfig)


def run(arguments: argparse.Namespace) -> int:
    """Reproduce; print the tables."""
    config = settings(ReproduceConfig, arguments)
    chosen = RESULTS if arguments.result == 'all' else (arguments.result,)
    if bool(arguments.bags) != bool(arguments.test) or (
        arguments.bags and arguments.result != 'baselines'
    ):
        raise ConfigError('bags are for baselines, together with --test')
    start = 'reproduce_quick_' if arguments.quick else 'reproduce_'
    paper = arguments.out or Path(f'{start}paper')
    wanted = [name for name in chosen if name in PAPER_RESULTS]
    if wanted:
        _paper(wanted, paper, config, arguments)
    if 'light' in chosen:
        own = arguments.out and (arguments.out / 'light' if wanted else arguments.out)
        _light(own or Path(f'{start}light'), config, arguments.quick)
    if 'year' in chosen:
        _year(arguments.out or Path(f'{start}year'), config, arguments.quick)
    return 0


def _light(out: Path, config: ReproduceConfig, quick: bool) -> None:
    from sfa_localization.commands.light_matrix import FULL, QUICK, reproduce_light
    from sfa_localization.reports.light import table

    print(table(reproduce_light(out, config, QUICK if quick else FULL, progress=True)))


def _year(out: Path, config: ReproduceConfig, quick: bool) -> None:
    from sfa_localization.commands.year import QUICK_YEAR, YEAR, reproduce_year
    from sfa_localization.reports.year import table

    print(table(reproduce_year(out, config, QUICK_YEAR if quick else YEAR, progress=True)))


def _paper(
    names: Sequence[str], out: Path, config: ReproduceConfig, arguments: argparse.Namespace
) -> None:
    """Those results that share a folder: say how long they take, then make what is missing."""
    from sfa_localization.commands import light_matrix
    from sfa_localization.commands.paper_tables import Work
    from sfa_localization.commands.reproduction import Progress
    from sfa_localization.commands.sites import FULL, QUICK

    plan = QUICK if arguments.quick else FULL
    work = Work(out, config, plan, Progress(shown=True), tuple(arguments.bags), arguments.test)
    light = light_matrix.QUICK if arguments.quick else light_matrix.FULL
    work.announce(names, light.minutes if arguments.result == 'all' else 0)
    for name in names:
        print(work.reproduced(name))
