# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The disagreement of rotated views must find the errors that it is told of, and no others."""

import numpy as np
import pytest

from sfa_localization.features.rotation_spread import Agreement, disagreement, share_within


def drawn(exponent, axes, count=20_000, seed=0):
    """Disagreements, squared errors whose variance follows them, and the variances claimed."""
    rng = np.random.default_rng(seed)
    u = np.exp(0.5 * rng.standard_normal(count))
    claimed = np.exp(0.3 * rng.standard_normal(count))
    error = rng.standard_normal((count, axes)) * np.sqrt(claimed * 2.0 * u**exponent)[:, None]
    return u, (error**2).sum(1), claimed


@pytest.mark.parametrize('axes', [1, 2])
@pytest.mark.parametrize('exponent', [0.0, 2.0])
def test_exponent_and_level_of_the_errors_are_found(exponent, axes):
    u, squared, claimed = drawn(exponent, axes)
    fit = Agreement.fit(u, squared, claimed, axes)
    assert fit.exponent == pytest.approx(exponent, abs=0.26)
    assert fit.factor(np.array([1.0]))[0] == pytest.approx(2.0, rel=0.1)


def test_fit_covers_half_and_most_of_heavy_tailed_errors():
    rng = np.random.default_rng(1)
    u = np.exp(0.5 * rng.standard_normal(20_000))
    squared = (rng.standard_t(2.5, (20_000, 2)) ** 2).sum(1)
    fit = Agreement.fit(u, squared, np.ones(20_000), 2)
    variance = fit.factor(u)
    assert (squared <= 1.386 * variance).mean() >= 0.49
    assert (squared <= 5.991 * variance).mean() >= 0.945


@pytest.mark.parametrize('axes', [1, 2])
def test_images_of_no_weight_change_nothing(axes):
    u, squared, claimed = drawn(1.0, axes, count=3000)
    weight = np.where(np.arange(3000) < 2000, 1.0, 0.0)
    squared[2000:] *= 100.0
    weighted = Agreement.fit(u, squared, claimed, axes, weight)
    assert weighted == Agreement.fit(u[:2000], squared[:2000], claimed[:2000], axes)
    assert weighted.level < 0.1 * Agreement.fit(u, squared, claimed, axes).level


def test_the_share_within_a_region_is_by_weight():
    assert share_within(np.array([1.0, 7.0]), 2, 0.95, np.array([3.0, 1.0])) == 0.75


def test_disagreement_is_zero_for_equal_views_and_does_not_depend_on_heading():
    rng = np.random.default_rng(2)
    top = rng.standard_normal((3, 1, 12, 5)).astype(np.float32)
    assert disagreement(np.repeat(top[:, :, :1], 12, axis=2)) == pytest.approx(0.0, abs=1e-7)
    assert disagreement(np.roll(top, 4, axis=2)) == pytest.approx(disagreement(top), rel=1e-6)
    assert disagreement(top) == pytest.approx(top[:, 0].std(1).mean(1), rel=1e-5)
