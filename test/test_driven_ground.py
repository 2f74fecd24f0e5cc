# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The ground that was driven in training: cells, lines, and the map for Nav2."""

import cv2
import numpy as np
import pytest
import yaml

from sfa_localization.cli import main
from sfa_localization.mapping.driven_ground import DrivenGround
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.place_model import PlaceModel

PLACES = np.array([[0.0, 0.0], [0.8, 0.0], [0.8, 0.8], [4.0, 0.8], [4.0, 1.6]])


@pytest.fixture
def ground():
    """A drive around a corner, then another 3 m away, which ends in a second run."""
    return DrivenGround.of(PLACES, np.array([0, 0, 0, 0, 1]), np.arange(5.0))


def covers(cells, x, y):
    column, row = np.floor((np.array([x, y]) - cells.corner) / cells.size_m).astype(int)
    return bool(cells.driven[row, column])


def test_only_what_was_driven_is_joined(ground):
    assert ground.lines.tolist() == [[0, 1], [1, 2]]
    again = DrivenGround.from_arrays(ground.to_arrays())
    assert all(np.array_equal(getattr(again, n), getattr(ground, n)) for n in ground.to_arrays())


def test_cells_within_half_of_the_width_are_driven(ground):
    cells = ground.cells(GroundConfig(width=0.5, cell=0.05))
    driven = [(0.0, 0.0), (0.4, 0.2), (0.4, -0.2), (0.8, 0.4), (4.0, 0.6), (4.0, 1.8)]
    unknown = [(0.4, 0.31), (0.4, -0.31), (-0.31, 0.0), (2.4, 0.8), (4.0, 1.2)]
    assert [covers(cells, *place) for place in driven] == [True] * len(driven)
    assert [covers(cells, *place) for place in unknown] == [False] * len(unknown)
    cells = ground.cells(GroundConfig(width=0.5, cell=0.01))
    line_m2 = 2 * 0.8 * 0.5 + 0.75 * np.pi * 0.25**2  # around the corner they overlap by a quarter
    points_m2 = 2 * np.pi * 0.25**2
    assert cells.driven.sum() * 0.01**2 == pytest.approx(line_m2 + points_m2, rel=0.05)
    assert not cells.driven[[0, -1]].any() and not cells.driven[:, [0, -1]].any()


def test_nav2_reads_the_map(trained, tmp_path):
    """By its trinary rule; the first row of the picture is the one farthest to the left (y)."""
    output = tmp_path / 'garden.yaml'
    assert main(['map', str(trained.model), '--output', str(output), '--width', '0.4']) == 0
    entries = yaml.safe_load(output.read_text())
    gray = cv2.imread(str(tmp_path / entries['image']), cv2.IMREAD_GRAYSCALE)
    occupied = (255.0 - gray[::-1]) / 255.0
    free = occupied < entries['free_thresh']
    assert not (occupied > entries['occupied_thresh']).any() and not entries['negate']
    ground = PlaceModel.load(trained.model).ground
    x, y = (np.floor((ground.places - entries['origin'][:2]) / entries['resolution'])).astype(int).T
    assert free[y, x].all() and 0.0 < free.mean() < 0.9
    assert len(ground.places) == len(trained.result.metric.images)
