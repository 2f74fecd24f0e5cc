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
    """A drive, its segments, and features of its images."""
    twists, start = meander(250.0, seed=2)
    run = drive(twists, start=start, yaw_noise=0.01, speed_noise=0.03, seed=2)
    segments = cut(run.odometry, run.stamps_ns, SegmentConfig())
    return run, segments, garden_features(run.poses[:, :2], noise=0.05)


def solved(segments, features):
    problem = MetricProblem.of(features, segments, MetricConfig())
    rows = problem.features
    scale = np.full(rows.shape[1], 1.0 / np.sqrt(rows.var(0).sum()))
    return problem.fit(Process.fit(rows, scale, 1e-2, 300))


def factors(fit):
    """How many times the stated variance each link of a fit has: of turns, of displacements."""
    stated, learned = fit.problem.links, fit.links
    return (
        learned.turn_variance / stated.turn_variance,
        learned.displacement_variance / stated.displacement_variance,
    )


def test_links_weigh_less_where_they_err_by_more_than_they_say():
    _, segments, features = recorded()
    for factor in factors(solved(segments, features)):
        assert 0.8 < np.median(factor) < 1.2 and factor.max() < 3.0
    for factor in factors(solved(worse(segments, 16.0), features)):
        assert 5.0 < np.median(factor) < 25.0


def test_the_map_is_better_for_it(monkeypatch):
    run, segments, features = recorded()

    def error(fit):
        places = np.column_stack([fit.places.real, fit.places.imag])
        truth = run.poses[fit.stack.images, :2]
        return np.hypot(*(align(places, truth).apply(places) - truth).T).mean()

    learned = error(solved(worse(segments, 16.0), features))
    monkeypatch.setattr(Links, 'learned', lambda stated, *_: stated)
    assert learned < 0.9 * error(solved(worse(segments, 16.0), features))


def test_a_wheel_that_slips_once_costs_one_link():
    _, segments, features = recorded()
    slipped = list(segments)
    for n in (10, 40, 70):
        slipped[n] = dataclasses.replace(slipped[n], displacement=slipped[n].displacement + 0.7)
    _, before = factors(solved(segments, features))
    fit = solved(dataclasses.replace(segments, items=tuple(slipped)), features)
    _, move = factors(fit)
    wrong = np.isin(fit.links.at, (10, 40, 70))
    assert move[wrong].min() > 10.0
    assert np.median(move[~wrong]) < 1.5 * np.median(before)


@pytest.mark.parametrize('names', [('turn', 'displacement'), ('displacement', 'turn')])
def test_links_without_weight_stay_without(names):
    _, segments, features = recorded()
    without, other = (f'{name}_variance' for name in names)
    unused = tuple(dataclasses.replace(item, **{without: np.inf}) for item in segments)
    links = solved(dataclasses.replace(segments, items=unused), features).links
    assert np.isinf(getattr(links, without)).all() and np.isfinite(getattr(links, other)).all()


def test_a_yaw_rate_bias_turns_the_paths_of_the_form():
    """z^H H z is the cost of paths at the bias b: y^H G y of y = [o, z, -b z], at the best o."""
    _, segments, features = recorded()
    none = {'turn_variance': np.inf, 'displacement_variance': np.inf}
    unlinked = tuple(dataclasses.replace(item, **none) for item in segments)
    fit = solved(dataclasses.replace(segments, items=unlinked), features)
    form, rng = fit.form(fit.ridge), np.random.default_rng(0)
    x, bias = rng.normal(size=(2, len(form.period))), rng.normal(size=form.period[-1] + 1)
    z, gram = x[0] + 1j * x[1], fit.ridge.gram(fit.stack)
    system, c = form.at(bias), np.concatenate([z, -bias[form.period] * z])
    y = np.concatenate([form.origins @ c, c])
    assert np.allclose(system, system.conj().T)
    assert np.vdot(z, system @ z).real == pytest.approx(np.vdot(y, gram @ y).real)
    assert np.allclose((gram @ y)[: len(z)], 0.0, atol=1e-6)
