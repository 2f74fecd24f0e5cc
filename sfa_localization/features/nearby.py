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
    phase = np.exp(1j * np.multiply.outer(angle, np.arange(spectra.shape[-1]))).astype(np.complex64)
    return np.asarray(spectra * phase[..., None, :])


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
    near, own = _vectors(keyframes, columns), _vectors(image, columns)
    scores = near @ own
    weight = np.exp((scores - scores.max()) / _LIKENESS)
    weight /= weight.sum()
    mean = weight @ near
    by_angle = 1j * np.arange(keyframes.shape[-1], dtype=np.float32)
    turning = (mean.view(np.complex64).reshape(keyframes.shape[1:]) * by_angle).view(np.float32)
    others = np.stack([mean, turning.ravel(), own])
    return _regressed(near @ near.T, near @ others.T, others @ others.T, weight, places)


def _regressed(
    products: Vectors, with_others: Vectors, of_others: Vectors, weight: Vectors, places: Array
) -> Nearby:
    """The regression by the products of N keyframes (N, N), with their mean by weight (N,), its
    derivative by the angle, and the image (N, 3), and of these (3, 3).

    Neither likeness to the mean nor a rest of angle is a matter of the place: the parts of all
    vectors along both, which are orthogonal, are taken out of the products.
    """
    gram, (mean, turning, own) = products.astype(np.float64), with_others.T.astype(np.float64)
    (square, _, likeness), (_, power, turned_by), (_, _, norm) = of_others.astype(np.float64)
    square, power = max(square, 1e-12), max(power, 1e-12)
    gain = max(likeness / square, _LEAST_GAIN)
    along, around = mean - square, turning
    gram += square - mean[:, None] - mean - np.outer(along, along) / square
    gram -= np.outer(around, around) / power
    shown = (own - likeness - along * likeness / square - around * turned_by / power) / gain
    rest = (norm - likeness**2 / square - turned_by**2 / power) / gain**2
    root, center = np.sqrt(weight), weight @ places
    gram *= np.outer(root, root)
    ridge = max(_RIDGE * float(np.trace(gram)), 1e-12)
    explained = np.linalg.solve(gram + ridge * np.eye(len(gram)), root * shown)
    rest += float(explained @ (gram @ explained - 2 * root * shown))
    place = center + (explained * root) @ (places - center)
    return Nearby(place, -turned_by / (gain * power), max(rest, 0.0) / square)


def _vectors(spectra: Spectra, columns: int) -> Vectors:
    """Vectors (..., D) whose products are the correlations of the textures of spectra."""
    weight = np.full(spectra.shape[-1], 2.0 / columns, np.float32)
    weight[0] = 1 / columns
    if columns % 2 == 0:
        weight[-1] = 1 / columns
    scaled = np.ascontiguousarray(spectra * np.sqrt(weight), np.complex64)
    return scaled.reshape(*spectra.shape[:-2], -1).view(np.float32)
