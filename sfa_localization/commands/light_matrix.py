# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The steps of `reproduce light`: one garden, trained in some lights, tested in all of them.

The test drives have the same poses in every light. Bags, models and cells of the matrix that are
finished are kept, and used again when the command is repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sfa_localization.bags.drives import as_live, image_cache, read_drive
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.commands.reproduction import (
    BATCH,
    Cell,
    Progress,
    Results,
    recorded,
    settings_of,
)
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.data.run import Run, Trajectory
from sfa_localization.evaluation import evaluate, moved, score
from sfa_localization.features.retrieval import ImageRetrieval
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.evaluation import save_text
from sfa_localization.reports.light import matrix_figure, table
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train

if TYPE_CHECKING:
    from sfa_localization.commands.reproduce import ReproduceConfig

RESULTS = 'matrix.json'
Condition = tuple[str, str]
"""Light and season."""
LIGHTS, SEASONS = ('day', 'morning', 'overcast', 'evening'), ('summer', 'autumn', 'winter')
TRAININGS: dict[str, tuple[str, ...]] = {'day': ('day',), 'day + overcast': ('day', 'overcast')}
"""Rows of the matrix: the lights of the training drives, in summer."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Size of the garden (m) and of the panoramas, where to test, and about how long it takes.

    `minutes` were measured on two cores.
    """

    area: tuple[float, float]
    panorama: tuple[int, int]
    tests: tuple[Condition, ...]
    minutes: int


FULL = Plan((16.0, 18.0), (600, 60), tuple((li, s) for s in SEASONS for li in LIGHTS), 60)
QUICK = Plan(
    (8.0, 8.0),
    (300, 30),
    (*((light, 'summer') for light in LIGHTS), ('overcast', 'autumn'), ('day', 'winter')),
    6,
)


@dataclass(frozen=True, slots=True)
class _Work:
    """The folder, the garden in it, and how its steps are shown."""

    out: Path
    config: ReproduceConfig
    plan: Plan
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

    def model(self, name: str, bags: Sequence[Path]) -> PlaceModel:
        """The model of some training drives."""
        path = self.out / f'{name.replace(" + ", "_")}.npz'
        if not path.exists():
            self.progress.say(f'train on {name}')
            train(bags, path, progress=self.progress.shown, resume=True)
        return PlaceModel.load(path)


def reproduce_light(
    out: Path, config: ReproduceConfig, plan: Plan, *, progress: bool = False
) -> list[Cell]:
    """Fill the matrix; write it as JSON, table and figure below `out`. Returns its cells.

    A cell has `trained`, `light` and `season`, the scores that `_judged` names, and those of plain
    image `retrieval` and of `slow` features alone. Raises LocalizationError, also for a folder with
    results of other settings.
    """
    report = Progress(progress)
    settings = settings_of(config.world, config.seed, plan.area, plan.panorama)
    results = Results.opened(out / RESULTS, settings)
    cells = results.cells
    done = f'; {len(cells)} cells are finished' if cells else ''
    report.say(f'this takes about {plan.minutes} minutes on two cores{done}')
    work = _Work(out, config, plan, report)
    for trained, lights in TRAININGS.items():
        missing = [test for test in plan.tests if not _found(results, trained, test)]
        if missing:
            _fill_row(work, trained, lights, missing, results.keep)
    save_text(out / 'matrix.md', table(cells) + '\n')
    matrix_figure(out / 'matrix.png', cells)
    report.say(f'see {out / "matrix.png"}')
    return cells


def _found(results: Results, trained: str, test: Condition) -> bool:
    return results.find(trained=trained, light=test[0], season=test[1]) is not None


def _fill_row(
    work: _Work,
    trained: str,
    lights: Sequence[str],
    tests: Sequence[Condition],
    keep: Callable[[Cell], None],
) -> None:
    """Train once and test in some lights; every finished cell is handed to `keep`."""
    bags = [work.training(light) for light in lights]
    drives = [work.test(test) for test in tests]
    model = work.model(trained, bags)
    recipe = as_live(Recipe(), work.panorama)
    with image_cache(work.out / 'images') as cache:
        retrieval = _retrieval([_read(bag, cache / bag.name, recipe) for bag in bags])
        transform = None
        for test, drive in zip(tests, drives, strict=True):
            work.progress.say(f'{trained}, tested in {" ".join(test)}')
            run = _read(drive, cache / drive.name, recipe)
            cell, transform = _judged(model, drive, bags[0], transform)
            beside = {'retrieval': _retrieved(retrieval, run)}
            if transform is not None:
                beside['slow'] = _slow_alone(model, run, transform)
            keep({'trained': trained, 'light': test[0], 'season': test[1], **cell, **beside})


def _read(bag: Path, cache: Path, recipe: Recipe) -> Run:
    cache.mkdir(exist_ok=True)
    return read_drive(bag, cache, recipe, want_truth=True)


def _judged(
    model: PlaceModel, bag: Path, align_bag: Path, transform: RigidTransform | None
) -> tuple[Cell, RigidTransform | None]:
    """Scores of one drive: `sfa` and `ekf` with `mean_m`, `heading_deg` and `within_95`, seconds
    `false_localised_s` and the share `localized` of the drive; and the transform to the truth.

    The map is laid on the truth by the first training drive, once. A drive without one usable
    image has only the `problem`.
    """
    try:
        result = evaluate(
            model, bag, align_bag=None if transform else align_bag, transform=transform
        )
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
    """Scores of slow features without the keyframes, which verify and replace their estimates."""
    views = [view for batch in run.panoramas.batches(BATCH) for view in model.views(batch)]
    poses = np.array([[*view.position, view.yaw] for view in views])
    truth = _truth(run)
    return _summary(score(truth, moved(Trajectory(truth.stamps_ns, poses), transform)))


def _retrieval(runs: Sequence[Run]) -> ImageRetrieval:
    """The images of the training drives at their true poses."""
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
