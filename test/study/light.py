# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `light`: one garden, trained in some lights, tested in all of them.

A row of the matrix tests one model in every light; the last row tests in each light the model of
the other three. The test drives have the same poses in every light. Bags, models and cells of the
matrix that are finished are kept, and used again when the command is repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sfa_localization.bags.drives import as_live, image_folder, read_drive
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, RigidTransform
from sfa_localization.data.run import Run, Trajectory
from sfa_localization.evaluation import evaluate, fit_transform, moved, score
from sfa_localization.keyframes.closures import Closures
from sfa_localization.metric.drives import Drives
from sfa_localization.metric.learning import learn_metric
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.figures import save_text
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train
from sfa_localization.training_input import drive_of
from study.light_report import matrix_figure, table
from study.paper import RECIPES, flat
from study.results import (
    BATCH,
    Cell,
    Progress,
    Results,
    StudyConfig,
    recorded,
    settings_of,
    usual_drift,
)
from study.retrieval import ImageRetrieval
from study.trials import STRAIGHT, features_of, slow_of, turned_of

RESULTS = 'matrix.json'
Condition = tuple[str, str]
"""Light and season."""
LIGHTS, SEASONS = ('day', 'morning', 'overcast', 'evening'), ('summer', 'autumn', 'winter')
TRAININGS: dict[str, tuple[str, ...]] = {'day': ('day',), 'day + overcast': ('day', 'overcast')}
"""Rows of the matrix with one model: the lights of its training drives, in summer."""
ALL_BUT = 'all but the tested'
"""The row with a model for each tested light: trained in the other three, in summer."""


@dataclass(frozen=True, slots=True)
class LightPlan:
    """Size of the garden (m) and of the panoramas, conditions of the tests, lights of `ALL_BUT`,
    and minutes on two cores.
    """

    area: tuple[float, float]
    panorama: tuple[int, int]
    tests: tuple[Condition, ...]
    untrained_lights: tuple[str, ...]
    minutes: int


FULL = LightPlan(
    (16.0, 18.0), (600, 60), tuple((li, s) for s in SEASONS for li in LIGHTS), LIGHTS, 60
)
QUICK = LightPlan(
    (8.0, 8.0),
    (300, 30),
    (*((light, 'summer') for light in LIGHTS), ('overcast', 'autumn'), ('day', 'winter')),
    ('evening', 'overcast'),
    5,
)


@dataclass(frozen=True, slots=True)
class Training:
    """The `lights` of a training, in summer, and its `tests`, cells of the row `trained`."""

    trained: str
    lights: tuple[str, ...]
    tests: tuple[Condition, ...]


def trainings(plan: LightPlan) -> Iterator[Training]:
    """The models of a plan: one for each row, and for `ALL_BUT` one for each tested light."""
    for trained, lights in TRAININGS.items():
        yield Training(trained, lights, plan.tests)
    for light in plan.untrained_lights:
        others = tuple(other for other in LIGHTS if other != light)
        yield Training(ALL_BUT, others, tuple(test for test in plan.tests if test[0] == light))


@dataclass(frozen=True, slots=True)
class _Work:
    """The folder, the garden in it, and how its steps are shown."""

    out: Path
    config: StudyConfig
    plan: LightPlan
    progress: Progress

    def training(self, light: str) -> Path:
        """The training drive in a light; each light has its own route."""
        name = f'train_{light}'
        return self._recorded(name, 'coverage', 1 + LIGHTS.index(light), (light, 'summer'))

    def test(self, condition: Condition) -> Path:
        """The test drive in light and season: always the same poses."""
        return self._recorded('test_' + '_'.join(condition), 'test', 0, condition)

    def _recorded(self, name: str, route: str, drive: int, condition: Condition) -> Path:
        config = SimulationConfig(
            trajectory=route,
            world=self.config.world,
            seed=self.config.seed + drive,
            area=self.plan.area,
            test_drift=usual_drift(self.plan.area),
            light=condition[0],
            season=condition[1],
            images='panorama',
            compression='jpeg',
        )
        return recorded(self.out / name, config, self.plan.panorama, self.progress)

    @property
    def panorama(self) -> PanoramaConfig:
        """Size of the simulated panoramas."""
        return PanoramaConfig(width=self.plan.panorama[0], height=self.plan.panorama[1])

    def model(self, lights: Sequence[str], bags: Sequence[Path]) -> PlaceModel:
        """The model of the training drives `bags`, in some lights."""
        path = self.out / f'{"_".join(lights)}.npz'
        if not path.exists():
            self.progress.say(f'train on {" + ".join(lights)}')
            train(bags, path, progress=self.progress.shown, resume=True)
        return PlaceModel.load(path)


