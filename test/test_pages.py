# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pages of reports: one file each, complete, legible on a phone. See test_clicks.py."""

import base64
import html
import itertools
import json
import logging
import re
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from cylinder_worlds import SMALL_RECIPE
from numpy.testing import assert_allclose, assert_array_equal
from places import lengths
from scipy import stats
from test_inspection import write as write_drive

from sfa_localization.bags.drives import images_at
from sfa_localization.bags.settings import TopicNames
from sfa_localization.cli import main
from sfa_localization.commands.options import noticed
from sfa_localization.data.geometry import rotation
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import evaluate
from sfa_localization.reports import evaluation, page, plots, training
from sfa_localization.reports.moments import MOST, Estimate, moments_of

FOREIGN = re.compile(r'<(script|link|iframe)|href=|srcset=|onload=|onclick=|url\(|@import')
LARGEST = 1_500_000
"""Bytes of a page."""
PREFIX = re.compile('^(note|problem|corrected|not enough to train on|error|together not enough): ')
IMAGE = re.compile(r'<img[^>]* src="data:image/webp;base64,([^"]+)"[^>]*>')


def read(folder, plots=False):
    """Headings, images and text of a page, which needs no other file but for its plots, and is
    legible on a phone.
    """
    text = (folder / page.PAGE).read_text('utf-8')
    assert text.count('<script src="plotly.min.js">') == plots
    scripts = re.compile('<script.*?</script>', re.DOTALL)
    text = scripts.sub('', text) if plots else text
    assert 'viewport' in text and 'prefers-color-scheme: dark' in text and not FOREIGN.search(text)
    assert (folder / page.PAGE).stat().st_size < LARGEST
    assert text.count('<table') == text.count('<div class="wide"><table')
    for tag in ('h2', 'p', 'table', 'tr', 'td', 'figure', 'div'):
        assert len(re.findall(f'<{tag}[ >]', text)) == text.count(f'</{tag}>'), tag
    raw = [np.frombuffer(base64.b64decode(data), np.uint8) for data in IMAGE.findall(text)]
    images = [cv2.imdecode(data, cv2.IMREAD_COLOR) for data in raw]
    assert text.count('<img') == len(re.findall('<img[^>]* alt="[^"]', text)) == len(images)
    assert all(image.std() > 1 for image in images), 'a figure is blank'
    headings = [html.unescape(heading) for heading in re.findall('<h2[^>]*>(.*?)</h2>', text)]
    words = re.sub(r'<style.*?</style>|<[^>]*>', '\n', text, flags=re.DOTALL)
    return SimpleNamespace(headings=headings, images=images, text=html.unescape(words))


@pytest.fixture(scope='module')
def reported(trained, tmp_path_factory):
    folder, worst = tmp_path_factory.mktemp('report'), training.worst_of(trained.result)
    pictures = images_at(trained.bag, [stamp for _, stamp in worst.values()], SMALL_RECIPE)
    samples = {image: pictures[stamp] for image, (_, stamp) in worst.items()}
    training.write_training_report(folder, trained.result, samples)
    return trained.result, folder, [*worst]


def test_the_page_of_a_training_answers_its_four_questions(reported):
    result, folder, worst = reported
    content = read(folder)
    assert content.headings[:4] == [
        'Is my map good?', 'Where is it weak?', 'May I trust it?', 'What do I drive next?',
    ]  # fmt: skip
    assert {'Slow features', 'Worst images'} <= set(content.headings)
    figures = [*folder.glob('*.png')]
    assert len(content.images) == len(figures) == 4
    corners = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[0, 0] for path in figures]
    assert_array_equal(corners, np.uint8([[255, 255, 255, 0]] * 4))
    assert f'{result.model.quality["expected_error_m"]:.2f} m' in content.text
    assert ('Proven: ' in content.text) == result.model.quality['certified']
    errors = [image.error_m for image in worst]
    assert errors == sorted(errors, reverse=True) and len(errors) <= 6
    assert errors[0] == pytest.approx(lengths(result.metric.residuals).max())
    for image, other in itertools.combinations(worst, 2):
        assert np.hypot(image.x_m - other.x_m, image.y_m - other.y_m) >= 1.0


