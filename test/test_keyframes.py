# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes locate images in any light, at any heading; unknown places are seen to be unknown."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cylinder_worlds import Spheres, alone, lanes
from places import lengths

from sfa_localization.camera.settings import PanoramaConfig, WatchConfig
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.keyframes.errors import LeftOut
from sfa_localization.keyframes.texture import quantized, texture
from sfa_localization.keyframes.training import choose_keyframes, located_without

CONFIG = PanoramaConfig(width=120, height=24)
COUNTER = replace(CONFIG, clockwise=False)
HOME = Spheres.about(0)


def sunny(images):
    """Images (N, H, W, 3) with a bright side and less contrast in what is bright."""
    width = images.shape[2]
    shade = 1 + 0.6 * np.cos(np.arange(width) * 2 * np.pi / width - 2.0)
    bright = np.clip(images * shade[:, None], 0, 255)
    return (255 * (bright / 255) ** 1.6).astype(np.uint8)


def textures_of(images):
    return quantized(np.stack([texture(image) for image in images]))


def keyframes_of(parts, poses, numbers, config=CONFIG):
    """Keyframes of drives with images (N, H, W, 3), poses (N, 3) and a number each."""
    drives = np.repeat(numbers, [len(at) for at in poses]).astype(np.int32)
    textures, poses = np.concatenate([*map(textures_of, parts)]), np.concatenate(poses)
    return choose_keyframes(textures, poses, config.sphere, drives)[0]


@cache
def learnt(world, config=CONFIG):
    """With errors as of some that are left out, which all count alike."""
    poses, drives = lanes(), np.zeros(len(lanes()), np.int32)
    textures = textures_of(world.panoramas(poses, config))
    keyframes, rows = choose_keyframes(textures, poses, config.sphere, drives)
    steps = lengths(np.diff(poses, axis=0, prepend=poses[:1]))
    tried, fits, _ = located_without(keyframes, np.cumsum(steps)[rows])
    trials = LeftOut.of(fits, keyframes.poses[tried], np.full(len(tried), 1 / len(tried)))
    return replace(keyframes, errors=trials.learn())


def unseen(number=60):
    rng = np.random.default_rng(3)
    return np.column_stack(
        [rng.uniform(-1.8, 1.8, (number, 2)), rng.uniform(-np.pi, np.pi, number)]
    )


def errors(keyframes, images, poses):
    """Errors (N,) m and (N,) rad of images, and their locations."""
    locations = [alone(keyframes, image) for image in images]
    difference = np.array([location.pose for location in locations]) - poses
    return lengths(difference), np.abs(wrap_angle(difference[:, 2])), locations


def errors_at(poses, world=HOME, config=CONFIG, change=lambda images: images):
    """The same of images in a learnt world that are changed somehow."""
    images = np.clip(change(world.panoramas(poses, config)), 0, 255).astype(np.uint8)
    return errors(learnt(world, config), images, poses)


def within(locations, poses):
    """The share of locations whose ellipse of 95 % holds the pose of (N, 3)."""
    error = np.array([location.pose for location in locations])[:, :2] - poses[:, :2]
    inverse = np.linalg.inv([location.covariance[:2, :2] for location in locations])
    return float((np.einsum('ni,nij,nj->n', error, inverse, error) < 5.99).mean())


def stds(locations):
    """Standard deviations (N,) m along each axis."""
    return np.sqrt([np.trace(location.covariance[:2, :2]) / 2 for location in locations])


def familiar(location):
    return location.fit.explained >= WatchConfig().least_explained


LIGHTS = {
    'usual': (CONFIG, lambda images: images),
    'sun': (CONFIG, sunny),
    'dark and red': (COUNTER, lambda images: images * np.array([0.3, 0.5, 0.65])),
}


@pytest.mark.parametrize('light', LIGHTS)
def test_an_unseen_pose_is_located_in_any_light(light):
    config, change = LIGHTS[light]
    far, turned, locations = errors_at(unseen(), config=config, change=change)
    assert np.mean(far) < (0.03 if light == 'usual' else 0.08)
    assert np.median(turned) < np.radians(2)
    assert min(location.fit.explained for location in locations) > 0.85


@pytest.mark.parametrize(('covered', 'least'), [(0, 0.99), (60, 0.8)])
def test_the_ellipses_hold_what_they_promise_also_where_a_part_is_covered(covered, least):
    mask, poses = (np.arange(CONFIG.width) >= covered)[:, None], unseen(100)
    far, _, locations = errors_at(poses, change=lambda images: images * mask)
    assert within(locations, poses) > 0.85 and np.median(far) < 0.6
    assert np.mean([*map(familiar, locations)]) > least


STRANGE = {
    'foreign': lambda images: Spheres.about(9).panoramas(unseen(20), CONFIG),
    'mirrored': lambda images: images[:, :, ::-1],
    'black': np.zeros_like,
}


