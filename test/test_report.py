# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The report: errors by hand, and pictures that are whole, of the promised size, and not blank."""

import cv2
import numpy as np
import pytest

from sfa_localization.data.run import Trajectory
from sfa_localization.reports import evaluation as report

SECOND = 1_000_000_000


def straight(seconds: list[float], poses: list[list[float]]) -> Trajectory:
    stamps = np.array([round(second * SECOND) for second in seconds], np.int64)
    return Trajectory(stamps, np.array(poses, float))


@pytest.fixture
def truth() -> Trajectory:
    """One metre a second along x, for ten seconds."""
    return straight([5, 15], [[0, 0, 0], [10, 0, 0]])


@pytest.fixture
def estimate() -> Trajectory:
    """Two poses within the truth's time, 3-4-5 triangles away, and one before it."""
    return straight([4, 6, 7], [[9, 9, 9], [1 + 3, 4, np.radians(190)], [2, -5, np.nan]])


@pytest.fixture
def scores() -> dict[str, dict[str, float]]:
    row = {'mean': 0.12345, 'median': 0.1, 'p95': 0.2, 'rmse': 0.15, 'max': 0.3, 'n': 42}
    return {'ekf': dict(row), 'my filter': {**row, 'mean': 2.0}}


def test_errors_by_hand(truth, estimate):
    """Headings wrap; unknown ones are left out."""
    for found, times, expected in (
        (report.position_errors(truth, estimate), [1, 2], [5, 5]),
        (report.heading_errors(truth, estimate), [1], [-170]),
    ):
        np.testing.assert_allclose(found[0], times)
        np.testing.assert_allclose(found[1], expected)


def test_tables_show_what_could_not_be_judged_and_leave_out_unknown_headings(scores):
    scores['ekf'] |= {'mean': None, 'yaw_deg': {'mean': 1.234, 'median': 1.0, 'p95': 3.0}}
    assert report.table(scores).splitlines()[2].split('|')[2].strip() == '-'
    lines = report.heading_table(scores).splitlines()
    assert len(lines) == 3
    assert lines[2].split('|')[2].strip() == '1.23'


def test_the_figures_are_whole_and_paths_in_their_colors_and_to_scale(tmp_path, truth, scores):
    """A square path must come out as a square: equal axes."""
    folder, positions = tmp_path / 'new', np.random.default_rng(0).uniform(0, 10, (50, 2))
    features = np.column_stack([positions / 5 - 1, positions[:, 0] / 5 - 1])
    square = straight([5, 6, 7, 8, 9], [[0, 0, 0], [4, 0, 0], [4, 4, np.nan], [0, 4, 0], [0, 0, 0]])
    estimates = {'ekf': square, 'my filter': square}
    report.write_report(folder, truth, estimates, scores, positions, features)
    assert {path.name for path in folder.iterdir()} == {'overview.png', 'errors.png'}
    for path in folder.iterdir():
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 600 and picture.std() > 10, path.name
    picture = cv2.imread(str(folder / 'overview.png')).astype(int)
    paths = picture[: int(0.7 * len(picture)), : picture.shape[1] // 2]  # without the legend
    rows, columns = np.nonzero(np.abs(paths - (0xB2, 0x72, 0x00)).sum(axis=2) < 12)
    assert np.ptp(columns) == pytest.approx(np.ptp(rows), rel=0.02)
    assert np.ptp(rows) > 100
