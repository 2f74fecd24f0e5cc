# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The matrix of lights: what is kept and what is made again, its table and figure, the baseline."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import metric_worlds
import numpy as np
import pytest
from test_commands import gardens, small_network  # noqa: F401

from sfa_localization.bags.drives import as_live
from sfa_localization.bags.reader import Bag
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.commands import light_matrix, reproduction
from sfa_localization.commands.light_matrix import (
    ALL_BUT,
    FULL,
    LIGHTS,
    QUICK,
    SEASONS,
    Plan,
    Training,
    reproduce_light,
    trainings,
)
from sfa_localization.commands.paper_results import RECIPES, STRAIGHT
from sfa_localization.commands.reproduce import ReproduceConfig
from sfa_localization.commands.trials import Study, Trial, slow_of
from sfa_localization.data.errors import DataError, LocalizationError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import PanoramaArray, Run, Trajectory
from sfa_localization.evaluation import evaluate
from sfa_localization.features.retrieval import ImageRetrieval
from sfa_localization.metric.learning import learn_metric
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.light import MEASURES, matrix_figure, table
from sfa_localization.training import Recipe

TESTS = (('day', 'summer'), ('evening', 'summer'))
PLAN = Plan((6.0, 6.0), (160, 16), TESTS, ('evening',), 1)
CONFIG = ReproduceConfig(world=1)


# The baseline


def panoramas(count, seed=0):
    """Smooth random panoramas (count, 20, 200, 3) that repeat around, as real ones."""
    noise = np.random.default_rng(seed).standard_normal((count, 20, 200, 3))
    smooth = [cv2.GaussianBlur(np.concatenate([n] * 3, 1), (0, 0), 3)[:, 200:400] for n in noise]
    scaled = np.array(smooth) / np.std(smooth) * 40 + 120
    return np.clip(scaled, 0, 255).astype(np.uint8)


@pytest.mark.parametrize('clockwise', [True, False])
def test_retrieval_finds_the_image_and_the_turn(clockwise):
    """A robot that turns counterclockwise sees things move along clockwise columns."""
    images = panoramas(12)
    poses = np.column_stack([np.arange(12.0), -np.arange(12.0), np.linspace(-3, 3, 12)])
    retrieval = ImageRetrieval.of(images, poses, clockwise)
    for k, columns in [(0, 0), (4, 50), (11, 170)]:
        shift = columns if clockwise else -columns
        x, y, yaw = retrieval.locate(np.roll(images[k], shift, axis=1))
        assert (x, y) == (k, -k)
        turned = wrap_angle(yaw - poses[k, 2] - 2 * np.pi * columns / 200)
        assert abs(turned) < np.radians(2.5)


def test_retrieval_does_not_care_for_exposure():
    images = panoramas(12)
    retrieval = ImageRetrieval.of(images, np.column_stack([np.arange(12.0), np.zeros((12, 2))]))
    darker = np.rint(0.4 * images[7] + 20).astype(np.uint8)
    assert retrieval.locate(darker)[0] == 7


def test_retrieval_needs_an_image():
    with pytest.raises(DataError, match='no training image'):
        ImageRetrieval.of([], np.zeros((0, 3)))


# The matrix


@pytest.fixture(scope='module')
def made(tmp_path_factory, gardens, small_network):  # noqa: F811
    """A whole matrix of two tests, small, and its folder."""
    out = tmp_path_factory.mktemp('light') / 'matrix'
    return out, reproduce_light(out, CONFIG, PLAN)


@pytest.mark.slow
def test_each_training_is_tested_in_each_light(made):
    _, cells = made
    names = [(cell['trained'], cell['light'], cell['season']) for cell in cells]
    rows = [('day', *test) for test in TESTS] + [('day + overcast', *test) for test in TESTS]
    assert names == [*rows, (ALL_BUT, 'evening', 'summer')]
    for cell in cells:
        assert 0 <= cell['localized'] <= 1 and cell['false_localised_s'] >= 0
        assert 0 < cell['sfa']['mean_m'] < 6 and 0 <= cell['sfa']['within_95'] <= 1
        assert cell['slow']['mean_m'] > 0 and cell['slow']['mean_m'] != cell['sfa']['mean_m']
        assert ('paper' in cell) == (cell['trained'] == 'day')
    day = cells[0]
    assert day['retrieval']['mean_m'] < 1.0 and day['retrieval']['heading_deg'] < 20


