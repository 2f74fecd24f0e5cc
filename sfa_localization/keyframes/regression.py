# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where among neighboring keyframes an image was taken: a regression of their places on textures.

Turned to one heading, the textures q_k of N keyframes at places p_k differ by how far things move
over the panorama, which is about linear in the place over some decimeters. Differences that no
place makes are projected out: those of the lights of drives, of likeness to the mean, and of roll,
pitch and heading. Another light takes part of all differences away, which the image gets back. With
A the Gram matrix of what is left, a the products of the image with it, and w the weights of
likeness, ridge regression gives

    c = (w^(1/2) A w^(1/2) + r I)^-1 w^(1/2) a,     p = sum_k (m_k + c_k) p_k.

The products are weighted by channel, by how well the keyframes explain each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.keyframes.texture import Spectra, Texture, columns_of

# Difference of correlation over which the weight of a keyframe falls by a factor of e.
_LIKENESS = 0.05
# Ridge of the regression, of the variance of all textures: with the noise of pixels alone it
# would follow each of them.
_RIDGE = 0.005
BORDER = 0.6
"""Beyond this `Fit.outward` a place is at the border of the keyframes, or beside them."""
_TINY = 1e-6
# Parts of the panorama in which light and what hides the view are one error each: 22.5 deg.
_SECTORS = 16
# Of its likeness to the mean of the keyframes an image keeps so much in any light.
_LEAST_GAIN = 0.2


@dataclass(frozen=True, slots=True)
class Fit:
    """Where an image is among N keyframes: the `place` (2,) m is that of these by `shares` (N,) of
    sum 1. The image is turned by `yaw` rad, and has so much of the `changes` (3,) rad by roll,
    pitch and heading.

    `unlike` is what no place explains of the image, by its square, as a part of what it explains.
    `residual` (rows, F) is the spectrum of that, and `variance` m^2 what it makes of the place,
    along each axis, where sectors of the panorama err independently. `outward` is how far the place
    is from the middle of the keyframes, of their mean distance: 0 among them, 0.64 at a straight
    border of theirs, 1 far beside all. `facing` is the mean of exp(i yaw) of the keyframes.
    """

    place: Array
    shares: Array
    changes: Array
    unlike: float
    residual: Spectra
    variance: float
    outward: float
    yaw: float = 0.0
    facing: complex = 0j

    @property
    def explained(self) -> float:
        """The part of the image that its place explains, 0 to 1."""
        return 1 / (1 + self.unlike)


@dataclass(frozen=True, slots=True)
class _Regression:
    """`combine` (3, N + 1 + M) makes of the vectors of N keyframes, of the image and of M changes
    what is left of the image, and the two vectors along which that moves the `place`.
    """

    place: Array
    shares: Array
    changes: Array
    unlike: float
    combine: Array


