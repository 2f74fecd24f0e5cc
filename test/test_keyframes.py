# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: found in any light, from any heading; unknown places are known to be unknown."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from cylinder_worlds import Spheres

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.features.keyframe_training import fit_keyframes, spread
from sfa_localization.features.keyframes import Keyframes, quantized, texture
from sfa_localization.features.observation import Match
from sfa_localization.metric.keyframe_map import usual_turn_std

CONFIG = PanoramaConfig(width=120, height=24)
COUNTER = PanoramaConfig(width=120, height=24, clockwise=False)


def drive(step: float = 0.25) -> np.ndarray:
    """Poses (N, 3) up and down a square of 4 m, each lane headed the other way."""
    lanes = np.arange(-2.0, 2.01, step)
    poses = []
    for number, y in enumerate(lanes):
        xs = np.arange(-2.0, 2.01, step)[:: 1 if number % 2 == 0 else -1]
        poses += [(x, y, 0.0 if number % 2 == 0 else np.pi) for x in xs]
    return np.array(poses)


def path(poses: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])


def sunny(images: np.ndarray) -> np.ndarray:
    """Images (N, H, W, 3) with a bright side and less contrast in what is bright."""
    width = images.shape[2]
    shade = 1 + 0.6 * np.cos(np.arange(width) * 2 * np.pi / width - 2.0)
    bright = np.clip(images * shade[:, None], 0, 255)
    return (255 * (bright / 255) ** 1.6).astype(np.uint8)


def fitted(parts, poses, numbers, config=CONFIG) -> Keyframes:
    """Keyframes of drives with images (N, H, W, 3), poses (N, 3) and a number each."""
    textures = [quantized(np.stack([texture(image) for image in images])) for images in parts]
    paths = [path(at) + 1000 * k for k, at in enumerate(poses)]
    drives = np.repeat(numbers, [len(at) for at in poses]).astype(np.int32)
    joined = map(np.concatenate, (textures, poses, paths))
    return fit_keyframes(*joined, config.sphere, drives)


@cache
def learnt(world: Spheres, config: PanoramaConfig = CONFIG) -> Keyframes:
    return fitted([world.panoramas(drive(), config)], [drive()], [0], config)


def unseen(number: int = 60) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack(
        [rng.uniform(-1.8, 1.8, (number, 2)), rng.uniform(-np.pi, np.pi, number)]
    )


def errors(keyframes: Keyframes, images: np.ndarray, poses: np.ndarray):
    found = [keyframes.match(image) for image in images]
    difference = np.array([match.pose for match in found]) - poses
    return np.hypot(*difference[:, :2].T), np.abs(wrap_angle(difference[:, 2])), found


@pytest.mark.parametrize('config', [CONFIG, COUNTER])
def test_an_unseen_pose_is_found(config):
    world, poses = Spheres.about(0), unseen()
    far, turned, found = errors(learnt(world, config), world.panoramas(poses, config), poses)
    assert np.median(far) < 0.03 and np.mean(far) < 0.05
    assert np.median(turned) < np.radians(2)
    assert min(match.score for match in found) > 0.5


def test_the_ellipses_hold_what_they_promise_also_where_a_part_is_covered():
    for seed, number, covered in ((1, 150, 0), (0, 60, 30)):
        world, poses = Spheres.about(seed), unseen(number)
        keyframes, images = learnt(world), world.panoramas(poses, CONFIG)
        images[:, :, :covered] = 0
        far, _, found = errors(keyframes, images, poses)
        noise, held = keyframes.noise, []
        for match, pose in zip(found, poses, strict=True):
            doubt = max(noise.novelty(match.score), 1.0) if covered else 1.0
            held.append(holds(match, pose, noise.covariance(match) * doubt**2))
        assert np.mean(held) > 0.85 and np.median(far) < 0.6


def test_a_turn_of_the_robot_is_a_turn_of_the_match(columns=7):
    world, poses = Spheres.about(0), unseen(8)
    keyframes, turn = learnt(world), 2 * np.pi * columns / CONFIG.width
    for image in world.panoramas(poses, CONFIG):
        plain, turned = keyframes.match(image), keyframes.match(np.roll(image, columns, axis=1))
        assert np.allclose(turned.pose[:2], plain.pose[:2], atol=0.1)
        assert abs(wrap_angle(turned.pose[2] - plain.pose[2] - turn)) < np.radians(1.5)


LIGHTS = {
    'darker': lambda i: i * 0.5,
    'gamma': lambda i: 255 * (i / 255) ** 1.6,
    'sun': lambda i: (
        i * (1 + 0.4 * np.cos(np.arange(i.shape[2]) * 2 * np.pi / i.shape[2]))[:, None]
    ),
    'color': lambda i: i * np.array([0.6, 1.0, 1.3]),
}


