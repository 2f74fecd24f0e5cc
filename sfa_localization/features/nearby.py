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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

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
# Above this `Nearby.aside` a place is at the border of the keyframes: a straight one has 0.64.
_BORDER = 0.6
# Standard deviation of a place by keyframes in another light, m, for an image that has as much of
# its own as in common with them; and what it grows by with the distance from them: another light
# takes part of the differences away that show it.
_BY_LIGHT, _BY_DISTANCE = 0.1, 0.4
# How often the drives are weighed by the distance of the place from their keyframes.
_WEIGHED = 2
# Parts of the panorama in which light and what hides the view are one error each: 22.5 deg.
_SECTORS = 16


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

    `noise` (2, 2) m^2 is the covariance of the place by what is left of the image; `variation`
    how much the keyframes that are like it differ, in the unit of `unlike`: much where none of
    them is near, in any light. `aside` is how far the place is from the middle of them, of their
    mean distance: 0 among them, 0.64 at a straight border of theirs, 1 far beside all.
    """

    place: Array
    angle: float
    unlike: float
    noise: Array
    variation: float
    aside: float

    @property
    def at_border(self) -> bool:
        """Whether the place is at the border of the keyframes: it may be farther out."""
        return self.aside > _BORDER


@dataclass(frozen=True, slots=True)
class _Regression:
    """A regression of an image. `combine` (3, N + 2) makes of the vectors of N keyframes, of their
    mean's derivative and of the image what is left of the image, and the two vectors along which
    that moves the place.
    """

    place: Array
    angle: float
    unlike: float
    variation: float
    combine: Array


@dataclass(frozen=True, slots=True)
class _Basis:
    """What N keyframes are compared with: shares `mean` (N,) of the mean that is most like the
    image, and `means` (N, N), row by row, of that of each one's drive; the `center` (2,) m of the
    first, `centers` (N, 2) m of the second, `offsets` (N, 2) m of their places from it, their
    weights in the regression (N,), of sum 1, and the largest correlation of each one's drive (N,).
    """

    mean: Array
    means: Array
    weight: Array
    center: Array
    centers: Array
    offsets: Array
    likest: Array

    @classmethod
    def of(cls, scores: Vectors, drives: NDArray[np.int32], places: Array) -> _Basis:
        """By the correlations (N,) of the keyframes with the image, which say how near they are
        among those of one drive.
        """
        means = np.where(drives[:, None] == drives, np.asarray(scores, float), -np.inf)
        likest = means.max(axis=1)
        means = np.exp((means - likest[:, None]) / _LIKENESS)
        means /= means.sum(axis=1, keepdims=True)
        mean = np.exp((scores - scores.max()) / _LIKENESS, dtype=np.float64)
        mean /= mean.sum()
        weight, centers = np.diag(means) / np.trace(means), means @ places
        return cls(mean, means, weight, mean @ places, centers, places - centers, likest)

    def about(self, place: Array) -> _Basis:
        """With a mean that counts each drive by how certain a place (2,) m is by it: a light that
        is more like that of the image is no use far away.
        """
        apart = self.centers - place
        by_light = _BY_LIGHT**2 * (np.maximum(self.likest, 0.1) ** -2 - 1)
        variance = by_light + _BY_DISTANCE**2 * (apart**2).sum(1)
        mean = np.diag(self.means) / np.maximum(variance, 1e-6)
        mean /= mean.sum()
        return replace(self, mean=mean, weight=mean, center=mean @ (self.centers + self.offsets))


def place_among(
    image: Spectra,
    keyframes: Spectra,
    places: Array,
    columns: int,
    channels: Sequence[slice] = (slice(None),),
    drives: NDArray[np.int32] | None = None,
) -> Nearby:
    """The place of the spectrum (rows, F) of a texture of so many columns, among those (N, rows,
    F) of keyframes at places (N, 2) m, all turned to the heading of the image.

    `channels` are rows that may be unlike for reasons of their own: each counts by how well the
    keyframes explain it. Keyframes of different `drives` (N,) may differ by their light, so that
    only differences within one show the place; all of one drive by default.
    """
    scale = _scale(image.shape[-1], columns)
    near = [_vectors(keyframes[:, rows], scale) for rows in channels]
    own = [_vectors(image[None, rows], scale) for rows in channels]
    scores = sum(one @ other[0] for one, other in zip(near, own, strict=True))
    drives = np.zeros(len(places), np.int32) if drives is None else drives
    basis = _Basis.of(scores, drives, places)
    found, moved = _found(near, own, basis, scale, columns)
    for _ in range(_WEIGHED if (drives != drives[0]).any() else 0):
        found, moved = _found(near, own, basis.about(found.place), scale, columns)
    offset = places - found.place
    aside = float(np.hypot(*offset.mean(0)) / max(np.hypot(*offset.T).mean(), 1e-9))
    noise = moved @ moved.T
    return Nearby(found.place, found.angle, found.unlike, noise, found.variation, aside)


def _found(
    near: Sequence[Vectors], own: Sequence[Vectors], basis: _Basis, scale: Vectors, columns: int
) -> tuple[_Regression, Array]:
    """The regression of an image by the vectors of each channel of it and of keyframes, and what
    `_moved` says of all channels together.
    """
    mean = basis.mean.astype(np.float32)
    parts = [
        np.concatenate([one, _turning(mean @ one, len(scale)), other])
        for one, other in zip(near, own, strict=True)
    ]
    gains, products = zip(*(_products(part, basis.mean) for part in parts), strict=True)
    left = _regressed(np.tensordot(np.square(gains), products, 1), basis).combine[0]
    errors = np.einsum('i,cij,j->c', left, products, left) / [part.shape[1] for part in parts]
    trust = 1 / (errors + errors.min() + 1e-12)
    trust /= trust.max()
    found = _regressed(np.tensordot(trust, products, 1), basis)
    moved = sum(
        by * _moved(found, part, gain, scale, columns)
        for by, part, gain in zip(trust, parts, gains, strict=True)
    )
    return found, np.asarray(moved)


def _moved(found: _Regression, part: Vectors, gain: float, scale: Vectors, columns: int) -> Array:
    """By how much, m, what is left of a channel moves the place in each sector of the panorama,
    (2, sectors): light and what hides the view are alike within one, and not in all.
    """
    combine = found.combine.astype(np.float32)
    combine[:, -1] /= gain
    spectra = (combine @ part).view(np.complex64).reshape(3, -1, len(scale)) / scale
    left, along_x, along_y = fft.irfft(spectra, columns)
    pull = np.stack([(along_x * left).sum(axis=0), (along_y * left).sum(axis=0)])
    sectors = min(_SECTORS, columns)
    starts = np.arange(sectors) * columns // sectors
    return np.add.reduceat(pull, starts, axis=1).astype(np.float64)


def _turning(mean: Vectors, frequencies: int) -> Vectors:
    """The derivative by the angle of a vector (D,), (1, D)."""
    by_angle = 1j * np.arange(frequencies, dtype=np.float32)
    spectra = mean.view(np.complex64).reshape(-1, frequencies) * by_angle
    return spectra.astype(np.complex64).view(np.float32).reshape(1, -1)


def _products(part: Vectors, mean: Array) -> tuple[float, Array]:
    """The share of its likeness to the mean, by shares (N,) of N keyframes, that a channel of the
    image has kept; and the products (N + 2, N + 2) of the keyframes, of the derivative of their
    mean by the angle, and of the image, which gets back what it lacks.
    """
    products = (part @ part.T).astype(np.float64)
    likeness = products[:-2, :-2] @ mean
    gain = max(float(products[-1, :-2] @ mean) / max(float(likeness @ mean), 1e-12), _LEAST_GAIN)
    products[-1] /= gain
    products[:, -1] /= gain
    return gain, products


def _regressed(products: Array, basis: _Basis) -> _Regression:
    """The regression by the products (N + 2, N + 2) of N keyframes, the derivative of their mean by
    the angle, and the image.

    Neither likeness to the mean nor a rest of angle is a matter of the place: the parts of all
    vectors along both, which are orthogonal, are taken out.
    """
    count = len(basis.mean)
    common = np.zeros((2, count + 2))
    common[0, :-2], common[1, -2] = basis.mean, 1.0
    rows = np.eye(count + 1, count + 2)
    rows[:, -2:], rows[-1] = 0.0, np.eye(count + 2)[-1]
    rows[:-1, :-2] -= basis.means
    along = products @ common.T
    norms = np.maximum((common * along.T).sum(1), 1e-12)
    turned_by = float(along[-1, 1])
    rows -= (rows @ along / norms) @ common
    both = rows @ products @ rows.T
    square, root = float(norms[0]), np.sqrt(basis.weight)
    gram, shown = both[:-1, :-1] * np.outer(root, root), both[:-1, -1]
    variation = float(np.trace(gram))
    ridge = max(_RIDGE * variation, 1e-12)
    wanted = np.column_stack([shown, basis.offsets]) * root[:, None]
    share = (np.linalg.solve(gram + ridge * np.eye(count), wanted) * root[:, None]).T
    explained = np.append(-share[0], 1.0)
    return _Regression(
        basis.center + share[0] @ basis.offsets,
        -turned_by / float(norms[1]),
        max(float(explained @ both @ explained), 0.0) / square,
        variation / square,
        np.vstack([explained @ rows, share[1:] @ rows[:-1]]),
    )


def _scale(frequencies: int, columns: int) -> Vectors:
    """Of the spectra of so many columns, so that products are those of the textures."""
    weight = np.full(frequencies, 2.0 / columns, np.float32)
    weight[0] = 1 / columns
    if columns % 2 == 0:
        weight[-1] = 1 / columns
    return np.asarray(np.sqrt(weight), np.float32)


def _vectors(spectra: Spectra, scale: Vectors) -> Vectors:
    """Vectors (N, D) whose products are the correlations of the textures of spectra."""
    scaled = np.ascontiguousarray(spectra * scale, np.complex64)
    return scaled.reshape(len(spectra), -1).view(np.float32)
