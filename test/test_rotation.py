# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Slow features: sums over the full rotation against brute force, and sources recovered."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfa_localization.data.errors import DataError
from sfa_localization.sfa.rotation import Field, FieldStatistics, SampleStatistics, unfold
from sfa_localization.sfa.slowness import Statistics, solve

FIELDS = (
    Field(2, 3, 1),
    Field(2, 3, 2, spacing=2),
    Field(1, 4, 1, spacing=3),
    Field(3, 8, 1),
    Field(1, 1, 1),
)
BROKEN = np.array([True, False, True, False, True])


def maps(seed, count, rows=5, columns=12, channels=3):
    """Maps with a mean, changing slowly from picture to picture."""
    rng = np.random.default_rng(seed)
    drift = rng.normal(size=(count, rows, columns, channels)).cumsum(0)
    return (0.5 + drift).astype(np.float32)


def sequence(of):
    """The training sequence: map 0 at all rotations, then map 1, ...; (T * R, ...)."""
    turns = range(of.shape[2])
    return np.concatenate([[np.roll(m, -turn, axis=1) for turn in turns] for m in of])


def views(of, field):
    """What each node sees, cut out pixel by pixel in float64: (T, rows_out, R, D)."""
    t, rows, columns, _ = of.shape
    seen = []
    for top in range(0, rows - field.rows + 1, field.row_stride):
        for c in range(columns):
            at = [(c + i * field.spacing) % columns for i in range(field.columns)]
            cut = of[:, top : top + field.rows][:, :, at].astype(np.float64)
            seen.append(cut.transpose(0, 2, 1, 3).reshape(t, -1))
    return np.stack(seen, 1).reshape(t, -1, columns, seen[0].shape[-1])


def brute_force(signals, rotations, joined):
    """Sums over nodes of an explicit sequence (T * R, rows, nodes, D), divided by R."""
    d = signals.shape[-1]
    per_node = signals.reshape(len(signals), -1, d)
    weight = np.ones(len(signals) - 1)
    weight[rotations - 1 :: rotations] = joined
    difference = np.diff(per_node, axis=0) * weight[:, None, None]
    samples, steps = per_node.reshape(-1, d), difference.reshape(-1, d)
    counted = float((weight > 0).sum()) * per_node.shape[1]
    sums = len(samples), samples.sum(0), samples.T @ samples, counted, steps.T @ steps
    return Statistics(*(each / rotations for each in sums))


def assert_equal(ours, theirs, tolerance=1e-5):
    for name in ('weight', 'steps', 'total', 'second', 'difference'):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert np.abs(a - b).max() <= tolerance * np.abs(b).max(), name


def fed(sums, of, joined, batch=1000, axis=0):
    joined = np.concatenate([[True], joined])
    cuts = range(batch, of.shape[axis], batch)
    for part, pairs in zip(np.split(of, cuts, axis), np.split(joined, cuts), strict=True):
        sums.add(part, pairs.astype(bool))
    return sums.result()


def test_statistics_equal_brute_force():
    of = maps(1, 6)
    single, none = of[:1], np.zeros(0, bool)  # it turns, but does not move
    for seen, joined in ((of, BROKEN), (single, none)):
        turned, signals = sequence(seen), seen.transpose(3, 0, 1, 2).copy()
        for field in FIELDS:
            sums = FieldStatistics(field, 12, 3 * field.rows)
            explicit = brute_force(views(turned, field), 12, joined)
            assert_equal(fed(sums, seen, joined), explicit)
            assert np.array_equal(unfold(seen, field), views(seen, field).astype(np.float32))
        explicit = brute_force(turned.astype(np.float64), 12, joined)
        assert_equal(fed(SampleStatistics(12, 3), signals, joined, axis=1), explicit)


def test_without_rotation_only_images_at_the_same_view_are_compared():
    of, field = maps(1, 6), FIELDS[1]
    plain = fed(FieldStatistics(field, 12, 6, rotate=False), of, BROKEN, batch=4)
    signals = of.transpose(3, 0, 1, 2).copy()
    samples = fed(SampleStatistics(12, 3, rotate=False), signals, BROKEN, batch=4, axis=1)
    for ours, explicit in ((plain, views(of, field)), (samples, of.astype(np.float64))):
        flat = explicit.reshape(-1, explicit.shape[-1])
        steps = np.diff(explicit, axis=0)[BROKEN].reshape(-1, explicit.shape[-1])
        differences = len(steps) / 12, steps.T @ steps / 12
        assert_equal(ours, Statistics(len(flat), flat.sum(0), flat.T @ flat, *differences))


@given(batch=st.integers(1, 9), broken=st.integers(0, 7), seed=st.integers(0, 50))
@settings(max_examples=25, deadline=None)
def test_batches_and_merged_parts_equal_the_whole(batch, broken, seed):
    of, field, joined = maps(seed, 9), FIELDS[1], np.arange(8) != broken
    signals = of.transpose(3, 0, 1, 2).copy()
    for sums_of, feed, axis in (
        (lambda: FieldStatistics(field, 12, 6), of, 0),
        (lambda: SampleStatistics(12, 3), signals, 1),
    ):
        whole = fed(sums_of(), feed, joined, 1000, axis)
        assert_equal(fed(sums_of(), feed, joined, batch, axis), whole)
        first, second = sums_of(), sums_of()
        begin, lead, end = np.split(feed, (4, 5), axis)
        first.add(np.concatenate([begin, lead], axis), np.concatenate([[False], joined[:4]]))
        second.lead(lead)
        second.add(end, joined[4:])
        first.merge(second)
        assert_equal(first.result(), whole)


PERIODS = (400.0, 130.0, 47.0, 9.0)


def sources(count=8000):
    """Sinusoids of falling slowness, unit variance, (N, 4)."""
    t = np.arange(count)[:, None]
    return np.sqrt(2) * np.sin(2 * np.pi * t / np.array(PERIODS) + np.arange(4))


def mixed(seed=0):
    rng = np.random.default_rng(seed)
    return sources() @ rng.normal(size=(4, 4)) + rng.normal(size=4)


def fitted(x, outputs, relative_cut=1e-7):
    """The solution for a signal (N, D)."""
    dx = np.diff(x, axis=0)
    sums = Statistics(len(x), x.sum(0, dtype=np.float64), x.T @ x, len(dx), dx.T @ dx)
    return solve(sums, outputs, relative_cut)


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


def test_redundant_constant_and_rounded_dimensions_make_no_false_slow_features():
    redundant = mixed() @ np.random.default_rng(7).normal(size=(4, 12))
    solution = fitted(redundant, 4)
    assert solution.rank == 4
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
