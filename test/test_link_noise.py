# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry that is worse than it says is noticed, and bends the map less."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from metric_worlds import drive, garden_features, meander

from sfa_localization.data.geometry import align
from sfa_localization.metric.basis import Process
from sfa_localization.metric.links import Links
from sfa_localization.metric.map_fit import MetricProblem
from sfa_localization.metric.segments import cut
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.metric.stack import SegmentPoses


def worse(segments, factor, seed=0):
    """Displacements and turns with errors whose variances are a factor above the stated ones."""
    rng = np.random.default_rng(seed)

    def wrong(item):
        if not item.linked:
            return item
        std = np.sqrt((factor - 1) * item.displacement_variance)
        moved = item.displacement + std * complex(*rng.standard_normal(2))
        turned = item.turn_rad + np.sqrt((factor - 1) * item.turn_variance) * rng.standard_normal()
        return dataclasses.replace(item, displacement=moved, turn_rad=float(turned))

    return dataclasses.replace(segments, items=tuple(wrong(item) for item in segments))


@cache
def recorded():
    """A drive, its segments, features of its images, and the fit of them."""
    twists, start = meander(250.0, seed=2)
    run = drive(twists, start=start, yaw_noise=0.01, speed_noise=0.03, seed=2)
    segments = cut(run.odometry, run.stamps_ns, SegmentConfig())
    features = garden_features(run.poses[:, :2], noise=0.05)
    return run, segments, features, solved(segments, features)


def solved(segments, features):
    problem = MetricProblem.of(features, segments, MetricConfig())
    rows = problem.features
    scale = np.full(rows.shape[1], 1.0 / np.sqrt(rows.var(0).sum()))
    return problem.fit(Process.fit(rows, scale, 1e-2, 300))


def factors(fit):
    """How many times the stated variance each link of a fit has: of turns, of displacements."""
    names = 'turn_variance', 'displacement_variance'
    return [getattr(fit.links, name) / getattr(fit.problem.links, name) for name in names]


def error(fit):
    """Mean error of a map, m."""
    places = np.column_stack([fit.places.real, fit.places.imag])
    truth = recorded()[0].poses[fit.stack.images, :2]
    return np.hypot(*(align(places, truth).apply(places) - truth).T).mean()


def test_links_that_err_by_more_than_they_say_weigh_less_for_the_good_of_the_map(
    monkeypatch,
):
    _, segments, features, right = recorded()
    for factor in factors(right):
        assert 0.8 < np.median(factor) < 1.2 and factor.max() < 3.0
    wrong = worse(segments, 16.0)
    fit = solved(wrong, features)
    for factor in factors(fit):
        assert 5.0 < np.median(factor) < 25.0
    monkeypatch.setattr(Links, 'learned', lambda stated, *_: stated)
    assert error(fit) < 0.9 * error(solved(wrong, features))


def test_a_wheel_that_slips_costs_single_links():
    _, segments, features, right = recorded()
    slipped = list(segments)
    for n in (10, 40, 70):
        slipped[n] = dataclasses.replace(slipped[n], displacement=slipped[n].displacement + 0.7)
    fit = solved(dataclasses.replace(segments, items=tuple(slipped)), features)
    (_, before), (_, move) = factors(right), factors(fit)
    wrong = np.isin(fit.links.at, (10, 40, 70))
    assert move[wrong].min() > 10.0
    assert np.median(move[~wrong]) < 1.5 * np.median(before)


def test_the_gram_is_what_eq_1_costs_at_the_best_map():
    fit, rng = recorded()[3], np.random.default_rng(0)
    stack, n, ridge = fit.stack, fit.stack.segments, fit.ridge
    bias = 1e-3 * rng.normal(size=stack.period[-1] + 1)
    z = np.exp(1j * rng.uniform(-3, 3, n))
    poses = SegmentPoses(z, rng.normal(size=(n, 2)) @ [1, 1j], bias)
    places, y = poses.places(stack), poses.coefficients(stack.period)
    weights = ridge.fitted(places)
    residuals = places - ridge.expanded @ weights
    prior = ridge.basis.ridge @ np.abs(weights) ** 2
    total = ridge.weights @ np.abs(residuals) ** 2 + prior
    assert np.vdot(y, ridge.gram(stack) @ y).real == pytest.approx(total)