def test_the_answer_about_a_map_follows_its_figures(reported):
    result, _, _ = reported
    good = {'expected_error_m': 0.1, 'certified': True, 'left_out_within_95': 0.95}
    good['explained'] = 0.99
    for change, level, why in (
        ({}, page.GOOD, '0.10 m'), ({'expected_error_m': 0.6}, page.WEAK, '0.60 m from one image'),
        ({'certified': False}, page.WEAK, 'no certificate'),
        ({'left_out_within_95': 0.7}, page.WEAK, '95 % regions hold 70%'),
        ({'expected_error_m': 2.1}, page.BAD, 'drive next'), ({'explained': 0.3}, page.BAD, 'show'),
        ({'expected_yaw_error_deg': 90.0}, page.WEAK, 'look alike'),
    ):  # fmt: skip
        quality = {**result.model.quality, **good, **change}
        changed = replace(result, model=replace(result.model, quality=quality))
        grade, sentence = training.judgment(changed)
        assert grade == level and why in sentence
        assert training.trust_lines(changed)[0].startswith('NOT proven') != quality['certified']
        told = training.summary(changed)
        assert ('position: expect' in told) == (why != 'show'), 'no error of a useless map'
    sparse = replace(result.metric, poses=5 * result.metric.poses)
    assert 'm apart' in training.judgment(replace(result, metric=sparse))[1]
    places = result.metric.poses[:, :2]
    near, far = (' '.join(training.advice(result, k * places)) for k in (1, 30))
    assert 'drive lanes 2 m apart' in far and 'lanes' not in near


def test_a_useless_map_has_no_weak_places(reported, tmp_path):
    result, _, _ = reported
    useless = replace(result, model=replace(result.model, quality={**result.model.quality,
                                                                   'explained': 0.3}))  # fmt: skip
    warnings = ['drive: the camera leans <by> 7 degrees', training.summary(useless).splitlines()[1]]
    training.write_training_report(tmp_path, useless, warnings=warnings)
    content = read(tmp_path)
    assert 'The map cannot be used' in content.text and 'Where is it weak?' not in content.headings
    assert 'expect' not in content.text.split('What do I drive next?')[0]
    assert page.NOTICED in content.headings and content.text.count(warnings[0]) == 1
    assert content.text.count(warnings[1]) == 1, 'not twice'


def test_what_is_warned_of_is_kept_and_printed_once(capsys):
    logger = logging.getLogger('sfa_localization.test')
    with noticed() as outer, noticed() as warnings:
        logger.warning('%s leans', 'it')
        logger.info('a lens')
    logger.warning('later')
    assert outer == warnings == ['it leans']


@pytest.fixture
def judged():
    """Scores and counts of a drive."""
    row = {'mean': 0.1, 'median': 0.1, 'p95': 0.2, 'rmse': 0.15, 'max': 0.3, 'n': 100}
    row['yaw_deg'] = {'mean': 1.0, 'median': 1.0, 'p95': 2.0}
    used = {'used': 9, 'skipped': {}}
    counts = {'images': used, 'odometry': used, 'observations': used, 'fusion': {},
              'states_s': {'LOCALISED': 9.0}, 'false_localised_s': 0.0}  # fmt: skip
    return dict.fromkeys(('odometry', 'sfa', 'ekf'), row), counts


