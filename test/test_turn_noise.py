# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The live filter finds out how noisy the turns of its odometry are."""

import math

import numpy as np
import pytest
from filter_drives import Drive, winding

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


def driven(drive):
    """The share of yaw errors inside 95 % intervals in the second half, and the factor."""
    fused = PoseFilter(FilterConfig(initial_pose=tuple(drive.poses[0])), WHITE)
    inside, half = [], len(drive.pictures) // 2
    for event in drive.events():
        if event[1]:
            fused.add_measurement(event[0], drive.seen[event[2], :2], 0.01 * np.eye(2))
            if event[2] > half:
                _, yaw = drive.error(fused, drive.pictures[event[2]])
                inside.append(abs(yaw) < 1.96 * fused.state.yaw_std)
        else:
            fused.add_odometry(event[0], *drive.read[event[2]])
    return np.mean(inside), fused._history.newest.turn_factor


def test_turns_noisier_than_expected_are_noticed():
    shares, factors = zip(*(driven(slipping(0.05, seed)) for seed in range(4)), strict=True)
    assert np.mean(shares) > 0.8
    assert 2.0 < np.mean(factors) < 8.0


def test_turns_as_expected_change_nothing():
    factors = [driven(slipping(0.005, seed))[1] for seed in range(3)]
    assert np.mean(factors) < 1.3


def test_an_outlier_is_no_turn():
    drive = slipping(0.005, 0, seconds=80)
    rng = np.random.default_rng(0)
    wrong = rng.random(len(drive.seen)) < 0.03
    drive.seen[wrong, :2] += 50.0 * rng.standard_normal((wrong.sum(), 2))
    assert driven(drive)[1] < 1.5


@pytest.mark.parametrize('late', [1, 3])
def test_a_late_measurement_has_the_effect_it_would_have_had_in_time(late):
    drive = slipping(0.05, 1, seconds=30)
    filters = [PoseFilter(FilterConfig(initial_pose=tuple(drive.poses[0])), WHITE)
               for _ in range(2)]  # fmt: skip
    events = drive.events()
    delayed = sorted(events, key=lambda event: event[0] + late * 100_000_000 * event[1])
    for fused, order in zip(filters, (events, delayed), strict=True):
        for event in order:
            if event[1]:
                fused.add_measurement(event[0], drive.seen[event[2], :2], 0.01 * np.eye(2))
            else:
                fused.add_odometry(event[0], *drive.read[event[2]])
    newest = [fused._history.newest for fused in filters]
    assert newest[0].turn_factor == newest[1].turn_factor > 1.0
    assert np.array_equal(newest[0].mean, newest[1].mean)
