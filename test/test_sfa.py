# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Slow feature analysis recovers slow sources."""

import numpy as np
import pytest

from sfa_localization.data.errors import DataError
from sfa_localization.sfa.slowness import Statistics, solve

PERIODS = (400.0, 130.0, 47.0, 9.0)


def sources(count: int = 8000) -> np.ndarray:
    """Sinusoids of falling slowness, unit variance, (N, 4)."""
    t = np.arange(count)[:, None]
    return np.sqrt(2) * np.sin(2 * np.pi * t / np.array(PERIODS) + np.arange(4))


def mixed(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sources() @ rng.normal(size=(4, 4)) + rng.normal(size=4)


def statistics(x: np.ndarray) -> Statistics:
    """The sums over a signal (N, D)."""
    dx = np.diff(x, axis=0)
    return Statistics(len(x), x.sum(0, dtype=np.float64), x.T @ x, len(dx), dx.T @ dx)


def fitted(x: np.ndarray, outputs: int, relative_cut: float = 1e-7):
    return solve(statistics(x), outputs, relative_cut)


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


def test_signs_are_deterministic():
    for flip in (1.0, -1.0):
        weights = fitted(flip * mixed(), 4).weights
        assert (weights[np.abs(weights).argmax(0), np.arange(4)] > 0).all()


def test_redundant_constant_and_rounded_dimensions_make_no_false_slow_features():
    redundant = mixed() @ np.random.default_rng(7).normal(size=(4, 12))
    solution = fitted(redundant, 4)
    assert solution.rank == 4
    slow = solution.apply(redundant)
    assert np.abs(np.diag(np.corrcoef(slow.T, sources().T)[:4, 4:])).min() > 0.999
    assert fitted(redundant.astype(np.float32), 4, relative_cut=1e-6).rank == 4
    faint = mixed() * np.array([1.0, 1e-2, 1e-2, 1e-2])
    assert fitted(faint, 1, relative_cut=0.1).rank < 4
    assert fitted(faint, 4, relative_cut=0.1).rank == 4, 'as many as asked for'
    for signal, outputs, said in (
        (redundant, 5, 'rank 4, fewer than the 5 slow features'),
        (np.full((50, 3), 7.0), 1, 'rank 0'),
        (np.zeros((0, 2)), 1, 'two consecutive'),
        (np.zeros((1, 2)), 1, 'two consecutive'),
    ):
        with pytest.raises(DataError, match=said):
            fitted(signal, outputs)
