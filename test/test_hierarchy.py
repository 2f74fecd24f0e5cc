# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training the network: equal to the paper's explicit sequence, in shards, again and again."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, SIZE, drive
from test_rotation import brute_force, views

from sfa_localization.data.errors import DataError
from sfa_localization.data.run import PanoramaArray
from sfa_localization.sfa import network_training as hierarchy
from sfa_localization.sfa.network import Network, Node, expand, input_map
from sfa_localization.sfa.network_training import ImageSequence, shards_of, train_network
from sfa_localization.sfa.slowness import solve

CUT = 1e-7
"""Keeps what float64 and float32 agree on, so that both networks have the same directions."""


def trained(*sequences: ImageSequence, **options) -> Network:
    return train_network(ARCHITECTURE, sequences, light_std=0.0, relative_cut=CUT, **options)


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


def assert_alike(maps, other_maps, least=0.99999):
    """That the channels of all layers are the same up to sign."""
    for depth, pair in enumerate(zip(maps, other_maps, strict=True)):
        assert correlations(*pair).min() > least, f'layer {depth + 1}'


@pytest.mark.parametrize('broken', [False, True])
def test_features_equal_those_of_the_explicit_sequence(broken):
    of = drive(24)
    if broken:
        of.joined[[7, 15]] = False
    images = of.panoramas.read(0, 24)
    ours, theirs = trained(of).maps(images), explicit_network(of).maps(images)
    assert_alike(ours, theirs, 0.9999)


def test_shards_equal_the_whole(monkeypatch):
    of = drive(40)
    whole = trained(of)
    monkeypatch.setattr(hierarchy, 'SHARD', 7)
    images = of.panoramas.read(0, 40)
    assert_alike(whole.maps(images), trained(of).maps(images))


def test_drives_do_not_touch():
    """Two drives are one drive with a break, not one drive."""
    both = drive(24)
    images, stamps = both.panoramas.images, both.panoramas.stamps_ns
    parts = [
        ImageSequence(PanoramaArray(stamps[cut], images[cut]), np.ones(11, bool))
        for cut in (slice(0, 12), slice(12, 24))
    ]
    separate = trained(*parts)
    joined = np.ones(23, bool)
    joined[11] = False
    broken = trained(ImageSequence(both.panoramas, joined))
    assert_alike(separate.maps(images), broken.maps(images))
    assert not np.allclose(separate.nodes[0].linear, trained(both).nodes[0].linear, atol=1e-4)


def test_stages_resumed_give_the_same_bytes():
    of, partials = drive(16), []
    whole = trained(of, on_stage=partials.append)
    assert len(partials) == 6
    for partial in partials:
        resumed = trained(of, start=partial)
        assert resumed.nodes[-1].slow.tobytes() == whole.nodes[-1].slow.tobytes()


def test_of_a_long_drive_some_images_all_along_it_are_used(monkeypatch):
    monkeypatch.setattr(hierarchy, 'MOST', 20)
    shards = shards_of([drive(160), drive(2)], 0)
    assert [(s.start, s.stop, s.end) for s in shards] == [
        (0, 8, 64), (64, 72, 128), (128, 136, 160), (0, 2, 2),
    ]  # fmt: skip


def test_the_random_light_of_a_picture_is_the_same_in_every_shard_and_pass():
    def lit(start: int, std: float = 0.3, seed: int = 5) -> np.ndarray:
        shard = replace(shards_of([drive(12)], seed, std)[0], start=start, stop=12)
        return np.concatenate([images for images, _ in shard.batches()])

    whole, plain = lit(0), lit(0, std=0.0)
    assert np.array_equal(lit(4), whole[4:])
    assert not np.array_equal(lit(0, seed=6), whole)
    assert whole.mean((1, 2, 3)).std() > 3 * plain.mean((1, 2, 3)).std()


def test_what_has_no_difference_is_refused():
    of, images = drive(2), np.full((5, *SIZE, 3), 99, np.uint8)
    first = PanoramaArray(of.panoramas.stamps_ns[:1], of.panoramas.read(0, 1))
    with pytest.raises(DataError, match='two consecutive'):
        trained(ImageSequence(first, of.joined[:0]))
    with pytest.raises(DataError, match='rank'):
        trained(ImageSequence(PanoramaArray(np.arange(5), images), np.ones(4, bool)))
