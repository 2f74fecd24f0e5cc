# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The variances of places are learned from errors: learned again in errors that were drawn so."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from sfa_localization.data.statistics import TAIL, share_within
from sfa_localization.keyframes.errors import ErrorModel, LeftOut

COUNT = 8000
TRUE = ErrorModel(0.05, 1.2, 0.6, 2.0, 0.3, 0.04)


def drawn(seed: int = 0, common: float = 0.0):
    """Images left out, with errors by keyframes of `TRUE`; and the errors (COUNT, 2) by slow
    features, of which this part is that of keyframes, and the variances (COUNT,) that they claim.
    """
    rng = np.random.default_rng(seed)
    unlike, variance = np.exp(rng.normal(-1.5, 1.0, COUNT)), np.exp(rng.normal(-6, 1, COUNT))
    claimed, outward = np.exp(rng.normal(-5, 1, COUNT)), rng.uniform(0, 1, COUNT)
    tail = np.sqrt(rng.chisquare(TAIL, COUNT) / TAIL)
    both = [TRUE.variance(variance, outward, unlike), TRUE.slow_variance(claimed, unlike)]
    error, slow = np.sqrt(both)[:, :, None] * rng.normal(size=(2, COUNT, 2)) / tail[:, None]
    turn = rng.normal(size=COUNT) * np.sqrt(TRUE.yaw_variance(unlike))
    trials = LeftOut(unlike, outward, variance, error, turn, np.full(COUNT, 1 / COUNT))
    return trials, slow + common * (error - slow), claimed


def test_the_parameters_of_drawn_errors_are_learned():
    trials, *slow = drawn()
    learned = trials.learn_slow(trials.learn(), *slow)
    np.testing.assert_allclose(astuple(learned), astuple(TRUE), rtol=0.1)


def test_what_errs_in_both_is_counted():
    """95 % ellipses hold 84 % of Student's errors: 1 - (1 + 5.99 / 4)^-2."""
    for common in (0.0, 0.95):
        trials, *slow = drawn(1, common)
        learned = trials.learn_slow(trials.learn(), *slow)
        error, variance = trials.fused(learned, *slow)
        assert share_within((error**2).sum(1) / variance, 0.95, trials.weight) > 0.8
        mean, by_keyframes = np.hypot(*error.T).mean(), np.hypot(*trials.error.T).mean()
        assert mean < by_keyframes and (mean < 0.8 * by_keyframes) == (common == 0.0)


def test_images_of_no_weight_change_nothing():
    trials, *_ = drawn()
    weight = np.where(np.arange(COUNT) < COUNT // 2, 2.0, 0.0) / COUNT
    spoilt = np.where(weight[:, None] > 0, 1.0, 30.0) * trials.error
    learned = replace(trials, weight=weight, error=spoilt).learn()
    assert astuple(learned) == pytest.approx(astuple(replace(trials, weight=weight).learn()))
    assert learned.floor_m < 0.3 * replace(trials, error=spoilt).learn().floor_m
