# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid alignment recovers what was moved."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import align, align_complex


@given(st.integers(0, 1000), st.floats(-3.1, 3.1), st.floats(-50, 50), st.floats(-50, 50))
def test_a_rotation_and_translation_are_recovered(seed, yaw, x, y):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=20) + 1j * rng.normal(size=20)
    target = np.exp(1j * yaw) * source + x + 1j * y
    weights = rng.uniform(0.1, 5.0, 20)
    for turn, shift in (align_complex(source, target), align_complex(source, target, weights)):
        assert abs(turn - np.exp(1j * yaw)) < 1e-9 and abs(shift - (x + 1j * y)) < 1e-7
    found = align(np.stack([source.real, source.imag], 1), np.stack([target.real, target.imag], 1))
    assert (found.x_m, found.y_m) == pytest.approx((x, y), abs=1e-7)
    assert abs(np.exp(1j * found.yaw_rad) - np.exp(1j * yaw)) < 1e-9


def test_points_without_weight_do_not_count():
    source = np.array([0, 1, 2, 1j], complex)
    target = np.array([5, 5 + 1j, 5 + 2j, 900], complex)
    turn, shift = align_complex(source, target, np.array([1.0, 1.0, 3.0, 0.0]))
    assert turn == pytest.approx(1j) and shift == pytest.approx(5)


def test_points_that_show_no_direction_are_not_turned():
    same = np.full(3, 2.0 + 1.0j)
    assert align_complex(same, same + 4) == (1, 4)


def test_one_point_cannot_be_aligned():
    with pytest.raises(DataError, match='cannot align'):
        align(np.zeros((1, 2)), np.zeros((1, 2)))