@pytest.mark.parametrize('kind', STRANGE)
def test_what_was_never_seen_is_not_believed(kind):
    _, _, locations = errors_at(unseen(20), change=STRANGE[kind])
    for location in locations:
        assert np.isfinite([*location.pose, *location.covariance.ravel()]).all()
    sure = np.array([*map(familiar, locations)]) & (stds(locations) < 0.3)
    assert np.mean(sure) < 0.1


def test_a_symmetric_world_is_ambiguous():
    """Places that look alike are uncertain; in the middle, where four headings do, the heading."""
    world, poses = Spheres.about(2).symmetric(), unseen(12)
    keyframes = keyframes_of([world.panoramas(lanes(), CONFIG)], [lanes()], [0])
    _, _, locations = errors(keyframes, world.panoramas(poses, CONFIG), poses)
    assert np.mean(stds(locations) > 0.5) > 0.7
    poses *= np.array([0.05, 0.05, 1.0])
    _, _, locations = errors(keyframes, world.panoramas(poses, CONFIG), poses)
    assert np.mean(stds(locations) < 0.3) > 0.9
    assert all(location.covariance[2, 2] > 1.0 for location in locations)


@pytest.mark.parametrize('lit', [(1,), ()])
def test_drives_in_the_same_light_get_one_number(lit):
    """Together they are nearer to any place, and locate images better."""
    poses = [lanes(0.5) + np.array([step, step, 0.0]) for step in (0.0, 0.13, 0.27)]
    parts = [HOME.panoramas(at, CONFIG) for at in poses]
    for number in lit:
        parts[number] = sunny(parts[number])
    keyframes = keyframes_of(parts, poses, [3, 5, 7])
    numbers = [0, 1, 0] if lit else [0, 0, 0]
    assert keyframes.lights.tolist() == np.repeat(numbers, len(poses[0])).tolist()
    assert keyframes.first.all() and keyframes.trained == max(numbers) + 1
    if not lit:
        images = HOME.panoramas(unseen(30), CONFIG)
        off, turned, _ = errors(keyframes, images, unseen(30))
        worse, *_ = errors(keyframes_of(parts[:1], poses[:1], [0]), images, unseen(30))
        assert off.mean() < min(worse.mean(), 0.1) and np.degrees(turned.mean()) < 1.0


def test_each_drive_of_the_training_shows_the_place_in_its_light():
    """Images in the light of a drive lie where that drive alone puts them, or better."""
    world, poses = Spheres.about(1), [lanes(0.57), lanes(0.57) + 0.05]
    plain = [world.panoramas(at, CONFIG) for at in (*poses, unseen(30))]
    both = keyframes_of([plain[0], sunny(plain[1])], poses, [0, 1])
    alike = keyframes_of(plain[:1], poses[:1], [0])
    unlike = keyframes_of([sunny(plain[1])], poses[1:], [0])
    for images, best, worst in ((plain[2], alike, unlike), (sunny(plain[2]), unlike, alike)):
        of_both, of_best, of_worst = (
            errors(keyframes, images, unseen(30))[0].mean() for keyframes in (both, best, worst)
        )
        assert of_both < 1.25 * of_best and of_both < of_worst / 2


def test_many_images_are_thinned_evenly(often=9000, everywhere=16000, reach=20):
    """Two keyframes on each square meter of a large place, however often the robot came by."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-5, 3, (often, 2)), rng.uniform(-reach, reach, (everywhere, 2))
    poses = np.column_stack([np.concatenate(places), np.zeros(often + everywhere)])
    textures = quantized(rng.normal(size=(len(poses), 8, 12)).astype(np.float32))
    drives = np.zeros(len(poses), np.int32)
    keyframes, rows = choose_keyframes(textures, poses, CONFIG.sphere, drives)
    assert len(rows) == 3200 and np.array_equal(keyframes.poses, poses[rows])
    counts, _, _ = np.histogram2d(*poses[rows, :2].T, bins=np.arange(-reach, reach + 1))
    assert counts.min() >= 1 and counts.max() <= 1.5 * len(rows) / counts.size


def test_too_few_images_are_refused():
    textures, drives = np.zeros((3, 8, 24), np.int8), np.zeros(3, np.int32)
    with pytest.raises(DataError, match='too few'):
        choose_keyframes(textures, np.zeros((3, 3)), CONFIG.sphere, drives)


def test_images_beyond_the_keyframes_say_how_uncertain_their_place_is_and_those_among_do_not():
    rng = np.random.default_rng(1)
    columns = rng.uniform(2.0, 3.0, 60), rng.uniform(-1.5, 1.5, 60), rng.uniform(-3.0, 3.0, 60)
    (_, _, outside), (_, _, among) = errors_at(np.column_stack(columns)), errors_at(unseen())
    assert all(map(familiar, outside)) and within(outside, np.column_stack(columns)) > 0.85
    assert np.quantile(stds(among), 0.9) < 0.02 < np.median(stds(outside))
