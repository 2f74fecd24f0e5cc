# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Textures: small panoramas of local contrast, their spectra over the columns, and how alike they
are over all rotations: coarsely for all keyframes, in full for a few.

Local contrast survives another light and season. Brightness also shows the sunlit side of things,
and seems to move them with the sun; their colors stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image
from sfa_localization.data.statistics import parabola_peak

Texture = NDArray[np.float32]
Spectra = NDArray[np.complex64]
Scores = tuple[Texture, Texture]

LIKE_A_PLACE = 0.42
"""Images of unknown places do not reach it (foreign gardens: 0.35, mirrored ones: 0.35, one image
0.43)."""
COARSE = 12
"""Frequencies of the coarse correlation."""

_COLUMNS = 80
_ROWS = 16
_COLOR_ROWS = 8
# Standard deviation of the blur that removes light and its slow changes, of the columns: 10 deg.
_BLUR = 1 / 37.5
# Added to the brightness (8 bit) and to the standard deviation of its logarithm: the noise of dark
# and of plain surfaces stays small beside texture.
_DARKEST = 8.0
_FLATTEST = 0.1
# Quantization of textures to one byte: steps per standard deviation.
_STEPS = 127 / 4.0


def texture(panorama: Image) -> Texture:
    """Local contrast of a panorama (H, W, 3) uint8, small: (rows, columns), zero mean, unit norm.

    The logarithm of the brightness minus its surroundings, over their standard deviation. Below it,
    in half as many rows, the same of red over green and of blue over both; a gray camera has none.
    """
    small = _small(panorama, _ROWS, _COLUMNS)
    few = _small(small, _COLOR_ROWS, _COLUMNS)
    light = _logarithm(np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.float32))
    blue, green, red = np.moveaxis(_logarithm(few), 2, 0)
    colors = np.dstack([red - green, blue - (red + green) / 2])
    return normalized(np.concatenate([*_contrast(light[:, :, None]), *_contrast(colors)]))


def _logarithm(image: Texture) -> Texture:
    return np.asarray(np.log(image + np.float32(_DARKEST)), np.float32)


def _contrast(values: Texture) -> Texture:
    """Channels (rows, columns, C) minus their surroundings, over the standard deviation of these:
    (C, rows, columns).
    """
    width = values.shape[1]
    margin = max(width // 6, 1)
    around = cv2.copyMakeBorder(values, 0, 0, margin, margin, cv2.BORDER_WRAP)
    detail = around - cv2.GaussianBlur(around, (0, 0), width * _BLUR)
    deviation = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), width * _BLUR))
    contrast = (detail / (deviation + np.float32(_FLATTEST)))[:, margin:-margin]
    return np.asarray(np.moveaxis(contrast.reshape(*values.shape), 2, 0), np.float32)


def _small(image: NDArray[Any], rows: int, columns: int) -> Texture:
    """An image (H, W) or (H, W, C) of at most so many rows and columns."""
    size = min(image.shape[1], columns), min(image.shape[0], rows)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _stretched(image: Texture, rows: int) -> Texture:
    """An image (H, W) of so many rows."""
    size = image.shape[1], rows
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.float32)


def normalized(image: Texture) -> Texture:
    """An image of zero mean and unit norm."""
    centered = image - image.mean()
    return np.asarray(centered / max(float(np.linalg.norm(centered)), 1e-6), np.float32)


def spectrum(textures: Texture) -> Spectra:
    """Fourier coefficients of the columns, (..., rows, F)."""
    return np.asarray(np.fft.rfft(textures), np.complex64)


def channels(rows: int) -> tuple[slice, ...]:
    """The rows of brightness, and of both color differences, in a texture of so many rows."""
    few = min(rows // 3, _COLOR_ROWS)
    light = rows - 2 * few
    return slice(0, light), slice(light, light + few), slice(light + few, rows)


def picture(texture: Texture, parts: Sequence[slice]) -> Image:
    """A texture (rows, columns) with these `channels` as an image (rows, columns, 3) uint8 BGR, in
    which three standard deviations of brightness or color are black and white.
    """
    light, red, blue = (texture[part] for part in parts)
    if len(red):
        red, blue = (_stretched(color, len(light)) for color in (red, blue))
    else:
        red = blue = np.zeros_like(light)
    rest = light - blue / 3
    bgr = np.dstack([light + 2 / 3 * blue, rest - red / 2, rest + red / 2])
    scaled = 128 + bgr * (127 / max(3 * float(bgr.std()), 1e-6))
    return np.asarray(np.clip(scaled, 0, 255), np.uint8)


def quantized(textures: Texture) -> NDArray[np.int8]:
    """Textures (N, rows, columns) with one byte a pixel."""
    deviation = np.maximum(np.std(textures, axis=(1, 2), keepdims=True), 1e-6)
    return np.asarray(np.clip(np.rint(textures * (_STEPS / deviation)), -127, 127), np.int8)


def spectra_of(textures: NDArray[np.int8]) -> Spectra:
    """Spectra (K, rows, F) of quantized textures (K, rows, columns), each of unit norm."""
    return spectrum(np.stack([normalized(t.astype(np.float32)) for t in textures]))


def turned(spectra: Spectra, angle: Array | float) -> Spectra:
    """Spectra (..., rows, F) of textures whose content is moved by `angle` (...) rad, to the left
    for positive ones.
    """
    phase = np.exp(1j * np.multiply.outer(angle, np.arange(spectra.shape[-1]))).astype(np.complex64)
    return np.asarray(spectra * phase[..., None, :])


def columns_of(spectra: Spectra, columns: int) -> Texture:
    """Textures (..., rows, columns) of spectra (..., rows, F). (SciPy takes too long to import.)"""
    return np.asarray(np.fft.irfft(spectra, columns), np.float32)


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
