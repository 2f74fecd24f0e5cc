# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How alike textures are, over all rotations: coarse for all keyframes, in full for few."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Indices
from sfa_localization.data.statistics import parabola_peak
from sfa_localization.keyframes.texture import Spectra, Texture, columns_of

Scores = tuple[Texture, Texture]

LIKE_A_PLACE = 0.42
"""Unknown places do not reach it (foreign gardens: 0.35, mirrored ones: 0.35, one image 0.43)."""
COARSE = 12
"""Frequencies of the coarse correlation."""


def correlate(spectra: Spectra, keyframes: Spectra, columns: int) -> Scores:
    """Largest correlation of T spectra (T, rows, F) with each of K (K, rows, F), (T, K), and the
    shift of columns, to a part of one of so many, at which it is reached.
    """
    return peaks(keyframes.transpose(2, 0, 1) @ np.conj(spectra).transpose(2, 1, 0), columns)


def peaks(products: Spectra, columns: int) -> Scores:
    """The same by products (F, K, T) over the rows."""
    # Half columns: between whole ones, the same image would seem to be another one.
    curves = columns_of(products, 2 * columns, axis=0)
    top = curves.argmax(0)
    around = (top + np.arange(-1, 2)[:, None, None]) % len(curves)
    left, middle, right = np.take_along_axis(curves, around, 0)
    part = parabola_peak(left, middle, right)
    return (2 * middle - (left - right) * part / 2).T, np.asarray((top + part) / 2, np.float32).T


def coarse(spectra: Spectra) -> Texture:
    """Low frequencies of spectra (K, rows, F), the sums of four rows each, of unit norm: real parts
    and below them imaginary ones, (F', 2 rows', K).
    """
    low = _low(spectra).transpose(2, 1, 0)
    return np.ascontiguousarray(np.concatenate([low.real, low.imag], axis=1))


def coarse_scores(spectra: Spectra, keyframes: Texture) -> NDArray[np.float32]:
    """About the largest correlation (T, K) of spectra (T, rows, F) with keyframes' `coarse`."""
    low, (frequencies, rows, count) = _low(spectra).transpose(2, 0, 1), keyframes.shape
    parts = np.concatenate([low.real, low.imag, -low.imag, low.real], axis=2)
    images = parts.reshape(frequencies, -1, 2, rows).swapaxes(1, 2)
    products = images.reshape(frequencies, -1, rows) @ keyframes
    curves = _waves(frequencies) @ products.reshape(2 * frequencies, -1)
    return np.asarray(curves.max(0).reshape(len(spectra), count))


@cache
def _waves(frequencies: int) -> Texture:
    """What makes correlations (N,) at all headings of the parts (2 F,) of their coefficients."""
    angle = np.outer(np.arange(2 * frequencies + 2), np.arange(1, frequencies + 1))
    waves = np.exp(-1j * angle * np.pi / (frequencies + 1))
    return np.asarray(waves.astype(np.complex64).view(np.float32))


def _low(spectra: Spectra) -> Spectra:
    """Low frequencies of spectra (T, rows, F), the sums of four rows each, of unit norm."""
    low = np.add.reduceat(spectra[:, :, 1 : COARSE + 1], range(0, spectra.shape[1], 4), axis=1)
    return np.asarray(low / np.maximum(np.linalg.norm(low, axis=(1, 2), keepdims=True), 1e-9))


def least(values: NDArray[Any], number: int) -> Indices:
    """Where so many values (K,) are least, in their order."""
    few = len(values) <= number
    rows = np.arange(len(values)) if few else np.argpartition(values, number)[:number]
    return rows[np.argsort(values[rows])]
