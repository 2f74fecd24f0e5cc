# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `year`: one garden, learned once, and a drive in each month after that.

Each drive is judged before anything learns from it. The first model stays frozen; a copy of it is
updated after each drive. Bags, models and cells that are finished are used again when the command
is repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sfa_localization.data.errors import DataError
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.figures import save_text
from sfa_localization.updating import update
from study.light import judged
from study.results import Cell, Progress, Results, StudyConfig
from study.sites import SmallGarden
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


QUICK_MONTHS = MONTHS[:3]


def judge_year(
    out: Path, config: StudyConfig, months: Sequence[tuple[str, str, str]], progress: Progress
) -> list[Cell]:
    """Judge both models in all months; write JSON and table below `out`. Returns the cells:
    `model`, `month`, `light`, `season`, the mean errors `ekf_m` and `sfa_m`, and what
    `light.judged` gives.

    Raises LocalizationError, also for a folder with anything else.
    """
    results = SmallGarden.results(out / RESULTS, config)
    progress.say('a month takes about 40 seconds on two cores')
    _fill(SmallGarden(out, config.world, config.seed, progress), months, results)
    save_text(out / 'year.md', table(results.cells))
    progress.say(f'see {out / "year.md"}')
    return results.cells


def _fill(garden: SmallGarden, months: Sequence[tuple[str, str, str]], results: Results) -> None:
    """Judge the missing models, month by month."""
    light, season = FIRST
    first = garden.drive('first', 0, trajectory='coverage', light=light, season=season)
    frozen = updated = garden.model('frozen', first)
    transform = None
    for number, (month, light, season) in enumerate(months, 1):
        name = f'month_{number:02d}'
        drive = garden.drive(name, number, trajectory='test', light=light, season=season)
        for name, model in {'frozen': frozen, 'updated': updated}.items():
            if results.find(model=name, month=month):
                continue
            garden.progress.say(f'{month}, {light}, {season}: {name}')
            cell, transform = judged(model, drive, first, transform)
            names = {'model': name, 'month': month, 'light': light, 'season': season}
            errors = {f'{part}_m': cell[part]['mean_m'] for part in ('ekf', 'sfa') if part in cell}
            results.keep({**names, **cell, **errors})
        updated = _updated(garden, updated, drive, number)


def _updated(garden: SmallGarden, model: PlaceModel, drive: Path, number: int) -> PlaceModel:
    """The model, updated by the drive of a month unless the robot was never LOCALISED."""
    path = garden.folder / f'updated_{number:02d}.npz'
    if not path.exists():
        try:
            garden.progress.say(update(model, [drive], path).sentence())
        except DataError as error:
            garden.progress.say(str(error))
            model.save(path)
    return PlaceModel.load(path)
