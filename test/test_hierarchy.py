# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training the network: equal to the paper's explicit sequence, in shards, again and again."""

import sys

import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, SIZE, drive
from test_rotation import brute_force, views

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.run import PanoramaArray
from sfa_localization.sfa import mdp_engine, mdp_shim
from sfa_localization.sfa import network_training as hierarchy
from sfa_localization.sfa.network import Network, Node, expand, input_map
from sfa_localization.sfa.network_training import ImageSequence, shards_of, train_network
from sfa_localization.sfa.slowness import solve

CUT = 1e-7
"""Keeps what float64 and float32 agree on, so that both networks have the same directions."""


def trained(*sequences, light_std=0.0, relative_cut=CUT):
    options = {'light_std': light_std, 'relative_cut': relative_cut}
    return train_network(ARCHITECTURE, sequences, **options)


def explicit_network(of):
    """Train on every picture really turned, node by node, in float64."""
    images = of.panoramas.read(0, len(of.panoramas))
    shifts = -SIZE[1] // ARCHITECTURE.rotations * np.arange(ARCHITECTURE.rotations)
    turned = np.concatenate([[np.roll(i, shift, axis=1) for shift in shifts] for i in images])
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


def assert_alike(maps, other_maps, least=0.99999):
    """That the channels of all layers are the same up to sign."""
    for depth, pair in enumerate(zip(maps, other_maps, strict=True)):
        a, b = (each.reshape(-1, each.shape[-1]).astype(float).T for each in pair)
        correlation = np.corrcoef(a, b)[: len(a), len(a) :]
        assert np.abs(np.diag(correlation)).min() > least, f'layer {depth + 1}'


def test_features_equal_those_of_the_explicit_sequence_also_in_shards(monkeypatch):
    of = drive(24)
    of.joined[[7, 15]] = False
    images = of.panoramas.read(0, 24)
    whole = trained(of).maps(images)
    assert_alike(whole, explicit_network(of).maps(images), 0.9999)
    in_light = trained(of, light_std=0.3).maps(images)
    monkeypatch.setattr(hierarchy, 'SHARD', 7)
    assert_alike(whole, trained(of).maps(images))
    assert_alike(in_light, trained(of, light_std=0.3).maps(images))
    assert not np.allclose(in_light[-1], whole[-1], atol=0.1)


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


def test_of_a_long_drive_some_images_all_along_it_are_used(monkeypatch):
    monkeypatch.setattr(hierarchy, 'MOST', 20)
    shards = shards_of([drive(160), drive(2)], 0)
    assert [(s.start, s.stop, s.end) for s in shards] == [
        (0, 8, 64), (64, 72, 128), (128, 136, 160), (0, 2, 2),
    ]  # fmt: skip


@pytest.fixture
def mdp():
    try:
        return mdp_shim.import_mdp()
    except ConfigError as error:
        return pytest.skip(str(error))


@pytest.mark.parametrize('relative_cut', [1e-2, CUT])
def test_the_engine_of_mdp_learns_the_same_features(relative_cut, mdp):
    of = drive(24)
    of.joined[[7, 15]] = False
    images, options = of.panoramas.read(0, 24), {'light_std': 0.0, 'relative_cut': relative_cut}
    ours = trained(of, relative_cut=relative_cut)
    theirs = mdp_engine.train_network(ARCHITECTURE, [of], **options)
    assert ours.ranks == theirs.ranks
    assert_alike(ours.maps(images), theirs.maps(images), 0.9999)
    for pair in zip(ours.deltas, theirs.deltas, strict=True):
        assert np.allclose(*pair, rtol=2e-3)


def test_missing_mdp_tells_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, 'mdp', None)
    with pytest.raises(ConfigError, match=r'pip install "sfa_localization\[mdp\]"'):
        mdp_shim.import_mdp()
