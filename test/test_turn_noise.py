# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The live filter finds out how noisy the turns of its odometry are."""

import math

import numpy as np
import pytest
from filter_drives import SECOND, Drive, winding

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig

RATE_HZ = 20.0
WHITE = ErrorCorrelation(0.0, 1.0)


def slipping(walk, seed, seconds=150):
    """A drive whose turns differ from the odometry's by a random walk, rad per sqrt(s)."""
    rng, read = np.random.default_rng([seed, 7]), winding(seconds, RATE_HZ, 0.3)
    true = read + np.outer(rng.standard_normal(len(read)), [0.0, walk * math.sqrt(RATE_HZ)])
    drive = Drive(twists=true, rate_hz=RATE_HZ, every=10, position_std=0.1, seed=seed)
    drive.read = read
    return drive


def driven(drive, events=None):
    """The share of yaw errors inside 95 % intervals in the second half, and the filter."""
    fused = PoseFilter(FilterConfig(initial_pose=tuple(drive.poses[0])), WHITE)
    inside, half = [], len(drive.pictures) // 2
    for stamp_ns, kind, index in events or drive.events():
        if kind == 0:
            fused.add_odometry(stamp_ns, *drive.read[index])
            continue
        fused.add_measurement(stamp_ns, drive.seen[index, :2], 0.01 * np.eye(2))
        if index > half:
            _, yaw = drive.error(fused, drive.pictures[index])
            inside.append(abs(yaw) < 1.96 * fused.state.yaw_std)
    return np.mean(inside), fused


def growth(fused):
    """Of the heading's variance, by half a turn under way."""
    begin, at_ns = fused.state, fused.state.stamp_ns
    for k in range(1, 41):
        fused.add_odometry(at_ns + k * SECOND // 20, 0.3, 1.5)
    return fused.state.yaw_std**2 - begin.yaw_std**2


def test_turns_noisier_than_expected_are_noticed():
    drives = [slipping(0.05, seed) for seed in range(4)]
    shares, filters = zip(*map(driven, drives), strict=True)
    assert np.mean(shares) > 0.8
    usual = growth(driven(slipping(0.005, 0))[1])
    assert np.mean([growth(fused) for fused in filters]) > 4 * usual


def test_neither_usual_turns_nor_outliers_are_noisy_turns():
    drive, rng = slipping(0.005, 0, seconds=80), np.random.default_rng(0)
    usual, wrong = growth(driven(drive)[1]), rng.random(len(drive.seen)) < 0.03
    drive.seen[wrong, :2] += 50.0 * rng.standard_normal((wrong.sum(), 2))
    assert growth(driven(drive)[1]) < 2.3 * usual


@pytest.mark.parametrize('late', [1, 3])
def test_a_late_measurement_has_the_effect_it_would_have_had_in_time(late):
    drive = slipping(0.05, 1, seconds=30)
    delayed = sorted(drive.events(), key=lambda event: event[0] + late * 100_000_000 * event[1])
    first, then = driven(drive)[1], driven(drive, delayed)[1]
    assert np.array_equal(first.state.mean, then.state.mean)
    assert np.allclose(first.state.covariance, then.state.covariance, atol=1e-3)
    assert growth(first) == pytest.approx(growth(then), rel=0.01)
