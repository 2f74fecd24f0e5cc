# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The network: its geometry, what it refuses, and that its maps turn with the robot."""

import cv2
import numpy as np
import pytest
from cylinder_worlds import ARCHITECTURE, SIZE
from test_rotation import views

from sfa_localization.data.errors import ConfigError, ModelError
from sfa_localization.features.image_features import slow_features
from sfa_localization.features.network import (
    NORMALIZATIONS,
    Architecture,
    Layer,
    Network,
    Node,
    expand,
    input_map,
    resampled,
)
from sfa_localization.features.network import STANDARD_NETWORKS as STANDARD


def random_network(architecture: Architecture, seed: int = 0) -> Network:
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


def pictures(size: tuple[int, int], count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), np.uint8)


@pytest.mark.parametrize(
    ('size', 'grid', 'rotations', 'rows'),
    [
        ((60, 600), (30, 300), 60, [30, 6, 4, 1]),
        ((40, 320), (40, 320), 64, [40, 9, 2, 1]),
        ((25, 120), (30, 300), 60, [30, 6, 4, 1]),
        ((150, 720), (30, 300), 60, [30, 6, 4, 1]),
        ((128, 1024), (30, 300), 60, [30, 6, 4, 1]),
    ],
)
def test_standard_layers(size, grid, rotations, rows):
    layers = STANDARD[grid]
    architecture = Architecture(size, grid, 'panorama', layers)
    assert (architecture.rotations, architecture.map_rows) == (rotations, rows)
    made = random_network(architecture).maps(pictures(size, 2))
    assert [m.shape for m in made] == [
        (2, row, rotations, layer.outputs) for row, layer in zip(rows[1:], layers, strict=True)
    ]


def scene(rows: int, columns: int) -> np.ndarray:
    """The same smooth panorama in any size."""
    elevation = (np.arange(rows) + 0.5)[:, None] / rows
    azimuth = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    waves = (np.sin(azimuth), np.cos(2 * azimuth) * elevation, np.sin(3 * azimuth) + elevation)
    image = np.stack([120 + 40 * wave + 0 * elevation for wave in waves], axis=2)
    return image.round().astype(np.uint8)


@pytest.mark.parametrize('normalization', NORMALIZATIONS)
@pytest.mark.parametrize(
    ('size', 'grid'),
    [
        ((60, 600), (30, 300)),
        ((40, 320), (40, 320)),
        ((25, 120), (30, 300)),
        ((150, 720), (30, 300)),
    ],
)
def test_maps_turn_with_the_robot(size, grid, normalization):
    layers = STANDARD[grid]
    network = random_network(Architecture(size, grid, normalization, layers))
    images = pictures(size, 2)
    step = size[1] * layers[0].stride[1] // grid[1]
    turned = network.maps(np.roll(images, 7 * step, axis=2))
    for one, other in zip(network.maps(images), turned, strict=True):
        assert np.allclose(np.roll(one, 7, axis=2), other, atol=1e-5)
    slow = [slow_features(network.maps(p)) for p in (images, np.roll(images, 7 * step, axis=2))]
    assert np.allclose(*slow, atol=1e-5)


def test_maps_by_definition():
    """Each layer is clip(expand(field @ linear - offset) @ slow - offset), node by node."""
    network, images = random_network(ARCHITECTURE), pictures(SIZE, 3)
    below = input_map(images, ARCHITECTURE)
    for depth, (node, made) in enumerate(zip(network.nodes, network.maps(images), strict=True)):
        seen = views(below, ARCHITECTURE.fields[depth])
        z = seen @ node.linear - node.linear_offset
        i, j = np.triu_indices(z.shape[-1])
        s = np.concatenate([z, z[..., i] * z[..., j]], -1) @ node.slow - node.slow_offset
        assert np.allclose(made, np.clip(s, -4, 4), atol=1e-5)
        below = made


def test_outputs_are_clipped():
    layer = Layer((4, 8), (4, 4), 6, 5, clip=0.01)
    network = random_network(Architecture(SIZE, SIZE, 'none', (layer,)))
    assert np.abs(network.maps(pictures(SIZE, 1))[0]).max() == pytest.approx(0.01)