@pytest.mark.slow
def test_a_known_transform_is_used_instead_of_a_fit(made):
    out, cells = made
    model, drive = PlaceModel.load(out / 'day.npz'), out / 'test_evening_summer'
    first = evaluate(model, drive, align_bags=[out / 'train_day'])
    again = evaluate(model, drive, transform=first.transform)
    assert again.scores['sfa']['mean'] == first.scores['sfa']['mean'] == cells[1]['sfa']['mean_m']
    assert again.transform == first.transform
    away = replace(first.transform, x_m=first.transform.x_m + 100)
    assert evaluate(model, drive, transform=away).scores['sfa']['mean'] > 90


@pytest.mark.slow
def test_the_test_drive_is_the_same_in_any_light(made):
    out, _ = made
    truths = []
    for light, season in TESTS:
        with Bag(out / f'test_{light}_{season}') as bag:
            truths.append(bag.trajectory().poses)
    assert np.array_equal(*truths)


@pytest.mark.slow
def test_results_are_written_as_json_table_and_figure(made):
    out, cells = made
    assert json.loads((out / 'matrix.json').read_text())['cells'] == cells
    assert (out / 'matrix.md').read_text() == table(cells) + '\n'
    assert cv2.imread(str(out / 'matrix.png')).shape[1] > 300
    kept = {'matrix.json', 'matrix.md', 'matrix.png', 'day.npz', 'day_overcast.npz'}
    kept |= {
        'day_morning_overcast.npz',
        'train_day',
        'train_morning',
        'train_overcast',
        *('_'.join(['test', *test]) for test in TESTS),
    }
    assert {path.name for path in out.iterdir()} == kept


def never(*_args, **_named):
    raise AssertionError('done again')


@pytest.mark.slow
def test_what_is_finished_is_not_done_again(made, monkeypatch):
    out, cells = made
    monkeypatch.setattr(reproduction, 'simulate', never)
    for step in ('train', 'evaluate'):
        monkeypatch.setattr(light_matrix, step, never)
    assert reproduce_light(out, CONFIG, PLAN) == cells


@pytest.mark.slow
def test_an_interrupted_matrix_goes_on_with_the_missing_cell(made, monkeypatch):
    out, cells = made
    file = out / 'matrix.json'
    whole = json.loads(file.read_text())
    reproduction.write_json(file, {**whole, 'cells': cells[:-1]})
    monkeypatch.setattr(reproduction, 'simulate', never)
    monkeypatch.setattr(light_matrix, 'train', never)
    assert reproduce_light(out, CONFIG, PLAN) == cells


@pytest.mark.slow
def test_results_of_other_settings_are_left_alone(made):
    out, _ = made
    before = (out / 'matrix.json').read_bytes()
    for config, plan in [(ReproduceConfig(world=2), PLAN), (CONFIG, replace(PLAN, area=(7, 7)))]:
        with pytest.raises(LocalizationError, match='--out'):
            reproduce_light(out, config, plan)
    assert (out / 'matrix.json').read_bytes() == before


@pytest.mark.parametrize('content', [None, '', '[]', '{"settings": 1}', '\0'])
def test_a_foreign_folder_is_not_changed(tmp_path, content):
    (tmp_path / 'thesis.tex').write_text('ten years of work')
    if content is not None:
        (tmp_path / 'matrix.json').write_text(content)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(LocalizationError, match='--out'):
        reproduce_light(tmp_path, CONFIG, PLAN)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_drive_that_shows_nothing_is_a_cell_too(monkeypatch):
    def blind(*_args, **_named):
        raise DataError('no image can be used')

    monkeypatch.setattr(light_matrix, 'evaluate', blind)
    cell, transform = light_matrix._judged(None, Path('bag'), Path('train'), None)
    assert cell == {'problem': 'no image can be used'} and transform is None


# The paper's recipe


@pytest.mark.slow
def test_the_papers_recipe_is_that_of_the_papers_results(made, tmp_path):
    """Here it is laid on the truth by all images of the training drive, there by those in lines."""
    out, cells = made
    model = PlaceModel.load(out / 'day.npz')
    recipe = as_live(Recipe(), PanoramaConfig(width=160, height=16))
    study = Study.read([out / 'train_day'], out / 'test_evening_summer', tmp_path, recipe)
    features = study.features(slow_of(model.network))
    metric = learn_metric(features[0], study.segments(STRAIGHT), RECIPES['paper']).map
    rows = study.known(np.arange(len(study.places)))
    errors = Trial.of(study, metric, features, rows, rows).errors()
    assert cells[1]['paper']['mean_m'] == pytest.approx(errors['test'], rel=0.02)


