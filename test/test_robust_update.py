# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of images have heavy tails: those that lie farther off than usual lose weight."""

import numpy as np
import pytest
from filter_drives import Drive

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.fusion import update
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.update import LEAST_SCATTER

NOISY = {'v_std': 0.02, 'omega_std': 0.02, 'position_std': 0.3, 'yaw_std': 0.03}


def fed(drive, claimed=0.3, correlation=None):
    """The filter's errors in m at the images, and its claimed standard deviations."""
    fused, errors, stds = PoseFilter(FilterConfig(), correlation), [], []
    for stamp_ns, kind, index in drive.events(True):
        if kind == 0:
            fused.add_odometry(stamp_ns, *drive.read[index], drive.variances())
            continue
        spread = np.diag(np.square([claimed, claimed, claimed / 10]))
        fused.add_measurement(stamp_ns, drive.seen[index], spread)
        if fused.state is not None:
            pose = drive.poses[drive.pictures[index]]
            errors.append(np.hypot(*(fused.state.pose - pose)[:2]))
            stds.append(fused.state.position_std)
    return np.array(errors), np.array(stds), fused


def heavy_tailed(seed, length=10):
    """Images with small errors, but for stretches of some that lie half a meter off together."""
    drive = Drive(seconds=60, **{**NOISY, 'position_std': 0.06, 'yaw_std': 0.006}, seed=seed)
    rng = np.random.default_rng(seed)
    for start in rng.choice(len(drive.seen) - length, 12, replace=False):
        drive.seen[start : start + length, :2] += rng.normal(0, 0.4, 2)
    drive.seen[:, 2] = wrap_angle(drive.seen[:, 2])
    return drive


def test_stretches_of_images_that_lie_off_pull_less(monkeypatch):
    with_, without = [], []
    for seed in range(4):
        with_.append(fed(heavy_tailed(seed))[0].mean())
    monkeypatch.setattr(update, '_OUTLYING', {2: 1e9, 3: 1e9})
    for seed in range(4):
        without.append(fed(heavy_tailed(seed))[0].mean())
    assert np.mean(with_) < 0.85 * np.mean(without)


@pytest.mark.parametrize(('claimed', 'low', 'high'), [(0.3, 0.6, 1.0), (0.9, 0.05, 0.25)])
def test_the_usual_distance_is_learned(claimed, low, high):
    *_, fused = fed(Drive(seconds=60, **NOISY), claimed)
    assert low <= fused._history.newest.memory.scatter <= high


def test_the_usual_distance_stays_in_its_bounds():
    scatter = 1.0
    for _ in range(1000):
        scatter = update._scatter(scatter, 0.0)
    assert scatter == LEAST_SCATTER
    for _ in range(1000):
        scatter = update._scatter(scatter, 100.0)
    assert scatter == 1.0


def test_images_that_err_as_they_claim_hardly_lose_weight(monkeypatch):
    drives = [Drive(seconds=40, **NOISY, seed=seed) for seed in range(4)]
    robust = np.mean([fed(drive)[0].mean() for drive in drives])
    monkeypatch.setattr(update, '_OUTLYING', {2: 1e9, 3: 1e9})
    assert robust < 1.15 * np.mean([fed(drive)[0].mean() for drive in drives])


def test_positions_with_white_errors_keep_their_weight(monkeypatch):
    drive, white = Drive(seconds=60, **NOISY), ErrorCorrelation(0.02, 1.0)
    found = fed(drive, correlation=white)[0]
    monkeypatch.setattr(update, '_OUTLYING', {2: 1e9, 3: 1e9})
    assert np.array_equal(found, fed(drive, correlation=white)[0])
