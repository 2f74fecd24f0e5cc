# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `light`: one garden, trained by day in summer, tested in all lights and seasons.

The test drives have the same poses in every light. Bags, the model and cells that are finished are
kept, and used again when the command is repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from study.light_report import table
from study.paper import RECIPES, flat
from study.results import Cell, Progress, Results, StudyConfig, recorded, settings_of, usual_drift
from study.trials import STRAIGHT, features_of, slow_of, turned_of

RESULTS = 'matrix.json'
Condition = tuple[str, str]
"""Light and season."""
LIGHTS = 'day', 'morning', 'overcast', 'evening'
TRAINED = LIGHTS[0]


@dataclass(frozen=True, slots=True)
class LightPlan:
    """Size of the garden (m) and of the panoramas, conditions of the tests, and minutes on two
    cores.
    """

    area: tuple[float, float]
    panorama: tuple[int, int]
    tests: tuple[Condition, ...]
    minutes: int


PLAN = LightPlan(
    (8.0, 8.0),
    (300, 30),
    (*((light, 'summer') for light in LIGHTS), ('overcast', 'autumn'), ('day', 'winter')),
    4,
)


@dataclass(frozen=True, slots=True)
class _Work:
    """The folder, the garden in it, and how its steps are shown."""

    out: Path
    config: StudyConfig
    plan: LightPlan
    progress: Progress

    def training(self) -> Path:
        """The training drive."""
        return self._recorded(f'train_{TRAINED}', 'coverage', 1, (TRAINED, 'summer'))

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

    def model(self) -> PlaceModel:
        """The model of the training drive."""
        path = self.out / f'{TRAINED}.npz'
        if not path.exists():
            self.progress.say(f'train by {TRAINED}')
            train([self.training()], path, progress=self.progress.shown, resume=True)
        return PlaceModel.load(path)


def fill_matrix(
    out: Path, config: StudyConfig, plan: LightPlan, *, progress: bool = False
) -> list[Cell]:
    """Fill the matrix; write it as JSON and as a table below `out`. Returns its cells.

    A cell has `trained`, `light` and `season`, the scores that `_judged` names, and those of `slow`
    features alone and of the `paper`'s recipe. Raises LocalizationError, also for a folder with
    results of other settings.
    """
    report = Progress(progress)
    settings = settings_of(config.world, config.seed, plan.area, plan.panorama)
    results = Results.opened(out / RESULTS, settings)
    cells = results.cells
    done = f'; {len(cells)} cells are finished' if cells else ''
    report.say(f'this takes about {plan.minutes} minutes on two cores{done}')
    work = _Work(out, config, plan, report)
    missing = [test for test in plan.tests if not _is_done(results, test)]
    if missing:
        _fill(work, missing, results.keep)
    save_text(out / 'matrix.md', table(cells))
    report.say(f'see {out / "matrix.md"}')
    return cells


def _is_done(results: Results, test: Condition) -> bool:
    return results.find(trained=TRAINED, light=test[0], season=test[1]) is not None


def _fill(work: _Work, tests: Sequence[Condition], keep: Callable[[Cell], None]) -> None:
    """Train once and test in some lights; `keep` receives every finished cell."""
    training, model, transform = work.training(), work.model(), None
    recipe = as_live(Recipe(), work.panorama)
    cache = image_folder(work.out / 'images')
    paper = _paper_recipe(model, _read(training, cache / training.name, recipe))
    for test in tests:
        work.progress.say(f'tested in {" ".join(test)}')
        drive = work.test(test)
        run = _read(drive, cache / drive.name, recipe)
        cell, transform = _judged(model, drive, training, transform)
        cell['paper'] = paper(run)
        if transform is not None:
            cell['slow'] = _slow_alone(model, run, transform)
        keep({'trained': TRAINED, 'light': test[0], 'season': test[1], **cell})


def _read(bag: Path, cache: Path, recipe: Recipe) -> Run:
    cache.mkdir(exist_ok=True)
    return read_drive(bag, cache, recipe, want_truth=True)


def _judged(
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
