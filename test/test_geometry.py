# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid alignment recovers what was moved; paths, and the twists along them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import align, align_complex, wrap_angle
from sfa_localization.data.run import differences, integrate


@given(st.integers(0, 1000), st.floats(-3.1, 3.1), st.floats(-50, 50), st.floats(-50, 50))
def test_a_rotation_and_translation_are_recovered(seed, yaw, x, y):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=20) + 1j * rng.normal(size=20)
    target = np.exp(1j * yaw) * source + x + 1j * y
    weights = rng.uniform(0.1, 5.0, 20)
    for turn, shift in (align_complex(source, target), align_complex(source, target, weights)):
        assert abs(turn - np.exp(1j * yaw)) < 1e-9 and abs(shift - (x + 1j * y)) < 1e-7
    transform = align(
        np.stack([source.real, source.imag], 1), np.stack([target.real, target.imag], 1)
    )
    assert (transform.x_m, transform.y_m) == pytest.approx((x, y), abs=1e-7)
    assert abs(np.exp(1j * transform.yaw_rad) - np.exp(1j * yaw)) < 1e-9


def test_points_without_weight_or_extent():
    source = np.array([0, 1, 2, 1j], complex)
    target = np.array([5, 5 + 1j, 5 + 2j, 900], complex)
    turn, shift = align_complex(source, target, np.array([1.0, 1.0, 3.0, 0.0]))
    assert turn == pytest.approx(1j) and shift == pytest.approx(5)
    same = np.full(3, 2.0 + 1.0j)
    assert align_complex(same, same + 4) == (1, 4), 'without a direction there is no turn'
    with pytest.raises(DataError, match='cannot align'):
        align(np.zeros((1, 2)), np.zeros((1, 2)))


@pytest.mark.parametrize('v', [0.7, -0.4])
@pytest.mark.parametrize('omega', [0.0, 0.3, -2.9])
def test_exact_odometry_of_a_path_integrates_to_it(v, omega):
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(40_000_000, 60_000_000, 200))
    twists = np.column_stack([v * rng.uniform(0.5, 1.5, 200), omega * rng.uniform(0.5, 1.5, 200)])
    poses = integrate(stamps, twists, np.array([3.0, -2.0, 3.1]))
    exact = differences(stamps, poses)
    assert np.allclose(exact[1:], twists[1:], atol=1e-9)
    again = integrate(stamps, exact, poses[0]) - poses
    assert np.abs(again[:, :2]).max() < 1e-9 and np.abs(wrap_angle(again[:, 2])).max() < 1e-9
