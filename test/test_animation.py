# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The film of the README: what it draws, and the file that comes with the project."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip('rclpy')
from robustness.animation import BLUE, MAP, STRIP, WIDTH, Shot, Stage, write

FILM = Path(__file__).parents[1] / 'resource/kidnapped.webp'
LARGEST = 3_000_000
"""Bytes: a page with it still opens at once."""


def shot(second, x):
    panorama = np.full((60, 600, 3), 77, np.uint8)
    return Shot(second, np.array([x, 0.0, 0.0]), np.array([x, 1.0, 0.0]), np.eye(2) * 0.04,
                'LOCALISED', panorama)  # fmt: skip


def test_a_frame_shows_panorama_and_estimate_at_their_places():
    path = np.array([[-4.0, -2.0], [4.0, 2.0]])
    stage = Stage(path)
    frame = stage.frame([shot(0.0, 0.0), shot(1.0, 1.0)], 1)
    assert frame.shape == (STRIP + MAP, WIDTH, 3)
    assert (frame[:STRIP] == 77).all()
    column, row = (round(part / 16) for part in stage.at([1.0, 1.0]))
    assert tuple(frame[row, column]) == BLUE
    assert column > WIDTH / 2 and row < STRIP + MAP / 2, 'x to the right, y upward'


def test_frames_become_a_film(tmp_path):
    frames = [np.full((20, 30, 3), gray, np.uint8) for gray in (0, 120, 255)]
    write(tmp_path / 'film.webp', frames)
    with Image.open(tmp_path / 'film.webp') as film:
        assert (film.n_frames, film.size) == (3, (30, 20))


def test_the_film_that_comes_with_the_project_is_small():
    assert FILM.stat().st_size <= LARGEST
    with Image.open(FILM) as film:
        assert film.n_frames > 50 and film.size == (WIDTH, STRIP + MAP)
