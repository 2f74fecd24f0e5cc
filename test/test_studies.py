# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Each study, tiny: it ends, what is finished is kept, and its numbers are plausible."""

import json
import shutil
from dataclasses import replace
from functools import partial
from unittest import mock

import numpy as np
import page_tables
import pytest
from places import lengths
from study import __main__ as studies
from study import cameras, comparisons, light, page, results, sites, year
from study.comparisons import BASELINES, VARIANTS
from study.half_real import given_drive
from study.results import Results
from study.sites import SitePlan
from study.tables import NAMES

from sfa_localization import __version__
from sfa_localization.bags.drives import read_drive
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.run import Odometry, Trajectory
from sfa_localization.simulation.drive import START_NS
from sfa_localization.simulation.settings import SimulationConfig

MINUTES = dict.fromkeys(NAMES, 1)
PLAN = SitePlan((6.0, 6.0), (160, 16), {'coverage': 150, 'lines': 120, 'mower': 200}, MINUTES)
NAMED = {'ablations': 'paper', 'baselines': 'paper', 'light': 'light', 'year': 'year',
         'cameras': 'cameras'}  # fmt: skip
MONTHS = (('July', 'day', 'summer'), ('August', 'evening', 'summer'))
EVERYTHING = next(iter(VARIANTS))


def cells(file):
    return json.loads(file.read_text('utf-8'))['cells']


@pytest.fixture(scope='module')
def made(tmp_path_factory, gardens, small_network):
    """Studies, once, in a folder each; test_reproduce_quick.py makes the others."""
    out = tmp_path_factory.mktemp('studies')
    variants = (EVERYTHING, 'one image by slow features alone', 'no second pass')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparisons, 'VARIANTS', {name: VARIANTS[name] for name in variants})
        patch.setattr(studies, 'QUICK', PLAN)
        patch.setattr(sites, 'SMALL_AREA', PLAN.area)
        patch.setattr(sites, 'SMALL_PANORAMA', PLAN.panorama)
        patch.setattr(cameras, 'AREA', PLAN.area)
        patch.setattr(cameras, 'PANORAMA', PLAN.panorama)
        patch.setattr(light, 'TESTS', [(when, season) for _, when, season in MONTHS])
        patch.setattr(year, 'QUICK_MONTHS', MONTHS)
        # Few messages are enough, and quicker to write and read.
        slow = partial(SimulationConfig, odometry_rate=20.0)
        patch.setattr(sites, 'SimulationConfig', slow)
        made_in(out)
        yield out


def made_in(out):
    for name, folder in NAMED.items():
        assert studies.main([name, '--quick', '--out', str(out / folder)]) == 0


@pytest.mark.study
def test_comparisons_judge_every_recipe_alike(made):
    baselines = {cell['features']: cell for cell in cells(made / 'paper' / 'baselines.json')}
    assert all(0 < baselines[name]['test'] < 6 for name in BASELINES)
    assert baselines['slow features, first pass']['test'] < 1.5
    ablations = {cell['variant']: cell for cell in cells(made / 'paper' / 'ablations.json')}
    assert len({cell['sfa'] for cell in ablations.values()}) == 3, 'each locates otherwise'
    assert all(cell['sfa'] < 1.5 and cell['sfa_nees'] > 0 for cell in ablations.values())


@pytest.mark.study
def test_lights_and_months_are_judged_before_anything_is_learned(made):
    matrix = cells(made / 'light' / 'matrix.json')
    assert [cell['light'] for cell in matrix] == ['day', 'evening']
    for cell in matrix:
        assert 0 <= cell['localized'] <= 1 and 0 < cell['sfa']['mean_m'] < 6
        assert cell['slow']['mean_m'] > 0 and 'paper' in cell
    months = {(cell['month'], cell['model']): cell for cell in cells(made / 'year' / 'year.json')}
    assert months['July', 'frozen']['ekf_m'] == months['July', 'updated']['ekf_m']
    assert {model for month, model in months if month == 'August'} == {'frozen', 'updated'}


@pytest.mark.study
def test_rigs_are_judged_with_what_happens_to_a_camera(made, tmp_path):
    (cell,) = cells(made / 'cameras' / 'cameras.json')
    assert cell['case'] == 'two fisheyes' and 0 < cell['ekf'] < 1.5
    bag = next((made / 'cameras').glob('garden_*/rig_0/test'))
    gone = cameras.without_rear(bag, tmp_path / 'gone', (1.0, 2.0))
    topic = '/rear/image_raw/compressed'
    with Bag(bag) as whole, Bag(gone) as rest:
        lost = whole.topics[topic].count - rest.topics[topic].count
        assert 0 < lost < whole.topics[topic].count
        assert whole.topics['/odom'].count == rest.topics['/odom'].count


@pytest.mark.study
def test_what_is_finished_is_not_made_again(made, monkeypatch, capsys):
    for module, step in ((results, 'simulate'), (light, 'evaluate'), (sites, 'train'),
                         (cameras, 'train'),
                         (comparisons, 'evaluate')):  # fmt: skip
        monkeypatch.setattr(module, step, mock.Mock(side_effect=AssertionError))
    made_in(made)
    assert f'| {EVERYTHING} |' in capsys.readouterr().out


