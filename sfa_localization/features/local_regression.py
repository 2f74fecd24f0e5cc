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
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.features.observation import Match, Spectra

Vectors = NDArray[np.float32]

# Difference of correlation over which the weight of a keyframe falls by a factor of e.
_LIKENESS = 0.05
# Ridge of the regression, of the variance of all textures: with the noise of pixels alone it
# would follow each of them.
_RIDGE = 0.005
# Share of its likeness that an image keeps in any light.
_LEAST_GAIN = 0.2
# Standard deviation of a place by keyframes in another light, m, for an image that has as much of
# its own as in common with them; and what it grows by with the distance from them: another light
# takes part of the differences away that show it.
_BY_LIGHT, _BY_DISTANCE = 0.1, 0.4
# How often the drives are weighed by the distance of the place from their keyframes.
_WEIGHED = 2
# Parts of the panorama in which light and what hides the view are one error each: 22.5 deg.
_SECTORS = 16


def turned(spectra: Spectra, angle: Array | float) -> Spectra:
    """Spectra (..., rows, F) of textures whose content is moved by `angle` (...) rad, to the left
    for positive ones.
    """
    phase = np.exp(1j * np.multiply.outer(angle, np.arange(spectra.shape[-1]))).astype(np.complex64)
    return np.asarray(spectra * phase[..., None, :])


def columns_of(spectra: Spectra, columns: int, axis: int = -1) -> Vectors:
    """So many columns of what has these spectra. (SciPy would take as long to import as NumPy.)"""
    return np.asarray(np.fft.irfft(spectra, columns, axis), np.float32)


@dataclass(frozen=True, slots=True)
class _Regression:
    """A regression of an image: its `place` is that of the N keyframes by `shares` (N,) of sum 1.
    `combine` (3, N + 1 + M) makes of the vectors of N keyframes, of
    the image and of M changes what is left of the image, and the two vectors along which that moves
    the place. `changed` (M,) is how much of each change the image has.
    """

    place: Array
    shares: Array
    changed: Array
    unlike: float
    variation: float
    combine: Array


@dataclass(frozen=True, slots=True)
class Neighbors:
    """N keyframes at `places` (N, 2) m, among which images are located: the `vectors` (N, D) of
    their spectra (rows, F) at one heading, and the `products` (C, N, N) of these in C `channels`.

    Channels are rows, all in their order, that may be unlike for reasons of their own: each counts
    by how well the keyframes explain it. Textures have so many `columns`; keyframes of different
    `drives` (N,) may differ by their light.
    """

    vectors: Vectors
    places: Array
    drives: NDArray[np.int32]
    channels: tuple[slice, ...]
    columns: int
    products: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        products = _with(self.vectors, np.zeros((len(self.channels), 0, 0)), self.channels)
        object.__setattr__(self, 'products', products)

    def find(self, image: Spectra, angle: float = 0.0) -> Found:
        """The place of the spectrum of a texture, (1, rows, F), followed by its derivatives
        (1 + 2, rows, F) by roll and pitch, or without; at the heading of the keyframes when it is
        `turned` by an angle rad.
        """
        vectors, count = self.vectors_of(turned(image, angle), self.columns), len(self.vectors)
        seen = _with(vectors, self.products, self.channels, self.vectors)
        basis = _Basis.of(seen[:, count, :count].sum(axis=0), self.drives, self.places)
        turning, gains, products = self._compared(seen, vectors, basis.mean)
        trust = self._trust(gains, products, basis)
        found = _regressed(np.tensordot(trust, products, 1), basis)
        for _ in range(_WEIGHED if len(basis.means) > 1 else 0):
            basis = basis.about(found.place)
            turning, gains, products = self._compared(seen, vectors, basis.mean)
            found = _regressed(np.tensordot(trust, products, 1), basis)
        return Found(self, angle, vectors, turning, gains, trust, found)

    @staticmethod
    def vectors_of(spectra: Spectra, columns: int) -> Vectors:
        """Spectra (M, rows, F) of textures of so many columns as vectors (M, D), whose products are
        those of the textures.
        """
        weighted = spectra * weights(spectra.shape[2], columns)
        return weighted.reshape(len(spectra), -1).view(np.float32)

    def by_row(self, values: Array) -> Vectors:
        """Of each row (rows,) what is given of channels (C,)."""
        heights = [part.stop - part.start for part in self.channels]
        return np.repeat(values, heights).astype(np.float32)

    def _compared(self, seen: Array, image: Vectors, mean: Array) -> tuple[Vectors, Array, Array]:
        """With a mean by shares (N,) of the keyframes: its derivative by the angle, `turning`
        (1, D), the shares of its likeness to the mean that the image has kept in each channel,
        `gains` (C,), and the products (C, N + 2 + T, N + 2 + T) of keyframes, the image and its T
        derivatives, which get back what they lack, and `turning`.
        """
        count, rows = len(mean), self.channels[-1].stop
        spectra = (mean.astype(np.float32) @ self.vectors).view(np.complex64).reshape(rows, -1)
        by_angle = (1j * np.arange(spectra.shape[1])).astype(np.complex64)
        turning = (spectra * by_angle).view(np.float32).reshape(1, -1)
        alike = np.maximum(self.products @ mean @ mean, 1e-12)
        gains = np.maximum(seen[:, count, :count] @ mean / alike, _LEAST_GAIN)
        products = _with(turning, seen, self.channels, self.vectors, image)
        products[:, count:-1] /= gains[:, None, None]
        products[..., count:-1] /= gains[:, None, None]
        return turning, gains, products

    def _trust(self, gains: Array, products: Array, basis: _Basis) -> Array:
        """How much each channel counts, 1 at most: by how well the keyframes explain it there."""
        left = _regressed(np.tensordot(gains**2, products, 1), basis).combine[0]
        sizes = [part.stop - part.start for part in self.channels]
        errors = (products @ left) @ left / sizes
        trust = 1 / (errors + errors.min() + 1e-12)
        return np.asarray(trust / trust.max())


