# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""evaluate and tune look at a drive as the nodes do, by the same parameter file."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from picture_readers import PictureReader, Recording, load_pictures
from scipy import signal

from sfa_localization import evaluation
from sfa_localization.bags.reader import Bag
from sfa_localization.camera.turns import VisualGyro
from sfa_localization.cli import main
from sfa_localization.config import write_config
from sfa_localization.data.geometry import rotation
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Trajectory
from sfa_localization.fusion import pose_filter
from sfa_localization.fusion.belief import DrivenPath
from sfa_localization.fusion.camera_clock import CameraClock
from sfa_localization.fusion.health import health_of
from sfa_localization.motion.truth import TruePoses


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return Recording().write(tmp_path_factory.mktemp('bags') / 'drive')


@pytest.fixture(autouse=True)
def model(monkeypatch):
    load_pictures(monkeypatch)


def read_truth(bag):
    with Bag(bag) as opened:
        return opened.trajectory()


def evaluated(bag, tmp_path, align='', **sections):
    """Return what evaluate counts with a parameter file of these sections."""
    write_config(tmp_path / 'own.yaml', sections)
    figures = tmp_path / 'figures.json'
    arguments = ['--config', str(tmp_path / 'own.yaml'), '--json', str(figures)]
    arguments += ['--align', align] if align else []
    assert main(['evaluate', 'reader.npz', str(bag), *arguments]) == 0
    return json.loads(figures.read_text())


def test_evaluate_judges_pictures_by_the_section_of_sfa_node(bag, tmp_path, capsys):
    plain = evaluated(bag, tmp_path)['counts']['observations']
    assert plain == {
        'used': 119 - 1 - 2 - 1 - 3 - 6 - 4,
        'skipped': {
            'image is unlike all training images': 4,
            'image is dark': 2,
            'image is covered: it shows nothing': 1,
            'image repeats the one before': 3,
            'camera is frozen: it repeats its image': 6,
        },
    }
    assert '; 2 skipped: image is dark' in capsys.readouterr().out
    watch = {'least_explained': 0.4}
    skipped = evaluated(bag, tmp_path, sfa_node=watch)['counts']['observations']['skipped']
    assert skipped['image is unlike all training images'] == 4 + 3