def test_expansion_by_hand():
    z = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)
    assert expand(z).tolist() == [[1, 2], [3, 4], [1, 4], [3, 8], [9, 16]]
    assert len(expand(np.zeros((7, 1), np.float32))) == Layer((1, 1), (1, 1), 7, 1).expanded


class TestPreparing:
    """Resampling and normalization."""

    def architecture(self, normalization: str, grid: tuple[int, int] = SIZE) -> Architecture:
        layer = Layer((grid[0], 8), (1, 4), 6, 5)
        return Architecture(SIZE, grid, normalization, (layer,))

    def test_too_many_pixels_are_averaged(self):
        images = pictures(SIZE, 1)
        smaller = input_map(images, self.architecture('none', (6, 24))).reshape(6, 24, 3)
        mean = images[0].reshape(6, 2, 24, 2, 3).mean((1, 3))
        assert np.abs((smaller + 1) * 128 - mean).max() <= 0.51

    @pytest.mark.parametrize(
        'size', [(15, 90), (25, 120), (29, 299), (150, 720), (40, 1000), (600, 120)]
    )
    def test_a_scene_looks_alike_in_all_sizes(self, size):
        grid = (30, 300)
        shown = resampled(scene(*size), grid)
        assert shown.shape == (*grid, 3)
        assert np.abs(shown.astype(float) - scene(*grid)).max() < 12

    @pytest.mark.parametrize('columns', [90, 120, 299, 720])
    def test_the_ends_belong_together(self, columns):
        image = scene(30, columns)
        turned = resampled(np.roll(image, columns // 2, axis=1), (30, 300))
        shift = 300 * (columns // 2) / columns
        there = resampled(image, (30, 300)).astype(float)
        frequencies = np.fft.rfftfreq(300)[:, None] * shift
        back = np.fft.rfft(there, axis=1) * np.exp(-2j * np.pi * frequencies)
        assert np.abs(np.fft.irfft(back, 300, axis=1) - turned).max() < 6

    @pytest.mark.parametrize('gain', [0.8, 0.5])
    def test_gain_does_not_matter(self, gain):
        bright = cv2.GaussianBlur(pictures(SIZE, 1)[0], (0, 0), 2)[None]
        dark = (bright * gain).round().astype(np.uint8)
        a, b = (input_map(i, self.architecture('panorama')) for i in (bright, dark))
        assert np.abs(a - b).max() < 0.1 * np.abs(a).max()
        a, b = (input_map(i, self.architecture('none')) for i in (bright, dark))
        assert np.abs(a - b).max() > 0.1

    def test_each_channel_has_zero_mean_and_unit_scale(self):
        maps = input_map(pictures(SIZE, 2), self.architecture('panorama')).reshape(2, -1, 3)
        assert np.allclose(maps.mean(1), 0, atol=1e-5)
        assert np.allclose(maps.std(1), 1, atol=1e-5)

    def test_grey_has_one_channel(self):
        image = np.zeros((1, *SIZE, 3), np.uint8)
        image[..., 1] = 128
        maps = input_map(image, self.architecture('grey'))
        assert maps.shape == (1, 12, 12, 4)
        assert np.allclose(maps, 0.587 - 1, atol=1e-6)

    def test_another_size_is_refused(self):
        with pytest.raises(ModelError, match=r'48 x 12 pixels, got 50 x 12.*omnicam'):
            input_map(np.zeros((1, 12, 50, 3), np.uint8), ARCHITECTURE)


@pytest.mark.parametrize(('grid', 'reason'), [
    ((30, 302), 'do not hold whole strides of 5'), ((31, 300), 'layer 1: .* do not fill 31 rows'),
    ((26, 300), 'layer 3'), ((30, 50), 'wider than the 10 columns'), ((30, 0), 'above 0'),
])  # fmt: skip
def test_odd_grids_are_rejected(grid, reason):
    with pytest.raises(ConfigError, match=reason):
        Architecture((60, 600), grid, 'panorama', STANDARD[30, 300])
