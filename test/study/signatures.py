# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Features of panoramas that do not depend on the heading, without slowness: for comparison.

Turning the robot turns the phases of the harmonics of every row of the panorama, and leaves their
magnitudes. The Fourier signature keeps the magnitudes of all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image

Complex = NDArray[np.complex128]
Batches = Callable[[], Iterable[Image]]

COLUMNS, ROWS = 150, 30
"""Largest size of the images, as for image retrieval."""
HARMONICS = 16
"""Mean and harmonics 1 to 15 of each row, about the resolution of the receptive fields."""
DIMENSIONS = 32
"""Number of features, that of the network."""


def row_harmonics(image: Image) -> Complex:
    """Harmonics (H, rows * channels) of a panorama (h, w, C) uint8, at most ROWS x COLUMNS.

    Each channel has zero mean and unit scale over the image, so exposure does not matter.
    """
    size = min(image.shape[1], COLUMNS), min(image.shape[0], ROWS)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    small -= small.mean((0, 1))
    small /= np.maximum(small.std((0, 1)), 1.0)
    waves = np.fft.rfft(small, axis=1)[:, :HARMONICS] / size[0]
    waves[:, 1:] *= np.sqrt(2.0)
    return np.asarray(waves.transpose(1, 0, 2).reshape(waves.shape[1], -1))


@dataclass(frozen=True, slots=True)
class FourierSignature:
    """Magnitudes of the harmonics of every row, reduced to their principal components.

    `mean` (D,) and orthonormal `axes` (D, K) of the magnitudes.
    """

    mean: Array
    axes: Array

    @classmethod
    def fit(cls, batches: Batches) -> FourierSignature:
        """Fit to panoramas in batches (T, h, w, C). Raises DataError for fewer than two."""
        count, total, second = 0, np.zeros(1), np.zeros((1, 1))
        for images in batches():
            vectors = _magnitudes(images)
            count, total = count + len(vectors), total + vectors.sum(0)
            second = second + vectors.T @ vectors
        _require(count)
        mean = total / count
        variance, axes = np.linalg.eigh(second / count - np.outer(mean, mean))
        return cls(mean, axes[:, np.argsort(variance)[::-1][:DIMENSIONS]])

    def features(self, images: Image) -> Array:
        """Features (T, K), the strongest first, of panoramas (T, h, w, C)."""
        return np.asarray((_magnitudes(images) - self.mean) @ self.axes)


def _magnitudes(images: Image) -> Array:
    return np.array([np.abs(row_harmonics(image)).ravel() for image in images])


def _require(count: int) -> None:
    if count < 2:
        raise DataError('signatures need at least two images')