def test_the_page_of_an_evaluation(trained, tmp_path):
    """It shows images evenly over the drive and the worst ones, with poses in the truth's frame."""
    model = trained.result.model
    recipe = replace(SMALL_RECIPE, topics=TopicNames(ground_truth='/odom'))
    found = evaluate(model, trained.bag, recipe=recipe)
    counts = {**found.counts, 'images': {'used': 6, 'skipped': {'too <dark> & small': 3}}}
    counts['drowned'] = 0.125
    counts['fusion'] = {'measurement: accepted': 9, 'measurement: outside the gate': 2}
    result = replace(found, counts=counts)
    features = result.estimates['sfa'].poses[:, :2], result.features
    notes = ['aligned on a drive']
    evaluation.write_evaluation_page(tmp_path, 'a <model>', result, model, features, notes)
    content = read(tmp_path, plots=True)
    assert content.headings == [
        'How far off?', 'Where, and what did it see?', 'Where is it weak?', 'May I trust it?',
        'What was rejected?', 'Slow features',
    ]  # fmt: skip
    for words in (
        'images: 6 used; 3 skipped: too <dark> & small', 'a <model>', 'aligned on a drive',
        '2 times measurement: outside the gate', 'light drowns 45 degrees of the view',
    ):  # fmt: skip
        assert words in content.text, 'escaped, and read back'
    shown = moments_of(result, model)
    assert len(content.images) == 3 * len(shown) + 1 and len(shown) <= MOST
    errors = np.hypot(*(result.estimates['sfa'].poses - result.truth.at(
        result.estimates['sfa'].stamps_ns))[:, :2].T)  # fmt: skip
    assert max(k.error_m(k.single) for k in shown) == pytest.approx(errors.max(), abs=1e-6)
    for moment in shown:
        pose = model.keyframes.poses[moment.match.row]
        assert_allclose(moment.keyframe[:2], result.transform.apply(pose[None, :2])[0])
        assert moment.match.correlation > 0.9, 'the drive is that of the training'
        assert np.hypot(*(moment.keyframe - moment.truth)[:2]) < 1.0


def test_the_answer_about_a_drive_follows_its_figures(judged):
    scores, counts = judged
    for change, wrong_s, level in (
        ({}, 0.0, page.GOOD), ({}, 2.0, page.BAD), ({'mean': 0.2}, 0.0, page.WEAK),
        ({'mean': None}, 0.0, page.BAD), ({'within_95': 0.5}, 0.0, page.WEAK),
    ):  # fmt: skip
        changed = {**scores, 'ekf': {**scores['ekf'], **change}}
        counted = {**counts, 'false_localised_s': wrong_s}
        assert evaluation.judgment(changed, counted)[0] == level
    for ratio, words in (
        (1.2, 'are right'),
        (0.36, 'cautious: errors are 0.60 times the standard deviations'),
        (4.0, 'small'),
    ):
        sure = {**scores, 'ekf': {**scores['ekf'], 'nees': ratio, 'nees_right': [0.7, 1.4]}}
        grade, text = evaluation.judgment(sure, counts)
        assert words in text and (grade == page.GOOD) == (ratio < 2)


def test_the_page_of_an_inspection(tmp_path, capsys):
    """And of a bag that cannot be read; it says all that the terminal says."""
    robot = (4, 10, 25, 40)
    write_drive(tmp_path / 'few', pictures=100, shape=(12, 60), body=[robot])
    words = ['inspect', str(tmp_path / 'few'), str(tmp_path / 'none')]
    assert main([*words, '--report', str(tmp_path / 'report')]) == 1
    content = read(tmp_path / 'report')
    told = capsys.readouterr()
    assert 'shows the robot' in told.out and 'compared  ' in told.out
    for line in f'{told.err}{told.out}'.splitlines()[:-1]:  # the last names the page
        line = PREFIX.sub('', line.strip())
        for cell in re.split(r'  +| \(\w+\): | messages, | Hz$', line):
            assert cell.removeprefix(f'{tmp_path}/') in content.text, line
    for name in ('few', 'none'):
        assert f'{name} is not enough to train on yet.' in content.text
    assert '100 images with odometry are few: drive until there are 300' in content.text
    assert content.headings[:3] == [
        'Are they enough together?', 'What do I drive or change next?', 'What is in it?'
    ]  # fmt: skip
    assert len(content.images) == 2


def results(mean, grade='good'):
    row = {'mean': mean, 'p95': 2 * mean, 'max': 0.5}
    return {'odometry': row, 'ekf': {**row, 'max': None}, 'grade': grade, 'sentence': f'{mean} <m>'}


