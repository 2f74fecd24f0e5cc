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


def field_statistics(of, field, joined, batch=1000):
    sums = FieldStatistics(field, of.shape[2], field.rows * of.shape[3])
    return fed(sums, of, joined, batch)


def sample_statistics(of, joined, batch=1000):
    signals = of.transpose(3, 0, 1, 2).copy()
    return fed(SampleStatistics(of.shape[2], of.shape[-1]), signals, joined, batch, axis=1)


def fed(sums, of, joined, batch, axis=0):
    joined = np.concatenate([[True], joined])
    cuts = range(batch, of.shape[axis], batch)
    for maps, part in zip(np.split(of, cuts, axis), np.split(joined, cuts), strict=True):
        sums.add(maps, part.astype(bool))
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


def without_rotation(signals: np.ndarray, joined: np.ndarray) -> tuple[float, np.ndarray]:
    """Steps and differences between images (T, rows, R, D) at the same view, divided by R."""
    rotations, d = signals.shape[2], signals.shape[-1]
    difference = np.diff(signals, axis=0)[joined].reshape(-1, d)
    return len(difference) / rotations, difference.T @ difference / rotations


@pytest.mark.parametrize('joined', [JOINED, BROKEN])
def test_without_rotation_only_images_at_the_same_view_are_compared(joined):
    of, field = maps(1, 6), FIELDS[1]
    seen = views(of, field)
    plain = fed(FieldStatistics(field, 12, 6, rotate=False), of, joined, batch=4)
    signals = of.transpose(3, 0, 1, 2).copy()
    samples = fed(SampleStatistics(12, 3, rotate=False), signals, joined, batch=4, axis=1)
    for ours, explicit in ((plain, seen), (samples, of.astype(np.float64))):
        steps, difference = without_rotation(explicit, joined)
        assert ours.steps == pytest.approx(steps)
        assert np.abs(ours.difference - difference).max() < 1e-5 * np.abs(difference).max()
        flat = explicit.reshape(-1, explicit.shape[-1])
        assert np.allclose(ours.second, flat.T @ flat, rtol=1e-5)


@given(batch=st.integers(1, 9), broken=st.integers(0, 7), seed=st.integers(0, 50))
@settings(max_examples=25, deadline=None)
def test_batches_equal_the_whole(batch, broken, seed):
    of, field = maps(seed, 9), Field(2, 3, 1, spacing=2)
    joined = np.arange(8) != broken
    assert_equal(field_statistics(of, field, joined, batch), field_statistics(of, field, joined))
    assert_equal(sample_statistics(of, joined, batch), sample_statistics(of, joined))


def test_merging_with_a_lead_equals_the_whole():
    of, field, joined = maps(4, 9), FIELDS[1], np.arange(8) % 3 != 1
    signals = of.transpose(3, 0, 1, 2).copy()
    for whole, make, part in (
        (field_statistics(of, field, joined), lambda: FieldStatistics(field, 12, 6),
         lambda *cut: of[slice(*cut)]),
        (sample_statistics(of, joined), lambda: SampleStatistics(12, 3),
         lambda *cut: signals[:, slice(*cut)].copy()),
    ):  # fmt: skip
        first, second = make(), make()
        first.add(part(0, 5), np.concatenate([[False], joined[:4]]))
        second.lead(part(4, 5))
        second.add(part(5, 9), joined[4:])
        first.merge(second)
        assert_equal(first.result(), whole)
