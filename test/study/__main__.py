# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Make the tables and figures of test/EVALUATION.md; make half-real bags.

PYTHONPATH=.:test python -m study all --quick
PYTHONPATH=.:test python -m study simulator --seeds 5
PYTHONPATH=.:test python -m study baselines --training bags/coverage bags/lines --test bags/test
PYTHONPATH=.:test python -m study half_real bags/real --poses truth.tum --odometry odom.csv
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sfa_localization.cli import guarded
from sfa_localization.commands.options import add_settings, settings
from sfa_localization.data.errors import ConfigError
from study import half_real, large, light, light_report, year, year_report
from study.results import Progress, StudyConfig
from study.sites import FULL, QUICK
from study.tables import NAMES, Work

STUDIES = {
    'all': 'the next five, which take hours',
    'simulator': "the paper's experiment in its simulator",
    'robot': "the paper's experiment with a robot, simulated",
    'baselines': 'other features instead of slow features',
    'ablations': 'this package without some of its parts',
    'light': 'train in one, two or three lights, test in every light and season',
    'year': 'train once, then drive each month, with and without updates of the model',
    'large': 'gardens of 16 m x 18 m to 64 m x 72 m, at one density of drives',
}


def main(words: Sequence[str] | None = None) -> int:
    """Run the study that the first word names; return the exit code."""
    arguments = study_parser().parse_args(words)
    return guarded(lambda: int(arguments.run(arguments)))


def study_parser() -> argparse.ArgumentParser:
    """The parser of all studies."""
    parser = argparse.ArgumentParser(
        prog='study', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(metavar='STUDY', required=True)
    for name, summary in STUDIES.items():
        add_arguments(commands.add_parser(name, help=summary), name)
    half_real.add_arguments(commands.add_parser('half_real', help=half_real.SUMMARY))
    return parser


def add_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the folder and the settings of a study."""
    parser.set_defaults(run=run, study=name, training=[], test=None)
    parser.add_argument(
        '--out',
        type=Path,
        metavar='DIR',
        help='folder to write, or one with the same settings to go on with [study_paper, '
        'study_light, study_year, study_large; with --quick study_quick...]',
    )
    parser.add_argument(
        '--quick', action='store_true', help='a smaller garden, smaller images, fewer seasons'
    )
    add_settings(parser, StudyConfig)
    if name == 'baselines':
        parser.add_argument(
            '--training', nargs='+', type=Path, metavar='BAG', help='drives to train on'
        )
        parser.add_argument('--test', type=Path, metavar='BAG', help='drive to test on')


def run(arguments: argparse.Namespace) -> int:
    """Complete the studies, and print their tables."""
    config = settings(StudyConfig, arguments)
    start = 'study_quick_' if arguments.quick else 'study_'
    if bool(arguments.training) != bool(arguments.test):
        raise ConfigError('--training and --test: give both, or neither')
    chosen = (*NAMES, 'light') if arguments.study == 'all' else (arguments.study,)
    paper = [name for name in chosen if name in NAMES]
    if paper:
        _paper(paper, arguments.out or Path(f'{start}paper'), config, arguments)
    if 'light' in chosen:
        out = arguments.out and (arguments.out / 'light' if paper else arguments.out)
        plan = light.QUICK if arguments.quick else light.FULL
        cells = light.fill_matrix(out or Path(f'{start}light'), config, plan, progress=True)
        print(light_report.table(cells))
    if 'year' in chosen:
        months = year.QUICK_YEAR if arguments.quick else year.YEAR
        cells = year.judge_year(
            arguments.out or Path(f'{start}year'), config, months, progress=True
        )
        print(year_report.table(cells))
    if 'large' in chosen:
        areas = large.QUICK_AREAS if arguments.quick else large.AREAS
        print(large.judge_areas(arguments.out or Path(f'{start}large'), config, areas))
    return 0


def _paper(
    names: Sequence[str], out: Path, config: StudyConfig, arguments: argparse.Namespace
) -> None:
    """Announce the duration of the paper's results, then complete them in one folder."""
    plan, training = QUICK if arguments.quick else FULL, tuple(arguments.training)
    work = Work(out, config, plan, Progress(shown=True), training, arguments.test)
    lights = light.QUICK if arguments.quick else light.FULL
    work.announce(names, lights.minutes if arguments.study == 'all' else 0)
    for name in names:
        print(work.reproduced(name))


if __name__ == '__main__':
    sys.exit(main())
