# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The position of an image among neighboring keyframes: a regression of positions on textures.

Turned to one heading, the textures q_k of N keyframes at places p_k differ by how far things move
over the panorama, which is about linear in the place over some decimeters. The mean of each
light, the likeness to the mean of all, and the changes by roll, pitch and heading are
projected out. Another light reduces all differences by one factor, so the image is scaled. With
A the Gram matrix of the residual textures, a their products with the residual image, and w the
weights of likeness, ridge regression gives

    c = (w^(1/2) A w^(1/2) + r I)^-1 w^(1/2) a,     p = sum_k (m_k + c_k) p_k.

The products are weighted by channel, by how well the keyframes explain each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.keyframes.texture import Spectra, Texture, columns_of

# Difference of correlation over which the weight of a keyframe falls by a factor of e.
_LIKENESS = 0.05
# Ridge of the regression, of the variance of all textures: with the noise of pixels alone the
# regression would follow each of them.
_RIDGE = 0.005
BORDER = 0.6
"""Beyond this `Fit.outward` a place is at the border of the keyframes, or outside."""
PARTS = 60
"""Independent numbers that an image counts as: neighboring pixels are one. From 20 to 200, places
are the same."""
_TINY = 1e-6
# Sectors of the panorama within which errors by light or occlusion are correlated: 22.5 degrees.
_SECTORS = 16
# An image keeps at least this part of its likeness to the mean of the keyframes in any light.
_LEAST_GAIN = 0.2


