# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of the full rotation against brute force over explicitly rotated pictures."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfa_localization.sfa.rotation import Field, FieldStatistics, SampleStatistics, unfold
from sfa_localization.sfa.slowness import Statistics

FIELDS = (
    Field(2, 3, 1),
    Field(2, 3, 2, spacing=2),
    Field(1, 4, 1, spacing=3),
    Field(3, 8, 1),
    Field(1, 1, 1),
)
JOINED, BROKEN = np.ones(5, bool), np.array([True, False, True, False, True])


def maps(seed: int, count: int, rows: int = 5, columns: int = 12, channels: int = 3) -> np.ndarray:
    """Maps with a mean, changing slowly from picture to picture."""
    rng = np.random.default_rng(seed)
    drift = rng.normal(size=(count, rows, columns, channels)).cumsum(0)
    return (0.5 + drift).astype(np.float32)


def sequence(of: np.ndarray) -> np.ndarray:
    """The training sequence: map 0 at all rotations, then map 1, ...; (T * R, ...)."""
    turns = range(of.shape[2])
    return np.concatenate([[np.roll(m, -turn, axis=1) for turn in turns] for m in of])


def views(of: np.ndarray, field: Field) -> np.ndarray:
    """What each node sees, cut out pixel by pixel in float64: (T, rows_out, R, D)."""
    t, rows, columns, _ = of.shape
    seen = []
    for top in range(0, rows - field.rows + 1, field.row_stride):
        for c in range(columns):
            at = [(c + i * field.spacing) % columns for i in range(field.columns)]
            cut = of[:, top : top + field.rows][:, :, at].astype(np.float64)
            seen.append(cut.transpose(0, 2, 1, 3).reshape(t, -1))
    return np.stack(seen, 1).reshape(t, -1, columns, seen[0].shape[-1])


def brute_force(signals: np.ndarray, rotations: int, joined: np.ndarray) -> Statistics:
    """Sums over nodes of an explicit sequence (T * R, rows, nodes, D), divided by R."""
    d = signals.shape[-1]
    per_node = signals.reshape(len(signals), -1, d)
    weight = np.ones(len(signals) - 1)
    weight[rotations - 1 :: rotations] = joined
    difference = np.diff(per_node, axis=0) * weight[:, None, None]
    samples, steps = per_node.reshape(-1, d), difference.reshape(-1, d)
    counted = float((weight > 0).sum()) * per_node.shape[1]
    sums = (samples.T @ samples, steps.T @ steps)
    return Statistics(
        len(samples) / rotations,
        samples.sum(0) / rotations,
        sums[0] / rotations,
        counted / rotations,
        sums[1] / rotations,
    )


def assert_equal(ours: Statistics, theirs: Statistics, tolerance: float = 1e-5) -> None:
    assert ours.weight == pytest.approx(theirs.weight, rel=1e-12)
    assert ours.steps == pytest.approx(theirs.steps, rel=1e-12)
    for name in ('total', 'second', 'difference'):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert np.abs(a - b).max() < tolerance * np.abs(b).max(), name


def field_statistics(of, field, joined):
    return fed(FieldStatistics(field, of.shape[2], field.rows * of.shape[3]), of, joined)


def sample_statistics(of, joined):
    signals = of.transpose(3, 0, 1, 2).copy()
    return fed(SampleStatistics(of.shape[2], of.shape[-1]), signals, joined, axis=1)


def fed(sums, of, joined, batch=1000, axis=0):
    joined = np.concatenate([[True], joined])
    cuts = range(batch, of.shape[axis], batch)
    for part, pairs in zip(np.split(of, cuts, axis), np.split(joined, cuts), strict=True):
        sums.add(part, pairs.astype(bool))
    return sums.result()


@pytest.mark.parametrize('joined', [JOINED, BROKEN])
def test_statistics_equal_brute_force(joined):
    of = maps(1, 6)
    turned = sequence(of)
    for field in FIELDS:
        explicit = views(turned, field)
        assert_equal(field_statistics(of, field, joined), brute_force(explicit, 12, joined))
        assert np.array_equal(unfold(of, field), views(of, field).astype(np.float32))
    explicit = brute_force(turned.astype(np.float64), 12, joined)
    assert_equal(sample_statistics(of, joined), explicit)
    single, none = of[:1], np.zeros(0, bool)  # it turns, but does not move
    explicit = brute_force(views(sequence(single), FIELDS[0]), 12, none)
    assert_equal(field_statistics(single, FIELDS[0], none), explicit)
    assert_equal(sample_statistics(single, none), brute_force(sequence(single), 12, none))


@pytest.mark.parametrize('joined', [JOINED, BROKEN])
def test_without_rotation_only_images_at_the_same_view_are_compared(joined):
    of, field = maps(1, 6), FIELDS[1]
    plain = fed(FieldStatistics(field, 12, 6, rotate=False), of, joined, batch=4)
    signals = of.transpose(3, 0, 1, 2).copy()
    samples = fed(SampleStatistics(12, 3, rotate=False), signals, joined, batch=4, axis=1)
    for ours, explicit in ((plain, views(of, field)), (samples, of.astype(np.float64))):
        flat = explicit.reshape(-1, explicit.shape[-1])
        steps = np.diff(explicit, axis=0)[joined].reshape(-1, explicit.shape[-1])
        differences = len(steps) / 12, steps.T @ steps / 12
        expected = Statistics(len(flat), flat.sum(0), flat.T @ flat, *differences)
        assert_equal(ours, expected)


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
