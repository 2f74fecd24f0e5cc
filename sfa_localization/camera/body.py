# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which part of panoramas shows the robot itself: it stays the same while the robot turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.sphere import Sphere

STILL = 0.4
"""A part that changes by less than this share of what its directions change elsewhere is fixed:
columns of bodies had 0.00 to 0.35 (textured or plain, with noise), those of the surroundings 0.74
or more; the lower third of their rows had 0.3 or more, and therefore counts below half of this."""
LOWER = 1 / 3
"""A body that hides less than this share of the rows harms little."""
WHOLE = 0.8
"""If more rows are hidden, the whole columns are blind."""
IMAGES = 400
"""Images that are compared, from all over a drive."""
# Headings count alike, in bins of 30 degrees with enough images; of fewer bins, nothing is certain.
_BINS, _FEWEST_IMAGES, _FEWEST_BINS = 12, 5, 6
# The columns that tell how much a direction changes are at least so far away: the body is as wide.
_FAR = 1 / 6
_FEWEST_COLUMNS = 2
_MASK = 'draw this part black in an image of the panorama, and set mask_file to it'


@dataclass(frozen=True, slots=True)
class Body:
    """What hides the view from azimuth `start` to `end`, degrees counterclockwise from forward, and
    from the `top`, a share of the height, to the lower edge.
    """

    start: float
    end: float
    top: float

    def __str__(self) -> str:
        return f'from {self.start:.0f} to {self.end:.0f} degrees'


def blind_sectors(bodies: Sequence[Body]) -> str:
    """The parameter of omnicam_node that hides those with all rows; '' for none."""
    edges = [f'{edge:.1f}' for body in bodies if not body.top for edge in (body.start, body.end)]
    return f'blind_sectors: [{", ".join(edges)}]' if edges else ''


def sentences(bodies: Sequence[Body]) -> list[str]:
    """What hides the view, and the remedy, for the columns and for the lower parts of some."""
    whole = [body for body in bodies if not body.top]
    groups = [('the view', whole, f'set {blind_sectors(bodies)}')] if whole else []
    groups += [(f'the lower {1 - b.top:.0%} of the view', [b], _MASK) for b in bodies if b.top]
    return [
        f'{part} {" and ".join(map(str, hidden))} (0: forward, 90: left) stays the same while the '
        f'robot turns, so it shows the robot: {remedy}'
        for part, hidden, remedy in groups
    ]


def bodies(textures: NDArray[np.int8], yaw: Array, sphere: Sphere) -> list[Body]:
    """What hides the view all the time, by textures (N, rows, columns) of images from all over a
    drive, taken at headings `yaw` (N,) rad. Each is a column wider on both sides.
    """
    change = changes(textures, yaw, sphere)
    if change is None:
        return []
    rows, columns = change.shape
    lowest = change[-max(round(LOWER * rows), 1) :].mean(0) < STILL / 2
    moving = np.where(change[::-1] < STILL, rows, np.arange(rows)[:, None]).min(0)
    top = np.where(lowest, rows - np.maximum(moving, round(LOWER * rows)), rows) / rows
    whole = np.maximum(change.mean(0), change[: rows // 2].mean(0)) < STILL
    top[whole | (top < 1 - WHOLE)] = 0.0
    parts, degrees = [], 360.0 / columns
    for first, last in _runs(top < 1.0):
        hidden = np.arange(first, last) % columns
        edges = np.degrees(sphere.azimuths(columns)[[hidden[0], hidden[-1]]])
        start = float((edges[1] if sphere.clockwise else edges[0]) - 1.5 * degrees) % 360.0
        width = (last - first + 2) * degrees
        parts.append(Body(start, (start + width) % 360.0, float(np.median(top[hidden]))))
    return parts


def _runs(hidden: Mask) -> list[tuple[int, int]]:
    """First and last + 1 of the runs of a ring (columns,) that are wide enough; a single column
    between two is hidden as well.
    """
    hidden = hidden | (np.roll(hidden, 1) & np.roll(hidden, -1))
    if hidden.all() or not hidden.any():
        return []
    begin = int(np.argmin(hidden))  # a visible column
    ring = np.roll(hidden, -begin).astype(int)
    edges = np.flatnonzero(np.diff(ring, append=0)) + 1 + begin
    pairs = edges.reshape(-1, 2).tolist()
    return [(a, b) for a, b in pairs if b - a >= _FEWEST_COLUMNS]


def changes(textures: NDArray[np.int8], yaw: Array, sphere: Sphere) -> Array | None:
    """How much each part (rows, columns) of textures (N, rows, columns) changes, over how much its
    directions change in the columns elsewhere, which see them at other headings.

    `yaw` (N,) rad are the headings of the robot. None where it turned too little.
    """
    bins = np.floor(yaw % (2 * np.pi) * (_BINS / (2 * np.pi))).astype(int) % _BINS
    counts = np.bincount(bins, minlength=_BINS)
    used = counts[bins] >= _FEWEST_IMAGES
    if (counts >= _FEWEST_IMAGES).sum() < _FEWEST_BINS:
        return None
    weight = 1.0 / counts[bins[used]]
    images, columns = textures[used].astype(np.float32), textures.shape[2]
    images = images - np.average(images, axis=0, weights=weight)
    squares = (images**2).swapaxes(1, 2) * weight[:, None, None]
    column = np.broadcast_to(np.arange(columns), squares.shape[:2])
    # The column that shows the same direction at heading 0.
    turned = np.rint(yaw[used] * (columns / (2 * np.pi))).astype(int)
    seen = (column - (turned if sphere.clockwise else -turned)[:, None]) % columns
    change, counted = np.zeros((columns, columns, squares.shape[2])), np.zeros((columns, columns))
    np.add.at(change, (column, seen), squares)
    np.add.at(counted, (column, seen), np.broadcast_to(weight[:, None], seen.shape))
    apart = np.abs((column[:1] - column[:1].T + columns // 2) % columns - columns // 2)
    far = (apart >= _FAR * columns).astype(float)
    others = np.tensordot(far, change, 1) / np.maximum(far @ counted, 1e-9)[..., None]
    expected = (counted[..., None] * others).sum(1)
    return np.asarray(change.sum(1) / np.maximum(expected, 1e-9)).T