@dataclass(frozen=True, slots=True)
class Fit:
    """Where an image is among N keyframes: `place` (2,) m, the mean of their places by `shares`
    (N,) of sum 1; its heading `yaw` rad; and the `changes` (3,) rad of roll, pitch and heading that
    it shows.

    `unlike` is the squared norm of the unexplained part of the image over that of the explained
    part. `residual` (rows, F) is the spectrum of the unexplained part, and `variance` m^2 per axis
    the position variance that it causes if sectors of the panorama err independently. `outward` is
    the distance of the place from the middle of the keyframes, over their mean distance from it: 0
    among them, 0.64 at a straight border of theirs, 1 far beside all. `facing` is the mean of exp(i
    yaw) of the keyframes; `start` numbers the place about which they were chosen.
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
    start: int = 0

    @property
    def explained(self) -> float:
        """The part of the image that its place explains, 0 to 1."""
        return 1 / (1 + self.unlike)

    @property
    def evidence(self) -> float:
        """ln p(image | fit), up to a constant: see location.py."""
        return PARTS / 2 * math.log1p(1 / max(self.unlike, 1e-9))


def regress(
    image: Spectra,
    keyframes: Spectra,
    places: Array,
    lights: NDArray[np.int32],
    channels: Sequence[slice],
    columns: int,
) -> Fit:
    """Locate an image among N keyframes at `places` (N, 2) m, by their spectra (N, rows, F).

    `image` (4, rows, F) is the spectrum of its texture, and of the derivatives of that by roll,
    pitch and a turn, at the heading of the keyframes. Textures have so many `columns`, and their
    `channels` are rows; keyframes may be of several `lights` (N,).
    """
    count = len(keyframes)
    heights = [part.stop - part.start for part in channels]
    textures = _Textures.of(keyframes, image, channels, columns)
    products = textures.products()
    basis = _Basis.of(products[:, count, :count].sum(axis=0), lights, places)
    gains = basis.gains(products)
    scale = np.ones(products.shape[:2])
    scale[:, count:] /= gains[:, None]
    products *= scale[:, :, None] * scale[:, None]
    trust = _trust(gains, products, basis, heights)
    combinations, shares, unlike = _regression(np.tensordot(trust, products, 1), basis)
    residual, *directions = textures.combined(combinations * scale[:, None])
    trust_of_rows, gain_of_rows = np.repeat([trust, gains], heights, axis=1).astype(np.float32)
    variance = _variance(residual, directions, trust_of_rows, columns)
    place = shares @ places
    changes = -combinations[0, count + 1 :]
    residual = residual * gain_of_rows[:, None]
    outward = _outward(places - place)
    return Fit(place, shares, changes, unlike, residual, variance, outward)


@dataclass(frozen=True, slots=True)
class _Textures:
    """The real spectra (n, 2 h F) of n textures in each channel of h rows, times the `norm` (F,)
    with which their products are those of textures.
    """

    channels: list[Texture]
    norm: Texture

    @classmethod
    def of(
        cls, keyframes: Spectra, image: Spectra, channels: Sequence[slice], columns: int
    ) -> _Textures:
        once = 2 * np.arange(image.shape[2]) % columns == 0
        norm = np.sqrt(np.where(once, 1, 2) / columns).astype(np.float32)
        both = (np.concatenate([keyframes[:, part], image[:, part]]) * norm for part in channels)
        return cls([part.reshape(len(part), -1).view(np.float32) for part in both], norm)

    def products(self) -> Array:
        """Products (C, n, n) by channel."""
        return np.stack([part @ part.T for part in self.channels]).astype(float)

    def combined(self, shares: Array) -> Spectra:
        """Spectra (M, rows, F) of combinations with shares (C, M, n) of each channel."""
        parts = map(np.matmul, shares.astype(np.float32), self.channels)
        spectra = np.concatenate(list(parts), axis=1).view(np.complex64)
        return np.asarray(spectra.reshape(len(spectra), -1, len(self.norm)) / self.norm)


def _outward(offset: Array) -> float:
    """`Fit.outward` of a place from which keyframes lie at an offset (N, 2) m."""
    return float(np.hypot(*offset.mean(0)) / max(np.hypot(*offset.T).mean(), 1e-9))


@dataclass(frozen=True, slots=True)
class _Basis:
    """What N keyframes are compared with: the shares `mean` (N,) of the mean that is most like the
    image, and `centered` (N, N), which subtracts from each keyframe the likest mean of its light;
    their `places` (N, 2) m, and their `weight` (N,) in the regression, of sum 1.
    """

    mean: Array
    centered: Array
    places: Array
    weight: Array

    @classmethod
    def of(cls, scores: Array, lights: NDArray[np.int32], places: Array) -> _Basis:
        """By the correlations (N,) of the keyframes with the image, which say how near they are
        among those of one light.
        """
        numbers, light = np.unique(lights, return_inverse=True)
        means = _likest(np.where(numbers[:, None] == lights, scores, -np.inf))
        centered = np.eye(len(lights)) - means[light]
        return cls(_likest(scores), centered, places, means.mean(axis=0))

    def nuisance(self, number: int) -> Array:
        """What is projected out of so many textures (1 + M, n): likeness, tilt and heading."""
        count = len(self.mean)
        rows = np.eye(number)[count:]
        rows[0, :count] = self.mean
        rows[0, count] = 0.0
        return rows

    def gains(self, products: Array) -> Array:
        """The factors (C,) of the light on all differences: another light reduces them as it does
        the likeness of the image to the mean. By products (C, n, n)."""
        count = len(self.mean)
        square = products[:, :count, :count] @ self.mean @ self.mean
        likeness = products[:, count, :count] @ self.mean
        return np.maximum(likeness / np.maximum(square, 1e-12), _LEAST_GAIN)


def _likest(scores: Array) -> Array:
    """Weights (..., N) of sum 1 by correlations (..., N)."""
    weight = np.exp((scores - scores.max(axis=-1, keepdims=True)) / _LIKENESS)
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def _trust(gains: Array, products: Array, basis: _Basis, heights: Sequence[int]) -> Array:
    """How much each channel (C,) counts, 1 at most: by how well the keyframes explain it."""
    residual = _regression(np.tensordot(gains**2, products, 1), basis)[0][0]
    errors = (products @ residual) @ residual / heights
    trust = 1 / (errors + errors.min() + 1e-12)
    return np.asarray(trust / trust.max())


def _regression(products: Array, basis: _Basis) -> tuple[Array, Array, float]:
    """The regression by the products (n, n), n = N + 1 + M, of N keyframes, the image, and M
    changes by roll, pitch and heading: the combinations (3, n) of these that are the residual of
    the image and the two directions along which it moves the place; the shares (N,) of the
    keyframes; and `Fit.unlike`.
    """
    count = len(basis.mean)
    nuisance = basis.nuisance(len(products))
    within = nuisance @ products @ nuisance.T
    residuals = _residuals(nuisance, within, products, basis)
    gram = residuals @ products @ residuals.T
    root = np.sqrt(basis.weight)[:, None]
    system = gram[:-1, :-1] * root * root.T
    system += max(_RIDGE * system.trace(), 1e-12) * np.eye(count)
    targets = np.column_stack([-gram[:-1, -1], basis.centered @ basis.places]) * root
    solution = (np.linalg.solve(system, targets) * root).T
    combinations = solution @ residuals[:-1]
    combinations[0] += residuals[-1]
    # An image without any texture has no residual, and is not like the mean either.
    square = max(within[0, 0], 1e-12)
    likeness = max(nuisance[0] @ products[:, count] / square, 0.0)
    unexplained = max(combinations[0] @ products @ combinations[0] / square, 0.0)
    unlike = (unexplained + _TINY) / (likeness**2 + _TINY**2)
    shares = basis.mean - solution[0] @ basis.centered
    return combinations, shares, float(unlike)


def _residuals(nuisance: Array, within: Array, products: Array, basis: _Basis) -> Array:
    """The combinations (N + 1, n) that are keyframes and image without the mean of their light and
    the `nuisance` (1 + M, n), whose products are `within`.
    """
    count = len(basis.mean)
    ridge = np.diag(1e-9 * within.diagonal() + 1e-12)
    residuals = np.eye(count + 1, len(products))
    residuals[:count, :count] = basis.centered
    shares = np.linalg.solve(within + ridge, nuisance @ products @ residuals.T)
    return np.asarray(residuals - shares.T @ nuisance)


def _variance(
    residual: Spectra, directions: Sequence[Spectra], trust: Texture, columns: int
) -> float:
    """`Fit.variance` of a residual, from textures along the directions of the place and the `trust`
    (rows,): errors by light and occlusion are correlated within a sector, independent between
    sectors.
    """
    textures = columns_of(np.stack([residual, *directions]), columns)
    moved = trust @ (textures[1:] * textures[0])
    sectors = min(_SECTORS, columns)
    starts = np.arange(sectors) * columns // sectors
    by_sector = np.add.reduceat(moved, starts, axis=1).astype(float)
    return float((by_sector**2).sum()) / 2
