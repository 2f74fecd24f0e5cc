# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `light`: one garden, trained by day in summer, tested in all lights and seasons.

The test drives have the same poses in every light. Bags, the model and cells that are finished are
kept, and used again when the command is repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sfa_localization.bags.drives import as_live, image_folder, read_drive
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, RigidTransform
from sfa_localization.data.run import Run, Trajectory
from sfa_localization.evaluation import evaluate, fit_transform, moved, score
from sfa_localization.keyframes.closures import Closures
from sfa_localization.mapping.drives import Drives
from sfa_localization.mapping.learning import learn_metric
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.figures import save_text
from sfa_localization.training import Recipe
from sfa_localization.training_input import drive_of
from study.light_report import table
from study.paper import RECIPES, flat
from study.results import Cell, Progress, Results, StudyConfig
from study.sites import SmallGarden
from study.trials import STRAIGHT, features_of, slow_of, turned_of

RESULTS = 'matrix.json'
Condition = tuple[str, str]
"""Light and season."""
TESTS = (
    ('day', 'summer'), ('morning', 'summer'), ('overcast', 'summer'), ('evening', 'summer'),
    ('overcast', 'autumn'), ('day', 'winter'),
)  # fmt: skip


def fill_matrix(out: Path, config: StudyConfig, progress: Progress) -> list[Cell]:
    """Judge all conditions; write JSON and a table below `out`. Returns the cells.

    A cell has `world`, `light` and `season`, the scores that `judged` names, and those of `slow`
    features alone and of the `paper`'s recipe. Raises LocalizationError, also for a folder with
    results of other settings.
    """
    results = SmallGarden.results(out / RESULTS, config)
    progress.say('this takes about 4 minutes on two cores')
    missing = [test for test in TESTS if not _is_done(results, test)]
    if missing:
        _fill(SmallGarden(out, config.world, config.seed, progress), missing, results.keep)
    save_text(out / 'matrix.md', table(results.cells))
    progress.say(f'see {out / "matrix.md"}')
    return results.cells


def _is_done(results: Results, test: Condition) -> bool:
    return results.find(light=test[0], season=test[1]) is not None


def _fill(garden: SmallGarden, tests: Sequence[Condition], keep: Callable[[Cell], None]) -> None:
    """Train once and test in some lights; `keep` receives every finished cell."""
    training = garden.drive('train_day', 1, trajectory='coverage', light='day', season='summer')
    model, transform = garden.model('day', training), None
    recipe = as_live(Recipe(), model.panorama)
    cache = image_folder(garden.folder / 'images')
    paper = _paper_recipe(model, _read(training, cache / training.name, recipe))
    for light, season in tests:
        garden.progress.say(f'tested in {light}, {season}')
        name = f'test_{light}_{season}'
        drive = garden.drive(name, 0, trajectory='test', light=light, season=season)
        run = _read(drive, cache / drive.name, recipe)
        cell, transform = judged(model, drive, training, transform)
        cell['paper'] = paper(run)
        if transform is not None:
            cell['slow'] = _slow_alone(model, run, transform)
        keep({'world': garden.world, 'light': light, 'season': season, **cell})


def _read(bag: Path, cache: Path, recipe: Recipe) -> Run:
    cache.mkdir(exist_ok=True)
    return read_drive(bag, cache, recipe, want_truth=True)


def judged(
    model: PlaceModel, bag: Path, training: Path, transform: RigidTransform | None
) -> tuple[Cell, RigidTransform | None]:
    """Scores of one drive: `sfa` and `ekf` with `mean_m`, `heading_deg` and `within_95`, seconds
    `false_localised_s` and the share `localized` of the drive; and the transform to the truth.

    The map is aligned on the training drive, once. A drive without a usable image has only a
    `problem`.
    """
    try:
        align = () if transform else (training,)
        result = evaluate(model, bag, align_bags=align, transform=transform)
    except DataError as error:
        return {'problem': str(error)}, transform
    states = result.counts['states_s']
    cell = {
        **{name: _summary(result.scores[name]) for name in ('sfa', 'ekf')},
        'false_localised_s': result.counts['false_localised_s'],
        'localized': states.get('LOCALISED', 0.0) / max(sum(states.values()), 1e-9),
    }
    return cell, result.transform


def _summary(scores: Mapping[str, Any]) -> Cell:
    yaw = scores['yaw_deg']
    return {
        'mean_m': scores['mean'],
        'heading_deg': yaw['mean'] if yaw else None,
        'within_95': scores.get('within_95'),
    }


def _slow_alone(model: PlaceModel, run: Run, transform: RigidTransform) -> Cell:
    """Scores of positions from the map alone, turned by the headings of the keyframes."""
    truth = _truth(run)
    places = model.metric.predict(features_of(turned_of(model), run))[0]
    estimate = Trajectory(truth.stamps_ns, flat(places))
    return _summary(score(truth, moved(estimate, transform)))


def _paper_recipe(model: PlaceModel, training: Run) -> Callable[[Run], Cell]:
    """A function that scores the paper's recipe (section 4) on the single images of a test drive:
    monomials of the slow features, learned from the straight lines of the training drive.

    It is aligned on all images of the training drive, and has no heading. If these lines give no
    map, the score is a `problem`.
    """
    slow = slow_of(model.network)
    features = features_of(slow, training)
    try:
        segments = Drives((drive_of(training),), Closures.none(), STRAIGHT).cut()
        metric = learn_metric(features, segments, RECIPES['paper']).map
    except DataError as error:
        nothing: Cell = {'mean_m': None, 'problem': str(error)}
        return lambda _drive: nothing

    def located(run: Run, features: Array) -> Trajectory:
        return Trajectory(run.panoramas.stamps_ns, flat(metric.predict(features)[0]))

    transform = fit_transform((_truth(training), located(training, features)))
    return lambda drive: _summary(
        score(_truth(drive), moved(located(drive, features_of(slow, drive)), transform))
    )


def _truth(run: Run) -> Trajectory:
    """True poses of the images."""
    if run.ground_truth is None:
        raise DataError(f'{run.name}: no ground truth')
    stamps = run.panoramas.stamps_ns
    return Trajectory(stamps, run.ground_truth.at(stamps))
