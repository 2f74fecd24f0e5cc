# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Novelty: how unlike the training images an image is, layer by layer.

Each layer's map is described by the mean and standard deviation over its columns, which do not
depend on the heading; novelty is the Mahalanobis distance of this description.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.features.rotation import Map

# Principal directions of the descriptions: more would fit the noise of a short drive.
_DIRECTIONS = 24
# Share of unseen images of the same drive that count as familiar.
_QUANTILE = 0.99


def describe(maps: Map) -> Array:
    """Mean and standard deviation over the columns of maps (T, rows, R, ch): (T, 2 * rows * ch)."""
    mean = maps.mean(2, dtype=np.float32)
    spread = np.sqrt(np.maximum((maps * maps).mean(2, dtype=np.float32) - mean * mean, 0.0))
    both = np.concatenate([mean, spread], axis=2).reshape(len(maps), -1)
    return np.asarray(both, np.float64)


@dataclass(frozen=True, slots=True)
class Familiarity:
    """The distribution of the training images' descriptions in one layer.

    `mean` (D,), `directions` (D, P) scaled to unit variance; what they do not span has
    the variance `rest`. `limit` is the distance that 1 in 100 unseen images exceeds.
    """

    mean: Array
    directions: Array
    axes: Array
    rest: float
    limit: float

    @classmethod
    def fit(cls, descriptions: Array) -> Familiarity:
        """From descriptions (T, D) of the training images, in order of driving."""
        if len(descriptions) < 4:
            raise DataError(f'{len(descriptions)} images are too few to learn novelty from')
        parts = np.arange(len(descriptions)) * 8 // len(descriptions) % 2
        unseen = [
            cls._of(descriptions[parts != part]).distance(descriptions[parts == part])
            for part in (0, 1)
        ]
        fitted = cls._of(descriptions)
        limit = float(np.quantile(np.concatenate(unseen), _QUANTILE))
        return cls(fitted.mean, fitted.directions, fitted.axes, fitted.rest, max(limit, 1e-9))

    @classmethod
    def _of(cls, descriptions: Array) -> Familiarity:
        mean = descriptions.mean(0)
        centered = descriptions - mean
        count = min(_DIRECTIONS, len(descriptions) - 1, descriptions.shape[1])
        _, values, axes = np.linalg.svd(centered, full_matrices=False)
        std = np.maximum(values[:count] / np.sqrt(len(descriptions)), 1e-6)
        outside = max(descriptions.shape[1] - count, 1)
        rest = float((values[count:] ** 2).sum() / len(descriptions) / outside) + 1e-9
        kept = axes[:count].T
        return cls(mean, kept / std, kept, rest * outside, 1.0)

    def distance(self, descriptions: Array) -> Array:
        """Distances (T,) of descriptions (T, D), about 1 within the training set's spread."""
        centered = descriptions - self.mean
        inside = (centered @ self.directions) ** 2
        left = (centered**2).sum(1) - ((centered @ self.axes) ** 2).sum(1)
        return np.asarray(np.sqrt(inside.mean(1) + np.maximum(left, 0.0) / self.rest))


@dataclass(frozen=True, slots=True)
class Novelty:
    """Novelty of an image: its largest distance in any layer, over the limit of the layer."""

    layers: tuple[Familiarity, ...]

    @classmethod
    def fit(cls, descriptions: Sequence[Array]) -> Novelty:
        """From each layer's descriptions (T, D) of the training images."""
        return cls(tuple(Familiarity.fit(layer) for layer in descriptions))

    def per_layer(self, maps: Sequence[Map]) -> Array:
        """Novelty (T, layers) of images from every layer's maps: at most 1 is familiar."""
        known = zip(self.layers, maps, strict=True)
        return np.stack([layer.distance(describe(m)) / layer.limit for layer, m in known], axis=1)

    def to_arrays(self) -> dict[str, Array]:
        """Arrays to save, without pickle."""
        arrays: dict[str, Array] = {}
        for number, layer in enumerate(self.layers):
            arrays[f'{number}/mean'] = layer.mean
            arrays[f'{number}/directions'] = layer.directions
            arrays[f'{number}/axes'] = layer.axes
            arrays[f'{number}/scalars'] = np.array([layer.rest, layer.limit])
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> Novelty:
        layers = []
        for number in range(sum(name.endswith('/mean') for name in arrays)):
            part = {
                key: np.asarray(arrays[f'{number}/{key}'], float)
                for key in ('mean', 'directions', 'axes', 'scalars')
            }
            rest, limit = part['scalars']
            layers.append(
                Familiarity(
                    part['mean'], part['directions'], part['axes'], float(rest), float(limit)
                )
            )
        return cls(tuple(layers))
