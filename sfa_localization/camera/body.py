# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which part of panoramas shows the robot itself: it stays the same while the robot turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.sphere import Sphere

STILL = 0.4
"""A column that changes by less than this share of what others change is fixed: those of bodies had
0.00 to 0.35 (textured or plain, with noise), those of the surroundings 0.67 or more; the lower
third of their rows had 0.3 or more, and therefore counts below half of this."""
IMAGES = 400
"""Images that are compared, from all over a drive."""
# A body is no wider than this share of the columns.
_WIDEST = 0.6
# Headings count alike, in bins of 30 degrees with enough images; of fewer bins, nothing is certain.
_BINS = 12
_FEWEST_IMAGES = 5
_FEWEST_BINS = 6


def seen_mask(robot: Mask, size: tuple[int, int]) -> Mask:
    """The pixels of panoramas of a size (H, W) beside those of the robot in a mask (rows, columns)
    of textures.
    """
    rows, columns = (np.arange(n) * m // n for n, m in zip(size, robot.shape, strict=True))
    return np.asarray(~robot[np.ix_(rows, columns)])


def sentences(robot: Mask, sphere: Sphere) -> list[str]:
    """What hides the view, by the mask (rows, columns) of the robot."""
    height = robot.mean(axis=0)
    half = 180.0 / robot.shape[1]
    begin = int(np.argmin(height))  # the clearest column
    ring = np.roll(np.arange(len(height)), -begin)
    texts = []
    for (run,) in ndimage.find_objects(ndimage.label(height[ring] > 0)[0]):
        inside = ring[run]
        edges = np.degrees(sphere.azimuths(len(height)))[inside[[0, -1]]]
        start, end = edges[::-1] if sphere.clockwise else edges
        share = height[inside].mean()
        part = '' if share == 1 else f'the lower {share:.0%} of '
        texts.append(
            f'{part}the view from {(start - half) % 360:.0f} to {(end + half) % 360:.0f} degrees '
            '(0: forward, 90: left) stays the same while the robot turns, so it shows the robot: '
            'the model does without it, in all drives'
        )
    return texts


def robot_in_view(textures: NDArray[np.int8], yaw: Array) -> Mask:
    """What shows the robot all the time, by textures (N, rows, columns) of images from all over a
    drive, taken at headings `yaw` (N,) rad: a mask (rows, columns), from below up to a row in each
    column, with a column more on both sides.
    """
    change = changes(textures, yaw)
    if change is None:
        return np.zeros(textures.shape[1:], bool)
    rows = len(change)
    whole = np.maximum(change.mean(0), change[: rows // 2].mean(0)) < STILL
    hidden = whole | (change[-(rows // 3) :].mean(0) < STILL / 2)
    hidden |= np.roll(hidden, 1) & np.roll(hidden, -1)
    hidden &= np.roll(hidden, 1) | np.roll(hidden, -1)
    moves = ndimage.median_filter(change[::-1], (1, 3), mode='wrap') >= STILL
    height = np.where(moves.any(axis=0) & ~whole, moves.argmax(axis=0), rows)
    height = np.where(hidden, np.maximum(height, rows // 3), 0)
    height = ndimage.maximum_filter1d(height, 3, mode='wrap')
    return np.asarray(np.arange(rows)[::-1, None] < height)


def changes(textures: NDArray[np.int8], yaw: Array) -> Array | None:
    """The variance in time of each part (rows, columns) of textures (N, rows, columns), over that
    of the other columns; None where the headings `yaw` (N,) rad of the robot hardly change.
    """
    heading = np.floor(yaw % (2 * np.pi) * (_BINS / (2 * np.pi))).astype(int) % _BINS
    counts = np.bincount(heading, minlength=_BINS)
    if (counts >= _FEWEST_IMAGES).sum() < _FEWEST_BINS:
        return None
    weight = np.where(counts >= _FEWEST_IMAGES, 1.0 / np.maximum(counts, 1), 0.0)[heading]
    images = textures - np.average(textures, axis=0, weights=weight)
    variance = np.average(images**2, axis=0, weights=weight)
    usual = np.quantile(variance, _WIDEST, axis=1, keepdims=True)
    return np.asarray((variance + 1e-9) / (usual + 1e-9))
