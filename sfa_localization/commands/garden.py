# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The work on one garden of a fleet, by the commands inspect, train and evaluate."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

from sfa_localization import __version__
from sfa_localization.bags.recording import METADATA, is_bag, recorded_files
from sfa_localization.commands import evaluate, inspect, train
from sfa_localization.data.errors import BagError, LocalizationError
from sfa_localization.data.files import read_text, write_json
from sfa_localization.data.plain_yaml import LONGEST
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.fleet import STATES
from sfa_localization.reports.page import BAD, WEAK

CONFIG = 'localization.yaml'
POINTS = 'points.csv'
TESTS = 'test'
TRAINING = 'training.json'
Judgment = Mapping[str, Any]
"""What a command writes as JSON, with a `grade` of STATES and a `sentence`."""


@dataclass(frozen=True, slots=True)
class Garden:
    """The folder of a garden's bags, and the folder of its model and result; absolute paths."""

    folder: Path
    output: Path

    @property
    def model(self) -> Path:
        """The file of the model."""
        return self.output / 'model.npz'

    def bags(self, folder: str = '') -> list[Path]:
        """The bags in the garden, or in a folder of it."""
        inside = self.folder / folder
        if (inside / METADATA).is_file():
            return [inside]
        paths = sorted(inside.iterdir()) if inside.is_dir() else []
        paths = [path for path in paths if path.name != TESTS and path.name[0] != '.']
        return [path for path in paths if is_bag(path)]

    def unread(self) -> list[Judgment]:
        """A judgment on each bag that lies too deep in the garden."""
        deep = (path for path in sorted(self.folder.glob('*/*')) if path.parent.name != TESTS)
        bags = [path for path in deep if path.is_dir() and is_bag(path)]
        text = 'not used: bags lie directly in the folder of a garden'
        return [{'grade': WEAK, 'sentence': f'{bag}: {text}'} for bag in bags]

    def option(self, name: str, file: str) -> list[Path | str]:
        """The words of an option, if the garden has the file that it names."""
        path = self.folder / file
        return [name, path] if path.is_file() else []

    def inputs(self) -> dict[str, Any]:
        """The version, and size and time (ns) of all files of bags and options, by their names."""
        paths = [*self.bags(), *self.bags(TESTS), self.folder / CONFIG, self.folder / POINTS]
        files = [file for path in paths for file in recorded_files(path) if file.is_file()]
        states = {str(file.relative_to(self.folder)): file.stat() for file in files}
        stamps = {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()}
        return {'version': __version__, **stamps}

    def result(self) -> dict[str, Any]:
        """What the last run wrote; {} without a readable file."""
        return _read_json(self.output / 'result.json')

    def is_up_to_date(self) -> bool:
        """Whether the last run read the same files, and its model is there."""
        result = self.result()
        done = self.model.is_file() or result.get('grade') == BAD
        return done and bool(result.get('inputs') == self.inputs()) and not self.unread()

    def write(self, result: Mapping[str, Any], judgments: Sequence[Judgment]) -> str:
        """Write a result with judgments, the worst first; the state. Raises LocalizationError."""
        ordered = sorted(judgments, key=lambda judgment: [*STATES].index(judgment['grade']))
        grade = ordered[0]['grade']
        sentences = [judgment['sentence'] for judgment in ordered]
        head = {'garden': self.output.name, 'grade': grade, 'state': STATES[grade]}
        write_json(self.output / 'result.json', {**result, **head, 'sentences': sentences})
        return STATES[grade]


def _read_json(path: Path) -> dict[str, Any]:
    """A mapping that a run has written; {} without a readable file."""
    try:
        return dict(json.loads(read_text(path, LONGEST, LocalizationError)))
    except (LocalizationError, ValueError):
        return {}


def work(garden: Garden) -> str:
    """Bring a garden up to date, write its result last, and return its state.

    A LocalizationError is a result; any other error is raised, and no result is written.
    """
    result = garden.result()
    inputs = garden.inputs()
    with redirect_stdout(StringIO()) as output, redirect_stderr(output):
        try:
            training, *updates = _learn(garden, result, inputs)
            model = PlaceModel.load(garden.model)
            tests = _evaluate(garden, 'points' in model.quality)
            judgments = [training, *updates, *tests]
            result['tested'] = _tested(tests)
            error_m = model.quality['expected_error_m']
            if 'expected_error_m' in result:
                result['change_m'] = error_m - result['expected_error_m']
            result['expected_error_m'] = error_m
            result['area_m2'] = model.ground.cells(GroundConfig()).area_m2
            result['trained_s'] = (garden.output / TRAINING).stat().st_mtime
        except LocalizationError as error:
            stays = '; the earlier model stays' if garden.model.is_file() else ''
            judgments = [{'grade': BAD, 'sentence': f'{error}{stays}'}]
    return garden.write({**result, 'inputs': inputs}, [*judgments, *garden.unread()])


