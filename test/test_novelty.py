# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Strange pictures are novel, familiar ones are not, whatever the heading."""

import cv2
import numpy as np
import pytest
from cylinder_worlds import PLACE_SIZE, Spheres, place, recipe, visit

from sfa_localization.data.errors import DataError
from sfa_localization.features.novelty import Familiarity, Novelty, describe


@pytest.fixture(scope='module')
def familiar() -> np.ndarray:
    return visit().panoramas.read(0, 43)


def novelty(pictures: np.ndarray) -> np.ndarray:
    return np.array([e.novelty for e in place().model.locate_all(pictures)])


def test_most_pictures_of_the_place_are_familiar(familiar):
    assert np.median(novelty(familiar)) < 1
    assert (novelty(familiar) < 1).mean() > 0.85


@pytest.mark.parametrize('level', [0, 10, 128, 255])
def test_a_blank_picture_is_novel(level):
    assert novelty(np.full((1, *PLACE_SIZE, 3), level, np.uint8))[0] > 1


def test_noise_is_novel():
    noise = np.random.default_rng(0).integers(0, 256, (20, *PLACE_SIZE, 3), np.uint8)
    assert novelty(noise).min() > 1


def test_darkness_is_novel(familiar):
    assert (novelty((familiar * 0.3).astype(np.uint8)) > 1).mean() > 0.9


def test_another_place_is_novel():
    other = Spheres.about(77).panoramas(visit().odometry.poses, recipe().panorama)
    assert (novelty(other) > 1).mean() > 0.9


def test_a_covered_camera_is_novel(familiar):
    covered = familiar.copy()
    covered[:, 10:45] = 20
    assert (novelty(covered) > 1).mean() > 0.9


def test_a_picture_upside_down_is_novel(familiar):
    assert (novelty(familiar[:, ::-1].copy()) > 1).mean() > 0.9


def test_more_blur_is_more_novel(familiar):
    medians = [
        np.median(novelty(np.stack([cv2.GaussianBlur(p, (0, 0), s) for p in familiar])))
        for s in (0.5, 2, 8)
    ]
    assert medians[0] < medians[1] < medians[2]


def test_descriptions_by_hand():
    maps = np.zeros((1, 1, 4, 2), np.float32)
    maps[0, 0, :, 0] = [1, 1, 3, 3]
    maps[0, 0, :, 1] = 5
    assert np.allclose(describe(maps), [[2, 5, 1, 0]])


def test_descriptions_do_not_depend_on_heading():
    maps = np.random.default_rng(0).normal(size=(3, 2, 12, 4)).astype(np.float32)
    assert np.allclose(describe(maps), describe(np.roll(maps, 5, axis=2)), atol=1e-6)


def test_distance_is_about_one_in_the_training_set():
    x = np.random.default_rng(0).normal(size=(400, 10)) * np.arange(1, 11)
    distances = Familiarity.fit(x).distance(x)
    assert 0.7 < distances.mean() < 1.6


def test_distance_grows_away_from_the_training_set():
    rng = np.random.default_rng(0)
    fitted = Familiarity.fit(rng.normal(size=(400, 30)) @ rng.normal(size=(30, 60)))
    away = rng.normal(size=60)
    distances = fitted.distance(np.outer(np.linspace(0, 50, 9), away))
    assert (np.diff(distances) > 0).all()


def test_one_in_a_hundred_unseen_pictures_is_novel():
    rng = np.random.default_rng(1)
    mix = rng.normal(size=(8, 20))
    fitted = Familiarity.fit(rng.normal(size=(2000, 8)) @ mix)
    unseen = fitted.distance(rng.normal(size=(2000, 8)) @ mix) / fitted.limit
    assert 0.003 < (unseen > 1).mean() < 0.03


def test_arrays_round_trip():
    rng = np.random.default_rng(0)
    layers = [rng.normal(size=(50, 8)), rng.normal(size=(50, 8))]
    maps = [rng.normal(size=(5, 2, 6, 2)).astype(np.float32) for _ in range(2)]
    fitted = Novelty.fit(layers)
    again = Novelty.from_arrays(fitted.to_arrays())
    assert np.array_equal(again.per_layer(maps), fitted.per_layer(maps))
    assert fitted.per_layer(maps).shape == (5, 2)


def test_too_few_pictures_are_refused():
    with pytest.raises(DataError, match='3 images are too few'):
        Familiarity.fit(np.zeros((3, 4)))
