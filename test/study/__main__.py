# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Make the tables and figures of test/EVALUATION.md and PAPER.md; make half-real bags.

PYTHONPATH=.:test python -m study all --quick
PYTHONPATH=.:test python -m study simulator --seeds 5
PYTHONPATH=.:test python -m study baselines --training bags/coverage bags/lines --test bags/test
PYTHONPATH=.:test python -m study half_real bags/real --poses truth.tum --odometry odom.csv
PYTHONPATH=.:test python -m study page study_paper study_light
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sfa_localization.cli import guarded
from sfa_localization.commands.options import add_settings, settings
from sfa_localization.data.errors import ConfigError
from study import (
    bags,
    cameras,
    half_real,
    large,
    light,
    light_report,
    page,
    rig,
    year,
    year_report,
)
from study.results import Progress, StudyConfig
from study.sites import FULL, QUICK
from study.tables import NAMES, Work

STUDIES = {
    'all': 'the next nine, which take hours, and their page',
    'simulator': "the paper's experiment in its simulator",
    'robot': "the paper's experiment with a robot, simulated",
    'baselines': 'other features instead of slow features',
    'ablations': 'this package without some of its parts',
    'light': 'train by day in summer, test in every light and season',
    'rig': 'a camera ahead of the axle, and uneven ground',
    'cameras': 'several cameras around the robot, and what happens to one of them',
    'year': 'train once, then drive each month, with and without updates of the model',
    'large': 'gardens of 16 m x 18 m to 64 m x 72 m, at one density of drives',
}
COMMANDS = {'half_real': half_real, 'bags': bags, 'page': page}
"""What needs other arguments."""


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
    for name, command in COMMANDS.items():
        command.add_arguments(commands.add_parser(name, help=command.SUMMARY))
    return parser


def add_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the folder and the settings of a study."""
    parser.set_defaults(run=run, study=name, training=[], test=None)
    parser.add_argument(
        '--out',
        type=Path,
        metavar='DIR',
        help='folder to write, or one with the same settings to go on with [study_paper, '
        'study_light, study_rig, study_cameras, study_year, study_large; with --quick '
        'study_quick_paper...]',
    )
    parser.add_argument(
        '--quick', action='store_true', help='a smaller garden, smaller images, fewer months'
    )
    add_settings(parser, StudyConfig)
    if name == 'baselines':
        parser.add_argument(
            '--training', nargs='+', type=Path, metavar='BAG', help='drives to train on'
        )
        parser.add_argument('--test', type=Path, metavar='BAG', help='drive to test on')


def run(arguments: argparse.Namespace) -> int:
    """Complete the studies, and print their tables; of all, write the page."""
    if bool(arguments.training) != bool(arguments.test):
        raise ConfigError('--training and --test: give both, or neither')
    every = arguments.study == 'all'
    chosen = [*STUDIES][1:] if every else [arguments.study]
    folders = {name: _folder(arguments, name) for name in chosen}
    paper = [name for name in chosen if name in NAMES]
    if paper:
        _paper(paper, folders[paper[0]], arguments)
    for name in chosen:
        if name not in NAMES:
            print(_other(name, folders[name], arguments), end='')
    if every and not arguments.quick:
        page.update([*dict.fromkeys(folders.values())])
    return 0


def _folder(arguments: argparse.Namespace, name: str) -> Path:
    """The folder of a study; the paper's results share one."""
    name = 'paper' if name in NAMES else name
    if arguments.out is None:
        return Path(f'study_quick_{name}' if arguments.quick else f'study_{name}')
    return Path(arguments.out / name if arguments.study == 'all' else arguments.out)


def _paper(names: Sequence[str], out: Path, arguments: argparse.Namespace) -> None:
    """Announce the duration of the paper's results, then complete them in one folder."""
    plan, training = QUICK if arguments.quick else FULL, tuple(arguments.training)
    config = settings(StudyConfig, arguments)
    work = Work(out, config, plan, Progress(shown=True), training, arguments.test)
    work.announce(names)
    for name in names:
        print(work.reproduced(name), end='')


def _other(name: str, out: Path, arguments: argparse.Namespace) -> str:
    """Complete another study; return its table."""
    config, quick, progress = settings(StudyConfig, arguments), arguments.quick, Progress(True)
    if name == 'light':
        return light_report.table(light.fill_matrix(out, config, progress))
    if name == 'rig':
        cases = rig.QUICK_CASES if quick else rig.CASES
        return rig.table(rig.judge_rigs(out, config, cases, progress))
    if name == 'cameras':
        rigs = cameras.QUICK_RIGS if quick else cameras.RIGS
        return cameras.table(cameras.judge_cameras(out, config, rigs, progress))
    if name == 'year':
        months = year.QUICK_MONTHS if quick else year.MONTHS
        return year_report.table(year.judge_year(out, config, months, progress))
    areas = large.QUICK_AREAS if quick else large.AREAS
    return large.table(large.judge_areas(out, config, areas))


if __name__ == '__main__':
    sys.exit(main())
