# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The year of drives: who is judged when, what is kept, its table and figure."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import pytest

from sfa_localization.commands import reproduction, year
from sfa_localization.commands.reproduce import ReproduceConfig
from sfa_localization.commands.year import MONTHS, QUICK_YEAR, YEAR, reproduce_year
from sfa_localization.data.errors import DataError, LocalizationError
from sfa_localization.reports.year import table, year_figure
from sfa_localization.simulation.settings import SimulationConfig

CONFIG = ReproduceConfig(world=3, seed=20)


class Model(SimpleNamespace):
    """A model that knows only its history."""

    def save(self, path):
        path.write_text(self.history)

    @classmethod
    def load(cls, path):
        return cls(history=path.read_text())


@pytest.fixture
def notes(monkeypatch):
    """Stand-ins for all that takes long, and what they were handed."""
    noted = SimpleNamespace(drives=[], judged=[], trained=[])

    def simulated(config, bag, panorama, progress):
        noted.drives.append((bag.name, config.seed, config.light, config.season))
        bag.mkdir()

    def trained(bags, path, resume):
        noted.trained.append([bag.name for bag in bags])
        Model(history='+'.join(bag.name for bag in bags)).save(path)

    def updated(model, bags, path):
        if bags[0].name == 'month_02':
            raise DataError('never LOCALISED')
        newer = Model(history=f'{model.history}, {bags[0].name}')
        newer.save(path)
        return SimpleNamespace(model=newer, sentence=lambda: 'one image')

    def evaluated(model, bag, align_bags, transform):
        noted.judged.append((model.history, bag.name, align_bags[0].name if align_bags else None))
        return SimpleNamespace(
            scores={'ekf': {'mean': 0.1}, 'sfa': {'mean': 0.2}},
            counts={'states_s': {'LOCALISED': 3.0, 'LOST': 1.0}, 'false_localised_s': 0.5},
            transform=f'of {model.history}',
        )

    for name, stand_in in {
        'train': trained, 'update': updated, 'evaluate': evaluated,
        'PlaceModel': Model,
    }.items():  # fmt: skip
        monkeypatch.setattr(year, name, stand_in)
    monkeypatch.setattr(reproduction, 'simulate', simulated)
    return noted


def test_a_drive_is_judged_before_anything_learns_from_it(notes, tmp_path):
    cells = reproduce_year(tmp_path / 'year', CONFIG, QUICK_YEAR)
    assert notes.judged[:4] == [
        ('first', 'month_01', 'first'),
        ('first', 'month_01', None),
        ('first', 'month_02', None),
        ('first, month_01', 'month_02', None),
    ]
    assert notes.judged[5] == ('first, month_01', 'month_03', None), 'no place in month 2'
    assert notes.judged[7] == ('first, month_01, month_03', 'month_04', None)
    assert ('first+month_10', 'month_11', 'first') in notes.judged
    retrained = [cell['month'] for cell in cells if cell['model'] == 'retrained']
    assert retrained == ['December', 'May']
    assert cells[0] == {
        'model': 'frozen', 'month': 'July', 'light': 'morning', 'season': 'summer',
        'ekf_m': 0.1, 'sfa_m': 0.2, 'false_localised_s': 0.5, 'localized': 0.75,
    }  # fmt: skip


def test_each_month_has_its_light_and_a_route_of_its_own(notes, tmp_path):
    reproduce_year(tmp_path / 'year', CONFIG, QUICK_YEAR)
    assert notes.drives[0] == ('first', 20, 'day', 'summer')
    assert notes.drives[1:] == [
        (f'month_{k:02d}', 20 + k, light, season) for k, (_, light, season) in enumerate(MONTHS, 1)
    ]


def test_what_is_finished_is_not_done_again(notes, tmp_path):
    cells = reproduce_year(tmp_path / 'year', CONFIG, QUICK_YEAR)
    notes.drives.clear()
    notes.trained.clear()
    notes.judged.clear()
    assert reproduce_year(tmp_path / 'year', CONFIG, QUICK_YEAR) == cells
    assert notes.drives == notes.trained == notes.judged == []


def test_results_are_written_as_json_table_and_figure(notes, tmp_path):
    cells = reproduce_year(tmp_path / 'year', CONFIG, QUICK_YEAR)
    written = json.loads((tmp_path / 'year' / 'year.json').read_text())
    assert written['cells'] == cells and written['settings']['world'] == 3
    assert (tmp_path / 'year' / 'year.md').read_text() == table(cells) + '\n'
    assert cv2.imread(str(tmp_path / 'year' / 'year.png')).shape[1] > 300


@pytest.mark.parametrize('content', [None, '[]', '{"settings": 1}', '\0'])
def test_a_foreign_folder_is_not_changed(tmp_path, content):
    (tmp_path / 'thesis.tex').write_text('ten years of work')
    if content is not None:
        (tmp_path / 'year.json').write_text(content)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(LocalizationError, match='--out'):
        reproduce_year(tmp_path, CONFIG, QUICK_YEAR)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_results_of_other_settings_are_left_alone(notes, tmp_path):
    reproduce_year(tmp_path / 'year', CONFIG, QUICK_YEAR)
    with pytest.raises(LocalizationError, match='other settings'):
        reproduce_year(tmp_path / 'year', replace(CONFIG, world=4), QUICK_YEAR)


def test_a_year_has_every_light_and_season():
    choices = {
        field: set(SimulationConfig.__dataclass_fields__[field].metadata['choices'])
        for field in ('light', 'season')
    }
    assert {light for _, light, _ in MONTHS} == choices['light']
    assert {season for _, _, season in MONTHS} == choices['season']
    assert len({month for month, _, _ in MONTHS}) == 12
    assert set(QUICK_YEAR.retrained) < set(YEAR.retrained) <= set(range(2, 13))


CELLS = [
    {'model': 'frozen', 'month': 'July', 'light': 'day', 'season': 'summer',
     'ekf_m': 0.1, 'sfa_m': 0.3, 'false_localised_s': 0.0},
    {'model': 'updated', 'month': 'July', 'light': 'day', 'season': 'summer',
     'ekf_m': 0.2, 'sfa_m': 0.4, 'false_localised_s': 1.5},
    {'model': 'frozen', 'month': 'May', 'light': 'evening', 'season': 'winter', 'problem': 'dark'},
    {'model': 'updated', 'month': 'May', 'light': 'evening', 'season': 'winter',
     'ekf_m': 0.4, 'sfa_m': 0.6, 'false_localised_s': 0.5},
]  # fmt: skip


def test_the_table_has_a_line_for_each_month_and_their_means():
    lines = table(CELLS).splitlines()
    assert len({line.count('|') for line in lines}) == 1
    assert lines[2:] == [
        '| July | day, summer | 0.100 | 0.200 | 0.300 | 0.400 | 0.0 | 1.5 |',
        '| May | evening, winter | - | 0.400 | - | 0.600 | - | 0.5 |',
        '| mean |  | - | 0.300 | - | 0.500 | - | 1.0 |',
    ]


def test_the_figure_shows_the_errors(tmp_path):
    year_figure(tmp_path / 'one.png', CELLS)
    year_figure(tmp_path / 'other.png', [{**CELLS[0], 'ekf_m': 0.5}, *CELLS[1:]])
    one, other = (cv2.imread(str(tmp_path / name)) for name in ('one.png', 'other.png'))
    assert one.shape == other.shape and (one != other).any()
