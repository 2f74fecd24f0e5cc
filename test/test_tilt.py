# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Uneven ground: roll and pitch of the robot are found in the image and change no estimate."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cylinder_worlds import Spheres, lanes, place, recipe, run_in, visit, wander
from numpy.testing import assert_allclose
from places import distances, lengths
from test_keyframes import HOME, errors, familiar, keyframes_of, unseen

from sfa_localization.camera.leveling import NEAR_NS, tilted, tilts_at
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.run import PanoramaArray
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.leveling import camera_lean, leveled_runs
from sfa_localization.keyframes.texture import spectrum, texture, turned
from sfa_localization.keyframes.tilt import find_tilt
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import learn_place

BOTH = pytest.mark.parametrize('clockwise', [True, False])
SPHERE = Sphere(-0.6, 0.6)
CONFIG = PanoramaConfig(width=160, height=40, elevation_min=-34.4, elevation_max=34.4)


@BOTH
def test_things_sink_in_the_image_where_the_camera_rises(clockwise):
    """Positive roll lifts the left side, positive pitch lowers the front."""
    sphere = Sphere(-0.6, 0.6, clockwise)
    line = np.zeros((60, 120, 1), np.uint8)
    line[29:31] = 200
    leftward = int(np.argmin(np.abs(sphere.azimuths(120) - np.pi / 2)))
    down = 0.1 / (1.2 / 60)
    for tilt, column, expected in (((0.1, 0.0), leftward, down), ((0.0, 0.1), 60, -down)):
        image = tilted(line, np.array(tilt), sphere)[:, column, 0].astype(float)
        moved = (image @ np.arange(60)) / image.sum() - 29.5
        assert moved == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize('degrees', [(0, 0), (-8, 5), (0, 10)])
def test_the_tilt_between_two_textures_is_measured(degrees):
    tilt, turn = np.radians(degrees), np.array([0.0, 1.0, 0.0])
    images = HOME.panoramas(np.array([[0.0, 0, 0], [4, 4, 1], [-4, 3, 2]]), CONFIG)
    channels = slice(0, 16), slice(16, 24), slice(24, 32)
    others = spectrum(np.stack([texture(image) for image in images]))
    seen = spectrum(texture(tilted(images[0], tilt, SPHERE)))
    tilts, scores = find_tilt(seen, turned(others, -turn), turn, 80, channels, SPHERE)
    assert scores.argmax() == 0
    assert np.hypot(*(tilts[0] - tilt)) < 0.7 * 1.2 / 16  # of a row


def swayed(images, degrees, seed, sphere=SPHERE):
    """Images (N, H, W, 3) of a robot that is tilted at random by so much, and the tilts (N, 2)."""
    tilts = np.radians(degrees) * np.random.default_rng(seed).normal(size=(len(images), 2))
    return np.stack([tilted(*pair, sphere) for pair in zip(images, tilts, strict=True)]), tilts


@cache
def learnt():
    return keyframes_of([HOME.panoramas(lanes(), CONFIG)], [lanes()], [0], CONFIG)


def test_a_tilted_image_is_located_like_a_level_one():
    images = HOME.panoramas(unseen(40), CONFIG)
    flat, turns, _ = errors(learnt(), images, unseen(40))
    images, tilts = swayed(images, 4.0, 1)
    off, swung, locations = errors(learnt(), images, unseen(40))
    assert off.mean() < 1.5 * flat.mean() + 0.01
    assert swung.mean() < turns.mean() + np.radians(0.3)
    rest = distances(np.array([location.tilt for location in locations]), tilts)
    assert np.degrees(np.median(rest)) < 0.5
    assert all(map(familiar, locations))


@BOTH
def test_drives_are_leveled_before_they_are_learned_from(clockwise):
    """By the images of a place that were taken at other times; a level drive stays as it is."""
    panorama = recipe(clockwise).panorama
    level = run_in(Spheres.about(1), wander(240, 2, hz=4.0), panorama)
    (same,) = leveled_runs([level], panorama.sphere)
    assert same is level
    few = run_in(Spheres.about(1), wander(3, 2, hz=4.0), panorama)
    assert leveled_runs([few], panorama.sphere) == (few,), 'nothing is seen again'
    images, tilts = swayed(level.panoramas.images, 4.0, 0, panorama.sphere)
    run = replace(level, panoramas=PanoramaArray(level.panoramas.stamps_ns, images))
    counted = []
    (leveled_run,) = leveled_runs([run], panorama.sphere, counted.append)
    assert set(counted) == {1} and np.array_equal(run.panoramas.images, images)
    rest = distances(leveled_run.panoramas.tilts, tilts)
    assert np.median(rest) < 0.25 * np.median(lengths(tilts))
    batches = np.concatenate(list(leveled_run.panoramas.batches(64)))
    assert np.array_equal(batches, leveled_run.panoramas.read(0, 240)) and len(batches) == 240


LEAN = np.radians([-4.0, 7.0])


def leaning(run):
    """A run by a camera that leans on its robot by LEAN."""
    images = np.stack(
        [tilted(image, LEAN, recipe().panorama.sphere) for image in run.panoramas.images]
    )
    return replace(run, panoramas=PanoramaArray(run.panoramas.stamps_ns, images))


@BOTH
def test_a_lean_of_the_camera_is_told_from_slopes_of_the_ground(clockwise):
    panorama = recipe(clockwise).panorama
    level = run_in(Spheres.about(1), wander(240, 2, hz=4.0), panorama)
    images, _ = swayed(level.panoramas.images, 4.0, 0, panorama.sphere)
    uneven = replace(level, panoramas=PanoramaArray(level.panoramas.stamps_ns, images))
    for run in (level, uneven):
        assert not camera_lean([run], panorama.sphere).any()
    images = [tilted(image, LEAN, panorama.sphere) for image in images]
    run = replace(level, panoramas=PanoramaArray(level.panoramas.stamps_ns, np.stack(images)))
    assert np.degrees(np.hypot(*(camera_lean([run], panorama.sphere) - LEAN))) < 2.0


def test_a_model_levels_the_images_of_a_camera_that_leans(tmp_path):
    """As those of its training, wherever they come from."""
    run = leaning(run_in(Spheres.about(1), wander(400, 2, hz=4.0), recipe().panorama))
    learn_place(place().model.network, [run], recipe()).model.save(tmp_path / 'model.npz')
    model = PlaceModel.load(tmp_path / 'model.npz')
    assert np.degrees(np.hypot(*(model.lean - LEAN))) < 1.0
    seen = model.locate_all(leaning(visit()).panoramas.images)
    places = np.array([observation.position for observation in seen])
    assert distances(places, visit().odometry.poses).mean() < 0.1


def test_the_orientation_of_an_image_is_that_near_its_stamp():
    stamps = np.array([0, 1, 3]) * NEAR_NS
    tilts = np.array([[0.0, 0.1], [0.2, 0.1], [0.2, -0.1]])
    missing = [np.nan, np.nan]
    expected = [missing, [0.1, 0.1], [0.2, 0.0], [0.2, -0.05], missing]
    of_images = tilts_at(np.array([-2, 0.5, 2, 2.5, 5]) * NEAR_NS, stamps, tilts)
    assert_allclose(of_images, expected, atol=1e-12)
    assert np.isnan(tilts_at(stamps, stamps[:0], tilts[:0])).all()
