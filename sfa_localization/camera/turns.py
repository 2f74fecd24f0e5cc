# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Turns seen in panoramas: a robot that turns shifts the columns of its panorama.

The shift between neighboring images is measured without any map or training.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.run import BATCH, Image, Panoramas
from sfa_localization.data.statistics import parabola_peak

Texture = NDArray[np.float32]

_COLUMNS, _ROWS = 200, 10
# Of what is kept of each image: enough to see whether it changed.
_FEW_COLUMNS = 50
# Structure wider than this part of the panorama is light, not landmarks.
_WIDEST = 0.2
# What every image shows alike (the robot, a mask) is the mean of so many that differ so much.
_STATIC_MIN, _STATIC_MAX, _DIFFERENT = 8, 64, 0.95
# What is left beside it shows a turn only where one shift stands out by so many standard deviations
# of all. Of a robot that hardly turns, that mean holds the surroundings, and noise is left: by 3.
_STANDS_OUT = 3.2
# Contrast beyond a factor e, as at the edge of a mask, counts no more.
_CONTRAST = np.float32(1.0)


class _Shift(NamedTuple):
    """Columns by which one texture must be shifted to give the other; by how many standard
    deviations it is then more alike than elsewhere, and the square sum of what differs still.
    """

    columns: float
    stands_out: float
    error: float


class VisualGyro:
    """Heading from the shift of neighboring panoramas: fed with images in order, it adds up.

    `clockwise`: whether columns grow clockwise seen from above.
    """

    def __init__(self, clockwise: bool = True) -> None:
        self._sign = 1.0 if clockwise else -1.0
        self._before: Texture | None = None
        self._static: Texture | None = None
        self._last_static: Texture | None = None
        self._statics = 0
        self.yaw_rad = 0.0

    def add(self, image: Image) -> float:
        """The heading (rad, wrapped, from the first image on) after a panorama (H, W, C) uint8."""
        texture = _texture(image)
        if self._before is None or self._before.shape != texture.shape:
            self._before, self._static, self._statics = texture, np.zeros_like(texture), 0
            self._last_static = texture
            return self.yaw_rad
        shift = _shift(self._before, texture)
        if self._static is not None and self._statics >= _STATIC_MIN:
            rest = _shift(self._before - self._static, texture - self._static)
            if rest.stands_out > _STANDS_OUT and rest.error < shift.error:
                shift = rest
        self._learn_static(texture)
        self._before = texture
        turn = self._sign * shift.columns * 2 * np.pi / texture.shape[1]
        self.yaw_rad = float(wrap_angle(self.yaw_rad + turn))
        return self.yaw_rad

    @property
    def texture(self) -> NDArray[np.int8]:
        """Local contrast of the last image, small (rows, columns), of zero mean all around."""
        assert self._before is not None
        size = _FEW_COLUMNS, _ROWS
        small = cv2.resize(self._before, size, interpolation=cv2.INTER_AREA)
        return np.asarray(np.rint(small * (127 / _CONTRAST)), np.int8)

    def _learn_static(self, texture: Texture) -> None:
        """Average images that differ: a standing robot's surroundings are not a part of it."""
        assert self._last_static is not None and self._static is not None
        if _likeness(texture, self._last_static) > _DIFFERENT:
            return
        self._last_static, self._statics = texture, min(self._statics + 1, _STATIC_MAX)
        self._static += (texture - self._static) / np.float32(self._statics)


def _texture(image: Image) -> Texture:
    """Rows and columns of logarithmic brightness, free of what changes slowly around."""
    height, width = min(image.shape[0], _ROWS), min(image.shape[1], _COLUMNS)
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.shape[2] == 3 else image[..., 0]
    small = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    light = np.log1p(small.astype(np.float32))
    reach = max(int(width * _WIDEST) // 2, 1)
    wide = np.concatenate([light[:, -reach:], light, light[:, :reach]], axis=1)
    mean = cv2.blur(wide, (2 * reach + 1, 1), borderType=cv2.BORDER_REPLICATE)
    return np.clip(light - mean[:, reach:-reach], -_CONTRAST, _CONTRAST)


def _likeness(a: Texture, b: Texture) -> float:
    """Correlation of two textures."""
    power = float((a * a).sum()) * float((b * b).sum())
    return float((a * b).sum()) / np.sqrt(power) if power > 0 else 1.0


def _shift(before: Texture, after: Texture) -> _Shift:
    """The shift, to a part of a column, by which one texture gives the other best."""
    width = before.shape[1]
    product = np.conj(np.fft.rfft(before, axis=1)) * np.fft.rfft(after, axis=1)
    score = np.fft.irfft(product.sum(0), width)
    top = int(np.argmax(score))
    left, middle, right = score[[top - 1, top, (top + 1) % width]].astype(float)
    columns = top + float(parabola_peak(left, middle, right))
    spread, powers = float(score.std()), float((before * before).sum() + (after * after).sum())
    top_score = float(middle)
    return _Shift(columns, top_score / spread if spread > 0 else 0.0, powers - 2 * top_score)


def turns_and_textures(
    panoramas: Panoramas, clockwise: bool = True
) -> tuple[list[float], NDArray[np.int8]]:
    """Of N panoramas the headings rad, and textures (N, rows, columns), of a `VisualGyro`."""
    gyro = VisualGyro(clockwise)
    images = (image for batch in panoramas.batches(BATCH) for image in batch)
    yaws, textures = zip(*((gyro.add(image), gyro.texture) for image in images), strict=True)
    return list(yaws), np.stack(textures)


def headings(panoramas: Panoramas, clockwise: bool = True) -> Iterator[float]:
    """The headings rad, one for each panorama, that a `VisualGyro` adds up."""
    gyro = VisualGyro(clockwise)
    for batch in panoramas.batches(BATCH):
        for image in batch:
            yield gyro.add(image)