@dataclass(frozen=True, slots=True)
class Neighbors:
    """N keyframes at `places` (N, 2) m, among which images are located: the `vectors` (N, D) of
    their spectra (rows, F) at one heading, and the `products` (C, N, N) of these in C `channels`,
    which are rows, all in their order. Textures have so many `columns`; keyframes of different
    `drives` (N,) may differ by their light.
    """

    vectors: Texture
    places: Array
    drives: NDArray[np.int32]
    channels: tuple[slice, ...]
    columns: int
    products: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        products = _with(self.vectors, np.zeros((len(self.channels), 0, 0)), self.channels)
        object.__setattr__(self, 'products', products)

    def fit(self, image: Spectra) -> Fit:
        """Of the spectrum of a texture and of its derivatives by roll, pitch and a turn, at the
        heading of the keyframes, (4, rows, F).
        """
        vectors, count = vectors_of(image, self.columns), len(self.vectors)
        products = _with(vectors, self.products, self.channels, self.vectors)
        basis = _Basis.of(products[:, count, :count].sum(axis=0), self.drives, self.places)
        gains = self._gains(products, basis)
        products[:, count:] /= gains[:, None, None]
        products[..., count:] /= gains[:, None, None]
        trust = self._trust(gains, products, basis)
        found = _regressed(np.tensordot(trust, products, 1), basis)
        vectors /= self._by_row(gains).repeat(vectors.shape[1] // self.channels[-1].stop)
        residual, moved = self._residual(found.combine.astype(np.float32), vectors, trust)
        residual *= self._by_row(gains)[:, None]
        offset = self.places - found.place
        outward = float(np.hypot(*offset.mean(0)) / max(np.hypot(*offset.T).mean(), 1e-9))
        of_place = found.place, found.shares, found.changes, found.unlike
        return Fit(*of_place, residual, float((moved**2).sum()) / 2, outward)

    def _gains(self, products: Array, basis: _Basis) -> Array:
        """Of its likeness to the mean of the keyframes the part (C,) that the image has kept in
        each channel, which differences from the mean have kept, too.
        """
        alike = np.maximum(self.products @ basis.mean @ basis.mean, 1e-12)
        count = len(basis.mean)
        return np.maximum(products[:, count, :count] @ basis.mean / alike, _LEAST_GAIN)

    def _by_row(self, values: Array) -> NDArray[np.float32]:
        """Of each row (rows,) what is given of channels (C,)."""
        heights = [part.stop - part.start for part in self.channels]
        return np.repeat(values, heights).astype(np.float32)

    def _trust(self, gains: Array, products: Array, basis: _Basis) -> Array:
        """How much each channel counts, 1 at most: by how well the keyframes explain it there."""
        residual = _regressed(np.tensordot(gains**2, products, 1), basis).combine[0]
        sizes = [part.stop - part.start for part in self.channels]
        errors = (products @ residual) @ residual / sizes
        trust = 1 / (errors + errors.min() + 1e-12)
        return np.asarray(trust / trust.max())

    def _residual(
        self, combine: Texture, image: Texture, trust: Array
    ) -> tuple[Spectra, NDArray[np.float64]]:
        """What is left of the image, (rows, F), and by how much, m, each sector of the panorama
        moves the place, (2, sectors): light and what hides the view are alike within one, not in
        all.
        """
        columns, count = self.columns, len(self.vectors)
        frequencies = columns // 2 + 1
        vectors = combine[:, count:] @ image + combine[:, :count] @ self.vectors
        spectra = vectors.view(np.complex64).reshape(3, -1, frequencies)
        spectra = spectra * (1 / weights(frequencies, columns))
        left, *along = columns_of(spectra, columns)
        sectors = min(_SECTORS, columns)
        starts = np.arange(sectors) * columns // sectors
        moved = np.add.reduceat(self._by_row(trust) @ (along * left), starts, axis=1)
        return spectra[0], moved.astype(np.float64)


@dataclass(frozen=True, slots=True)
class _Basis:
    """What N keyframes are compared with: shares `mean` (N,) of the mean that is most like the
    image, `means` (D, N) of that of each drive's, which is the `owner` (D, N) of some; `places`
    (N, 2) m, and their weights in the regression (N,), of sum 1.
    """

    mean: Array
    means: Array
    owner: Array
    places: Array
    weight: Array

    @classmethod
    def of(cls, scores: Array, drives: NDArray[np.int32], places: Array) -> _Basis:
        """By the correlations (N,) of the keyframes with the image, which say how near they are
        among those of one drive.
        """
        owner = np.unique(drives)[:, None] == drives
        own = np.where(owner, scores, -np.inf)
        means = np.exp((own - own.max(axis=1, keepdims=True)) / _LIKENESS)
        means /= means.sum(axis=1, keepdims=True)
        mean = np.exp((scores - scores.max()) / _LIKENESS)
        return cls(mean / mean.sum(), means, owner.astype(float), places, means.mean(axis=0))


def vectors_of(spectra: Spectra, columns: int) -> Texture:
    """Spectra (M, rows, F) of textures of so many columns as vectors (M, D), whose products are
    those of the textures.
    """
    weighted = spectra * weights(spectra.shape[2], columns)
    return weighted.reshape(len(spectra), -1).view(np.float32)


def _with(new: Texture, products: Array, channels: Sequence[slice], *known: Texture) -> Array:
    """Products (C, n, n) of vectors that are `known`, and M new ones: (C, n + M, n + M)."""
    size, count = new.shape[1] // channels[-1].stop, products.shape[1]
    both = np.empty((len(products), count + len(new), count + len(new)))
    both[:, :count, :count] = products
    for of_channel, part in zip(both, channels, strict=True):
        own = np.s_[:, part.start * size : part.stop * size]
        of_channel[count:] = np.hstack([new[own] @ each[own].T for each in (*known, new)])
    both[:, :count, count:] = both[:, count:, :count].swapaxes(1, 2)
    return both


def _apart(products: Array, basis: _Basis) -> tuple[Array, Array, Array, float]:
    """What N keyframes and an image differ by, of the products (N + 1 + M, N + 1 + M) of these and
    M changes, after drive mean, likeness and changes are projected out: the Gram matrix
    (N + 1, N + 1) of the residuals; shares (C, N + 1) of the combinations (C, N + 1 + M) that were
    projected out; and the square of the mean.
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
    gram.flat[:: count + 1] += max(_RIDGE * float(gram.trace()), 1e-12)
    offsets = basis.places - owner.T @ (means @ basis.places)
    wanted = np.column_stack([-apart[:-1, -1], offsets]) * root
    combine = np.zeros((3, len(products)))
    combine[0, count] = 1.0
    combine[:, :count] = (np.linalg.solve(gram, wanted) * root).T
    centered = combine[:, : count + 1].copy()
    combine[:, :count] -= (centered[:, :-1] @ owner.T) @ means
    shares = basis.mean - combine[0, :count]
    combine -= (centered @ out.T) @ common
    # An image without any texture has nothing left, and keeps nothing of the mean either.
    kept = float(common[0] @ products[:, count]) / square
    unexplained = max(float(centered[0] @ apart @ centered[0]), 0.0) / square
    unlike = (unexplained + _TINY) / (max(kept, 0.0) ** 2 + _TINY**2)
    return _Regression(shares @ basis.places, shares, out[1:, -1], unlike, combine)


@cache
def weights(frequencies: int, columns: int) -> Texture:
    """Of spectra (..., rows, F), so that their products over rows and F are those of textures."""
    once = 2 * np.arange(frequencies) % columns == 0
    return np.asarray(np.sqrt(np.where(once, 1, 2) / columns), np.float32)
