# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Slow feature analysis recovers slow sources; its statistics stream and merge."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfa_localization.data.errors import DataError
from sfa_localization.features.sfa import Statistics, StreamingSFA, solve

PERIODS = (400.0, 130.0, 47.0, 9.0)


def sources(count: int = 8000) -> np.ndarray:
    """Sinusoids of falling slowness, unit variance, (N, 4)."""
    t = np.arange(count)[:, None]
    return np.sqrt(2) * np.sin(2 * np.pi * t / np.array(PERIODS) + np.arange(4))


def mixed(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sources() @ rng.normal(size=(4, 4)) + rng.normal(size=4)


def fitted(x: np.ndarray, outputs: int, **options: float):
    return StreamingSFA(outputs, **options).partial_fit(x).fit()


@pytest.mark.parametrize('seed', range(5))
def test_sources_recovered_up_to_sign(seed):
    slow = fitted(mixed(seed), 4).apply(mixed(seed))
    correlation = np.corrcoef(slow.T, sources().T)[:4, 4:]
    assert np.abs(np.diag(correlation)).min() > 0.999


def test_features_white_and_slowest_first():
    x = np.random.default_rng(3).normal(size=(500, 9)).cumsum(0)
    solution = fitted(x, 5)
    slow = solution.apply(x)
    assert np.allclose(slow.mean(0), 0, atol=1e-9)
    assert np.allclose(slow.T @ slow / len(slow), np.eye(5), atol=1e-8)
    assert (np.diff(solution.delta) > 0).all()
    assert np.allclose(solution.delta, (np.diff(slow, axis=0) ** 2).mean(0))


def test_delta_value_of_a_sinusoid():
    # <ds^2> of sqrt(2) sin(w t) is 2 (1 - cos w).
    expected = 2 * (1 - np.cos(2 * np.pi / np.array(PERIODS)))
    assert np.allclose(fitted(mixed(), 4).delta, expected, rtol=0.01)


def test_statistics_by_hand():
    s = StreamingSFA(1).partial_fit(np.array([[1.0, 0.0], [2.0, 1.0], [4.0, -1.0]])).statistics
    assert s is not None and (s.weight, s.steps) == (3, 2)
    assert np.array_equal(s.total, [7, 0])
    assert np.array_equal(s.second, [[21, -2], [-2, 2]])
    assert np.array_equal(s.difference, [[5, -3], [-3, 5]])


def same(a: Statistics | None, b: Statistics | None) -> None:
    assert a is not None and b is not None
    assert (a.weight, a.steps) == (b.weight, b.steps)
    for one, other in zip(
        (a.total, a.second, a.difference), (b.total, b.second, b.difference), strict=True
    ):
        assert np.allclose(one, other, rtol=1e-10, atol=1e-10)


@given(st.lists(st.integers(0, 40), max_size=4), st.integers(0, 100))
@settings(max_examples=30, deadline=None)
def test_chunks_equal_the_whole(cuts, seed):
    x = np.random.default_rng(seed).normal(size=(40, 3))
    streamed = StreamingSFA(1)
    for chunk in np.split(x, sorted(cuts)):
        streamed.partial_fit(chunk)
    same(streamed.statistics, StreamingSFA(1).partial_fit(x).statistics)


def test_chunks_with_times_equal_the_whole():
    rng = np.random.default_rng(5)
    x, time = rng.normal(size=(40, 3)), rng.uniform(0.1, 2, 40).cumsum()
    streamed = StreamingSFA(1)
    for start in range(0, 40, 7):
        streamed.partial_fit(x[start : start + 7], time[start : start + 7])
    same(streamed.statistics, StreamingSFA(1).partial_fit(x, time).statistics)


def test_no_difference_across_runs():
    x = np.random.default_rng(0).normal(size=(30, 2))
    broken = StreamingSFA(1).partial_fit(x[:12]).end_run().partial_fit(x[12:] + 1000)
    assert broken.statistics is not None
    assert broken.statistics.steps == 28
    assert np.abs(broken.statistics.difference).max() < 1000


def test_merging_equals_runs_in_a_row():
    x = np.random.default_rng(1).normal(size=(30, 3))
    merged = StreamingSFA(2).partial_fit(x[:12]).merge(StreamingSFA(2).partial_fit(x[12:]))
    in_a_row = StreamingSFA(2).partial_fit(x[:12]).end_run().partial_fit(x[12:])
    same(merged.statistics, in_a_row.statistics)
    assert np.allclose(merged.fit().weights, in_a_row.fit().weights)


def test_merging_into_an_empty_estimator():
    x = np.random.default_rng(1).normal(size=(30, 3))
    assert StreamingSFA(1).merge(StreamingSFA(1).partial_fit(x)).fit().rank == 3


def test_real_time_steps_undo_uneven_sampling():
    # Sampled unevenly, ds/dt of a sinusoid keeps its size: Delta = w^2 for unit variance.
    rng = np.random.default_rng(2)
    time = rng.uniform(0.2, 1.8, 20000).cumsum()
    x = np.sin(time[:, None] * np.array([0.02, 0.3])) @ rng.normal(size=(2, 2))
    solution = StreamingSFA(2).partial_fit(x, time).fit()
    assert np.allclose(solution.delta, np.array([0.02, 0.3]) ** 2, rtol=0.05)


def test_times_must_increase():
    with pytest.raises(DataError, match='must increase'):
        StreamingSFA(1).partial_fit(np.zeros((3, 2)), np.array([0.0, 1.0, 1.0]))


def test_signs_are_deterministic():
    x = mixed()
    for flip in (1.0, -1.0):
        weights = fitted(x * flip, 4).weights
        assert (weights[np.abs(weights).argmax(0), np.arange(4)] > 0).all()
    assert fitted(x, 4).weights.tobytes() == fitted(x.copy(), 4).weights.tobytes()


class TestRankDeficiency:
    """Redundant, constant and nearly constant dimensions make no false slow features."""

    def test_redundant_dimensions_are_cut(self):
        x = mixed() @ np.random.default_rng(7).normal(size=(4, 12))
        solution = fitted(x, 4)
        assert solution.rank == 4
        assert np.abs(np.diag(np.corrcoef(solution.apply(x).T, sources().T)[:4, 4:])).min() > 0.999

    def test_more_features_than_rank_are_refused(self):
        x = mixed() @ np.random.default_rng(7).normal(size=(4, 12))
        with pytest.raises(DataError, match='rank 4, fewer than the 5 slow features'):
            fitted(x, 5)

    def test_a_constant_signal_is_refused(self):
        with pytest.raises(DataError, match='rank 0'):
            fitted(np.full((50, 3), 7.0), 1)

    def test_a_constant_dimension_is_no_slow_feature(self):
        x = np.column_stack([mixed(), np.full(8000, 3.0)])
        solution = fitted(x, 4)
        assert solution.rank == 4 and solution.delta.min() > 1e-5

    def test_float32_rounding_is_no_signal(self):
        x = (mixed() @ np.random.default_rng(7).normal(size=(4, 12))).astype(np.float32)
        assert fitted(x, 4, relative_cut=1e-6).rank == 4

    def test_the_cut_leaves_as_many_as_asked_for(self):
        x = mixed() * np.array([1.0, 1e-2, 1e-2, 1e-2])
        assert fitted(x, 1, relative_cut=0.1).rank < 4
        assert fitted(x, 4, relative_cut=0.1).rank == 4


@pytest.mark.parametrize(
    ('x', 'told'),
    [
        (np.zeros(5), 'shape'),
        (np.full((5, 2), np.nan), 'finite'),
        (np.full((5, 2), np.inf), 'finite'),
    ],
)
def test_bad_signals_are_refused(x, told):
    with pytest.raises(DataError, match=told):
        StreamingSFA(1).partial_fit(x)


def test_other_dimensions_are_refused():
    sfa = StreamingSFA(1).partial_fit(np.zeros((3, 2)))
    with pytest.raises(DataError, match='expected 2 dimensions, got 3'):
        sfa.partial_fit(np.zeros((3, 3)))
    with pytest.raises(DataError, match='cannot merge'):
        Statistics.empty(2) + Statistics.empty(3)


def test_too_little_signal_is_refused():
    with pytest.raises(DataError, match='no signal'):
        StreamingSFA(1).fit()
    with pytest.raises(DataError, match='two consecutive'):
        StreamingSFA(1).partial_fit(np.zeros((1, 2))).fit()
    with pytest.raises(DataError, match='two consecutive'):
        solve(Statistics.empty(2), 1)
