# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Conditions of the latest images: what the light adds, and how wrong slow features are."""

from functools import cache

import numpy as np
from cylinder_worlds import Spheres, alone
from test_keyframes import COUNTER, learnt, stds, unseen, within
from test_location import STD, fit_at, locate

from sfa_localization.keyframes.light import Conditions


def sunny(poses, config, share=0.3):
    """Images of the world and of what is in the sky, in one direction wherever the robot is."""
    other = Spheres.about(77)
    far = (1e6 * each for each in (other.places, other.heights, other.radii))
    sky = Spheres(*far, share * other.colors).panoramas(poses, config) - 128.0
    return np.clip(Spheres.about(1).panoramas(poses, config) + sky, 0, 255).astype(np.uint8)


@cache
def drive(**share):
    """Locations of 110 images in another light, without and with the conditions by earlier images;
    the poses, and the conditions.
    """
    keyframes, conditions = learnt(Spheres.about(1), COUNTER), Conditions()
    plain, adapted, poses = [], [], unseen(150)
    for image in sunny(poses, COUNTER, **share):
        plain.append(alone(keyframes, image))
        adapted.append(alone(keyframes, image, conditions))
        conditions.add(adapted[-1])
    return plain[40:], adapted[40:], poses[40:], conditions


def test_in_another_light_ellipses_are_small_and_hold():
    plain, adapted, poses, _ = drive()
    assert np.median(stds(adapted) ** 2) < 0.7 * np.median(stds(plain) ** 2)
    assert within(plain, poses) > 0.9
    assert within(adapted, poses) > 0.9


def test_what_the_light_adds_everywhere_moves_no_place():
    """In the light of the training nothing changes."""
    patterns = []
    for share, most in ((0.3, 0.75), (0.0, 1.1)):
        *locations, poses, conditions = drive(share=share)
        positions = np.array([[each.pose[:2] for each in of] for of in locations])
        plain, adapted = np.linalg.norm(positions - poses[:, :2], axis=2).mean(1)
        assert adapted < most * plain
        patterns.append(np.linalg.norm(conditions.pattern))
    assert patterns[1] < 0.2 * patterns[0]


def seen(x, residual, outward=0.2):
    return locate([fit_at(x, residual=residual.astype(np.complex64), outward=outward)])


def test_the_pattern_is_a_mean_over_places():
    share, conditions = np.ones((3, 4)), Conditions()
    conditions.add(seen(0.0, share))
    once = conditions.pattern.copy()
    for _ in range(100):
        conditions.add(seen(0.1, share))
    assert np.array_equal(conditions.pattern, once), 'a robot that stands learns nothing'
    conditions.add(seen(0.5, share, outward=0.7))
    assert np.array_equal(conditions.pattern, once), 'nor does one beside the keyframes'
    conditions.add(seen(0.4, share))
    assert np.all(conditions.pattern.real > once.real)


def test_slow_features_count_by_their_latest_errors():
    conditions, rng, claimed = Conditions(), np.random.default_rng(0), 0.3
    for wrong, least, most in ((1.0, 1.0, 1.5), (10.0, 6.0, 15.0), (1.0, 1.0, 1.5)):
        for _ in range(60):
            x, slow = STD * rng.normal(), wrong * claimed * rng.normal(size=2)
            location = locate([fit_at(x, STD * rng.normal())], [slow], claimed, conditions.scales)
            conditions.add(location)
        assert least < conditions.slow_error_factor < most
        moved = locate([fit_at()], [(0.1, 0.0)], claimed, conditions.scales).pose[0] / 0.1
        by_claim = STD**2 / (STD**2 + claimed**2)
        assert moved > 0.8 * by_claim if wrong == 1.0 else moved < 0.4 * by_claim
