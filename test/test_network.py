# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The network: its geometry, what it refuses, and that its maps turn with the robot."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, SIZE
from test_rotation import views

from sfa_localization.data.errors import ConfigError, ModelError
from sfa_localization.sfa import network as sfa
from sfa_localization.sfa.image_features import slow_features
from sfa_localization.sfa.network import Architecture, Layer, Network, Node, input_map, resampled


def random_network(architecture, seed=0):
    """Weights at random: the network's algebra does not care."""
    rng = np.random.default_rng(seed)
    nodes, channels = [], input_map(pictures(architecture.size, 1), architecture).shape[-1]
    for layer, receptive in zip(architecture.layers, architecture.fields, strict=True):
        inputs = receptive.columns * receptive.rows * channels
        shapes = ((inputs, layer.linear), (layer.linear,))
        shapes += ((layer.expanded, layer.outputs), (layer.outputs,))
        scales = (inputs**-0.5, 0.1, layer.expanded**-0.5, 0.1)
        parts = (rng.normal(0, s, shape) for s, shape in zip(scales, shapes, strict=True))
        nodes.append(Node(*(part.astype(np.float32) for part in parts)))
        channels = layer.outputs
    return Network(architecture, tuple(nodes))


def pictures(size, count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), np.uint8)


def scene(rows, columns):
    """The same smooth panorama in any size."""
    elevation = (np.arange(rows) + 0.5)[:, None] / rows
    azimuth = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    waves = (np.sin(azimuth), np.cos(2 * azimuth) * elevation, np.sin(3 * azimuth) + elevation)
    image = np.stack([120 + 40 * wave + 0 * elevation for wave in waves], axis=2)
    return image.round().astype(np.uint8)


@pytest.mark.parametrize(('size', 'grid', 'rotations', 'rows'), [
    ((60, 600), (30, 300), 60, [30, 6, 4, 1]),
    ((40, 320), (40, 320), 64, [40, 9, 2, 1]),
    ((150, 720), (30, 300), 60, [30, 6, 4, 1]),
])  # fmt: skip
def test_maps_have_the_standard_shapes_and_turn_with_the_robot(size, grid, rotations, rows):
    layers = sfa.STANDARD_NETWORKS[grid]
    for normalization in sfa.NORMALIZATIONS:
        architecture = Architecture(size, grid, normalization, layers)
        assert (architecture.rotations, architecture.map_rows) == (rotations, rows)
        network, images = random_network(architecture), pictures(size, 2)
        step = size[1] * layers[0].stride[1] // grid[1]
        both = [network.maps(part) for part in (images, np.roll(images, 7 * step, axis=2))]
        for plain, turned, layer, row in zip(*both, layers, rows[1:], strict=True):
            assert plain.shape == (2, row, rotations, layer.outputs)
            assert np.allclose(np.roll(plain, 7, axis=2), turned, atol=1e-5)
        assert np.allclose(*map(slow_features, both), atol=1e-5)


def test_maps_by_definition():
    """Each layer is clip(expand(field @ linear - offset) @ slow - offset), node by node."""
    for clip in (4.0, 0.01):
        layers = tuple(replace(layer, clip=clip) for layer in ARCHITECTURE.layers)
        architecture = replace(ARCHITECTURE, layers=layers)
        network, images = random_network(architecture), pictures(SIZE, 3)
        below = input_map(images, architecture)
        for node, field, made in zip(
            network.nodes, architecture.fields, network.maps(images), strict=True
        ):
            z = views(below, field) @ node.linear - node.linear_offset
            i, j = np.triu_indices(z.shape[-1])
            s = np.concatenate([z, z[..., i] * z[..., j]], -1) @ node.slow - node.slow_offset
            assert np.allclose(made, np.clip(s, -clip, clip), atol=1e-5)
            below = made


def prepared(images, normalization, grid=SIZE):
    layer = Layer((grid[0], 8), (1, 4), 6, 5)
    return input_map(images, Architecture(SIZE, grid, normalization, (layer,)))


def test_too_many_pixels_are_averaged():
    images = pictures(SIZE, 1)
    smaller = prepared(images, 'none', (6, 24)).reshape(6, 24, 3)
    mean = images[0].reshape(6, 2, 24, 2, 3).mean((1, 3))
    assert np.abs((smaller + 1) * 128 - mean).max() <= 0.51


@pytest.mark.parametrize('size', [(15, 90), (29, 299), (600, 120)])
def test_a_scene_looks_alike_in_all_sizes_and_its_ends_belong_together(size):
    grid, image = (30, 300), scene(*size)
    smaller = resampled(image, grid)
    assert smaller.shape == (*grid, 3)
    assert np.abs(smaller.astype(float) - scene(*grid)).max() < 12
    turned = resampled(np.roll(image, size[1] // 2, axis=1), grid)
    shift = 300 * (size[1] // 2) / size[1]
    frequencies = np.fft.rfftfreq(300)[:, None] * shift
    back = np.fft.rfft(smaller.astype(float), axis=1) * np.exp(-2j * np.pi * frequencies)
    assert np.abs(np.fft.irfft(back, 300, axis=1) - turned).max() < 6


def test_gain_does_not_matter_to_channels_of_zero_mean_and_unit_scale():
    bright = cv2.GaussianBlur(pictures(SIZE, 1)[0], (0, 0), 2)[None]
    dark = (bright * 0.5).round().astype(np.uint8)
    a, b = (prepared(i, 'panorama') for i in (bright, dark))
    assert np.abs(a - b).max() < 0.1 * np.abs(a).max()
    assert np.allclose(a.reshape(-1, 3).mean(0), 0, atol=1e-5)
    assert np.allclose(a.reshape(-1, 3).std(0), 1, atol=1e-5)


def test_another_size_and_odd_grids_are_refused():
    with pytest.raises(ModelError, match=r'48 x 12 pixels, got 50 x 12.*omnicam'):
        input_map(np.zeros((1, 12, 50, 3), np.uint8), ARCHITECTURE)
    for grid, reason in (
        ((30, 302), 'do not hold whole strides of 5'), ((26, 300), 'layer 3'),
        ((31, 300), 'layer 1: .* do not fill 31 rows'), ((30, 0), 'above 0'),
        ((30, 50), 'wider than the 10 columns'),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=reason):
            Architecture((60, 600), grid, 'panorama', sfa.STANDARD_NETWORKS[30, 300])
