# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's equations 1 to 8, by hand and by finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from metric_worlds import criss_cross, drive, exact_features
from places import as_complex

from sfa_localization.data.errors import DataError
from sfa_localization.mapping.basis import monomials
from sfa_localization.mapping.map_fit import MetricProblem
from sfa_localization.mapping.paper_solver import Lines, descend, learn, odometry_start
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.stack import Stack
from sfa_localization.motion.settings import SegmentConfig


def problem():
    rng, line = np.random.default_rng(0), np.repeat(np.arange(4), 6)
    turns = np.array([0.5, np.nan, -1.2])
    lines = Lines(rng.standard_normal((24, 6)), rng.uniform(0, 8, 24), line, turns)
    places = as_complex(rng.standard_normal((10, 2)))
    return lines, np.concatenate([rng.uniform(0, 6, 4), places])


def test_cost_of_one_point_by_hand():
    # o = 1 + 2 i, d = 3 along alpha = 90 deg gives 1 + 5 i; W^T s = 2 (1 + i).
    lines = Lines(np.array([[2.0]]), np.array([3.0]), np.array([0]), np.zeros(0))
    theta = np.array([np.pi / 2, 1 + 2j, 1 + 1j])
    assert lines.cost(theta) == pytest.approx(0.5 * (1 + 9))


def test_gradients_are_the_slopes_of_the_costs():
    lines, theta = problem()
    gradient, small = lines.gradient(theta), 1e-6
    assert not gradient[:4].imag.any()
    for axis, slope in ((1.0, gradient.real), (1j, gradient.imag)):
        for k in range(4 if axis == 1j else 0, len(theta)):
            step = np.eye(len(theta))[k] * small * axis
            up, down = (lines.cost(theta + s * step) for s in (1, -1))
            assert slope[k] == pytest.approx((up - down) / (2 * small), rel=1e-5, abs=1e-5)


def test_one_step_is_equations_7_and_8():
    lines, theta = problem()
    first = theta - 1e-3 * lines.gradient(theta)
    velocity, slope = theta - first, lines.gradient(first)
    second = first - (0.9 * velocity + 1e-3 * slope)
    end, history = descend(lines, theta, iterations=2, learning_rate=1e-3, momentum=0.9)
    assert np.allclose(end, second, atol=1e-12)
    assert history == pytest.approx([lines.cost(theta), lines.cost(first), lines.cost(end)])


@pytest.mark.filterwarnings('ignore:overflow', 'ignore:invalid value')
def test_a_diverging_descent_names_the_other_solver():
    lines, theta = problem()
    with pytest.raises(DataError, match='solver: certified'):
        descend(lines, theta, iterations=10000, learning_rate=1.0)


def lines_of_a_drive():
    run = drive(*criss_cross(10))
    segments = run.segments(SegmentConfig(segments='straight'))
    return run, Stack.of(segments), segments


def test_the_odometry_start_of_perfect_odometry_costs_nothing():
    run, stack, _ = lines_of_a_drive()
    regressors = monomials(exact_features(run.poses[stack.images]))
    lines = Lines(regressors, stack.path.real, stack.owner, np.zeros(0))
    assert lines.cost(odometry_start(lines, stack.starts)) == pytest.approx(0.0, abs=1e-9)


def test_curved_segments_are_refused():
    _, stack, segments = lines_of_a_drive()
    features = np.random.default_rng(0).standard_normal((stack.images.max() + 1, 3))
    straight = MetricProblem.of(features, segments, MetricConfig())
    bent = replace(straight, stack=replace(stack, path=1j * stack.path))
    with pytest.raises(DataError, match='segments: straight'):
        learn(bent)
