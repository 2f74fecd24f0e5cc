# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the light adds to all images; what is unlike by it, and what because no keyframe is near."""

import numpy as np
import pytest
from cylinder_worlds import Spheres
from test_keyframes import CONFIG, COUNTER, holds, learnt, unseen

from sfa_localization.features.observation import Match, MatchNoise
from sfa_localization.features.other_light import OtherLight

NOISE = MatchNoise(by_variation=5.0)


def images(light: float, number: int, seed: int = 0, scatter: float = 0.3):
    """Images at places of which some have keyframes near and others none, all in one light."""
    rng = np.random.default_rng(seed)
    for variation in rng.uniform(0.05, 0.4, number):
        place = NOISE.expected_unlike(variation) * np.exp(scatter * rng.normal())
        unlike = (1 + place) * (1 + light) - 1
        yield seen(float(unlike), float(variation))


def seen(unlike: float, variation: float, aside: float = 0.2, x: float = 0.0, left=None) -> Match:
    return Match(np.array([x, 0.0, 0.0]), unlike, variation, aside, left=left)


def after(matches) -> float:
    light = OtherLight()
    for one in matches:
        light.add(one, NOISE)
    return light.unlike


def test_the_light_of_a_drive_is_found_within_some_seconds_and_may_change():
    """Or less, as long as it is not sure."""
    for unlike in (0.0, 0.3, 0.8):
        assert 0.6 * unlike - 0.05 < after(images(unlike, 150)) < unlike + 0.05
        assert after(images(unlike, 1)) == 0.0
    assert after([*images(0.5, 200), *images(0.0, 300)]) < 0.1


def test_what_is_no_other_light():
    """A drive beside all tracks, an excursion beyond the keyframes (the place seems to be among
    those at the border, which cannot show how far it is), images that are more alike than usual.
    """
    assert after([seen(0.8, 0.4)] * 100) < 0.05
    assert after([seen(1.5, 0.05, aside=0.7)] * 100) == 0.0
    away = [seen(unlike, 0.05) for unlike in (0.2, 0.5, 0.9, *[1.4] * 60)]
    assert after([*images(0.0, 150), *away]) < 0.15
    assert after([seen(0.0, 0.3)] * 50) == 0.0
    assert after([seen(1e6, 0.05)] * 500) <= 1.0, 'no light hides the place'


def repainted(world: Spheres, share: float) -> Spheres:
    """The same world with a share of other colors: sun on other sides."""
    rng = np.random.default_rng(11)
    colors = world.colors + share * rng.uniform(-90, 90, world.colors.shape)
    return Spheres(world.places, world.heights, world.radii, colors)


def test_in_another_light_ellipses_are_small_and_hold():
    world, poses = Spheres.about(1), unseen(150)
    keyframes, light = learnt(world), OtherLight()
    plain, known = [], []
    for image in repainted(world, 0.5).panoramas(poses, CONFIG):
        match = keyframes.match(image)
        light.add(match, keyframes.noise)
        plain.append(match)
        known.append(keyframes.noise.covariance(match, light.unlike))
    late = slice(50, None)
    first = [keyframes.noise.covariance(match) for match in plain]
    spreads = np.array([first[late], known[late]])[:, :, :2, :2]
    sizes = np.median(np.trace(spreads, axis1=2, axis2=3), axis=1)
    assert light.unlike > 0.1
    assert sizes[1] < 0.7 * sizes[0]
    late_ones = zip(plain[late], poses[late], known[late], strict=True)
    assert np.mean([holds(m, p, c) for m, p, c in late_ones]) > 0.9


def far_away(world: Spheres, share: float) -> Spheres:
    """The same in the sky: what stays in its direction wherever the robot is."""
    places, heights, radii = (1e6 * each for each in (world.places, world.heights, world.radii))
    return Spheres(places, heights, radii, share * world.colors)


def drive_in_other_light(config, share, seed=1, number=150):
    """Errors (m) of single images in a light that adds a pattern, without and with what the images
    before have shown of it.
    """
    world, poses = Spheres.about(seed), unseen(number)
    keyframes, light, sun = learnt(world, config), OtherLight(), far_away(Spheres.about(77), share)
    images = world.panoramas(poses, config) + (sun.panoramas(poses, config) - 128.0)
    errors = []
    for image, pose in zip(np.clip(images, 0, 255).astype(np.uint8), poses, strict=True):
        plain, known = keyframes.match(image), keyframes.match(image, pattern=light.pattern)
        light.add(known, keyframes.noise)
        errors.append([np.hypot(*(found.pose - pose)[:2]) for found in (plain, known)])
    return np.array(errors)[40:].mean(0), light


@pytest.mark.parametrize('config', [CONFIG, COUNTER])
def test_what_the_light_adds_everywhere_moves_no_place(config):
    """In the light of the training nothing changes."""
    (plain, known), light = drive_in_other_light(config, 0.3)
    assert known < 0.75 * plain
    (plain, known), same = drive_in_other_light(config, 0.0)
    assert known < 1.1 * plain
    assert np.linalg.norm(same.pattern) < 0.2 * np.linalg.norm(light.pattern)


def test_the_pattern_is_a_mean_over_places():
    """What is unusual about one place, as a visitor there, is none of the others' business."""
    share, rng = np.ones((3, 4), np.complex64), np.random.default_rng(0)
    light = OtherLight()
    light.add(seen(0.1, 0.05, left=share), NOISE)
    once = light.pattern.copy()
    for _ in range(100):
        light.add(seen(0.1, 0.05, x=0.1, left=share), NOISE)
    assert np.array_equal(light.pattern, once), 'a robot that stands learns nothing'
    light.add(seen(0.1, 0.05, x=0.4, left=share), NOISE)
    assert np.all(light.pattern.real > once.real)
    light = OtherLight()
    for k in range(300):
        known = light.pattern if light.pattern is not None else 0 * share
        shown = share + rng.normal(0, 1.0, share.shape)
        left = (shown - known).astype(np.complex64)
        light.add(seen(0.0, 0.3, x=0.3 * k, left=left), NOISE)
    assert np.abs(light.pattern.mean() - 1) < 0.15
    assert np.std(light.pattern) < 0.3
