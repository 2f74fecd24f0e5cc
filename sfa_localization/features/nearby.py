# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The place of an image among the keyframes around it, by linear regression of their textures.

Turned to one heading, the textures of neighboring places differ by how far things move over the
panorama, which is about linear in the place over some decimeters. What an image has of these
differences says where it was taken; another light takes part of its likeness away, but has
little to do with them.
"""

from __future__ import annotations

from collections.abc import Sequence
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


def place_among(
    image: Spectra,
    keyframes: Spectra,
    places: Array,
    columns: int,
    channels: Sequence[slice] = (slice(None),),
) -> Nearby:
    """The place of the spectrum (rows, F) of a texture of so many columns, among those (N, rows,
    F) of keyframes at places (N, 2) m, all turned to the heading of the image.

    `channels` are rows that may be unlike for reasons of their own: each counts by how well the
    keyframes explain it.
    """
    near, own = _vectors(keyframes, columns), _vectors(image, columns)
    scores = near @ own
    weight = np.exp((scores - scores.max()) / _LIKENESS)
    weight /= weight.sum()
    mean = weight @ near
    by_angle = 1j * np.arange(keyframes.shape[-1], dtype=np.float32)
    turning = (mean.view(np.complex64).reshape(keyframes.shape[1:]) * by_angle).view(np.float32)
    vectors = np.concatenate([near, turning.reshape(1, -1), own[None]])
    rows = vectors.reshape(len(vectors), len(image), -1)
    parts = [rows[:, channel].reshape(len(rows), -1) for channel in channels]
    gains, products = zip(*(_products(part, weight) for part in parts), strict=True)
    rest = _regressed(np.tensordot(np.square(gains), products, 1), weight, places)[1]
    left = np.einsum('i,cij,j->c', rest, products, rest)
    noise = left / [part.shape[1] for part in parts]
    trust = 1 / (noise + noise.min() + 1e-12)
    return _regressed(np.tensordot(trust / trust.max(), products, 1), weight, places)[0]


def _products(part: Vectors, weight: Vectors) -> tuple[float, Array]:
    """The share of its likeness to the mean by weight (N,) of N keyframes that a channel of the
    image has kept; and the products (N + 2, N + 2) of the keyframes, of the derivative of their
    mean by the angle, and of the image, which gets back what it lacks.
    """
    products = (part @ part.T).astype(np.float64)
    means = products[:-2, :-2] @ weight
    gain = max(float(products[-1, :-2] @ weight) / max(float(means @ weight), 1e-12), _LEAST_GAIN)
    products[-1] /= gain
    products[:, -1] /= gain
    return gain, products


def _regressed(products: Array, weight: Vectors, places: Array) -> tuple[Nearby, Array]:
    """The regression by the products (N + 2, N + 2) of N keyframes, the derivative of their mean by
    the angle, and the image; and what it leaves of the image, as a combination of these.

    Neither likeness to the mean nor a rest of angle is a matter of the place: the parts of all
    vectors along both, which are orthogonal, are taken out of the products.
    """
    means = weight.astype(np.float64)
    gram, around, with_own = products[:-2, :-2].copy(), products[-2, :-2], products[-1, :-2]
    mean, turned_by, norm = gram @ means, float(products[-2, -1]), float(products[-1, -1])
    likeness = float(means @ with_own)
    square, power = max(float(means @ mean), 1e-12), max(float(products[-2, -2]), 1e-12)
    along = mean - square
    gram += square - mean[:, None] - mean - np.outer(along, along) / square
    gram -= np.outer(around, around) / power
    shown = with_own - likeness - along * likeness / square - around * turned_by / power
    rest = norm - likeness**2 / square - turned_by**2 / power
    root, center = np.sqrt(means), means @ places
    gram *= np.outer(root, root)
    ridge = max(_RIDGE * float(np.trace(gram)), 1e-12)
    explained = np.linalg.solve(gram + ridge * np.eye(len(gram)), root * shown)
    rest += float(explained @ (gram @ explained - 2 * root * shown))
    by = explained * root
    place = center + by @ (places - center)
    of_mean = by @ (1 + along / square) - likeness / square
    of_turning = (float(by @ around) - turned_by) / power
    left = np.concatenate([of_mean * means - by, [of_turning, 1.0]])
    return Nearby(place, -turned_by / power, max(rest, 0.0) / square), left


def _vectors(spectra: Spectra, columns: int) -> Vectors:
    """Vectors (..., D) whose products are the correlations of the textures of spectra."""
    weight = np.full(spectra.shape[-1], 2.0 / columns, np.float32)
    weight[0] = 1 / columns
    if columns % 2 == 0:
        weight[-1] = 1 / columns
    scaled = np.ascontiguousarray(spectra * np.sqrt(weight), np.complex64)
    return scaled.reshape(*spectra.shape[:-2], -1).view(np.float32)
