# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The pose by images that agree among themselves."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from sfa_localization.fusion.belief import CAPACITY, SPACING_M, PositionFix, remembered
from sfa_localization.fusion.relocation import relocate

STD_M, STD_RAD = 0.1, 0.05


def along(count, step_m=0.2, heading=True, wrong=(), noise=0.0, turn=1.2, seed=0):
    """Images of a robot that dead reckoning moves along x, in a map that is turned by `turn`."""
    rng, images = np.random.default_rng(seed), []
    for k in range(count):
        way_m = k * step_m
        place = way_m * np.exp(1j * turn) + (5 - 3j) + noise * complex(*rng.standard_normal(2))
        place += complex(*rng.uniform(3, 9, 2)) if k in wrong else 0
        yaw, variance = (turn, STD_RAD**2) if heading else (math.nan, math.inf)
        images.append(PositionFix(k, place, yaw, STD_M**2, variance, (way_m, 0.0, 0.0), way_m))
    return images


@pytest.mark.parametrize('heading', [True, False])
@pytest.mark.parametrize('turn', [0.0, 1.2, math.pi])
def test_images_along_the_odometry_show_the_pose(turn, heading):
    relocated = relocate(along(21, heading=heading, wrong=(3, 4, 11), turn=turn), 1.0)
    place = 4.0 * np.exp(1j * turn) + (5 - 3j)
    assert relocated.pose[:2] == pytest.approx([place.real, place.imag], abs=1e-9)
    assert abs(math.remainder(relocated.pose[2] - turn, 2 * math.pi)) < 1e-9
    assert (relocated.images, relocated.dissenting, relocated.distance_m) == (
        18,
        3,
        pytest.approx(4.0),
    )
    assert np.linalg.eigvalsh(relocated.covariance)[0] > 0


def test_a_place_without_heading_or_motion_shows_no_pose():
    assert relocate(along(1, heading=False), 1.0) is None
    assert relocate(along(30, step_m=0.0, heading=False), 1.0) is None


def test_errors_are_as_large_as_claimed_and_neighbors_that_err_alike_count_as_fewer():
    place, squared = 8.0 * np.exp(1.2j) + (5 - 3j), []
    for seed in range(50):
        seen = along(41, noise=STD_M, heading=False, seed=seed)
        relocated = relocate(seen, 1e-3)
        miss = relocated.pose - [place.real, place.imag, 1.2]
        squared.append(miss @ np.linalg.solve(relocated.covariance, miss))
    low = chi2.ppf(0.0005, 150)
    # Dead reckoning has no error here, but is expected to drift: the claim is rather too modest.
    assert low / 2 < sum(squared) < low
    alike = relocate(seen, 2.0)
    assert np.allclose(alike.covariance, relocated.covariance * 41 / (1 + 8.0 / 2.0))


def test_of_what_is_remembered_the_newer_half_is_complete_and_the_older_reaches_far():
    kept = ()
    for image in along(900, step_m=0.02):
        kept = remembered(kept, image)
        assert len(kept) <= CAPACITY
    assert [image.stamp_ns for image in kept[-30:]] == list(range(870, 900))
    older = [image.traveled_m for image in kept[:-30] if image.is_new]
    assert len(older) >= 20 and np.allclose(np.diff(older), SPACING_M)
    far = along(2, step_m=100.0)
    assert remembered(remembered((), far[0]), far[1]) == (far[1],)
