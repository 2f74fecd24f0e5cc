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
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.sphere import Sphere, rotation
from sfa_localization.data.statistics import parabola_peak
from sfa_localization.keyframes.texture import Spectra, Texture, columns_of, turned

_LARGEST = np.radians(12.0)
"""Of the tilts that are tried, along each axis."""
_UNLIKELY = 0.01 / np.radians(4.0) ** 2
"""What a correlation with a tilt counts less, per squared rad: few tilts are above 4 degrees."""


def visible(tilt: Array, rows: int, columns: int, sphere: Sphere) -> NDArray[np.bool_]:
    """Where a panorama (rows, columns) that was `leveled` shows what the tilted one did."""
    up = sphere.rays(rows, columns) @ rotation(*tilt)[:, 2]
    return np.asarray((up > np.sin(sphere.low)) & (up < np.sin(sphere.high)))


def derivatives(texture: Texture, channels: Sequence[slice], sphere: Sphere) -> Texture:
    """Of a panorama (rows, columns) by roll and pitch: (2, rows, columns) per rad; `channels` are
    rows of one panorama each.
    """
    heights = tuple(part.stop - part.start for part in channels)
    upward, sideways, sin, cos = _slopes(sphere, heights, texture.shape[1])
    up, left = upward @ texture, np.roll(texture, -1, 1) - np.roll(texture, 1, 1)
    left *= sideways
    return np.stack([up * sin - left * cos, -left * sin - up * cos])


@lru_cache(maxsize=8)
def _slopes(sphere: Sphere, heights: tuple[int, ...], columns: int) -> tuple[Texture, ...]:
    """What makes of textures their derivatives along which a tilt moves them up, (rows, rows), and
    of two columns' differences those sideways, (rows, 1); sine and cosine of azimuths (columns,).
    """
    upward = np.zeros((sum(heights), sum(heights)))
    for end, rows in zip(np.cumsum(heights), heights, strict=True):
        part, row = slice(end - rows, end), (sphere.low - sphere.high) / rows
        upward[part, part] = np.gradient(np.eye(rows), row, axis=0)
    elevations = np.concatenate([sphere.elevations(rows) for rows in heights])
    azimuth, sign = sphere.azimuths(columns), -1 if sphere.clockwise else 1
    sideways = np.tan(elevations)[:, None] * (sign * columns / (4 * np.pi))
    slopes = upward, sideways, np.sin(azimuth), np.cos(azimuth)
    return tuple(np.asarray(one, np.float32) for one in slopes)


def find_tilt(
    image: Spectra,
    others: Spectra,
    turn: Array,
    columns: int,
    channels: Sequence[slice],
    sphere: Sphere,
) -> tuple[Array, Array]:
    """Roll and pitch rad with which a texture is likest each of M level ones, by the spectra of
    their columns, (rows, F) and (M, rows, F), of its heading when `turned` by `turn` (M,) rad: the
    tilts (M, 2), and the correlations (M,), less for large tilts. `channels` are rows of one
    panorama each, of the first one the most.

    All tilts up to 12 degrees in steps of one row are tried: each column is correlated with shifted
    ones of the others once, and the correlation by a tilt is a sum of these over the columns. Every
    second column will do: a tilt is the same in all.
    """
    tried = _Tilts.of(sphere, tuple(part.stop - part.start for part in channels), columns)
    few = tried.columns // 2 + 1
    others = turned(others[..., :few], turn)
    level = columns_of(others.swapaxes(1, 2), tried.columns, axis=1)
    shifted = columns_of(image[:, :few], tried.columns).T @ tried.shifts
    by_shift = level.swapaxes(0, 1) @ shifted.reshape(*level.shape[1:], -1)
    scores = by_shift.swapaxes(0, 1).reshape(len(others), -1) @ tried.weights
    count = len(tried.steps)
    square = scores.reshape(len(others), count, count) - tried.unlikely
    return _peaks(square, tried.steps), square.max((1, 2))


@dataclass(frozen=True, slots=True)
class _Tilts:
    """Rolls, and pitches, `steps` (S,) rad that are tried, of textures with so many `columns` left.

    `shifts` (rows, rows * S) are what makes of one column all of its shifts, so that correlations
    are those of all columns, and all rows; `weights` (columns * S, S * S) what shifts of columns
    each tilt makes; and how much `unlikely` (S, S) tilts are.
    """

    steps: Array
    columns: int
    shifts: Texture
    weights: Texture
    unlikely: Texture

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, sphere: Sphere, heights: tuple[int, ...], columns: int) -> _Tilts:
        rows, few = heights[0], columns // 2
        row = (sphere.high - sphere.low) / rows
        count = max(min(round(_LARGEST / row), rows // 2 - 1), 1)
        shifts = np.arange(-count, count + 1)
        first = sphere.azimuths(columns)[0] - sphere.azimuths(few)[0]
        azimuth = (sphere.azimuths(few) + first)[:, None, None]
        shift = shifts * np.cos(azimuth) - shifts[:, None] * np.sin(azimuth)
        # Of each column, between two whole rows.
        near = np.maximum(
            1 - np.abs(np.clip(shift, -count, count)[:, None] - shifts[:, None, None]), 0
        )
        steps = row * shifts
        unlikely = _UNLIKELY * np.add.outer(steps**2, steps**2)
        # Of half as many columns, spectra make values twice as large.
        scale = np.sqrt(rows / (rows - np.abs(shifts))) * few / columns
        moved = np.zeros((sum(heights), sum(heights), len(shifts)))
        for end, n in zip(np.cumsum(heights), heights, strict=True):
            # Rows of a texture with fewer of them are as many finer ones.
            fine = np.arange(n) == (np.arange(rows) * n // rows)[:, None]
            by_shift = [fine.T @ np.eye(rows, k=k) @ fine for k in shifts.tolist()]
            moved[end - n : end, end - n : end] = np.stack(by_shift, axis=2)
        weights = near.reshape(few * len(shifts), -1)
        tables = (moved * scale).reshape(len(moved), -1), weights, unlikely
        return cls(steps, few, *(np.asarray(one, np.float32) for one in tables))


def _peaks(scores: Texture, steps: Array) -> Array:
    """Where each of M squares (M, S, S) over rolls and pitches is largest, between the steps."""
    inner = scores[:, 1:-1, 1:-1].reshape(len(scores), -1).argmax(1)
    roll, pitch = (at + 1 for at in np.divmod(inner, len(steps) - 2))
    which = np.arange(len(scores))
    found = []
    for at, ahead in ((roll, (1, 0)), (pitch, (0, 1))):
        before = scores[which, roll - ahead[0], pitch - ahead[1]]
        after = scores[which, roll + ahead[0], pitch + ahead[1]]
        part = parabola_peak(before, scores[which, roll, pitch], after)
        found.append(steps[at] + part * (steps[1] - steps[0]))
    return np.column_stack(found)
