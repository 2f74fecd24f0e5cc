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
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

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
class _Compared:
    """C channels and a mean of their N keyframes: its derivative by the angle, `turning` (D,), the
    shares of its likeness to the mean that the image has kept, `gains` (C,), and the
    products (C, N + 2 + T, N + 2 + T) of keyframes, the image and its derivatives, which get back
    what they lack, and `turning`.
    """

    turning: Vectors
    gains: Array
    products: Array


@dataclass(frozen=True, slots=True)
class _Textures:
    """N keyframes, an image, and T derivatives of it by what is no matter of its place: their
    `vectors` (N + 1 + T, D), in that order, and the products (C, N + 1 + T, N + 1 + T) of these in
    C channels, which are correlations; of a channel the vectors are those `parts`.
    """

    vectors: Vectors
    parts: tuple[slice, ...]
    products: Array
    frequencies: int

    @classmethod
    def of(cls, keyframes: Spectra, image: Spectra, channels: Sequence[slice]) -> _Textures:
        """Of spectra (N, rows, F) and (1 + T, rows, F), times `weights`."""
        both = np.concatenate([keyframes, image])
        count, rows, frequencies = both.shape
        vectors = both.reshape(count, -1).view(np.float32)
        size = 2 * frequencies
        parts = tuple(slice(*(size * end for end in one.indices(rows)[:2])) for one in channels)
        products = [vectors[:, part] @ vectors[:, part].T for part in parts]
        return cls(vectors, parts, np.array(products, np.float64), frequencies)

    def about(self, mean: Array) -> _Compared:
        """With a mean by shares (N,) of the keyframes."""
        count, size = len(mean), len(self.vectors)
        spectra = (mean.astype(np.float32) @ self.vectors[:count]).view(np.complex64)
        by_angle = np.tile(1j * np.arange(self.frequencies), len(spectra) // self.frequencies)
        turning = (spectra * by_angle.astype(np.complex64)).view(np.float32)
        products = np.zeros((len(self.parts), size + 1, size + 1))
        products[:, :-1, :-1] = self.products
        for product, part in zip(products, self.parts, strict=True):
            product[-1, :-1] = product[:-1, -1] = self.vectors[:, part] @ turning[part]
            product[-1, -1] = turning[part] @ turning[part]
        kept, whole = self.products[:, count, :count] @ mean, self.products[:, :count, :count]
        gains = np.maximum(kept / np.maximum(whole @ mean @ mean, 1e-12), _LEAST_GAIN)
        products[:, count:-1] /= gains[:, None, None]
        products[:, :, count:-1] /= gains[:, None, None]
        return _Compared(turning, gains, products)

    def remainder(
        self, found: _Regression, compared: _Compared, angle: float, columns: int
    ) -> tuple[Spectra, Array]:
        """What is left of the image, turned by an angle, (rows, F), and by how much, m, each
        channel moves the place in each sector of the panorama, (2, C, sectors): light and what
        hides the view are alike within one, not in all.
        """
        combine, changes = found.combine.astype(np.float32), len(found.changed)
        vectors = combine[:, -1:] * compared.turning
        for part, gain in zip(self.parts, compared.gains.tolist(), strict=True):
            own = combine[:, :-1].copy()
            own[:, -changes:] /= gain
            vectors[:, part] += own @ self.vectors[:, part]
        spectra = vectors.view(np.complex64).reshape(3, -1, self.frequencies)
        spectra = turned(spectra / weights(self.frequencies, columns), angle)
        left, *along = fft.irfft(spectra, columns)
        rows = [part.start // (2 * self.frequencies) for part in self.parts]
        sectors = min(_SECTORS, columns)
        starts = np.arange(sectors) * columns // sectors
        pull = np.add.reduceat(along * left, rows, axis=1)
        moved = np.add.reduceat(pull, starts, axis=2).astype(np.float64)
        gains = np.repeat(compared.gains, np.diff([*rows, len(left)])).astype(np.float32)
        return spectra[0] * gains[:, None], moved


@dataclass(frozen=True, slots=True)
class _Basis:
    """What N keyframes are compared with: shares `mean` (N,) of the mean that is most like the
    image, `means` (D, N) of that of each drive's, whose number is `drive` (N,), and the `likest`
    (D,), the largest correlation of each; `places` (N, 2) m, and their weights in the regression
    (N,), of sum 1.
    """

    mean: Array
    means: Array
    drive: NDArray[np.intp]
    likest: Array
    places: Array
    weight: Array

    @classmethod
    def of(cls, scores: Array, drives: NDArray[np.int32], places: Array) -> _Basis:
        """By the correlations (N,) of the keyframes with the image, which say how near they are
        among those of one drive.
        """
        numbers, drive = np.unique(drives, return_inverse=True)
        own = np.where(numbers[:, None] == drives, scores, -np.inf)
        likest = own.max(axis=1)
        means = np.exp((own - likest[:, None]) / _LIKENESS)
        means /= means.sum(axis=1, keepdims=True)
        mean = np.exp((scores - scores.max()) / _LIKENESS)
        weight = means.sum(axis=0) / len(numbers)
        return cls(mean / mean.sum(), means, drive, likest, places, weight)

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


def place_among(
    image: Spectra,
    keyframes: Spectra,
    places: Array,
    columns: int,
    channels: Sequence[slice] = (slice(None),),
    drives: NDArray[np.int32] | None = None,
    angle: float = 0.0,
) -> Match:
    """The place of the spectrum (rows, F) of a texture of so many columns, among those (N, rows,
    F) of keyframes, times `weights`, at places (N, 2) m, all at the heading of the image when it is
    `turned` by an angle rad; it may be followed by its derivatives (1 + 2, rows, F) by roll and
    pitch, which then are found too. The yaw of the match is the angle rad by which `turned` would
    still turn the image to them.

    `channels` are rows, all in their order, that may be unlike for reasons of their own: each
    counts by how well the keyframes explain it. Keyframes of different `drives` (N,) may differ by
    their light.
    """
    image, count = image if image.ndim == 3 else image[None], len(places)
    seen = turned(image, angle) * weights(image.shape[-1], columns)
    textures = _Textures.of(keyframes, seen, channels)
    scores = textures.products[:, count, :count].sum(axis=0)
    drives = np.zeros(count, np.int32) if drives is None else drives
    basis = _Basis.of(scores, drives, places)
    compared = textures.about(basis.mean)
    trust = _trust(textures, compared, basis)
    found = _regressed(np.tensordot(trust, compared.products, 1), basis)
    for _ in range(_WEIGHED if len(basis.means) > 1 else 0):
        basis = basis.about(found.place)
        compared = textures.about(basis.mean)
        found = _regressed(np.tensordot(trust, compared.products, 1), basis)
    left, moves = textures.remainder(found, compared, -angle, columns)
    moved = np.tensordot(moves, trust, (1, 0))
    offset = places - found.place
    aside = float(np.hypot(*offset.mean(0)) / max(np.hypot(*offset.T).mean(), 1e-9))
    *tilt, turning = found.changed
    pose, noise = np.append(found.place, -turning), moved @ moved.T
    made = Match(pose, found.unlike, found.variation, aside, noise, left=left, shares=found.shares)
    return replace(made, tilt=np.array(tilt)) if tilt else made


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
        left=np.tensordot(share.astype(np.float32), left, 1),
        tilt=mean([one.tilt for one in parts]),
    )


def _trust(textures: _Textures, compared: _Compared, basis: _Basis) -> Array:
    """How much each channel counts, 1 at most: by how well the keyframes explain it there."""
    products = np.tensordot(np.square(compared.gains), compared.products, 1)
    left = _regressed(products, basis).combine[0]
    sizes = [part.stop - part.start for part in textures.parts]
    errors = (compared.products @ left) @ left / sizes
    trust = 1 / (errors + errors.min() + 1e-12)
    return np.asarray(trust / trust.max())


@dataclass(frozen=True, slots=True)
class _Apart:
    """What N keyframes and an image differ by: the products (N + 1, N + 1) of these differences;
    what was taken out of them, shares `out` (C, N + 1) of combinations `common` (C, N + 1 + M) of
    keyframes, the image and M changes; and the `square` of the mean.
    """

    products: Array
    out: Array
    common: Array
    square: float

    @classmethod
    def of(cls, products: Array, basis: _Basis) -> _Apart:
        """Neither the drive, nor likeness to the mean, nor a change is a matter of the place: of
        the products (N + 1 + M, N + 1 + M) the parts of all vectors along these are taken out.
        """
        count, means, drive = len(basis.mean), basis.means, basis.drive
        common = np.zeros((len(products) - count, len(products)))
        common[0, :count] = basis.mean
        common[1:, count + 1 :] = np.eye(len(common) - 1)
        apart = products[:, : count + 1].copy()
        apart[:, :-1] -= (apart[:, :-1] @ means.T)[:, drive]
        both = apart[: count + 1].copy()
        both[:-1] -= (means @ both[:-1])[drive]
        within = common @ products @ common.T
        square = max(float(within[0, 0]), 1e-12)
        within[np.diag_indices(len(common))] += 1e-9 * within.diagonal() + 1e-12
        along = common @ apart
        out = np.asarray(np.linalg.solve(within, along), float)
        return cls(both - along.T @ out, out, common, square)


def _regressed(products: Array, basis: _Basis) -> _Regression:
    """The regression by the products (N + 1 + M, N + 1 + M) of N keyframes, the image, and M
    changes that are no matter of the place.
    """
    count, means, drive = len(basis.mean), basis.means, basis.drive
    apart = _Apart.of(products, basis)
    root = np.sqrt(basis.weight)
    gram, shown = apart.products[:-1, :-1] * np.outer(root, root), apart.products[:-1, -1]
    variation = float(np.trace(gram))
    ridge = max(_RIDGE * variation, 1e-12)
    offsets = basis.places - (means @ basis.places)[drive]
    wanted = np.column_stack([shown, offsets]) * root[:, None]
    share = (np.linalg.solve(gram + ridge * np.eye(count), wanted) * root[:, None]).T
    share[0] *= -1
    sums = np.stack([np.bincount(drive, one, len(means)) for one in share])
    of_image = np.array([1.0, 0.0, 0.0])
    centered = np.column_stack([share, of_image])
    combine = np.zeros((3, len(products)))
    own = share - sums @ means
    combine[:, : count + 1] = np.column_stack([own, of_image])
    combine -= (centered @ apart.out.T) @ apart.common
    shares = basis.mean - own[0]
    return _Regression(
        shares @ basis.places,
        shares,
        apart.out[1:, -1],
        max(float(centered[0] @ apart.products @ centered[0]), 0.0) / apart.square,
        variation / apart.square,
        combine,
    )


@cache
def weights(frequencies: int, columns: int) -> Vectors:
    """Of spectra (..., rows, F), so that their products over rows and F are those of textures."""
    once = 2 * np.arange(frequencies) % columns == 0
    return np.asarray(np.sqrt(np.where(once, 1, 2) / columns), np.float32)
