# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Robust statistics by hand, and on normal and heavy-tailed numbers."""

import numpy as np
import pytest
from places import lengths
from scipy import stats

from sfa_localization.data import statistics


def test_a_weight_of_three_counts_three_values():
    values, weight = np.array([4.0, 1.0, 3.0, 2.0]), np.array([1.0, 3.0, 1.0, 2.0])
    repeated = np.sort(np.repeat(values, weight.astype(int)))
    for share in (0.1, 0.5, 0.6, 0.95, 1.0):
        assert statistics.quantile(values, share, weight) == repeated[int(np.ceil(share * 7)) - 1]
    assert statistics.quantile(np.array([3.0, 1.0, 2.0]), 0.5) == 2.0
    assert statistics.share_within(np.array([1.0, 7.0]), 0.95, np.array([3.0, 1.0])) == 0.75


def test_medians_give_the_standard_deviation_of_normal_numbers_and_vectors():
    pairs = np.random.default_rng(0).standard_normal((100_000, 2))
    for median, factor in (
        (np.median(np.abs(pairs[:, 0])), statistics.MEDIAN_TO_STD),
        (np.median(lengths(pairs)), statistics.LENGTH_TO_STD),
    ):
        assert median * factor == pytest.approx(1.0, abs=0.01)


def test_an_outlier_counts_little_and_the_usual_error_fully():
    """At 4 degrees of freedom: (4 + 1) / (4 + 1) for an error of one standard deviation."""
    factors = statistics.outlier_factor(np.array([0.0, 1.0, 96.0]))
    assert factors.tolist() == [0.8, 1.0, 20.0]
    assert statistics.outlier_factor(np.array([2.0]), 2).tolist() == [1.0]


def test_the_surprise_is_the_density_of_student():
    """Minus the logarithm, up to a constant."""
    x = np.array([0.0, 0.5, 3.0])
    difference = statistics.surprise(x**2, 1) + stats.t.logpdf(x, statistics.TAIL)
    assert np.ptp(difference) < 1e-12


def test_the_peak_of_a_parabola_lies_between_the_samples():
    at = np.array([-1.0, 0.0, 1.0])[:, None]
    for peak in (-0.5, 0.0, 0.4):
        assert statistics.parabola_peak(*-((at - peak) ** 2)) == pytest.approx(peak)
    flat = statistics.parabola_peak(*np.zeros((3, 1), np.float32))
    assert flat == 0.0 and flat.dtype == np.float32