@pytest.mark.parametrize('words', ['evaluate reader.npz {}', 'tune {} --model a.npz --output b'])
def test_a_parameter_file_for_other_panoramas_is_refused(words, bag, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_config('own.yaml', {'omnicam_node': {'elevation_max': 30.0}})
    assert main([*words.format(bag).split(), '--config', 'own.yaml']) == 1
    assert 'elevation_max 30.0 instead of 24.0' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['own.yaml']


def test_what_the_filter_rejected_and_how_long_it_was_sure_or_wrong_is_printed(
    bag, tmp_path, monkeypatch, capsys
):
    # The pictures of the reader hold its answers, and show no turns.
    monkeypatch.setattr(VisualGyro, 'add', lambda gyro, picture: np.nan)
    counts = evaluated(bag, tmp_path, ekf_node={'measurement_factor': 0.02})['counts']
    out, seconds = capsys.readouterr().out, counts['states_s']
    rejected = counts['fusion']['measurement: outside the gate']
    assert f'filter: {rejected} times measurement: outside the gate' in out
    assert seconds['LOCALISED'] > 1.0 and counts['false_localised_s'] == 0.0
    assert f'state: UNINITIALISED {seconds["UNINITIALISED"]:.1f} s, ' in out
    assert 'an error of more than a meter' not in out
    locate = PictureReader.locate

    def torn(reader, image):
        """Reads positions beyond x = 7 m as ten meters farther."""
        seen = locate(reader, image)
        shift = np.array([10.0 if seen.position[0] > 7 else 0.0, 0.0, 0.0])
        return replace(seen, pose=seen.pose + shift)

    monkeypatch.setattr(PictureReader, 'locate', torn)
    # Driving would notice it.
    trusted = DrivenPath(placed_m=(-math.inf,))
    monkeypatch.setattr(pose_filter, 'health_of', lambda *_: health_of(trusted, ()))
    counts = evaluated(bag, tmp_path)['counts']
    wrong, localised = counts['false_localised_s'], counts['states_s']['LOCALISED']
    assert 0.5 * localised < wrong <= localised
    line = f'state: LOCALISED for {wrong:.1f} s with an error of more than a meter'
    assert line in capsys.readouterr().out


def test_what_was_corrected_of_the_truth_is_said_and_headings_it_lacks_are_not_judged(
    bag, tmp_path, monkeypatch, capsys, caplog
):
    poses = TruePoses(read_truth(bag), False, ('ground truth has no headings',))
    monkeypatch.setattr(evaluation, 'true_poses', lambda *_: poses)
    figures = evaluated(bag, tmp_path, align='none')
    said = capsys.readouterr().out
    assert figures['corrections'] == ['drive: ground truth has no headings']
    assert 'drive: ground truth has no headings' in said and 'heading error' not in said
    assert figures['ekf']['yaw_deg'] is None and figures['ekf']['mean'] < 0.1
    assert 'has no measured points, so that its coordinates are its own' in caplog.text


@pytest.mark.parametrize(('factor', 'told'), [(0.5, True), (0.98, False)])
def test_turns_that_are_counted_otherwise_than_in_training_are_told(
    factor, told, bag, tmp_path, monkeypatch
):
    clock = CameraClock(turn_factor=Quantity(factor, 0.01))
    monkeypatch.setattr(evaluation, 'camera_clock', lambda *_: clock)
    told_as = 'drive: wheels: 0.50 times the turns counted, 1.00 times in training; the filter'
    corrections = ' '.join(evaluated(bag, tmp_path)['corrections'])
    assert (told_as in corrections) == told


def spread_out(seed, covariance, count=4000):
    """A true path, and estimates of it whose errors have a covariance."""
    rng, stamps = np.random.default_rng(seed), np.arange(count) * 100_000_000
    truth = np.column_stack([rng.uniform(0, 9, (count, 2)), rng.uniform(-3, 3, count)])
    error = rng.multivariate_normal([0.0, 0.0], covariance, count)
    poses = truth + np.column_stack([error, rng.normal(0, 0.1, count)])
    return Trajectory(stamps, truth), Trajectory(stamps, poses)


def test_regions_of_95_percent_hold_what_they_say_in_a_turned_map():
    inside_map, turn = np.diag([0.09, 0.0009]), rotation(1.0)
    truth, estimate = spread_out(0, turn @ inside_map @ turn.T)
    claimed = np.zeros((4000, 3, 3))
    claimed[:, :2, :2], claimed[:, 2, 2] = inside_map, 0.01
    right = evaluation.calibration(truth, estimate, turn, claimed)
    assert right['within_95'] == pytest.approx(0.95, abs=0.015)
    assert right['yaw_within_95'] == pytest.approx(0.95, abs=0.015)
    assert right['nees'] == pytest.approx(1.0, abs=0.08)
    sure = evaluation.calibration(truth, estimate, turn, claimed / 9)
    assert sure['within_95'] < 0.4 and sure['yaw_within_95'] < 0.6 and sure['nees'] > 8


@pytest.mark.parametrize('memory', [0.0, 0.95])
def test_errors_that_neighbors_share_leave_the_squared_error_of_a_drive_uncertain(memory):
    """The range holds 95 % of drives with right covariances, whose errors fade exponentially."""
    drives, count, inside, widths = 300, 1000, 0, []
    rng = np.random.default_rng(3)
    fresh = np.sqrt(1 - memory**2) * rng.normal(size=(drives, count, 2))
    fresh[:, 0] = rng.normal(size=(drives, 2))
    errors = signal.lfilter([1.0], [1.0, -memory], fresh, axis=1)
    stamps, still = np.arange(count) * 100_000_000, np.zeros((count, 3))
    claimed = np.broadcast_to(np.eye(3), (count, 3, 3))
    for error in errors:
        estimate = Trajectory(stamps, np.column_stack([error, np.zeros(count)]))
        result = evaluation.calibration(Trajectory(stamps, still), estimate, np.eye(2), claimed)
        low, high = result['nees_right']
        inside += low <= result['nees'] <= high
        widths.append(high - low)
    assert 0.88 < inside / drives < 0.99
    shared = np.sum(memory ** (2 * np.abs(np.arange(-count, count)))) if memory else 1.0
    assert np.median(widths) == pytest.approx(4 * np.sqrt(shared / count), rel=0.25)


def test_a_map_from_wheels_of_a_wrong_radius_fits_the_truth_when_scaled():
    truth, estimate = spread_out(2, 1e-6 * np.eye(2))
    places = 0.97 * estimate.poses[:, :2] @ rotation(0.4) + [3.0, 1.0]
    small = Trajectory(estimate.stamps_ns, np.column_stack([places, estimate.poses[:, 2]]))
    laid = evaluation.moved(small, evaluation.fit_transform((truth, small)))
    assert evaluation.score(truth, laid)['mean'] > 0.05
    for estimate in (small, laid):
        best = evaluation.similarity(truth, estimate)
        assert best['scale'] == pytest.approx(1 / 0.97, abs=1e-3)
        assert best['mean'] < 0.005


def test_the_map_is_laid_on_the_truth_by_all_training_drives():
    """Two drives with as many images, one of which the map shows 0.2 m beside its place."""
    drives = []
    for seed, shift in ((3, [0.0, 0.0]), (4, [0.2, 0.0])):
        truth, estimate = spread_out(seed, 1e-6 * np.eye(2))
        places = estimate.poses[:, :2] + shift
        drives.append((truth, Trajectory(estimate.stamps_ns, np.column_stack([places, places]))))
    first, both = evaluation.fit_transform(drives[0]), evaluation.fit_transform(*drives)
    assert first.x_m == pytest.approx(0.0, abs=0.01) and both.x_m == pytest.approx(-0.1, abs=0.03)