def _with(new: Vectors, products: Array, channels: Sequence[slice], *known: Vectors) -> Array:
    """Products (C, n, n) of vectors that are `known`, and M new ones: (C, n + M, n + M)."""
    size, count = new.shape[1] // channels[-1].stop, products.shape[1]
    both = np.empty((len(products), count + len(new), count + len(new)))
    both[:, :count, :count] = products
    for one, part in zip(both, channels, strict=True):
        own = np.s_[:, part.start * size : part.stop * size]
        one[count:] = np.hstack([new[own] @ each[own].T for each in (*known, new)])
    both[:, :count, count:] = both[:, count:, :count].swapaxes(1, 2)
    return both


@dataclass(frozen=True, slots=True)
class Found:
    """Where an image, turned by an `angle`, is `among` keyframes."""

    among: Neighbors
    angle: float
    image: Vectors
    turning: Vectors
    gains: Array
    trust: Array
    regression: _Regression

    @property
    def pose(self) -> Array:
        """Its place m, and the angle rad by which `turned` would still turn it to them, (3,)."""
        return np.append(self.regression.place, -self.regression.changed[-1])

    def match(self) -> Match:
        """With what else is known of it."""
        found, (left, moved) = self.regression, self._remainder()
        offset = self.among.places - found.place
        aside = float(np.hypot(*offset.mean(0)) / max(np.hypot(*offset.T).mean(), 1e-9))
        made = Match(self.pose, found.unlike, found.variation, aside, moved @ moved.T, left=left)
        tilt = found.changed[:-1] if len(found.changed) > 1 else made.tilt
        return replace(made, shares=found.shares, tilt=tilt)

    def _remainder(self) -> tuple[Spectra, Array]:
        """What is left of the image, as it was seen, (rows, F), and by how much, m, each sector of
        the panorama moves the place, (2, sectors): light and what hides the view are alike within
        one, not in all.
        """
        among, combine = self.among, self.regression.combine.astype(np.float32)
        gains, columns = among.by_row(self.gains), among.columns
        count, frequencies = len(among.vectors), columns // 2 + 1
        vectors = combine[:, count:-1] @ self.image / np.repeat(gains, 2 * frequencies)
        vectors += combine[:, -1:] * self.turning + combine[:, :count] @ among.vectors
        spectra = vectors.view(np.complex64).reshape(3, -1, frequencies)
        spectra = turned(spectra * (1 / weights(frequencies, columns)), -self.angle)
        left, *along = columns_of(spectra, columns)
        sectors = min(_SECTORS, columns)
        starts = np.arange(sectors) * columns // sectors
        moved = np.add.reduceat(among.by_row(self.trust) @ (along * left), starts, axis=1)
        return spectra[0] * gains[:, None], moved.astype(np.float64)


