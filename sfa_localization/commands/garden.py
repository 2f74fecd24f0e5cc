# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The work on one garden of a fleet: inspect its bags, train or update its model, evaluate it."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfa_localization import __version__
from sfa_localization.bags.recording import METADATA, SUFFIXES, recorded_files
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands import options
from sfa_localization.commands.inspect import inspected
from sfa_localization.commands.inspect import write_report as write_inspection
from sfa_localization.commands.train import write_report as write_training
from sfa_localization.data.errors import BagError, LocalizationError, ModelError
from sfa_localization.data.files import read_text, write_json
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.data.plain_yaml import LONGEST
from sfa_localization.evaluation import evaluate
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.inspection import InspectionConfig, lacks_together
from sfa_localization.metric.settings import GroundConfig, MetricConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.evaluation import judgment as judgment_of_drive
from sfa_localization.reports.page import BAD, GOOD, PAGE, WEAK
from sfa_localization.reports.summary import judgment
from sfa_localization.training import Recipe, train
from sfa_localization.updating import update

CONFIG, POINTS, TESTS, RESULT = 'localization.yaml', 'points.csv', 'test', 'result.json'
STATES = {GOOD: 'good', WEAK: 'weak', BAD: 'refused'}
"""State of a garden by the worst grade of its judgments; the worst is last."""
Judgment = tuple[str, ...]
"""What is judged (run, training, inspection, update, or a test drive), grade, and sentence."""


@dataclass(frozen=True, slots=True)
class Garden:
    """The folder of a garden's bags, and the folder of its model and result; absolute paths."""

    folder: Path
    output: Path

    @property
    def model(self) -> Path:
        """The file of the model."""
        return self.output / 'model.npz'

    def inputs(self, bags: Iterable[Path]) -> dict[str, Any]:
        """The version, and size and time (ns) of each file of bags and options. Raises OSError."""
        paths = *bags, self.folder / CONFIG, self.folder / POINTS
        files = (file for path in paths for file in recorded_files(path) if file.is_file())
        states = {os.path.relpath(file, self.folder): file.stat() for file in files}
        stamps = {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()}
        return {'version': __version__, **stamps}

    def result(self) -> dict[str, Any]:
        """What the last run wrote; {} without a readable file."""
        try:
            text = read_text(self.output / RESULT, LONGEST, LocalizationError)
            return dict(json.loads(text))
        except (LocalizationError, ValueError):
            return {}

    def lasting(self) -> list[Judgment]:
        """Judgments of the model that is there, which hold until it is trained again."""
        judgments = self.result().get('judgments', []) if self.model.is_file() else []
        return [tuple(item) for item in judgments if item[0] in ('training', 'inspection')]

    def write(self, judgments: Sequence[Judgment], **more: Any) -> str:
        """Write the result, and return the state. Raises LocalizationError."""
        _, grade, sentence = max(judgments, key=lambda judgment: [*STATES].index(judgment[1]))
        head = {'garden': self.output.name, 'state': STATES[grade], 'sentence': sentence}
        write_json(self.output / RESULT, {**head, 'judgments': judgments, **more})
        return STATES[grade]


def bags_in(folder: Path) -> list[Path]:
    """The folder if it holds files of a bag, else the bags in it, by name. Raises OSError."""
    if _is_bag(folder):
        return [folder]
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path for path in inside if path.name != TESTS and _is_bag(path)]


def _is_bag(path: Path) -> bool:
    names = os.listdir(path) if path.is_dir() else [path.name]
    return any(name == METADATA or name.endswith(SUFFIXES) for name in names)


def is_up_to_date(garden: Garden) -> bool:
    """Whether the last run read the same bags and options, and its model is there."""
    result, folder = garden.result(), garden.folder
    try:
        inputs = garden.inputs([*bags_in(folder), *bags_in(folder / TESTS)])
    except OSError:  # which the work on this garden meets again, and reports
        return False
    return result.get('inputs') == inputs and (not result['model'] or garden.model.is_file())


def work(garden: Garden) -> str:
    """Bring a garden up to date, write its result last, and return its state.

    A LocalizationError is a result; any other error is raised, and no result is written.
    """
    start_s, before, page = time.time(), garden.result(), 'training'
    tests, model = bags_in(garden.folder / TESTS), before.get('model')
    inputs = garden.inputs([*bags_in(garden.folder), *tests])
    errors_m: dict[str, float] = {}
    try:
        settings = _settings(garden)
        model, judgments = _learn(garden, settings, before)
        for bag in tests:
            judgments.append(_evaluate(garden, settings, bag, errors_m))
    except LocalizationError as error:
        page, judgments = 'inspection', [('run', BAD, str(error)), *garden.lasting()]
    return garden.write(
        judgments,
        model=model if garden.model.is_file() else None,
        errors_m=errors_m,
        page=f'{page}/{PAGE}' if (garden.output / page / PAGE).is_file() else '',
        seconds=round(time.time() - start_s, 1),
        inputs=inputs,
    )


