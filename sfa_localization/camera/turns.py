# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turns of the robot measured in panoramas: they shift the columns of neighboring images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import BATCH, Image, Panoramas
from sfa_localization.data.statistics import parabola_peak

Texture = NDArray[np.float32]

_COLUMNS = 200
_ROWS = 10
_FEW_COLUMNS = 50  # of the textures that are stored
_WIDEST = 0.2  # of the panorama: wider structures are light, not landmarks
# The mean of this many images with correlations below _DIFFERENT shows only constant parts: the
# robot, a mask.
_STATIC_MIN = 8
_STATIC_MAX = 64
_DIFFERENT = 0.95
# Textures without that mean count where their peak exceeds this many standard deviations. If the
# robot hardly turns, the mean contains the surroundings, and the rest is noise with a peak of 3.
_PROMINENT = 3.2
_CONTRAST = np.float32(1.0)  # logarithmic; more, as at the edge of a mask, is clipped


class _Shift(NamedTuple):
    """Columns by which one texture is shifted against another, the prominence of the peak of their
    correlation in standard deviations, and the squared sum of the residual.
    """

    columns: float
    prominence: float
    residual: float


class VisualGyro:
    """Integrates the heading from the shifts between neighboring panoramas, added in order.

    `clockwise`: whether columns grow clockwise seen from above.
    """

    def __init__(self, clockwise: bool = True) -> None:
        self._sign = 1.0 if clockwise else -1.0
        self._before = self._static = self._last_static = np.zeros((0, 0), np.float32)
        self._statics = 0
        self.yaw_rad = 0.0

    def add(self, image: Image) -> float:
        """The heading (rad, wrapped, 0 at the first image) after a panorama (H, W, C) uint8."""
        texture = _texture(image)
        if self._before.shape != texture.shape:
            self._static = np.zeros_like(texture)
            self._statics = 0
            self._last_static = texture
        else:
            shift = _shift(self._before, texture)
            if self._statics >= _STATIC_MIN:
                rest = _shift(self._before - self._static, texture - self._static)
                if rest.prominence > _PROMINENT and rest.residual < shift.residual:
                    shift = rest
            self._learn_static(texture)
            turn = self._sign * shift.columns * 2 * np.pi / texture.shape[1]
            self.yaw_rad = float(wrap_angle(self.yaw_rad + turn))
        self._before = texture
        return self.yaw_rad

    @property
    def texture(self) -> NDArray[np.int8]:
        """Local contrast of the last image (rows, columns), with zero mean in each row."""
        size = _FEW_COLUMNS, _ROWS
        small = cv2.resize(self._before, size, interpolation=cv2.INTER_AREA)
        return np.asarray(np.rint(small * (127 / _CONTRAST)), np.int8)

    def _learn_static(self, texture: Texture) -> None:
        """Average images that differ, so that surroundings of a standing robot do not count."""
        if _likeness(texture, self._last_static) > _DIFFERENT:
            return
        self._last_static, self._statics = texture, min(self._statics + 1, _STATIC_MAX)
        self._static += (texture - self._static) / np.float32(self._statics)


def _texture(image: Image) -> Texture:
    """Logarithmic brightness (rows, columns) minus its wide running mean around."""
    height = min(image.shape[0], _ROWS)
    width = min(image.shape[1], _COLUMNS)
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.shape[2] == 3 else image[..., 0]
    small = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    light = np.log1p(small.astype(np.float32))
    reach = max(int(width * _WIDEST) // 2, 1)
    wide = np.concatenate([light[:, -reach:], light, light[:, :reach]], axis=1)
    mean = cv2.blur(wide, (2 * reach + 1, 1), borderType=cv2.BORDER_REPLICATE)
    return np.clip(light - mean[:, reach:-reach], -_CONTRAST, _CONTRAST)


def _likeness(a: Texture, b: Texture) -> float:
    """Correlation of two textures."""
    power = float(np.sum(a**2)) * float(np.sum(b**2))
    return float(np.sum(a * b)) / np.sqrt(power) if power > 0 else 1.0


def _shift(before: Texture, after: Texture) -> _Shift:
    """The shift between two textures, to a fraction of a column, at the peak of correlation."""
    width = before.shape[1]
    product = np.conj(np.fft.rfft(before, axis=1)) * np.fft.rfft(after, axis=1)
    score = np.fft.irfft(product.sum(0), width)
    top = int(np.argmax(score))
    lower, peak, upper = score[[top - 1, top, (top + 1) % width]].astype(float)
    columns = top + float(parabola_peak(lower, peak, upper))
    prominence = float(peak / score.std()) if score.std() > 0 else 0.0
    return _Shift(columns, prominence, float(np.sum(before**2 + after**2) - 2 * peak))


def turns_and_textures(
    panoramas: Panoramas, clockwise: bool = True
) -> tuple[Array, NDArray[np.int8]]:
    """Headings rad, and textures (N, rows, columns), of N panoramas by a `VisualGyro`."""
    gyro = VisualGyro(clockwise)
    images = (image for batch in panoramas.batches(BATCH) for image in batch)
    yaws, textures = zip(*((gyro.add(image), gyro.texture) for image in images), strict=True)
    return np.array(yaws), np.stack(textures)


def headings(panoramas: Panoramas, clockwise: bool = True) -> Iterator[float]:
    """The heading rad of each panorama by a `VisualGyro`."""
    gyro = VisualGyro(clockwise)
    return (gyro.add(image) for batch in panoramas.batches(BATCH) for image in batch)
