# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""One mixture of hypotheses by keyframes and of how wrong slow features may be; their errors."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from places import lengths

from sfa_localization.data.statistics import TAIL, share_within
from sfa_localization.keyframes.errors import ErrorModel, LeftOut
from sfa_localization.keyframes.location import SCALES, located
from sfa_localization.keyframes.regression import Fit

STD = 0.1
ERRORS = ErrorModel(floor_m=STD, residual=0.0, outward_m=0.0, slow=1.0, slow_m=0.0, yaw_std=0.02)
RIGHT = np.where(SCALES == 1, 1.0, 1e-12)
"""Slow features err as they claim."""


def fit_at(x=0.0, y=0.0, yaw=0.0, unlike=0.1, outward=0.0, residual=None):
    residual = np.zeros((2, 3), np.complex64) if residual is None else residual
    of_image = np.zeros(3), unlike, residual, 0.0
    return Fit(np.array([x, y]), np.ones(1), *of_image, outward, yaw, np.exp(1j * yaw))


def locate(fits, slow=((0.0, 0.0),), std=1e3, scales=RIGHT, starts=None):
    """By fits, each of its own start or of those given, and places (1 or N, 2) of slow features."""
    starts = range(len(fits)) if starts is None else starts
    fits = [replace(fit, start=start) for fit, start in zip(fits, starts, strict=True)]
    places = np.broadcast_to(slow, (len(fits), 2)), np.full(len(fits), std**2)
    return located(fits, places, scales, ERRORS, np.zeros(2))


def test_a_hypothesis_and_slow_features_are_fused_by_their_information():
    """By hand: variances of 0.01 and 0.03 m^2 at 0 and 1 m give 0.0075 m^2 at 0.25 m."""
    location = locate([fit_at(yaw=3.0)], [(1.0, 0.0)], np.sqrt(0.03))
    assert location.pose == pytest.approx([0.25, 0.0, 3.0])
    expected = np.diag([0.0075, 0.0075, (1.1 * ERRORS.yaw_std) ** 2])
    assert_allclose(location.covariance, expected, rtol=1e-6)
    assert location.fit.explained == pytest.approx(1 / 1.1)


def test_two_hypotheses_of_equal_evidence_are_held_both():
    location = locate([fit_at(), fit_at(4.0, 0.0, 2.0)])
    assert location.pose == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)
    expected = np.diag([4.0**2 / 2 + STD**2, STD**2, 2.0**2 / 2])
    assert_allclose(location.covariance, expected, rtol=1e-3)


@pytest.mark.parametrize(
    ('unlike', 'slow'),
    [
        ((0.5, 0.3), [(0.0, 0.0)] * 2),
        ((0.3, 0.3), [(4.0, 2.0), (4.1, 1.1)]),
    ],
)
def test_what_explains_more_of_an_image_or_agrees_with_slow_features_is_believed(unlike, slow):
    fits = [fit_at(unlike=unlike[0]), fit_at(4.0, 1.0, 2.0, unlike=unlike[1])]
    location = locate(fits, slow, 1e3 if unlike[0] > unlike[1] else 0.3)
    assert np.hypot(*(location.pose[:2] - (4.0, 1.0))) < 0.1
    assert location.pose[2] == pytest.approx(2.0)
    assert np.trace(location.covariance[:2, :2]) < 2.5 * STD**2


def test_lights_of_the_training_that_disagree_make_a_place_uncertain():
    """Along the axis on which they differ, and not where the other light explains far less."""
    alike, mostly = (
        locate([fit_at(-0.2), fit_at(0.2, unlike=unlike)], starts=(0, 0)) for unlike in (0.1, 0.5)
    )
    assert alike.pose == pytest.approx(np.zeros(3), abs=1e-6)
    variances = [np.diag(each.covariance)[:2] / STD**2 for each in (alike, mostly)]
    assert_allclose(variances, [[5.0, 1.0], [1.0, 1.0]], rtol=1e-3)
    assert mostly.pose[0] == pytest.approx(-0.2, abs=1e-3)


def test_slow_features_that_are_far_away_count_less_where_they_may_err_more():
    even = np.full(len(SCALES), 1 / len(SCALES))
    for far, most in ((0.1, 0.04), (1.0, 0.03), (3.0, 0.02)):
        location = locate([fit_at()], [(far, 0.0)], 0.1, even)
        assert 0 < location.pose[0] < most
    assert location.covariance[0, 0] == pytest.approx(STD**2, rel=0.1)
    assert SCALES @ location.scales > 300


# The error model, recovered from errors drawn by it.

COUNT = 8000
TRUE = ErrorModel(0.05, 1.2, 0.6, 2.0, 0.3, 0.04)


def drawn(seed=0, common=0.0):
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


def test_the_parameters_are_recovered():
    trials, *slow = drawn()
    errors = trials.learn_slow(trials.learn(), *slow)
    assert_allclose(astuple(errors), astuple(TRUE), rtol=0.1)


def test_what_errs_in_both_is_counted():
    """95 % ellipses hold 84 % of Student's errors: 1 - (1 + 5.99 / 4)^-2."""
    for common in (0.0, 0.95):
        trials, *slow = drawn(1, common)
        errors = trials.learn_slow(trials.learn(), *slow)
        error, variance = trials.fused(errors, *slow)
        assert share_within((error**2).sum(1) / variance, 0.95, trials.weight) > 0.8
        mean, by_keyframes = lengths(error).mean(), lengths(trials.error).mean()
        assert mean < by_keyframes and (mean < 0.8 * by_keyframes) == (common == 0.0)


def test_images_of_no_weight_change_nothing():
    trials, *_ = drawn()
    weight = np.where(np.arange(COUNT) < COUNT // 2, 2.0, 0.0) / COUNT
    spoilt = np.where(weight[:, None] > 0, 1.0, 30.0) * trials.error
    errors = replace(trials, weight=weight, error=spoilt).learn()
    assert astuple(errors) == pytest.approx(astuple(replace(trials, weight=weight).learn()))
    assert errors.floor_m < 0.3 * replace(trials, error=spoilt).learn().floor_m
