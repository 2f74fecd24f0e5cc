# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training the network: equal to the paper's explicit sequence, in shards, again and again."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, SIZE, drive
from test_rotation import added, assert_equal, brute_force, views

from sfa_localization.data.errors import DataError
from sfa_localization.data.run import PanoramaArray
from sfa_localization.features import network_training as hierarchy
from sfa_localization.features.network import (
    STANDARD_NETWORKS,
    Network,
    Node,
    expand,
    input_map,
    standard_architecture,
)
from sfa_localization.features.network_training import (
    ImageSequence,
    Partial,
    Shard,
    shards_of,
    train_network,
)
from sfa_localization.features.sfa import Statistics, solve

CUT = 1e-7
"""Keeps what float64 and float32 agree on, so that both networks have the same directions."""


def trained(*sequences: ImageSequence, **options) -> Network:
    return train_network(ARCHITECTURE, sequences, light_std=0.0, relative_cut=CUT, **options)


def stage_statistics(partial: Partial, shard: Shard) -> Statistics:
    return hierarchy.stage_sums(partial, shard).result()


def explicit_network(of: ImageSequence) -> Network:
    """Train on every picture really turned, node by node, in float64."""
    turned = sequence_of_pictures(of.panoramas.read(0, len(of.panoramas)))
    below, nodes = input_map(turned, ARCHITECTURE), []
    for layer, field in zip(ARCHITECTURE.layers, ARCHITECTURE.fields, strict=True):
        seen = views(below, field)
        linear = solve(brute_force(seen, 12, of.joined), layer.linear, CUT)
        z = linear.apply(seen)
        expanded = np.moveaxis(expand(np.moveaxis(z, -1, 0)), 0, -1)
        slow = solve(brute_force(expanded, 12, of.joined), layer.outputs, CUT)
        nodes.append(Node.from_solutions(linear, slow))
        below = np.clip(slow.apply(expanded), -layer.clip, layer.clip).astype(np.float32)
    return Network(ARCHITECTURE, tuple(nodes))


def sequence_of_pictures(images: np.ndarray) -> np.ndarray:
    """Picture 0 at all rotations, then picture 1, ..."""
    step = images.shape[2] // ARCHITECTURE.rotations
    turns = range(ARCHITECTURE.rotations)
    return np.concatenate([[np.roll(i, -turn * step, axis=1) for turn in turns] for i in images])


def correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|corr| (K,) of each channel of two maps (..., K)."""
    a, b = (m.reshape(-1, m.shape[-1]).astype(np.float64) for m in (a, b))
    a, b = (m - m.mean(0) for m in (a, b))
    norms = np.sqrt((a**2).sum(0) * (b**2).sum(0))
    return np.asarray(np.abs((a * b).sum(0)) / norms)


@pytest.mark.parametrize('broken', [False, True])
def test_features_equal_those_of_the_explicit_sequence(broken):
    of = drive(24)
    if broken:
        of.joined[[7, 15]] = False
    images = of.panoramas.read(0, 24)
    ours, theirs = trained(of).maps(images), explicit_network(of).maps(images)
    for depth, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        assert correlations(one, other).min() > 0.9999, f'layer {depth + 1}'


def test_every_stage_equals_the_explicit_sequence():
    of, partials = drive(20), [Partial(ARCHITECTURE)]
    trained(of, on_stage=partials.append)
    turned = sequence_of_pictures(of.panoramas.read(0, 20))
    for partial in partials[:-1]:
        below = hierarchy._below(partial.network(), turned)
        seen = views(below, ARCHITECTURE.fields[partial.depth])
        if partial.linear is not None:
            z = partial.linear.apply(seen)
            seen = np.moveaxis(expand(np.moveaxis(z, -1, 0)), 0, -1)
        assert_equal(
            stage_statistics(partial, Shard(of, 0, 20)), brute_force(seen, 12, of.joined), 2e-5
        )


def test_features_are_white_and_slowest_first():
    of = drive(60)
    network = trained(of)
    top = network.maps(of.panoramas.read(0, 60))[-1].reshape(-1, 4).astype(float)
    inside = np.abs(top) < 4
    assert inside.mean() > 0.99
    assert np.allclose(np.cov(top.T), np.eye(4), atol=0.1)
    assert all((np.diff(deltas) > 0).all() for deltas in network.deltas)


def test_same_data_same_bytes():
    one, other = trained(drive(20)), trained(drive(20))
    for a, b in zip(one.nodes, other.nodes, strict=True):
        assert a.linear.tobytes() == b.linear.tobytes()
        assert a.slow.tobytes() == b.slow.tobytes()


@pytest.mark.parametrize('shard', [1, 7, 32])
def test_shards_equal_the_whole(shard, monkeypatch):
    of = drive(40)
    whole = trained(of)
    monkeypatch.setattr(hierarchy, 'SHARD', shard)
    images = of.panoramas.read(0, 40)
    for one, other in zip(whole.maps(images), trained(of).maps(images), strict=True):
        assert correlations(one, other).min() > 0.99999


@pytest.mark.parametrize('batch', [1, 5])
def test_batches_equal_the_whole(batch, monkeypatch):
    of = drive(12)
    partial = Partial(ARCHITECTURE)
    whole = stage_statistics(partial, Shard(of, 0, 12))
    monkeypatch.setattr(hierarchy, 'BATCH', batch)
    assert_equal(stage_statistics(partial, Shard(of, 0, 12)), whole)


def test_shards_add_up():
    of = drive(12)
    whole = stage_statistics(Partial(ARCHITECTURE), Shard(of, 0, 12))
    parts = [stage_statistics(Partial(ARCHITECTURE), Shard(of, *cut)) for cut in ((0, 5), (5, 12))]
    assert_equal(added(*parts), whole)


def test_drives_do_not_touch():
    """Two drives are one drive with a break, not one drive."""
    both = drive(24)
    images, stamps = both.panoramas.images, both.panoramas.stamps_ns
    parts = [
        ImageSequence(PanoramaArray(stamps[cut], images[cut]), np.ones(11, bool))
        for cut in (slice(0, 12), slice(12, 24))
    ]
    apart = trained(*parts)
    joined = np.ones(23, bool)
    joined[11] = False
    broken = trained(ImageSequence(both.panoramas, joined))
    for one, other in zip(apart.maps(images), broken.maps(images), strict=True):
        assert correlations(one, other).min() > 0.99999
    assert not np.allclose(apart.nodes[0].linear, trained(both).nodes[0].linear, atol=1e-4)


def test_stages_resumed_give_the_same_bytes():
    of, partials = drive(16), []
    whole = trained(of, on_stage=partials.append)
    assert len(partials) == 6
    for partial in partials:
        resumed = trained(of, start=partial)
        assert resumed.nodes[-1].slow.tobytes() == whole.nodes[-1].slow.tobytes()


def test_progress_counts_every_picture_in_every_stage():
    told = []
    trained(drive(10), drive(8, seed=1), on_shard=told.append)
    assert sum(told) == 6 * 18


class TestPhotometric:
    """The random light of training pictures."""

    def lit(self, start: int, stop: int, std: float = 0.3, seed: int = 5) -> np.ndarray:
        shard = replace(shards_of([drive(12)], seed, std)[0], start=start, stop=stop)
        return np.concatenate([images for images, _ in shard.batches()])

    def test_a_picture_is_lit_alike_in_every_shard_and_pass(self):
        whole = self.lit(0, 12)
        assert np.array_equal(self.lit(4, 12), whole[4:])
        assert np.array_equal(self.lit(0, 12), whole)

    def test_pictures_are_lit_differently(self):
        brightness = self.lit(0, 12).mean((1, 2, 3))
        assert brightness.std() > 3 * self.lit(0, 12, std=0.0).mean((1, 2, 3)).std()

    def test_another_seed_is_another_light(self):
        assert not np.array_equal(self.lit(0, 12, seed=6), self.lit(0, 12))


class TestArchitecture:
    """The standard network for a size of panorama."""

    @pytest.mark.parametrize(
        ('size', 'grid'),
        [
            ((60, 600), (30, 300)), ((30, 300), (30, 300)), ((40, 320), (40, 320)),
            ((61, 601), (30, 300)), ((15, 90), (30, 300)), ((600, 3600), (30, 300)),
        ],
    )  # fmt: skip
    def test_any_size_has_one(self, size, grid):
        found = standard_architecture(size, 'panorama')
        assert (found.size, found.grid, found.layers) == (size, grid, STANDARD_NETWORKS[grid])


def test_a_single_picture_is_refused():
    of = drive(2)
    first = PanoramaArray(of.panoramas.stamps_ns[:1], of.panoramas.read(0, 1))
    single = ImageSequence(first, of.joined[:0])
    with pytest.raises(DataError, match='two consecutive'):
        trained(single)


def test_blank_pictures_are_refused():
    images = np.full((5, *SIZE, 3), 99, np.uint8)
    blank = ImageSequence(PanoramaArray(np.arange(5), images), np.ones(4, bool))
    with pytest.raises(DataError, match='rank'):
        trained(blank)
