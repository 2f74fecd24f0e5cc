# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Correlation of textures over all rotations: coarse for all keyframes, in full for a few."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.statistics import parabola_peak
from sfa_localization.keyframes.texture import Spectra, Texture, columns_of

Scores = tuple[NDArray[np.float32], NDArray[np.float32]]

LIKE_A_PLACE = 0.42
"""Images of unknown places do not reach it (foreign gardens: 0.35, mirrored ones: 0.35, one image
0.43)."""
COARSE = 12
"""Frequencies of the coarse correlation."""


def correlate(spectrum: Spectra, others: Spectra, columns: int) -> Scores:
    """The largest correlation (K,) of the spectrum (rows, F) of a texture with each of K others
    (K, rows, F), and the shift (K,), in columns with a fraction, at which it is reached.
    """
    # At half columns too: else an image turned by half a column would look like another one.
    curves = columns_of(_products(spectrum, others), 2 * columns)
    top = curves.argmax(1)
    around = (top[:, None] + np.arange(-1, 2)) % curves.shape[1]
    before, peak, after = np.take_along_axis(curves, around, 1).T
    part = parabola_peak(before, peak, after)
    return 2 * peak - (before - after) * part / 2, np.asarray((top + part) / 2, np.float32)


def coarse(spectra: Spectra) -> Spectra:
    """The low frequencies of spectra (K, rows, F), summed over every four rows and of unit norm:
    (K, rows / 4, COARSE + 1), without a mean.
    """
    low = np.add.reduceat(spectra[:, :, : COARSE + 1], range(0, spectra.shape[1], 4), axis=1)
    low[:, :, 0] = 0
    return np.asarray(low / np.maximum(np.linalg.norm(low, axis=(1, 2), keepdims=True), 1e-9))


def coarse_scores(spectrum: Spectra, others: Spectra) -> Texture:
    """About proportional to the largest correlation (K,) of a spectrum (rows, F) with K others, of
    which their `coarse` spectra are given.
    """
    frequencies = others.shape[2]
    curves = columns_of(_products(coarse(spectrum[None])[0], others), 2 * frequencies)
    return np.asarray(curves.max(1))


def _products(spectrum: Spectra, others: Spectra) -> Spectra:
    return np.asarray(np.einsum('krf,rf->kf', others, spectrum.conj()))