@dataclass(frozen=True, slots=True)
class _Basis:
    """What N keyframes are compared with: shares `mean` (N,) of the mean that is most like the
    image, `means` (D, N) of that of each drive's, which is the `owner` (D, N) of some, and the
    `likest` (D,), the largest correlation of each; `places` (N, 2) m, and their weights in the
    regression (N,), of sum 1.
    """

    mean: Array
    means: Array
    owner: Array
    likest: Array
    places: Array
    weight: Array

    @classmethod
    def of(cls, scores: Array, drives: NDArray[np.int32], places: Array) -> _Basis:
        """By the correlations (N,) of the keyframes with the image, which say how near they are
        among those of one drive.
        """
        owner = np.unique(drives)[:, None] == drives
        own = np.where(owner, scores, -np.inf)
        likest = own.max(axis=1)
        means = np.exp((own - likest[:, None]) / _LIKENESS)
        means /= means.sum(axis=1, keepdims=True)
        mean = np.exp((scores - scores.max()) / _LIKENESS)
        weight = means.sum(axis=0) / len(means)
        return cls(mean / mean.sum(), means, owner.astype(float), likest, places, weight)

    def about(self, place: Array) -> _Basis:
        """With a mean that counts each drive by how certain a place (2,) m is by it: a light that
        is more like that of the image is no use far away.
        """
        apart = self.means @ self.places - place
        by_light = _BY_LIGHT**2 * (np.maximum(self.likest, 0.1) ** -2 - 1)
        variance = by_light + _BY_DISTANCE**2 * (apart**2).sum(1)
        mean = (1 / np.maximum(variance, 1e-6)) @ self.means
        mean /= mean.sum()
        return replace(self, mean=mean, weight=mean)


def averaged(parts: Sequence[Match], weights: Sequence[float]) -> Match:
    """The mean of what several drives say of one image, all with what is left of it, by weights
    (N,); `Match.apart` is how far apart they put it.
    """
    if len(parts) == 1:
        return parts[0]
    share = np.array(weights) / np.sum(weights)

    def mean(values: Sequence[Array | float]) -> Array:
        return np.tensordot(share, np.array(values), 1)

    pose = mean([one.pose for one in parts])
    apart = np.array([one.pose for one in parts])[:, :2] - pose[:2]
    left = np.array([one.left for one in parts if one.left is not None])
    return Match(
        pose,
        float(mean([one.unlike for one in parts])),
        float(mean([one.variation for one in parts])),
        float(mean([one.aside for one in parts])),
        mean([one.noise for one in parts]),
        (apart.T * share) @ apart,
        facing=complex(share @ np.array([one.facing for one in parts])),
        left=np.tensordot(share.astype(np.float32), left, 1),
        tilt=mean([one.tilt for one in parts]),
    )


def _apart(products: Array, basis: _Basis) -> tuple[Array, Array, Array, float]:
    """What N keyframes and an image differ by, of the products (N + 1 + M, N + 1 + M) of these and
    M changes. Neither the drive, nor likeness to the mean, nor a change is a matter of the place:
    besides the products (N + 1, N + 1) of the differences what was taken out of them, shares
    (C, N + 1) of combinations (C, N + 1 + M), and the square of the mean.
    """
    count, means, owner = len(basis.mean), basis.means, basis.owner
    common = np.eye(len(products))[count:]
    common[0, :count], common[0, count] = basis.mean, 0.0
    apart = products[:, : count + 1].copy()
    apart[:, :-1] -= (products[:, :count] @ means.T) @ owner
    both = apart[: count + 1].copy()
    both[:-1] -= owner.T @ (means @ apart[:count])
    within = common @ products @ common.T
    square = max(float(within[0, 0]), 1e-12)
    within[np.diag_indices(len(common))] += 1e-9 * within.diagonal() + 1e-12
    along = common @ apart
    out = np.asarray(np.linalg.solve(within, along), float)
    return both - along.T @ out, out, common, square


def _regressed(products: Array, basis: _Basis) -> _Regression:
    """The regression by the products (N + 1 + M, N + 1 + M) of N keyframes, the image, and M
    changes that are no matter of the place.
    """
    count, means, owner = len(basis.mean), basis.means, basis.owner
    apart, out, common, square = _apart(products, basis)
    root = np.sqrt(basis.weight)[:, None]
    gram = apart[:-1, :-1] * root * root.T
    variation = float(gram.trace())
    gram.flat[:: count + 1] += max(_RIDGE * variation, 1e-12)
    offsets = basis.places - owner.T @ (means @ basis.places)
    wanted = np.column_stack([-apart[:-1, -1], offsets]) * root
    combine = np.zeros((3, len(products)))
    combine[0, count] = 1.0
    combine[:, :count] = (np.linalg.solve(gram, wanted) * root).T
    centered = combine[:, : count + 1].copy()
    combine[:, :count] -= (centered[:, :-1] @ owner.T) @ means
    shares = basis.mean - combine[0, :count]
    combine -= (centered @ out.T) @ common
    unlike = max(float(centered[0] @ apart @ centered[0]), 0.0) / square
    place, changed = shares @ basis.places, out[1:, -1]
    return _Regression(place, shares, changed, unlike, variation / square, combine)


@cache
def weights(frequencies: int, columns: int) -> Vectors:
    """Of spectra (..., rows, F), so that their products over rows and F are those of textures."""
    once = 2 * np.arange(frequencies) % columns == 0
    return np.asarray(np.sqrt(np.where(once, 1, 2) / columns), np.float32)
