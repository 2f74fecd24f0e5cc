# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Uneven ground: what roll and pitch of the robot do to a panorama, and how they are found.

A robot with a small roll r and pitch p (rad, right-handed about x forward and y left; z is up)
sees in the direction of elevation e and azimuth a what it would see on flat ground at

    e + r sin a - p cos a     and     a - tan e (r cos a + p sin a).

So the derivatives of a panorama by roll and pitch are panoramas too, and a column moves up or down
by a sine of its azimuth.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.sphere import Sphere, rotation
from sfa_localization.data.statistics import parabola_peak
from sfa_localization.keyframes.texture import Spectra, Texture, columns_of, turned

_LARGEST = np.radians(12.0)
"""The largest tilt that is tried along each axis."""
_UNLIKELY = 0.01 / np.radians(4.0) ** 2
"""The correlation is reduced by this, times the square of the tilt in rad: few tilts are above 4
degrees."""


def visible(tilt: Array, rows: int, columns: int, sphere: Sphere) -> NDArray[np.bool_]:
    """Where a `leveled` panorama (rows, columns) shows what the camera saw."""
    up = sphere.rays(rows, columns) @ rotation(*tilt)[:, 2]
    return np.asarray((up > np.sin(sphere.low)) & (up < np.sin(sphere.high)))


def derivatives(texture: Texture, channels: Sequence[slice], sphere: Sphere) -> Texture:
    """Derivatives of a texture (rows, columns) by roll and pitch, (2, rows, columns) per rad;
    each of the `channels`, which are rows, is a panorama.
    """
    columns = texture.shape[1]
    upward = []
    elevations = []
    for part in channels:
        count = part.stop - part.start
        elevations.append(sphere.elevations(count))
        upward.append(np.gradient(texture[part], (sphere.low - sphere.high) / count, axis=0))
    sideways = np.roll(texture, -1, 1) - np.roll(texture, 1, 1)
    sideways = sideways * np.tan(np.concatenate(elevations))[:, None]
    sideways *= (-1 if sphere.clockwise else 1) * columns / (4 * np.pi)
    azimuth = sphere.azimuths(columns)
    up = np.concatenate(upward)
    sin = np.sin(azimuth)
    cos = np.cos(azimuth)
    return np.stack([up * sin - sideways * cos, -sideways * sin - up * cos])


def find_tilt(
    image: Spectra,
    others: Spectra,
    turn: Array,
    columns: int,
    channels: Sequence[slice],
    sphere: Sphere,
) -> tuple[Array, Array]:
    """Roll and pitch (M, 2) rad with the highest correlation between a texture and each of M level
    ones, and the correlations (M,), reduced for large tilts.

    The textures are given by the spectra of their columns, (rows, F) and (M, rows, F); the others
    have the heading of the image when `turned` by `turn` (M,) rad. `channels` are rows of one
    panorama each, of the first one the most. All tilts up to 12 degrees in steps of one row are
    tried: the correlation of an image with a tilt is a sum over the columns, each moved up or down.
    """
    rows = channels[0].stop
    # Rows of a channel with fewer of them are as many finer ones.
    fine = np.stack(
        [part.start + np.arange(rows) * (part.stop - part.start) // rows for part in channels]
    )
    level = columns_of(turned(others, turn), columns)[:, fine]
    row_rad = (sphere.high - sphere.low) / rows
    most = max(min(round(float(_LARGEST) / row_rad), rows // 2 - 1), 1)
    by_step = _by_step(columns_of(image, columns)[fine], level, most)
    scores = np.tensordot(by_step, _moves(sphere, columns, most), ((0, 2), (0, 1)))
    squares = np.square(np.arange(-most, most + 1))
    scores -= (_UNLIKELY * row_rad**2 * np.add.outer(squares, squares)).astype(np.float32)
    return row_rad * (_peaks(scores) - most), scores.max((1, 2))


@lru_cache(maxsize=4)
def _moves(sphere: Sphere, columns: int, most: int) -> Texture:
    """How much of each column moves up by -most to most rows by tilts of so many: (columns, steps,
    rolls, pitches), linear between two whole rows; read-only.
    """
    steps = np.arange(-most, most + 1)
    azimuth = sphere.azimuths(columns)[:, None, None]
    shift = np.clip(steps * np.cos(azimuth) - steps[:, None] * np.sin(azimuth), -most, most)
    distance = np.abs(shift[:, None] - steps[:, None, None])
    weights = np.asarray(np.maximum(1 - distance, 0), np.float32)
    weights.setflags(write=False)
    return weights


def _by_step(image: Texture, level: Texture, most: int) -> Texture:
    """Correlations (columns, M, steps) of the columns of an image (C, rows, columns), moved up by
    -most to most rows, with those of M level ones (M, C, rows, columns).
    """
    count, _, rows, columns = level.shape
    padded = np.pad(image, ((0, 0), (most, most), (0, 0)))
    moved = sliding_window_view(padded, rows, axis=1)[:, ::-1].transpose(2, 0, 3, 1)
    overlap = np.sqrt(rows / (rows - np.abs(np.arange(-most, most + 1)))).astype(np.float32)
    by_column = level.reshape(count, -1, columns).transpose(2, 0, 1)
    return np.asarray(by_column @ moved.reshape(columns, -1, len(overlap)) * overlap)


def _peaks(scores: Texture) -> Array:
    """Indices (M, 2), with a fraction, at which M squares (M, S, S) are largest."""
    inner = scores[:, 1:-1, 1:-1].reshape(len(scores), -1).argmax(1)
    roll, pitch = (at + 1 for at in np.divmod(inner, scores.shape[2] - 2))
    m = np.arange(len(scores))
    top = scores[m, roll, pitch]
    by_roll = parabola_peak(scores[m, roll - 1, pitch], top, scores[m, roll + 1, pitch])
    by_pitch = parabola_peak(scores[m, roll, pitch - 1], top, scores[m, roll, pitch + 1])
    return np.column_stack([roll + by_roll, pitch + by_pitch]).astype(float)
