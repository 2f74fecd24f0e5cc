# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pages of reports: one file each, complete, without scripts, legible on a phone."""

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
from numpy.testing import assert_allclose
from places import lengths
from test_inspection import write as write_drive

from sfa_localization.bags.drives import images_at
from sfa_localization.cli import main
from sfa_localization.commands.options import noticed
from sfa_localization.data.run import Trajectory
from sfa_localization.reports import evaluation, page, training

FOREIGN = re.compile(r'<(script|link|iframe)|href=|srcset=|onload=|onclick=|url\(|@import')
LARGEST = 1_500_000
"""Bytes of a page."""
PREFIX = re.compile('^(note|problem|corrected|not enough to train on|error|together not enough): ')
IMAGE = re.compile(r'<img[^>]* src="data:image/webp;base64,([^"]+)"[^>]*>')


def read(folder):
    """Headings, images and text of a page, which needs no other file, and is legible on a phone."""
    text = (folder / page.PAGE).read_text('utf-8')
    assert 'viewport' in text and 'prefers-color-scheme: dark' in text and not FOREIGN.search(text)
    assert len(text) < LARGEST and text.count('<table') == text.count('<div class="wide"><table')
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
    assert len(content.images) == len([*folder.glob('*.png')]) == 4
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
    """A filter that drifts off to one side, and single images with one that is far off."""
    stamps = np.arange(1, 101, dtype=np.int64) * 100_000_000
    truth = np.column_stack([np.arange(100) / 10, np.zeros((100, 2))])
    ekf, image = truth.copy(), truth.copy()
    ekf[:, 1], image[30, 1] = np.arange(100) / 500, 3.0
    row = {'mean': 0.1, 'median': 0.1, 'p95': 0.2, 'rmse': 0.15, 'max': 0.3, 'n': 100}
    row['yaw_deg'] = {'mean': 1.0, 'median': 1.0, 'p95': 2.0}
    poses = {'odometry': truth, 'sfa': image, 'ekf': ekf}
    used = {'used': 9, 'skipped': {}}
    counts = {'images': {'used': 6, 'skipped': {'too <dark> & small': 3}}, 'odometry': used,
              'observations': used,
              'fusion': {'measurement: accepted': 9, 'measurement: outside the gate': 2},
              'states_s': {'LOCALISED': 9.0, 'LOST': 1.0}, 'false_localised_s': 0.0}  # fmt: skip
    estimates = {name: Trajectory(stamps, path) for name, path in poses.items()}
    return estimates['odometry'], estimates, dict.fromkeys(estimates, row), counts


def test_the_page_of_an_evaluation(judged, tmp_path):
    truth, estimates, scores, counts = judged
    worst = evaluation.worst_of(truth, estimates['sfa'])
    first, stamp_ns = next(iter(worst.items()))
    assert first[:3] == (pytest.approx(3.0), 0.0, 3.0) and stamp_ns == 3_100_000_000
    rng = np.random.default_rng(0)
    pictures = dict.fromkeys(worst, rng.integers(0, 255, (9, 90, 3), np.uint8))
    features = rng.standard_normal((100, 8))
    evaluation.write_report(tmp_path, truth, estimates, scores, truth.poses[:, :2], features)
    evaluation.write_evaluation_page(
        tmp_path, 'a <model>', truth, estimates, scores, counts, pictures, ['aligned on a drive']
    )
    content = read(tmp_path)
    assert content.headings == ['How far off?', 'Where is it weak?', 'May I trust it?',
                                'What was rejected?', 'Worst images']  # fmt: skip
    for words in (
        'images: 6 used; 3 skipped: too <dark> & small', 'a <model>', 'LOST 1.0 s',
        '2 times measurement: outside the gate', 'aligned on a drive',
    ):  # fmt: skip
        assert words in content.text, 'escaped, and read back'
    text = (tmp_path / page.PAGE).read_text('utf-8')
    assert text.count('class="wide broad"') == 2, 'overview and errors'


def test_the_answer_about_a_drive_follows_its_figures(judged):
    _, _, scores, counts = judged
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
    assert 'second: 0.04 <m>' in told and 'after.json: 0.04 <m>' in content.text
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
    errors = evaluation.errors_of(TRUTH, estimate)
    assert_allclose(errors.seconds, [1, 2])
    assert_allclose(errors.position_m, [5, 5])
    assert_allclose(errors.heading_deg, [-170, np.nan])


def test_figures_show_paths_to_scale_and_tables_what_could_not_be_judged(tmp_path):
    """A square path must come out as a square: equal axes."""
    row = {'mean': 0.12345, 'median': 0.1, 'p95': 0.2, 'rmse': 0.15, 'max': 0.3, 'n': 42}
    scores = {'ekf': row, 'silent': dict.fromkeys(row)}
    places = np.random.default_rng(0).uniform(0, 10, (50, 2))
    square = path(range(5, 10), [[0, 0, 0], [4, 0, 0], [4, 4, np.nan], [0, 4, 0], [0, 0, 0]])
    estimates = {'ekf': square, 'silent': path([], np.zeros((0, 3)))}
    evaluation.write_report(tmp_path / 'new', TRUTH, estimates, scores, places, places / 5 - 1)
    pictures = {path.name: cv2.imread(str(path)) for path in (tmp_path / 'new').iterdir()}
    assert set(pictures) == {'overview.png', 'errors.png'}
    assert all(min(p.shape[:2]) > 600 and p.std() > 10 for p in pictures.values())
    picture = pictures['overview.png'].astype(int)
    paths = picture[: int(0.7 * len(picture)), : picture.shape[1] // 2]  # without the legend
    rows, columns = np.nonzero(np.abs(paths - (0xB2, 0x72, 0x00)).sum(axis=2) < 12)
    assert np.ptp(columns) == pytest.approx(np.ptp(rows), rel=0.02) and np.ptp(rows) > 100
    scores['ekf'] |= {'mean': None, 'yaw_deg': {'mean': 1.234, 'median': 1.0, 'p95': 3.0}}
    positions, headings = evaluation.tables(scores).split('\n\n')
    assert positions.splitlines()[2].split('|')[2].strip() == '-'
    lines = headings.splitlines()
    assert len(lines) == 3 and lines[2].split('|')[2].strip() == '1.23'
