# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pages of reports: one file each, complete, without scripts, legible on a phone."""

import base64
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_inspection import write as write_drive
from test_training import RECIPE, write_bag

from sfa_localization.bags.drives import images_at
from sfa_localization.cli import main
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.run import Trajectory
from sfa_localization.reports import page, training
from sfa_localization.reports.evaluation import (
    judgment,
    worst_of,
    write_evaluation_page,
    write_report,
)
from sfa_localization.training import train

VOID = {'meta', 'img', 'br', 'hr', 'link', 'input'}


class Page(HTMLParser):
    """What is in a page; fails where a tag is not closed."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open, self.tags, self.headings, self.images, self.text = [], [], [], [], ''
        self.feed(path.read_text('utf-8'))
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        given = dict(attributes)
        assert not {'href', 'onload', 'onclick', 'srcset'} & set(given)
        if tag == 'img':
            kind, _, data = given['src'].partition(',')
            assert kind == 'data:image/png;base64' and given['alt']
            raw = np.frombuffer(base64.b64decode(data, validate=True), np.uint8)
            self.images.append(cv2.imdecode(raw, cv2.IMREAD_COLOR))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == 'style':
            assert 'url(' not in data and '@import' not in data
            return
        if self.open and self.open[-1] == 'h2':
            self.headings.append(data)
        self.text += data + '\n'


def read(folder: Path) -> Page:
    found = Page(folder / page.PAGE)
    assert 'script' not in found.tags and 'link' not in found.tags and 'iframe' not in found.tags
    assert 'viewport' in (folder / page.PAGE).read_text('utf-8')
    for image in found.images:
        assert image is not None and image.std() > 1, 'a figure is blank'
    return found


@pytest.fixture(scope='module')
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp('training')
    bag = write_bag(folder / 'garden')
    result = train([bag], folder / 'model.npz', RECIPE)
    worst = training.worst_of(result)
    pictures = images_at(bag, [stamp for _, stamp in worst.values()], RECIPE)
    samples = {one: pictures[stamp] for one, (_, stamp) in worst.items()}
    training.write_training_report(folder / 'report', result, samples)
    return result, folder / 'report', [*worst]


def test_the_page_of_a_training_answers_its_four_questions(trained):
    result, folder, worst = trained
    found = read(folder)
    assert found.headings[:4] == [
        'Is my map good?', 'Where is it weak?', 'May I trust it?', 'What do I drive next?',
    ]  # fmt: skip
    assert {'Slow features', 'Worst images'} <= set(found.headings)
    assert len(found.images) == len([*folder.glob('*.png')]) == 4
    assert f'{result.model.quality["expected_error_m"]:.2f} m' in found.text
    assert ('Proven: ' in found.text) == result.model.quality['certified']
    assert 1 <= len(worst) <= 6


def test_the_worst_images_are_those_and_lie_apart(trained):
    result, _, worst = trained
    errors = np.hypot(*result.metric.residuals.T)
    assert worst[0].error_m == pytest.approx(errors.max())
    assert [one.error_m for one in worst] == sorted((one.error_m for one in worst), reverse=True)
    for k, one in enumerate(worst):
        for other in worst[:k]:
            assert np.hypot(one.x_m - other.x_m, one.y_m - other.y_m) >= 1.0


def with_quality(trained, **values):
    result = trained[0]
    model = replace(result.model, quality={**result.model.quality, **values})
    return replace(result, model=model)


def test_the_answer_about_a_map_follows_its_figures(trained):
    good = {'expected_error_m': 0.1, 'certified': True, 'left_out_within_95': 0.95}
    good['explained'] = 0.99
    for change, level in (
        ({}, page.GOOD),
        ({'expected_error_m': 0.6}, page.WEAK),
        ({'certified': False}, page.WEAK),
        ({'left_out_within_95': 0.7}, page.WEAK),
        ({'expected_error_m': 2.1}, page.BAD),
        ({'explained': 0.3}, page.BAD),
    ):
        assert training.judgment(with_quality(trained, **{**good, **change}))[0] == level
    found = with_quality(trained, certified=False)
    assert training.trust_lines(found)[0].startswith('NOT proven')


@pytest.fixture
def judged(tmp_path):
    """A filter that drifts off to one side, and single images with one that is far off."""
    stamps = np.arange(1, 101, dtype=np.int64) * 100_000_000
    truth = Trajectory(stamps, np.column_stack([np.arange(100) / 10, np.zeros((100, 2))]))
    ekf = Trajectory(stamps, truth.poses + np.column_stack([np.zeros(100), np.arange(100) / 500,
                                                            np.zeros(100)]))  # fmt: skip
    off = np.zeros((100, 3))
    off[30, 1] = 3.0
    estimates = {'odometry': truth, 'sfa': Trajectory(stamps, truth.poses + off), 'ekf': ekf}
    row = {'mean': 0.1, 'median': 0.1, 'p95': 0.2, 'rmse': 0.15, 'max': 0.3, 'n': 100}
    scores = {name: {**row, 'yaw_deg': {'mean': 1.0, 'median': 1.0, 'p95': 2.0}}
              for name in estimates}  # fmt: skip
    skipped = {'skipped': {'too <dark> & small': 3}}
    counts = {'images': skipped, 'odometry': {'skipped': {}}, 'observations': {'skipped': {}},
              'fusion': {'measurement: accepted': 9, 'measurement: outside the gate': 2},
              'states_s': {'LOCALISED': 9.0, 'LOST': 1.0}, 'false_localised_s': 0.0}  # fmt: skip
    return truth, estimates, scores, counts


def test_the_page_of_an_evaluation(judged, tmp_path):
    truth, estimates, scores, counts = judged
    worst = worst_of(truth, estimates['sfa'])
    first, stamp_ns = next(iter(worst.items()))
    assert first[:3] == (pytest.approx(3.0), 0.0, 3.0) and stamp_ns == 3_100_000_000
    pictures = dict.fromkeys(worst, np.random.default_rng(0).integers(0, 255, (9, 90, 3), np.uint8))
    features = np.random.default_rng(1).standard_normal((100, 8))
    places = truth.poses[:, :2]
    write_report(tmp_path, truth, estimates, scores, places, features)
    write_evaluation_page(tmp_path, 'a <model>', truth, estimates, scores, counts, pictures)
    found = read(tmp_path)
    assert found.headings == ['How far off?', 'Where is it weak?', 'May I trust it?',
                              'What was rejected?', 'Worst images']  # fmt: skip
    assert '3 images: too <dark> & small' in found.text, 'escaped, and read back'
    assert 'a <model>' in found.text
    assert 'LOST: 10% of the drive' in found.text
    assert '2 times measurement: outside the gate' in found.text


def test_the_answer_about_a_drive_follows_its_figures(judged):
    _, _, scores, counts = judged
    assert judgment(scores, counts)[0] == page.GOOD
    assert judgment(scores, {**counts, 'false_localised_s': 2.0})[0] == page.BAD
    for change, level in (({'mean': 0.2}, page.WEAK), ({'mean': None}, page.BAD),
                          ({'within_95': 0.5}, page.WEAK)):  # fmt: skip
        assert judgment({**scores, 'ekf': {**scores['ekf'], **change}}, counts)[0] == level


@pytest.fixture(scope='module')
def inspected(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('inspection')
    write_drive(folder / 'few', pictures=200)
    assert main(['inspect', str(folder / 'few'), '--report', str(folder / 'report')]) == 0
    return folder / 'report'


def test_the_page_of_an_inspection(inspected):
    found = read(inspected)
    assert 'few is not enough to train on yet.' in found.text
    assert '200 images with odometry are few: drive until there are 300' in found.text
    assert found.headings[:2] == ['What do I drive or change next?', 'What is in it?']
    assert len(found.images) == 2


def test_a_bag_that_cannot_be_read_has_a_page_too(tmp_path):
    assert main(['inspect', str(tmp_path / 'none'), '--report', str(tmp_path / 'report')]) == 1
    assert 'none is not enough to train on yet.' in read(tmp_path / 'report').text


def test_a_missing_figure_is_one_error(tmp_path):
    with pytest.raises(LocalizationError, match=r'none\.png: cannot be read'):
        page.figure(tmp_path / 'none.png', 'nothing')


CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser')


@pytest.mark.skipif(CHROMIUM is None, reason='chromium is not installed')
@pytest.mark.parametrize('width', [500, 1200])
def test_a_browser_shows_the_page_within_its_width(inspected, tmp_path, width):
    """500 is the narrowest window of a headless browser: a phone held upright has about 400."""
    target = tmp_path / 'shown.png'
    subprocess.run(
        [CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', '--hide-scrollbars',
         f'--user-data-dir={tmp_path / "profile"}', f'--window-size={width},1500',
         f'--screenshot={target}', (inspected / page.PAGE).as_uri()],
        check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    shown = cv2.imread(str(target))
    assert shown.shape[1] == width and shown.std() > 5
    assert (shown[:, -10:] == 255).all(), 'something is wider than the screen'