def test_two_evaluations_are_shown_side_by_side(tmp_path, capsys):
    files = [tmp_path / 'before.json', tmp_path / 'after.json']
    for file, result in zip(files, (results(0.1), results(0.04, 'weak')), strict=True):
        file.write_text(json.dumps(result))
    words = ['evaluate', *map(str, files)]
    assert main([*words, '--report', str(tmp_path / 'report')]) == 0
    told, content = capsys.readouterr().out, read(tmp_path / 'report')
    cells = ['0.100', '0.040', '0.200', '0.080', '-', '-']
    (row,) = (line for line in told.splitlines() if line.startswith('| EKF'))
    assert [cell.strip() for cell in row.split('|')[2:-1]] == cells
    assert '2: 0.04 <m>' in told and '2, after.json: 0.04 <m>' in content.text
    assert all(cell in content.text for cell in cells)
    files[1].write_text('{"ekf": {"mean": 1}}')
    assert main(words) == 1
    error = capsys.readouterr().err
    assert error == f'error: {files[1]}: holds no results: write them by evaluate --json\n'


def path(seconds, poses):
    return Trajectory(np.array(seconds, np.int64) * 1_000_000_000, np.array(poses, float))


TRUTH = path([5, 15], [[0, 0, 0], [10, 0, 0]])


def test_errors_by_hand():
    """3-4-5 triangles. Headings wrap; unknown ones, and those before the truth, are left out."""
    estimate = path([4, 6, 7], [[9, 9, 9], [1 + 3, 4, np.radians(190)], [2, -5, np.nan]])
    errors = plots.errors_of(TRUTH, estimate)
    assert_allclose(errors.seconds, [1, 2])
    assert_allclose(errors.position_m, [5, 5])
    assert_allclose(errors.heading_deg, [-170, np.nan])
    curve = plots.curves_of(TRUTH, {'ekf': estimate})['ekf']
    assert curve == {'seconds': [1.0, 2.0], 'x_m': [4.0, 2.0], 'y_m': [4.0, -5.0],
                     'error_m': [5.0, 5.0], 'heading_deg': [-170.0, None]}  # fmt: skip


def test_a_long_curve_keeps_its_largest_errors():
    count = 10 * plots.POINTS
    rng = np.random.default_rng(0)
    stamps = np.arange(count) * 1_000_000
    still = Trajectory(stamps, np.zeros((count, 3)))
    poses = np.zeros((count, 3))
    poses[:, 0] = rng.uniform(0, 0.1, count)
    poses[[7, 4321], 0] = 2.0, 1.0
    curve = plots.curves_of(still, {'ekf': Trajectory(stamps, poses)})['ekf']
    assert len(curve['seconds']) == plots.POINTS
    assert sorted(curve['error_m'])[-2:] == [1.0, 2.0] and np.all(np.diff(curve['seconds']) > 0)


def test_the_regions_of_95_percent_are_those_of_the_covariance():
    turn = rotation(0.4)
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([0.09, 0.01]) @ turn.T
    x, y = plots._ellipses([Estimate(np.array([1.0, 2.0, 0.0]), covariance)])
    outline = np.stack([x - 1, y - 2])[:, :-1]
    squares = np.einsum('in,ij,jn->n', outline, np.linalg.inv(covariance[:2, :2]), outline)
    assert_allclose(squares, stats.chi2.ppf(0.95, 2), rtol=1e-4)
    assert np.isnan(x[-1])


def test_what_could_not_be_judged_is_a_dash_in_the_tables():
    row = {'mean': 0.12345, 'median': 0.1, 'p95': 0.2, 'rmse': 0.15, 'max': 0.3, 'n': 42}
    scores = {'ekf': row, 'silent': dict.fromkeys(row)}
    scores['ekf'] |= {'mean': None, 'yaw_deg': {'mean': 1.234, 'median': 1.0, 'p95': 3.0}}
    positions, headings = evaluation.tables(scores).split('\n\n')
    assert positions.splitlines()[2].split('|')[2].strip() == '-'
    lines = headings.splitlines()
    assert len(lines) == 3 and lines[2].split('|')[2].strip() == '1.23'