def test_a_foreign_folder_and_results_of_other_settings_are_left_alone(tmp_path):
    (tmp_path / 'thesis.tex').write_text('ten years of work')
    for content in ('', '[]'):
        (tmp_path / 'year.json').write_text(content)
        assert studies.main(['year', '--quick', '--out', str(tmp_path)]) == 1
        assert sorted(path.name for path in tmp_path.iterdir()) == ['thesis.tex', 'year.json']
    folder = tmp_path / 'new'
    Results.opened(folder / 'robot.json', {'world': 1}).keep({'seed': 3})
    for name in ('robot.json', 'baselines.json'):
        with pytest.raises(LocalizationError, match='--out'):
            Results.opened(folder / name, {'world': 2}, ('robot.json',))
    assert Results.opened(folder / 'robot.json', {'world': 1}).find(seed=3) == {'seed': 3}


def test_results_come_onto_the_page_once_and_only_of_this_version(tmp_path, monkeypatch):
    monkeypatch.setattr(page, 'RECORD', shutil.copy(page.RECORD, tmp_path / 'record.json'))
    pages = [
        shutil.copy(source, tmp_path / f'{k}.md') for k, source in enumerate(page_tables.PAGES)
    ]
    monkeypatch.setattr(page_tables, 'PAGES', pages)
    monkeypatch.setattr(page, 'FIGURES', tmp_path)
    cell = {'log': 'a drive', 'plain': {'error_m': 0.0625, 'xy_within_95': 0.5}}
    cell['ours'] = {**cell['plain'], 'error_m': 0.03125}
    for version, code in ((__version__, 0), (__version__, 0), ('0.0.1', 1)):
        results.write_json(
            tmp_path / 'real/real.json', {'settings': {'version': version}, 'cells': [cell]}
        )
        assert studies.main(['page', str(tmp_path / 'real')]) == code
        written = ''.join(path.read_text('utf-8') for path in pages)
        assert written.count('| a drive | 0.062 | 50% | 0.031 | 50% |') == 1
        kept = json.loads(page.RECORD.read_text('utf-8'))['results']['real']
        assert [other['log'] for other in kept].count('a drive') == 1
    (tmp_path / 'empty').mkdir()
    assert studies.main(['page', str(tmp_path / 'empty')]) == 1


def circle():
    """2 m of radius at 20 Hz, with the jitter of motion capture, and odometry at 10 Hz."""
    rng, seconds = np.random.default_rng(5), np.arange(0, 40, 0.05)
    angle = 0.25 * seconds
    poses = np.column_stack([2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi / 2])
    poses[:, :2] += 2e-4 * rng.standard_normal((len(poses), 2))
    truth = Trajectory(np.rint(seconds * 1e9).astype(np.int64), poses)
    twists, times = np.tile([0.48, 0.26], (400, 1)), np.arange(400) * 100_000_000
    return truth, Odometry(times, np.zeros((400, 3)), twists, np.zeros((400, 2)))


HALF_REAL = SimulationConfig(area=(6.0, 6.0), images_every=0.2, images_every_turn=90.0)


def test_a_given_drive_spaces_its_images_along_the_path_and_has_none_where_its_poses_pause():
    truth, odometry = circle()
    driven = given_drive(truth, odometry, HALF_REAL)
    steps = lengths(np.diff(driven.image_poses, axis=0))
    assert steps.min() >= 0.2 and steps.max() < 0.24  # jitter of 0.2 mm adds nothing
    seconds = truth.stamps_ns * 1e-9
    kept = (seconds < 10) | (seconds > 20)
    parts = Trajectory(truth.stamps_ns[kept], truth.poses[kept])
    times = (given_drive(parts, odometry, HALF_REAL).image_stamps_ns - START_NS) * 1e-9
    assert times.max() > 30 and not np.any((times > 9.9) & (times < 20))
    with pytest.raises(LocalizationError, match='overlap'):
        given_drive(replace(truth, stamps_ns=truth.stamps_ns + 10**12), odometry, HALF_REAL)


def test_logs_become_a_half_real_bag(tmp_path):
    truth, odometry = circle()
    poses, log = tmp_path / 'truth.csv', tmp_path / 'odom.csv'
    for file, head, recorded, values in (
        (poses, 'stamp_s,x_m,y_m,yaw_rad', truth, truth.poses),
        (log, 'stamp_s,v_mps,omega_radps', odometry, odometry.twists),
    ):
        lines = np.column_stack([recorded.stamps_ns * 1e-9 + 1e9, values])
        np.savetxt(file, lines, '%.9f', ',', header=head, comments='')
    words = ['--poses', poses, '--odometry', log, '--area', '6x6', '--images', 'panorama']
    words += ['--size', '32x8', '--images-every', '2', '--images-every-turn', '360']
    assert studies.main(['half_real', str(tmp_path / 'bag'), *map(str, words)]) == 0
    run = read_drive(tmp_path / 'bag', tmp_path, want_truth=True)
    assert run.ground_truth.poses[:, :2] == pytest.approx(truth.poses[:, :2], abs=1e-6)
    assert run.odometry.twists == pytest.approx(odometry.twists)
    assert run.yaw_rate is None and len(run.panoramas) > 5
