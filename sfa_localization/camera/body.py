# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which part of panoramas shows the robot itself: it stays the same while the robot turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
_BINS, _FEWEST_IMAGES, _FEWEST_BINS = 12, 5, 6


@dataclass(frozen=True, slots=True)
class Body:
    """What hides the view from azimuth `start` to `end`, degrees counterclockwise from forward, and
    from the `top`, a share of the height, to the lower edge.
    """

    start: float
    end: float
    top: float


def seen_beside(bodies: Sequence[Body], size: tuple[int, int], sphere: Sphere) -> Mask:
    """The pixels of panoramas of a size (H, W) that do not show the robot."""
    (height, width), seen = size, np.ones(size, bool)
    azimuth = np.degrees(sphere.azimuths(width))
    for body in bodies:
        columns = (azimuth - body.start) % 360.0 <= (body.end - body.start) % 360.0
        seen[int(body.top * height) :, columns] = False
    return seen


def sentences(bodies: Sequence[Body]) -> list[str]:
    """What hides the view."""
    return [
        f'{f"the lower {1 - body.top:.0%} of " if body.top else ""}the view from {body.start:.0f} '
        f'to {body.end:.0f} degrees (0: forward, 90: left) stays the same while the robot turns, '
        'so it shows the robot: the model does without it'
        for body in bodies
    ]


def bodies(textures: NDArray[np.int8], yaw: Array, sphere: Sphere) -> list[Body]:
    """What hides the view all the time, by textures (N, rows, columns) of images from all over a
    drive, taken at headings `yaw` (N,) rad. Each is a column wider on both sides.
    """
    change = changes(textures, yaw)
    if change is None:
        return []
    rows, columns = change.shape
    whole = np.maximum(change.mean(0), change[: rows // 2].mean(0)) < STILL
    hidden = whole | (change[-(rows // 3) :].mean(0) < STILL / 2)
    hidden |= np.roll(hidden, 1) & np.roll(hidden, -1)
    begin = int(np.argmin(hidden))  # a visible column
    ring = np.roll(np.arange(columns), -begin)
    runs = ndimage.find_objects(ndimage.label(hidden[ring])[0])
    parts, half = [], 180.0 / columns
    for inside in (ring[run] for (run,) in runs if run.stop - run.start > 1):
        edges = np.degrees(sphere.azimuths(columns)[inside[[0, -1]]])
        start, end = edges[::-1] if sphere.clockwise else edges
        # From below, up to the first row that moves.
        moves = np.median(change[::-1, inside], axis=1) >= STILL
        top = 1.0 - max(int(np.argmax(moves)) / rows, 1 / 3)
        top = 0.0 if np.median(whole[inside]) else top
        parts.append(Body((start - 3 * half) % 360.0, (end + 3 * half) % 360.0, top))
    return parts


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
