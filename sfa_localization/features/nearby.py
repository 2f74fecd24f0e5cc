# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The place of an image among the keyframes around it, by linear regression of their textures.

Turned to one heading, the textures of neighboring places differ by how far things move over the
panorama, which is about linear in the place over some decimeters. What an image has of these
differences says where it was taken; another light takes part of its likeness away, but has
little to do with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array

Spectra = NDArray[np.complex64]
Vectors = NDArray[np.float32]

# Difference of correlation over which the weight of a keyframe falls by a factor of e.
_LIKENESS = 0.05
# Ridge of the regression, of the variance of all textures: with the noise of pixels alone it
# would follow each of them.
_RIDGE = 0.005
# Share of its likeness that an image keeps in any light.
_LEAST_GAIN = 0.2


def turned(spectra: Spectra, angle: Array) -> Spectra:
    """Spectra (..., rows, F) of textures whose content is moved by `angle` (...) rad, to the left
    for positive ones.
    """
    phase = np.exp(1j * np.multiply.outer(angle, np.arange(spectra.shape[-1])))
    return np.asarray(spectra * phase[..., None, :], np.complex64)


@dataclass(frozen=True, slots=True)
class Nearby:
    """Where an image is among keyframes: `place` (2,) m, the `angle` rad by which `turned` would
    still turn it to them, and `unlike`, how much of it no place among them explains: 0 for an
    image between them in their light, 1 for as much as what they have in common.
    """

    place: Array
    angle: float
    unlike: float


def place_among(image: Spectra, keyframes: Spectra, places: Array, columns: int) -> Nearby:
    """The place of the spectrum (rows, F) of a texture of so many columns, among those (N, rows,
    F) of keyframes at places (N, 2) m, all turned to the heading of the image.
    """
    likeness, near = _vectors(image, columns), _vectors(keyframes, columns)
    scores = near @ likeness
    weight = np.exp((scores - scores.max()) / _LIKENESS)
    weight /= weight.sum()
    mean, center = weight @ near, weight @ places
    frequencies = 1j * np.arange(keyframes.shape[-1], dtype=np.float32)
    turning = _vectors(np.tensordot(weight, keyframes, 1) * frequencies, columns)
    own, its = max(float(mean @ mean), 1e-12), max(float(turning @ turning), 1e-12)
    rest = likeness / max(float(likeness @ mean) / own, _LEAST_GAIN)
    angle = -float(rest @ turning) / its
    rest = _without(_without(rest, mean, own), turning, its)
    root = np.sqrt(weight)[:, None]
    differences = root * _without(_without(near - mean, mean, own), turning, its)
    gram = (differences @ differences.T).astype(np.float64)
    gram[np.diag_indices_from(gram)] += max(_RIDGE * float(np.trace(gram)), 1e-12)
    explained = np.linalg.solve(gram, differences @ rest)
    rest -= explained.astype(np.float32) @ differences
    place = center + explained @ (root * (places - center))
    return Nearby(place, angle, float(rest @ rest) / own)


def _without(vectors: Vectors, one: Vectors, square: float) -> Vectors:
    """Vectors (..., D) without their parts along another (D,), whose squared norm is given."""
    part = np.multiply.outer(vectors @ one / np.float32(square), one)
    return np.asarray(vectors - part, np.float32)


def _vectors(spectra: Spectra, columns: int) -> Vectors:
    """Vectors (..., D) whose products are the correlations of the textures of spectra."""
    weight = np.full(spectra.shape[-1], 2.0 / columns)
    weight[0] = 1 / columns
    if columns % 2 == 0:
        weight[-1] = 1 / columns
    scaled = np.ascontiguousarray(spectra * np.sqrt(weight), np.complex64)
    return scaled.reshape(*spectra.shape[:-2], -1).view(np.float32)