def give_up(garden: Garden, error: BaseException) -> str:
    """Write that the work on a garden ended in errors; the next run tries it again."""
    words = ' '.join(f'{type(error).__name__}: {error}'.split())
    sentence = f'its process ended twice, the last time by {words}: was the memory full?'
    judgments = [('run', BAD, sentence), *garden.lasting()]
    return garden.write(judgments, model=garden.result().get('model'))


def _settings(garden: Garden) -> dict[str, Any]:
    """What the garden's files set, as keywords of `update` and `evaluate`. Raises ConfigError."""
    config, points = garden.folder / CONFIG, garden.folder / POINTS
    arguments = argparse.Namespace(config=config if config.is_file() else None)
    if points.is_file():
        setattr(arguments, options.destination(MetricConfig, 'points'), str(points))
    watch, recipe = options.settings(WatchConfig, arguments), options.recipe(arguments)
    return {'recipe': recipe, 'watch': watch, 'config': options.settings(FilterConfig, arguments)}


def _learn(
    garden: Garden, settings: dict[str, Any], before: dict[str, Any]
) -> tuple[dict[str, Any], list[Judgment]]:
    """Train, or where only bags were added update the model; its figures, and judgments."""
    model, bags = before.get('model') or {'learned': {}}, bags_in(garden.folder)
    learned = model['learned']
    new = [bag for bag in bags if not garden.inputs([bag]).items() <= learned.items()]
    if garden.inputs(set(bags) - set(new)) != learned or not garden.model.is_file():
        return _train(garden, settings['recipe'], bags, model.get('expected_error_m'))
    judgments, saved = garden.lasting(), PlaceModel.load(garden.model)
    for bag in new:
        try:
            updated = update(saved, [bag], garden.model, **settings)
        except LocalizationError as error:
            judgments.append(('update', WEAK, f'{error}; the model stays without this drive'))
            continue
        saved, learned = updated.model, {**learned, **garden.inputs([bag])}
        judgments.append(('update', GOOD, updated.sentence()))
    return {**model, 'learned': learned}, judgments


def _train(
    garden: Garden, recipe: Recipe, bags: Sequence[Path], previous_error_m: float | None
) -> tuple[dict[str, Any], list[Judgment]]:
    """Inspect and train, with a page of each; the figures of the model, and judgments."""
    if not bags:
        raise BagError(f'{garden.folder}: holds no bag: record one into this folder')
    inputs, config = garden.inputs(bags), InspectionConfig()
    reports = inspected(bags, recipe.topics, config, recipe.panorama.clockwise)
    write_inspection(garden.output / 'inspection', reports)
    try:  # to continue a training that was interrupted
        trained = train(bags, garden.model, recipe, resume=True)
    except ModelError:  # it was of other bags or parameters
        trained = train(bags, garden.model, recipe)
    write_training(garden.output / 'training', bags, trained, recipe)
    ground = GroundConfig()
    model = {
        'learned': inputs,
        'trained_s': time.time(),
        'expected_error_m': trained.model.quality['expected_error_m'],
        'previous_error_m': previous_error_m,
        'area_m2': float(trained.model.ground.cells(ground).driven.sum() * ground.cell**2),
    }
    lacks = [('inspection', WEAK, text) for text in lacks_together(reports, config)]
    return model, [('training', *judgment(trained)), *lacks]


def _evaluate(
    garden: Garden, settings: dict[str, Any], bag: Path, errors_m: dict[str, float]
) -> Judgment:
    """Add the mean error (m) of the filter on a test drive, where it has ground truth; judge it.

    The map is aligned by measured points, or on the drives of the training.
    """
    model = PlaceModel.load(garden.model)
    if model.quality.get('points'):
        settings = {**settings, 'transform': RigidTransform(0.0, 0.0, 0.0)}
    else:
        settings = {**settings, 'align_bags': bags_in(garden.folder)}
    try:
        result = evaluate(model, bag, **settings)
    except LocalizationError as error:
        return f'test {bag.name}', GOOD, f'not evaluated: {error}'
    errors_m[bag.name] = result.scores['ekf']['mean']
    return f'test {bag.name}', *judgment_of_drive(result.scores, result.counts)