def give_up(garden: Garden, error: BaseException) -> str:
    """Write that the work on a garden ended in errors; the next run tries it again."""
    words = ' '.join(f'{type(error).__name__}: {error}'.split())
    sentence = f'its process ended twice, the last time by {words}: was the memory full?'
    result = {**garden.result(), 'inputs': {}}
    return garden.write(result, [{'grade': BAD, 'sentence': sentence}])


def _learn(garden: Garden, before: Mapping[str, Any], inputs: Mapping[str, Any]) -> list[Judgment]:
    """Update a useful model where only drives were added, else train.

    Returns the judgments of the training, which may be that of an earlier run, and of each update.
    """
    old = before.get('inputs', {})
    config = garden.option('--config', CONFIG)
    changes = {name for name in {*old, *inputs} if old.get(name) != inputs.get(name)}
    changed, former = ({Path(name).parts[0] for name in names} for names in (changes, old))
    added = [drive for drive in garden.bags() if drive.name in changed - former]
    useful = garden.model.is_file() and before.get('grade') != BAD
    if not useful or changed - {TESTS, *(drive.name for drive in added)}:
        return [_train(garden, config)]
    words = *config, '--update', garden.model, '--output', garden.model
    judgments: list[Judgment] = [_read_json(garden.output / TRAINING)]
    for drive in added:
        page = garden.output / f'update_{drive.name}'
        report = *words, '--report', page
        judgments.append(_attempt(train, garden.output / 'update.json', drive, *report))
    return judgments


def _train(garden: Garden, config: Sequence[Path | str]) -> Judgment:
    """Inspect and train, with a page of each."""
    drives = garden.bags()
    output = garden.output
    if not drives:
        problem = 'holds no bag' if garden.folder.is_dir() else 'is no folder'
        raise BagError(f'{garden.folder}: {problem}: record a bag into it')
    report = '--report', output / 'inspection'
    _run(inspect, output / 'inspection.json', *drives, *config, *report)
    words = [*drives, *config, *garden.option('--points', POINTS)]
    words += ['--output', garden.model, '--report', output / 'training']
    return _run(train, output / TRAINING, *words, '--resume')


def _evaluate(garden: Garden, has_points: bool) -> list[Judgment]:
    """Judge the filter on each test drive, with a page.

    The map is aligned by measured points, or on the drives of the training.
    """
    words = garden.option('--config', CONFIG)
    judgments = list[Judgment]()
    for drive in ['none'] if has_points else garden.bags():
        words += ['--align', drive]
    for bag in garden.bags(TESTS):
        page = garden.output / f'test_{bag.name}'
        report = *words, '--report', page
        judgments.append(_attempt(evaluate, page / 'scores.json', bag, garden.model, *report))
    return judgments


def _tested(tests: Sequence[Judgment]) -> dict[str, float]:
    """Mean, 95th percentile and maximum (m) of the filter's errors on the test drive with the
    largest mean; {} without any.
    """
    scores = [test['ekf'] for test in tests if test.get('ekf') and test['ekf']['mean'] is not None]
    if not scores:
        return {}
    worst = max(scores, key=lambda score: float(score['mean']))
    return {f'{name}_m': worst[name] for name in ('mean', 'p95', 'max')}


def _attempt(command: ModuleType, file: Path, bag: Path, *words: Path | str) -> Judgment:
    """The judgment of a command on a bag, without which the model is useful too."""
    try:
        judgment = _run(command, file, *words, bag)
    except LocalizationError as error:
        return {'grade': WEAK, 'sentence': f'not used: {error}'}
    return {**judgment, 'sentence': f'{bag.name}: {judgment["sentence"]}'}


def _run(command: ModuleType, file: Path, *words: Path | str) -> Judgment:
    """Run a command with words of its command line; what it writes as JSON into a file."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    command.run(parser.parse_intermixed_args([*map(str, words), '--json', str(file)]))
    return _read_json(file)