def fill_matrix(
    out: Path, config: StudyConfig, plan: LightPlan, *, progress: bool = False
) -> list[Cell]:
    """Fill the matrix; write it as JSON, table and figure below `out`. Returns its cells.

    A cell has `trained`, `light` and `season`, the scores that `_judged` names, and those of plain
    image `retrieval` and of `slow` features alone; where there is one training drive, also those
    of the `paper`'s recipe. Raises LocalizationError, also for a folder with results of other
    settings.
    """
    report = Progress(progress)
    settings = settings_of(config.world, config.seed, plan.area, plan.panorama)
    results = Results.opened(out / RESULTS, settings)
    cells = results.cells
    done = f'; {len(cells)} cells are finished' if cells else ''
    report.say(f'this takes about {plan.minutes} minutes on two cores{done}')
    work = _Work(out, config, plan, report)
    for training in trainings(plan):
        missing = [test for test in training.tests if not _is_done(results, training.trained, test)]
        if missing:
            _fill(work, replace(training, tests=tuple(missing)), results.keep)
    save_text(out / 'matrix.md', table(cells) + '\n')
    matrix_figure(out / 'matrix.png', cells)
    report.say(f'see {out / "matrix.png"}')
    return cells


def _is_done(results: Results, trained: str, test: Condition) -> bool:
    return results.find(trained=trained, light=test[0], season=test[1]) is not None


def _fill(work: _Work, training: Training, keep: Callable[[Cell], None]) -> None:
    """Train once and test in some lights; `keep` receives every finished cell."""
    bags = [work.training(light) for light in training.lights]
    drives = [work.test(test) for test in training.tests]
    model = work.model(training.lights, bags)
    recipe = as_live(Recipe(), work.panorama)
    cache = image_folder(work.out / 'images')
    runs = [_read(bag, cache / bag.name, recipe) for bag in bags]
    retrieval, transform = _retrieval(runs), None
    paper = _paper_recipe(model, runs[0]) if len(runs) == 1 else None
    for test, drive in zip(training.tests, drives, strict=True):
        work.progress.say(f'{" + ".join(training.lights)}, tested in {" ".join(test)}')
        run = _read(drive, cache / drive.name, recipe)
        cell, transform = _judged(model, drive, bags, transform)
        beside = {'retrieval': _retrieved(retrieval, run)}
        if transform is not None:
            beside['slow'] = _slow_alone(model, run, transform)
        if paper is not None:
            beside['paper'] = paper(run)
        names = {'trained': training.trained, 'light': test[0], 'season': test[1]}
        keep({**names, **cell, **beside})


def _read(bag: Path, cache: Path, recipe: Recipe) -> Run:
    cache.mkdir(exist_ok=True)
    return read_drive(bag, cache, recipe, want_truth=True)


def _judged(
    model: PlaceModel, bag: Path, trained: Sequence[Path], transform: RigidTransform | None
) -> tuple[Cell, RigidTransform | None]:
    """Scores of one drive: `sfa` and `ekf` with `mean_m`, `heading_deg` and `within_95`, seconds
    `false_localised_s` and the share `localized` of the drive; and the transform to the truth.

    The map is aligned on the training drives, once. A drive without a usable image has only a
    `problem`.
    """
    try:
        result = evaluate(model, bag, align_bags=() if transform else trained, transform=transform)
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


def _retrieval(runs: Sequence[Run]) -> ImageRetrieval:
    """Retrieval of the images of the training drives, at their true poses."""
    images = (image for run in runs for batch in run.panoramas.batches(BATCH) for image in batch)
    return ImageRetrieval.of(images, np.concatenate([_truth(run).poses for run in runs]))


def _retrieved(retrieval: ImageRetrieval, run: Run) -> Cell:
    truth = _truth(run)
    poses = [retrieval.locate(i) for batch in run.panoramas.batches(BATCH) for i in batch]
    return _summary(score(truth, Trajectory(truth.stamps_ns, np.array(poses))))


def _truth(run: Run) -> Trajectory:
    """True poses of the images."""
    if run.ground_truth is None:
        raise DataError(f'{run.name}: no ground truth')
    stamps = run.panoramas.stamps_ns
    return Trajectory(stamps, run.ground_truth.at(stamps))