@pytest.mark.parametrize('light', LIGHTS)
def test_light_does_not_matter(light):
    world, poses = Spheres.about(0), unseen()
    images = world.panoramas(poses, CONFIG)
    other = np.clip(LIGHTS[light](images.astype(float)), 0, 255).astype(np.uint8)
    keyframes = learnt(world)
    usual, _, _ = errors(keyframes, images, poses)
    far, turned, found = errors(keyframes, other, poses)
    assert np.mean(usual) < 0.03 and np.mean(far) < 0.08
    assert np.median(turned) < np.radians(2)
    assert min(match.score for match in found) > 0.5


def holds(match: Match, pose: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether the ellipse of 95 % of a match with a covariance (3, 3) holds a pose (3,)."""
    apart = (match.pose - pose)[:2]
    return bool(apart @ np.linalg.solve(covariance[:2, :2], apart) < 5.99)


def strange_images():
    rng = np.random.default_rng(5)
    poses = unseen(30)
    home = Spheres.about(0).panoramas(poses, CONFIG)
    return {
        'foreign': Spheres.about(9).panoramas(poses, CONFIG),
        'mirrored': home[:, :, ::-1],
        'upside down': home[:, ::-1],
        'noise': rng.integers(0, 255, home.shape).astype(np.uint8),
        'black': np.zeros_like(home),
        'grey': np.full_like(home, 128),
    }


@pytest.mark.parametrize('kind', ['foreign', 'mirrored', 'upside down', 'noise', 'black', 'grey'])
def test_what_was_never_seen_is_not_believed(kind):
    keyframes = learnt(Spheres.about(0))
    found = [keyframes.match(image) for image in strange_images()[kind]]
    spreads = [keyframes.noise.covariance(match) for match in found]
    assert np.isfinite([match.pose for match in found]).all() and np.isfinite(spreads).all()
    sure = [m.known and np.trace(c[:2, :2]) < 0.18 for m, c in zip(found, spreads, strict=True)]
    assert np.mean(sure) < 0.1


def test_a_symmetric_world_is_ambiguous():
    world, poses = Spheres.about(2).symmetric(), unseen(20)
    keyframes = learnt(world)
    wide = [
        np.trace(keyframes.noise.covariance(keyframes.match(image))[:2, :2]) / 2 > 0.5**2
        for image in world.panoramas(poses, CONFIG)
    ]
    assert np.mean(wide) > 0.7


@pytest.mark.parametrize('several', [False, True])
def test_they_are_saved_and_read(several):
    world = Spheres.about(0)
    keyframes = learnt(world)
    if several:
        drives = np.arange(len(keyframes.poses), dtype=np.int32) % 3
        keyframes = replace(keyframes, drives=drives, trained=2)
    again = Keyframes.from_arrays(keyframes.to_arrays(), keyframes.sphere)
    assert np.array_equal(again.first, keyframes.first)
    for image in world.panoramas(unseen(5), CONFIG):
        a, b = keyframes.match(image), again.match(image)
        assert np.array_equal(a.pose, b.pose)
        assert np.array_equal(keyframes.noise.covariance(a), again.noise.covariance(b))


def test_drives_in_one_light_are_one_and_those_in_another_are_not():
    """Together the drives in one light are nearer to any place, and locate it better."""
    world, steps = Spheres.about(0), (0.0, 0.13, 0.27)
    poses = [drive(0.5) + np.array([step, step, 0.0]) for step in steps]
    plain = [world.panoramas(at, CONFIG) for at in poses]
    lit, images = sunny(plain[1]), world.panoramas(unseen(), CONFIG)
    for parts, numbers in (
        ([plain[0], plain[1], plain[2]], [0, 0, 0]),
        ([plain[0], lit, plain[2]], [0, 1, 0]),
        ([lit, plain[1], plain[2]], [0, 1, 1]),
    ):
        keyframes = fitted(parts, poses, [3, 5, 7])
        assert keyframes.drives.tolist() == np.repeat(numbers, len(poses[0])).tolist()
        assert keyframes.first.all() and keyframes.trained == max(numbers) + 1
        if max(numbers) == 0:
            alone = fitted(parts[:1], poses[:1], [0])
            (off, turned, _), (worse, *_) = (
                errors(k, images, unseen()) for k in (keyframes, alone)
            )
            assert off.mean() < min(worse.mean(), 0.1) and np.degrees(turned.mean()) < 1.0


def test_drives_that_do_not_meet_are_kept_apart():
    poses = [drive(0.5), drive(0.5) + np.array([50.0, 0.0, 0.0])]
    parts = [Spheres.about(n).panoramas(drive(0.5), CONFIG) for n in (0, 1)]
    keyframes = fitted(parts, poses, [0, 1])
    assert set(keyframes.drives.tolist()) == {0, 1} and keyframes.first.all()
    off, turned, _ = errors(keyframes, Spheres.about(0).panoramas(unseen(), CONFIG), unseen())
    assert off.mean() < 0.1 and np.degrees(turned.mean()) < 1.0


def test_each_drive_of_the_training_shows_the_place_in_its_own_light():
    """Images in the light of one drive lie where that drive alone puts them, or better."""
    world, poses, images = Spheres.about(1), [drive(0.57), drive(0.57) + 0.05], unseen()
    plain = [world.panoramas(at, CONFIG) for at in (*poses, images)]
    lit = [sunny(one) for one in plain]
    both = fitted([plain[0], lit[1]], poses, [0, 1])
    alone = fitted([plain[0]], poses[:1], [0]), fitted([lit[1]], poses[1:], [0])
    for seen, own, other in ((plain[2], *alone), (lit[2], *alone[::-1])):
        joint, best, worst = (errors(k, seen, images)[0].mean() for k in (both, own, other))
        assert joint < 1.25 * best and joint < worst / 2


def test_many_images_are_thinned_evenly_and_too_few_rejected():
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(-5, 5, (4000, 2)), np.zeros(4000)])
    textures = rng.normal(size=(4000, 8, 24)).astype(np.float32)
    keyframes = fit_keyframes(quantized(textures), poses, np.arange(4000) * 0.1, CONFIG.sphere)
    assert len(keyframes.poses) == 2000
    counts, _, _ = np.histogram2d(*keyframes.poses[:, :2].T, bins=5)
    assert counts.min() > 50
    with pytest.raises(DataError, match='too few'):
        fit_keyframes(np.zeros((3, 4, 8), np.int8), np.zeros((3, 3)), np.arange(3.0), CONFIG.sphere)


def test_large_places_have_keyframes_on_each_square_meter():
    rng = np.random.default_rng(0)
    often, all_over = rng.uniform(0, 8, (9000, 2)), rng.uniform(0, 40, (16000, 2))
    poses = np.column_stack([np.concatenate([often, all_over]), np.zeros(25000)])
    kept = poses[spread(poses)]
    assert len(kept) == 2 * 1600
    counts, _, _ = np.histogram2d(*kept[:, :2].T, bins=np.arange(41))
    assert counts.min() >= 1 and counts.max() <= 3


def posts(sun: float) -> np.ndarray:
    """A panorama of brown posts before a blue sky, each lit on one side."""
    image = np.full((24, 120, 3), (220, 190, 170), np.float32)
    for start in np.random.default_rng(2).permutation(15)[:9] * 8:
        across = np.linspace(-1, 1, 6, dtype=np.float32)
        shade = np.exp(0.7 * sun * across)[None, :, None]
        image[6:, start : start + 6] = shade * np.array([40, 60, 90], np.float32)
    return np.clip(image, 0, 255).astype(np.uint8)


def gray(image: np.ndarray) -> np.ndarray:
    return np.repeat(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[:, :, None], 3, axis=2)


def test_color_weighs_about_as_much_as_brightness_and_a_gray_camera_has_none():
    image, rows = posts(0.0), (16, 24)
    parts = [np.linalg.norm(part) for part in np.split(texture(image), rows)]
    assert max(parts) < 3 * min(parts)
    assert all(np.ptp(part) < 1e-6 for part in np.split(texture(gray(image)), rows)[1:])
    tinted = (image * np.array([0.8, 1.0, 0.9])).astype(np.uint8)
    assert float((texture(image) * texture(tinted)).sum()) > 0.97, 'the white balance is no matter'


def test_images_beyond_the_keyframes_say_how_uncertain_their_place_is_and_those_among_do_not():
    world, rng, inside = Spheres.about(0), np.random.default_rng(1), unseen(60)
    keyframes = learnt(world)
    noise = keyframes.noise
    columns = rng.uniform(2.6, 3.2, 40), rng.uniform(-1.5, 1.5, 40), rng.uniform(-3.0, 3.0, 40)
    poses = np.column_stack(columns)
    _, _, found = errors(keyframes, world.panoramas(poses, CONFIG), poses)
    known = [one for one in zip(found, poses, strict=True) if one[0].known]
    own, wider = (
        [holds(m, p, noise.covariance(m) + k * noise.beyond(m) ** 2 * np.eye(3)) for m, p in known]
        for k in (0, 1)
    )
    assert np.mean(own) < 0.5, 'they seem to be at the border'
    assert np.mean(wider) > 0.9
    _, _, found = errors(keyframes, world.panoramas(inside, CONFIG), inside)
    assert np.mean([noise.beyond(match) == 0.0 for match in found]) > 0.9


def test_one_loose_stretch_does_not_make_all_headings_uncertain():
    stds = np.array([0.01] * 9 + [0.5])
    assert usual_turn_std(np.diag(stds**2)) == pytest.approx(0.01)
