# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `year`: one garden, learned once, and a drive in each month after that.

Each drive is judged before anything learns from it. The first model stays frozen; a copy of it is
updated after each drive. Bags, models and cells that are finished are used again when the command
is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.evaluation import evaluate
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.figures import save_text
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import train
from sfa_localization.updating import update
from study.results import Cell, Progress, Results, StudyConfig, recorded, settings_of, usual_drift
from study.year_report import table

RESULTS = 'year.json'
FIRST = ('day', 'summer')
"""Light and season of the training drive, in June."""
MONTHS = (
    ('July', 'morning', 'summer'),
    ('August', 'evening', 'summer'),
    ('September', 'overcast', 'summer'),
    ('October', 'morning', 'autumn'),
    ('November', 'overcast', 'autumn'),
    ('December', 'evening', 'winter'),
    ('January', 'overcast', 'winter'),
    ('February', 'day', 'winter'),
    ('March', 'morning', 'winter'),
    ('April', 'overcast', 'summer'),
    ('May', 'evening', 'summer'),
    ('June', 'day', 'summer'),
)
"""Months after the training, with the light and season of their drives."""


@dataclass(frozen=True, slots=True)
class YearPlan:
    """Size of the garden (m) and of the panoramas, the first months that are driven, and about how
    many minutes it takes on two cores.
    """

    area: tuple[float, float]
    panorama: tuple[int, int]
    months: int
    minutes: int


YEAR = YearPlan((8.0, 8.0), (300, 30), 12, 8)
QUICK_YEAR = YearPlan((8.0, 8.0), (300, 30), 3, 2)


@dataclass(frozen=True, slots=True)
class _Work:
    """The folder, the garden in it, and how its steps are shown."""

    out: Path
    config: StudyConfig
    plan: YearPlan
    progress: Progress

    def drive(self, number: int) -> Path:
        """The training drive, 0, or that of a month, each with a route of its own."""
        bag = self.out / (f'month_{number:02d}' if number else 'first')
        light, season = MONTHS[number - 1][1:] if number else FIRST
        config = SimulationConfig(
            trajectory='test' if number else 'coverage',
            world=self.config.world,
            seed=self.config.seed + number,
            area=self.plan.area,
            test_drift=usual_drift(self.plan.area),
            light=light,
            season=season,
            images='panorama',
            compression='jpeg',
        )
        return recorded(bag, config, self.plan.panorama, self.progress)

    def trained(self) -> PlaceModel:
        """The model trained on the first drive."""
        path = self.out / 'frozen.npz'
        if not path.exists():
            self.progress.say(f'train {path.name}')
            train([self.drive(0)], path, resume=True)
        return PlaceModel.load(path)

    def updated(self, model: PlaceModel, number: int) -> PlaceModel:
        """The model, updated by the drive of a month unless the robot was never LOCALISED."""
        path = self.out / f'updated_{number:02d}.npz'
        if not path.exists():
            try:
                done = update(model, [self.drive(number)], path)
                self.progress.say(done.sentence())
            except DataError as error:
                self.progress.say(str(error))
                model.save(path)
        return PlaceModel.load(path)


def judge_year(
    out: Path, config: StudyConfig, plan: YearPlan, *, progress: bool = False
) -> list[Cell]:
    """Judge all models in all months; write JSON and table below `out`. Returns the cells:
    `model`, `month`, `light`, `season`, and the scores that `_judged` names.

    Raises LocalizationError, also for a folder with anything else.
    """
    report = Progress(progress)
    settings = settings_of(config.world, config.seed, plan.area, plan.panorama)
    results = Results.opened(out / RESULTS, settings)
    report.say(f'this takes about {plan.minutes} minutes on two cores')
    _fill(_Work(out, config, plan, report), results)
    save_text(out / 'year.md', table(results.cells))
    report.say(f'see {out / "year.md"}')
    return results.cells


def _fill(work: _Work, results: Results) -> None:
    """Judge the missing models, month by month."""
    frozen = updated = work.trained()
    transform = None
    for number, (month, light, season) in enumerate(MONTHS[: work.plan.months], 1):
        for name, model in {'frozen': frozen, 'updated': updated}.items():
            if results.find(model=name, month=month):
                continue
            work.progress.say(f'{month}, {light}, {season}: {name}')
            scores, transform = _judged(model, work.drive(number), work.drive(0), transform)
            names = {'model': name, 'month': month, 'light': light, 'season': season}
            results.keep({**names, **scores})
        updated = work.updated(updated, number)


def _judged(
    model: PlaceModel, bag: Path, align_bag: Path, transform: RigidTransform | None
) -> tuple[Cell, RigidTransform | None]:
    """Mean errors `ekf_m` and `sfa_m`, seconds `false_localised_s` and the share `localized` of a
    drive, and the transform to the truth; only the `problem` of one without a usable image.
    """
    align = () if transform else (align_bag,)
    try:
        result = evaluate(model, bag, align_bags=align, transform=transform)
    except DataError as error:
        return {'problem': str(error)}, transform
    states = result.counts['states_s']
    scores = {
        'ekf_m': result.scores['ekf']['mean'],
        'sfa_m': result.scores['sfa']['mean'],
        'false_localised_s': result.counts['false_localised_s'],
        'localized': states.get('LOCALISED', 0.0) / max(sum(states.values()), 1e-9),
    }
    return scores, result.transform