def test_a_drive_without_straight_lines_has_no_map_of_the_papers_recipe(monkeypatch):
    monkeypatch.setattr(light_matrix, 'slow_of', lambda _network: lambda images: images[:, 0, :, 0])
    recorded = metric_worlds.drive(metric_worlds.turn(60.0))
    images = np.zeros((len(recorded.stamps_ns), 1, 12, 3), np.uint8)
    panoramas = PanoramaArray(recorded.stamps_ns, images)
    truth = Trajectory(recorded.stamps_ns, recorded.poses)
    run = Run('turning', panoramas, recorded.odometry, ground_truth=truth)
    cell = {'paper': light_matrix._paper_recipe(SimpleNamespace(network=None), run)(run)}
    assert cell['paper']['mean_m'] is None and 'segments' in cell['paper']['problem']
    assert table([{**CELLS[0], **cell}]).splitlines()[2].split(' | ')[3] == '-'


# Table and figure

CELLS = [
    {
        'trained': 'day', 'light': 'day', 'season': 'summer', 'localized': 0.97,
        'sfa': {'mean_m': 0.1234, 'heading_deg': 0.8, 'within_95': 0.9},
        'ekf': {'mean_m': 0.056, 'heading_deg': 0.512, 'within_95': 0.949},
        'slow': {'mean_m': 2.5}, 'paper': {'mean_m': 3.25}, 'false_localised_s': 1.25,
        'retrieval': {'mean_m': 0.2, 'heading_deg': 0.6},
    },
    {'trained': 'day', 'light': 'evening', 'season': 'winter', 'problem': 'no image can be used'},
]  # fmt: skip


def test_table_has_a_line_for_each_cell():
    lines = table(CELLS).splitlines()
    assert len({line.count('|') for line in lines}) == 1
    assert lines[2] == (
        '| day | day, summer | 2.500 | 3.250 | 0.123 | 0.056 | 0.51 '
        '| 95 % | 97 % | 1.2 | 0.200 | 0.60 |'
    )
    assert lines[3] == '| day | evening, winter |' + ' - |' * len(MEASURES)


def test_figure_of_a_matrix_with_holes(tmp_path):
    matrix_figure(tmp_path / 'one.png', CELLS)
    better = [{**CELLS[0], 'false_localised_s': 0.0}, CELLS[1]]
    matrix_figure(tmp_path / 'other.png', better)
    one, other = (cv2.imread(str(tmp_path / name)) for name in ('one.png', 'other.png'))
    assert one.shape == other.shape and (one != other).any()


def test_worse_scores_look_worse():
    worse = {
        'in 95 % ellipse': [0.95, 0.5, 0.0],
        'LOCALISED': [1.0, 0.5, 0.0],
        'falsely LOCALISED (s)': [0.0, 2.0, 10.0],
    }
    for measure in MEASURES:
        values = worse.get(measure.title, [0.1, 0.3, 3.0])
        badness = [measure.badness(value) for value in values]
        assert badness == sorted(badness) and badness[0] < badness[-1]


def test_every_plan_tests_the_light_that_is_trained_in():
    for plan in (FULL, QUICK):
        assert ('day', 'summer') in plan.tests and len(set(plan.tests)) == len(plan.tests)
    assert len(FULL.tests) == 12


def test_each_light_is_tested_by_a_model_of_the_others():
    *rows, day, morning, overcast, evening = trainings(FULL)
    assert rows == [
        Training('day', ('day',), FULL.tests),
        Training('day + overcast', ('day', 'overcast'), FULL.tests),
    ]
    others = [('morning', 'overcast', 'evening'), ('day', 'overcast', 'evening')]
    others += [('day', 'morning', 'evening'), ('day', 'morning', 'overcast')]
    for light, training, lights in zip(
        LIGHTS, (day, morning, overcast, evening), others, strict=True
    ):
        assert training == Training(ALL_BUT, lights, tuple((light, s) for s in SEASONS))


def test_a_quick_plan_trains_no_model_that_it_does_not_test():
    models = list(trainings(QUICK))
    assert all(training.tests for training in models)
    assert {training.lights for training in models[2:]} == {
        ('day', 'morning', 'evening'), ('day', 'morning', 'overcast'),
    }  # fmt: skip
