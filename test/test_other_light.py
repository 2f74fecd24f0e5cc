# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is unlike because of the light, and what because no keyframe is near."""

import numpy as np
import pytest
from cylinder_worlds import Spheres
from test_keyframes import CONFIG, holds, learnt, unseen

from sfa_localization.features.keyframes import MatchNoise
from sfa_localization.features.nearby import Nearby
from sfa_localization.features.other_light import OtherLight

NOISE = MatchNoise(by_variation=5.0)


def images(light: float, number: int, seed: int = 0, scatter: float = 0.3):
    """Images at places of which some have keyframes near and others none, all in one light."""
    rng = np.random.default_rng(seed)
    for variation in rng.uniform(0.05, 0.4, number):
        place = NOISE.expected_unlike(variation) * np.exp(scatter * rng.normal())
        unlike = (1 + place) * (1 + light) - 1
        yield seen(float(unlike), float(variation))


def seen(unlike: float, variation: float, aside: float = 0.2) -> Nearby:
    return Nearby(np.zeros(2), 0.0, unlike, np.zeros((2, 2)), variation, aside)


def after(nearby) -> float:
    light = OtherLight()
    for one in nearby:
        light.add(one, NOISE)
    return light.unlike


@pytest.mark.parametrize('unlike', [0.0, 0.3, 0.8])
def test_the_light_of_a_drive_is_found_within_some_seconds(unlike):
    """Or less, as long as it is not sure."""
    found = after(images(unlike, 150))
    assert 0.6 * unlike - 0.05 < found < unlike + 0.05
    assert after(images(unlike, 1)) == 0.0


def test_the_light_may_change():
    assert after([*images(0.5, 200), *images(0.0, 300)]) < 0.1


def test_keyframes_that_are_far_are_no_other_light():
    """A drive beside all tracks: images are unlike, and keyframes vary."""
    far = [seen(0.8, 0.4)] * 100
    assert after(far) < 0.05


def test_beside_all_keyframes_nothing_is_learned_of_the_light():
    assert after([seen(1.5, 0.05, aside=0.7)] * 100) == 0.0


def test_an_excursion_beyond_the_keyframes_is_no_other_light():
    """The place seems to be among those at the border, which cannot show how far it is."""
    away = [seen(unlike, 0.05) for unlike in (0.2, 0.5, 0.9, *[1.4] * 60)]
    assert after([*images(0.0, 150), *away]) < 0.15


def test_images_that_are_more_alike_than_usual_are_no_negative_light():
    assert after([seen(0.0, 0.3)] * 50) == 0.0


def test_no_light_hides_the_place():
    assert after([seen(1e6, 0.05)] * 500) <= 1.0


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
        light.add(match.nearby, keyframes.noise)
        plain.append(match)
        known.append(match.in_light(light.unlike, keyframes.noise))
    late = slice(50, None)
    sizes = [
        np.median([np.trace(m.covariance[:2, :2]) for m in found[late]]) for found in (plain, known)
    ]
    assert light.unlike > 0.1
    assert sizes[1] < 0.7 * sizes[0]
    assert np.mean([holds(m, p) for m, p in zip(known[late], poses[late], strict=True)]) > 0.9
