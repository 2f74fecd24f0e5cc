# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training the network: equal to the paper's explicit sequence, in shards, again and again."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, SIZE, drive
from test_rotation import assert_equal, brute_force, views

from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.run import PanoramaArray
from sfa_localization.features import network_training as hierarchy
from sfa_localization.features.network import LAYERS, Network, Node, expand, prepare
from sfa_localization.features.network_training import (
    Drive,
    Partial,
    Shard,
    architecture_of,
    shards_of,
    stage_statistics,
    train_network,
)
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.features.sfa import solve

CONFIG = NetworkConfig(relative_cut=1e-7, photometric_std=0.0)


def trained(*drives: Drive, config: NetworkConfig = CONFIG, **options) -> Network:
    return train_network(ARCHITECTURE, drives, config, **options)


def explicit_network(of: Drive) -> Network:
    """Train on every picture really turned, node by node, in float64."""
    turned = sequence_of_pictures(of.panoramas.read(0, len(of.panoramas)))
    below, nodes = prepare(turned, ARCHITECTURE), []
    for layer, field in zip(ARCHITECTURE.layers, ARCHITECTURE.fields, strict=True):
        seen = views(below, field)
        linear = solve(brute_force(seen, 12, of.scale), layer.linear, CONFIG.relative_cut)
        z = linear.apply(seen)
        expanded = np.moveaxis(expand(np.moveaxis(z, -1, 0)), 0, -1)
        slow = solve(brute_force(expanded, 12, of.scale), layer.outputs, CONFIG.relative_cut)
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
        of.scale[[7, 15]] = 0
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
            stage_statistics(partial, Shard(of, 0, 20)), brute_force(seen, 12, of.scale), 2e-5
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
    assert_equal(parts[0] + parts[1], whole)


def test_drives_do_not_touch():
    """Two drives are one drive with a break, not one drive."""
    both = drive(24)
    images, stamps = both.panoramas.images, both.panoramas.stamps_ns
    parts = [
        Drive(PanoramaArray(stamps[cut], images[cut]), np.ones(11, np.float32))
        for cut in (slice(0, 12), slice(12, 24))
    ]
    apart = trained(*parts)
    joined = np.ones(23, np.float32)
    joined[11] = 0
    broken = trained(Drive(both.panoramas, joined))
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


def test_scale_weighs_the_differences():
    of = drive(10)
    uneven = replace(of, scale=np.linspace(0.2, 2, 9).astype(np.float32))
    images = of.panoramas.read(0, 10)
    seen = views(prepare(sequence_of_pictures(images), ARCHITECTURE), ARCHITECTURE.fields[0])
    ours = stage_statistics(Partial(ARCHITECTURE), Shard(uneven, 0, 10))
    assert_equal(ours, brute_force(seen, 12, uneven.scale))


class TestPhotometric:
    """The random light of training pictures."""

    LIT = replace(CONFIG, photometric_std=0.3, photometric_seed=5)

    def lit(self, start: int, stop: int, config: NetworkConfig) -> np.ndarray:
        of = drive(12)
        shard = replace(shards_of([of], config)[0], start=start, stop=stop)
        return np.concatenate([images for images, _ in shard.batches()])

    def test_a_picture_is_lit_alike_in_every_shard_and_pass(self):
        whole = self.lit(0, 12, self.LIT)
        assert np.array_equal(self.lit(4, 12, self.LIT), whole[4:])
        assert np.array_equal(self.lit(0, 12, self.LIT), whole)

    def test_pictures_are_lit_differently(self):
        brightness = self.lit(0, 12, self.LIT).mean((1, 2, 3))
        assert brightness.std() > 3 * self.lit(0, 12, CONFIG).mean((1, 2, 3)).std()

    def test_another_seed_is_another_light(self):
        other = replace(self.LIT, photometric_seed=6)
        assert not np.array_equal(self.lit(0, 12, other), self.lit(0, 12, self.LIT))


class TestArchitecture:
    """The network that the configuration asks for."""

    @pytest.mark.parametrize('name', LAYERS)
    def test_found_by_size(self, name):
        width, height = map(int, name.split('x'))
        assert architecture_of(NetworkConfig(), (height, width)).layers == LAYERS[name][1]

    def test_no_fit_tells_sizes_for_each(self):
        with pytest.raises(ConfigError, match=r'no standard network fits.*use.*use.*custom'):
            architecture_of(NetworkConfig(), (61, 601))

    def test_custom_default_is_the_standard(self):
        custom = architecture_of(NetworkConfig(layers='custom'), (60, 600))
        assert custom == architecture_of(NetworkConfig(), (60, 600))

    def test_custom_arrays_of_one_length(self):
        with pytest.raises(ConfigError, match='one per layer'):
            architecture_of(NetworkConfig(layers='custom', field_rows=(10,)), (60, 600))


def test_a_single_picture_is_refused():
    of = drive(2)
    single = Drive(PanoramaArray(of.panoramas.stamps_ns[:1], of.panoramas.read(0, 1)), of.scale[:0])
    with pytest.raises(DataError, match='two consecutive'):
        trained(single)


def test_blank_pictures_are_refused():
    images = np.full((5, *SIZE, 3), 99, np.uint8)
    blank = Drive(PanoramaArray(np.arange(5), images), np.ones(4, np.float32))
    with pytest.raises(DataError, match='rank'):
        trained(blank)
