# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Paths and the twists along them."""

import numpy as np
import pytest

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import Odometry, Trajectory, integrate


@pytest.mark.parametrize('v', [0.7, -0.4])
@pytest.mark.parametrize('omega', [0.0, 0.3, -2.9])
def test_exact_odometry_of_a_path_integrates_to_it(v, omega):
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(40_000_000, 60_000_000, 200))
    twists = np.column_stack([v * rng.uniform(0.5, 1.5, 200), omega * rng.uniform(0.5, 1.5, 200)])
    poses = integrate(stamps, twists, np.array([3.0, -2.0, 3.1]))
    exact = Odometry.along(Trajectory(stamps, poses))
    assert np.allclose(exact.twists[1:], twists[1:], atol=1e-9)
    again = integrate(stamps, exact.twists, poses[0]) - poses
    assert np.abs(again[:, :2]).max() < 1e-9 and np.abs(wrap_angle(again[:, 2])).max() < 1e-9
    assert not exact.variances.any()
