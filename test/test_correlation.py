# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How pictures' errors hang together: fitted again in errors that are made so."""

import math

import numpy as np
import pytest
from filter_drives import lasting
from numpy.testing import assert_allclose

from sfa_localization.data.error_correlation import LEAST_M, ErrorCorrelation
from sfa_localization.data.errors import DataError


def made(share, distance, seed=0, step=0.1, stretches=60, length=80):
    """Errors (M, 2) of 0.2 m with variances (M,), way (M,) and stretch (M,)."""
    rng = np.random.default_rng(seed)
    fades = np.where(np.arange(stretches * length) % length, math.exp(-step / distance), 0.0)
    count = len(fades)
    errors = math.sqrt(share) * lasting(rng, fades, 2)
    errors += math.sqrt(1 - share) * rng.standard_normal(errors.shape)
    std = rng.uniform(0.1, 0.3, count)
    owner = np.repeat(np.arange(stretches), length)
    return errors * std[:, None], std**2, np.arange(count) * step, owner


@pytest.mark.parametrize(('share', 'distance'), [(0.3, 1.0), (0.7, 0.3), (0.9, 2.0)])
def test_share_and_distance_are_found_again(share, distance):
    fitted = [ErrorCorrelation.fit(*made(share, distance, seed)) for seed in range(5)]
    assert np.mean([f.share for f in fitted]) == pytest.approx(share, abs=0.06)
    assert np.median([f.distance_m for f in fitted]) == pytest.approx(distance, rel=0.3)


def test_white_errors_have_nothing_in_common_and_outliers_do_not_rule():
    assert ErrorCorrelation.fit(*made(0.0, 1.0)).share < 0.05
    errors, variances, way, owner = made(0.7, 1.0)
    errors[::25] += np.random.default_rng(1).uniform(-20, 20, (len(errors[::25]), 2))
    assert ErrorCorrelation.fit(errors, variances, way, owner).share == pytest.approx(0.7, abs=0.15)


def test_errors_of_different_stretches_are_not_compared_and_too_few_say_nothing():
    errors, variances, way, owner = made(0.8, 0.5, stretches=400, length=4)
    separate = ErrorCorrelation.fit(errors, variances, way, owner)
    mixed = ErrorCorrelation.fit(errors, variances, way, np.zeros_like(owner))
    assert separate.share == pytest.approx(0.8, abs=0.1) and mixed.distance_m < separate.distance_m
    few = made(0.2, 1.0, stretches=3, length=5)
    assert ErrorCorrelation.fit(*few) == ErrorCorrelation()


def test_errors_that_are_alike_count_as_fewer():
    """By hand: 0.5 of errors fades to a half in 1 m; what is far separate has nothing in common."""
    correlation = ErrorCorrelation(0.5, 1.0 / math.log(2.0))
    alike = correlation.alike(np.array([1.0, 0.0, 100.0, 2.0]))
    assert_allclose(alike, [1.5, 1.375, 1.0, 1.375])
    assert_allclose(correlation.alike(np.zeros(5)), 3.0)
    assert correlation.alike(np.zeros(0)).shape == (0,)


def test_numbers_that_cannot_be_are_refused():
    for share, distance in (
        (1.0, 1.0), (-0.1, 1.0), (math.nan, 1.0), (0.5, LEAST_M / 2), (0.5, math.inf),
        (0.5, math.nan),
    ):  # fmt: skip
        with pytest.raises(DataError, match='share'):
            ErrorCorrelation(share, distance)
