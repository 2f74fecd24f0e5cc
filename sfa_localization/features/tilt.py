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
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.sphere import Sphere, rotation

Texture = NDArray[np.float32]

_LARGEST = np.radians(12.0)
"""Of the tilts that are tried, along each axis."""
_EVERY = 2
"""So many columns are one apart where tilts are tried: a tilt is the same in all."""
_UNLIKELY = 0.01 / np.radians(4.0) ** 2
"""What a correlation with a tilt counts less, per squared rad: few tilts are above 4 degrees."""


def visible(tilt: Array, rows: int, columns: int, sphere: Sphere) -> NDArray[np.bool_]:
    """Where a panorama (rows, columns) that was `leveled` shows what the tilted one did."""
    up = sphere.rays(rows, columns) @ rotation(*tilt)[:, 2]
    return np.asarray((up > np.sin(sphere.low)) & (up < np.sin(sphere.high)))


def derivatives(texture: Texture, sphere: Sphere) -> Texture:
    """Of a panorama (rows, columns) by roll and pitch: (2, rows, columns) per rad."""
    sin, cos, aside = _waves(sphere, *texture.shape)
    up = np.empty_like(texture)
    np.subtract(texture[:-2], texture[2:], out=up[1:-1])
    up[0], up[-1] = 2 * (texture[0] - texture[1]), 2 * (texture[-2] - texture[-1])
    up *= np.float32(texture.shape[0] / (2 * (sphere.high - sphere.low)))
    left = (np.roll(texture, -1, 1) - np.roll(texture, 1, 1)) * aside
    return np.stack([up * sin - left * cos, -left * sin - up * cos])


@lru_cache(maxsize=8)
def _waves(sphere: Sphere, rows: int, columns: int) -> tuple[Texture, Texture, Texture]:
    """Sine and cosine of the azimuths (columns,), and by how much two columns' difference is the
    derivative along which a tilt moves the rows sideways, (rows, 1).
    """
    azimuth, sign = sphere.azimuths(columns), -1 if sphere.clockwise else 1
    aside = np.tan(sphere.elevations(rows))[:, None] * (sign * columns / (4 * np.pi))
    return _single(np.sin(azimuth)), _single(np.cos(azimuth)), _single(aside)


def _single(values: Array) -> Texture:
    return np.asarray(values, np.float32)


def find_tilt(
    texture: Texture, others: Texture, channels: Sequence[slice], sphere: Sphere
) -> tuple[Array, Array]:
    """Roll and pitch rad with which a texture (rows, columns) is likest each of M others, level
    ones at its heading, (M, rows, columns): the tilts (M, 2), and the correlations (M,), less for
    large tilts. `channels` are rows of one panorama each, of the first one the most.

    All tilts up to 12 degrees in steps of one row are tried: each column is correlated with shifted
    ones of the others once, and the correlation by a tilt is a sum of these over the columns.
    """
    tried = _Tilts.of(sphere, channels[0].stop - channels[0].start, texture.shape[1])
    few, others = texture[:, ::_EVERY], others[..., ::_EVERY]
    shifted = np.concatenate([tried.shifted(few[part]) for part in channels], axis=1)
    by_shift = others.transpose(2, 0, 1) @ shifted
    scores = by_shift.transpose(1, 0, 2).reshape(len(others), -1) @ tried.weights
    count = len(tried.steps)
    square = scores.reshape(len(others), count, count) - tried.unlikely
    return _peaks(square, tried.steps), square.max((1, 2))


@dataclass(frozen=True, slots=True)
class _Tilts:
    """Rolls, and pitches, `steps` (S,) rad that are tried, and what shifts of columns each makes:
    `weights` (columns * shifts, S * S); how much `unlikely` (S, S) makes them; and of the `shifts`
    in rows, 0 in the middle, the `scale` that fewer columns and overlapping rows ask for.
    """

    steps: Array
    weights: Texture
    unlikely: Texture
    scale: Texture
    rows: int

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, sphere: Sphere, rows: int, columns: int) -> _Tilts:
        row = (sphere.high - sphere.low) / rows
        count = max(min(round(_LARGEST / row), rows // 2 - 1), 1)
        shifts = np.arange(-count, count + 1)
        azimuth = sphere.azimuths(columns)[::_EVERY, None, None]
        shift = shifts * np.cos(azimuth) - shifts[:, None] * np.sin(azimuth)
        # Of each column, between two whole rows.
        near = np.maximum(
            1 - np.abs(np.clip(shift, -count, count)[:, None] - shifts[:, None, None]), 0
        )
        steps = row * shifts
        unlikely = _UNLIKELY * np.add.outer(steps**2, steps**2)
        scale = _EVERY * np.sqrt(rows / (rows - np.abs(shifts)))
        weights = near.reshape(len(azimuth) * len(shifts), -1)
        return cls(steps, _single(weights), _single(unlikely), _single(scale), rows)

    def shifted(self, texture: Texture) -> Texture:
        """Columns of a texture (rows, columns) under all shifts: (columns, rows, shifts)."""
        count, rows, few = len(self.scale) // 2, self.rows, len(texture)
        fine = np.arange(rows) * few // rows
        padded = np.pad(texture[fine].T, ((0, 0), (count, count)))
        moved = sliding_window_view(padded, len(self.scale), axis=1)[..., ::-1] * self.scale
        return (
            moved
            if few == rows
            else np.add.reduceat(moved, np.searchsorted(fine, np.arange(few)), 1)
        )


def _peaks(scores: Texture, steps: Array) -> Array:
    """Where each of M squares (M, S, S) over rolls and pitches is largest, between the steps."""
    inner = scores[:, 1:-1, 1:-1].reshape(len(scores), -1).argmax(1)
    roll, pitch = (at + 1 for at in np.divmod(inner, len(steps) - 2))
    which = np.arange(len(scores))
    found = []
    for at, ahead in ((roll, (1, 0)), (pitch, (0, 1))):
        before = scores[which, roll - ahead[0], pitch - ahead[1]]
        after = scores[which, roll + ahead[0], pitch + ahead[1]]
        bend = np.minimum(before - 2 * scores[which, roll, pitch] + after, -1e-9)
        part = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
        found.append(steps[at] + part * (steps[1] - steps[0]))
    return np.column_stack(found)
