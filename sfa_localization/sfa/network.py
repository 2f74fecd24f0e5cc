# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The hierarchical SFA network: receptive fields, quadratic expansion, shared weights.

Section 2.2 of the paper: each node performs linear SFA to reduce dimensions, expands
quadratically, and extracts slow features by a second linear SFA; layers converge onto one node.
Nodes of a layer share weights and their fields wrap around the panorama, so that a layer's map
shifts with the robot's rotation (see rotation.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import ConfigError, ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image
from sfa_localization.sfa.rotation import Field, Map, unfold
from sfa_localization.sfa.slowness import LinearSfa

Weights = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Layer:
    """One layer of shared nodes.

    `field` and `stride` are (rows, columns): pixels for the first layer, units of the layer below
    for the others. `linear` dimensions are kept by the first SFA and expanded quadratically,
    `outputs` slow features leave the second, limited to +-`clip` (unit variance).
    """

    field: tuple[int, int]
    stride: tuple[int, int]
    linear: int
    outputs: int
    clip: float = 4.0

    @property
    def expanded(self) -> int:
        return self.linear + self.linear * (self.linear + 1) // 2


@dataclass(frozen=True, slots=True)
class Architecture:
    """Sizes of the network; the weights are in `Network`.

    `size` is (rows, columns) of the panorama, `grid` that of the image it is resampled to for the
    first layer. `normalization` 'panorama' removes the mean and scale of each channel of each
    image.
    """

    size: tuple[int, int]
    grid: tuple[int, int]
    normalization: str
    layers: tuple[Layer, ...]

    def __post_init__(self) -> None:
        _check(self)

    @property
    def rotations(self) -> int:
        """Columns of every map: steps of the simulated rotation."""
        return self.grid[1] // self.layers[0].stride[1]

    @property
    def fields(self) -> tuple[Field, ...]:
        """Receptive fields in columns of the maps, one rotation step apart."""
        first = self.layers[0]
        made = [Field(first.field[0], first.field[1] // first.stride[1], first.stride[0])]
        spacing = 1
        for layer in self.layers[1:]:
            made.append(Field(*layer.field, layer.stride[0], spacing))
            spacing *= layer.stride[1]
        return tuple(made)

    @property
    def map_rows(self) -> list[int]:
        """Rows of the resampled image and of every layer's map."""
        rows = [self.grid[0]]
        for receptive in self.fields:
            rows.append(receptive.rows_out(rows[-1]))
        return rows

    @property
    def channels(self) -> list[int]:
        """Channels of the map below each layer."""
        colors = 1 if self.normalization == 'grey' else 3
        above = (layer.outputs for layer in self.layers[:-1])
        return [self.layers[0].stride[1] * colors, *above]

    @property
    def outputs(self) -> int:
        return self.layers[-1].outputs


def _check(architecture: Architecture) -> None:
    """Fields must fill their maps in whole strides. Raises ConfigError."""
    numbers: list[object] = [*architecture.size, *architecture.grid]
    for layer in architecture.layers:
        numbers += [*layer.field, *layer.stride, layer.linear, layer.outputs]
    whole = all(isinstance(n, int) and n >= 1 for n in numbers)
    if not (architecture.layers and whole and all(layer.clip > 0 for layer in architecture.layers)):
        raise ConfigError('a network has layers, whose sizes are whole numbers above 0')
    if architecture.normalization not in _NORMALIZATIONS:
        raise ConfigError(f'unknown normalization: use {", ".join(NORMALIZATIONS)}')
    first = architecture.layers[0]
    columns = architecture.grid[1]
    if first.field[1] % first.stride[1] or columns % first.stride[1]:
        raise ConfigError(
            f'a grid {columns} wide and fields {first.field[1]} wide do not hold whole strides of '
            f'{first.stride[1]} pixels'
        )
    levels = zip(architecture.fields, architecture.map_rows[:-1], strict=True)
    for depth, (receptive, rows) in enumerate(levels, 1):
        if receptive.columns * receptive.spacing > architecture.rotations + receptive.spacing - 1:
            raise ConfigError(
                f'layer {depth}: a field of {receptive.columns} columns, {receptive.spacing} '
                f'apart, is wider than the {architecture.rotations} columns of its map'
            )
        if rows < receptive.rows or (rows - receptive.rows) % receptive.row_stride:
            raise ConfigError(
                f'layer {depth}: fields of {receptive.rows} rows, stride {receptive.row_stride}, '
                f'do not fill {rows} rows'
            )


# 600 x 60 color panoramas, the paper's size; layers found best on path-traced gardens.
PAPER_LAYERS = (
    Layer(field=(10, 10), stride=(4, 5), linear=32, outputs=32),
    Layer(field=(3, 5), stride=(1, 1), linear=32, outputs=32),
    Layer(field=(4, 20), stride=(1, 1), linear=48, outputs=32),
)
# 320 x 40 images, as published for this family of networks.
SMALL_LAYERS = (
    Layer(field=(8, 10), stride=(4, 5), linear=32, outputs=32),
    Layer(field=(6, 14), stride=(3, 7), linear=32, outputs=32),
    Layer(field=(2, 9), stride=(1, 1), linear=32, outputs=32),
)

STANDARD_NETWORKS = {(30, 300): PAPER_LAYERS, (40, 320): SMALL_LAYERS}
"""Layers by grid; the first grid is for panoramas of all sizes that are not a grid themselves."""


def standard_architecture(size: tuple[int, int], normalization: str) -> Architecture:
    """The standard network for panoramas of (rows, columns), which are resampled to its grid."""
    grid = size if size in STANDARD_NETWORKS else next(iter(STANDARD_NETWORKS))
    return Architecture(size, grid, normalization, STANDARD_NETWORKS[grid])


@dataclass(frozen=True, slots=True)
class Node:
    """Trained weights shared by a layer's nodes, float32, means folded into offsets.

    z = x `linear` - `linear_offset`; s = expand(z) `slow` - `slow_offset`.
    """

    linear: Weights
    linear_offset: Weights
    slow: Weights
    slow_offset: Weights

    @classmethod
    def from_solutions(cls, linear: LinearSfa, slow: LinearSfa) -> Node:
        return cls(*folded(linear), *folded(slow))


def folded(solution: LinearSfa) -> tuple[Weights, Weights]:
    """Weights (D, K) of a solution, and its mean as an offset (K,): x weights - offset."""
    weights = solution.weights.astype(np.float32)
    return weights, (solution.mean @ solution.weights).astype(np.float32)


def expand(z: Map) -> Map:
    """All monomials of degree 1 and 2 of signals (L, ...): (L + L (L + 1) / 2, ...)."""
    return np.concatenate([z, *(z[i] * z[i:] for i in range(len(z)))])


def input_map(images: Image, architecture: Architecture) -> Map:
    """Panoramas (T, H, W, C) uint8 -> resampled, normalized map (T, rows, R, stride * C) float32.

    Raises ModelError when the images have another size than the network expects.
    """
    require_size(images, architecture)
    normalize = _NORMALIZATIONS[architecture.normalization]
    maps = np.stack([normalize(resampled(image, architecture.grid)) for image in images])
    return maps.reshape(len(maps), maps.shape[1], architecture.rotations, -1)


def require_size(images: Image, architecture: Architecture) -> None:
    """Raise ModelError when images are not of the size (T, H, W, C) that the network expects."""
    if images.ndim != 4 or images.shape[1:3] != architecture.size:
        height, width = architecture.size
        raise ModelError(
            f'the model expects panoramas of {width} x {height} pixels, got {images.shape[-2]} x '
            f'{images.shape[-3]}: set the panorama size of the omnicam node, or train again'
        )


def resampled(image: Image, grid: tuple[int, int]) -> Image:
    """A panorama (H, W, C), resampled to (rows, columns) and wrapped around at its ends: averaged
    along an axis with more pixels than the grid, interpolated along one with fewer.
    """
    rows, columns = grid
    height = min(image.shape[0], rows)
    width = min(image.shape[1], columns)
    if image.shape[:2] != (height, width):
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    if (height, width) == grid:
        return image
    # As many columns on both sides as give whole columns of the grid.
    margin = width // math.gcd(width, columns)
    added = margin * columns // width
    wrapped = np.pad(image, ((0, 0), (margin, margin), (0, 0)), 'wrap')
    size = (columns + 2 * added, rows)
    larger = cv2.resize(wrapped, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(larger[:, added : added + columns])


def _unnormalized(image: Image) -> Map:
    return np.asarray(image / np.float32(128) - 1, np.float32)


def _gray(image: Image) -> Map:
    return np.asarray(_unnormalized(image) @ np.array([[0.114], [0.587], [0.299]], np.float32))


def _per_panorama(image: Image) -> Map:
    """Zero mean and unit scale of each channel over the whole image: independent of exposure."""
    mean, std = (row.astype(np.float32).ravel() for row in cv2.meanStdDev(image))
    return np.asarray((image - mean) / np.maximum(std, 1), np.float32)


_NORMALIZATIONS = {
    'none': _unnormalized,
    'grey': _gray,
    'panorama': _per_panorama,
}
NORMALIZATIONS = tuple(_NORMALIZATIONS)


def linear_stage(below: Map, receptive: Field, linear: Weights, offset: Weights) -> Map:
    """First half of a layer: reduced signals (L, rows, R) of one map (rows, R, channels)."""
    reduced = np.tensordot(unfold(below[None], receptive)[0], linear, 1) - offset
    return np.asarray(np.moveaxis(reduced, -1, 0), np.float32)


@dataclass(frozen=True, slots=True)
class Network:
    """A trained hierarchy: panoramas in, slow features out.

    `deltas` holds each layer's Delta values, `ranks` the dimensions its two SFAs kept.
    """

    architecture: Architecture
    nodes: tuple[Node, ...]
    deltas: tuple[Array, ...] = field(default=())
    ranks: tuple[tuple[int, int], ...] = field(default=())

    def layer(self, maps: Map, depth: int) -> Map:
        """Output map of layer `depth` (0-based) from the map below."""
        node = self.nodes[depth]
        layer = self.architecture.layers[depth]
        receptive = self.architecture.fields[depth]
        above = []
        for below in maps:  # the monomials of all images at once would need much memory
            reduced = linear_stage(below, receptive, node.linear, node.linear_offset)
            slow = np.tensordot(expand(reduced), node.slow, (0, 0)) - node.slow_offset
            above.append(np.clip(slow, -layer.clip, layer.clip))
        return np.stack(above)

    def maps(self, images: Image) -> list[Map]:
        """Every layer's output map (T, rows, R, outputs) for panoramas (T, H, W, C)."""
        below = input_map(images, self.architecture)
        made = []
        for depth in range(len(self.nodes)):
            below = self.layer(below, depth)
            made.append(below)
        return made


def check_weights(network: Network) -> None:
    """Raise ModelError unless the weights have the sizes of the architecture."""
    architecture = network.architecture
    levels = zip(
        network.nodes,
        architecture.layers,
        architecture.fields,
        architecture.channels,
        strict=True,
    )
    for depth, (node, layer, receptive, channels) in enumerate(levels, 1):
        inputs = receptive.rows * receptive.columns * channels
        linear = (inputs, layer.linear)
        slow = (layer.expanded, layer.outputs)
        if (node.linear.shape, node.slow.shape) != (linear, slow):
            raise ModelError(f'the weights of layer {depth} do not fit its sizes')
