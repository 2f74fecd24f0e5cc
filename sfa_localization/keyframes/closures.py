# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures: images of one place that were taken at different times, and the turn between them.

Correlation of local contrast finds them in any light (see keyframes.py), before anything has been
learned. They tie the stretches of a drive to each other, and drives in different lights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.run import Odometry, Run, Stamps
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.texture import (
    Scores,
    coarse,
    coarse_scores,
    correlate,
    quantized,
    spectra_of,
    texture,
)

LIKE = 0.55
"""Least correlation of a closure: images of other places reach 0.4, some a little more."""
STRETCH_M = 6.0
"""Images that are nearer along the same drive are alike because they are neighbors."""
CLOSURES_MIN = 30
"""Fewer closures show neither whether images turn better nor the scale of two drives."""
SAMPLES = 3000
"""Images that are compared, however long the drives."""
# Candidates that the coarse correlation passes to the full one; with half as many only half of a
# tilt is recovered.
_CANDIDATES = 24


@dataclass(frozen=True, slots=True)
class Closures:
    """L pairs of images: `images` (L, 2) indices among those of all drives; `turn` (L,) rad is the
    camera's heading at the second minus that at the first.
    """

    images: Indices
    turn: Array

    def __len__(self) -> int:
        return len(self.turn)

    @classmethod
    def none(cls) -> Closures:
        """No closures."""
        return cls(np.zeros((0, 2), np.int64), np.zeros(0))

    def of_robot(self, camera_yaw: Array) -> Closures:
        """The same with turns of the robot instead of the camera, whose yaw on the robot is (N,)
        rad in N images.
        """
        first, second = camera_yaw[self.images].T
        return Closures(self.images, self.turn - second + first)


@dataclass(frozen=True, slots=True)
class Textures:
    """Images in driving order: `textures` (S, rows, columns), their indices `images` (S,) among
    those of all drives, the drive `run` (S,) and the distance driven in it until each, (S,) m. They
    show what is `seen` (rows, columns), by default all.
    """

    textures: NDArray[np.int8]
    images: Indices
    run: Indices
    path_m: Array
    seen: Mask | None = None

    def take(self, rows: NDArray[Any]) -> Textures:
        """Some of the images, by a mask (S,) or indices."""
        return Textures(
            self.textures[rows], self.images[rows], self.run[rows], self.path_m[rows], self.seen
        )

    def near(self, row: int, rows: Indices) -> NDArray[np.bool_]:
        """Which of the images `rows` (M,) are of the same stretch of driving as another one."""
        near = np.abs(self.path_m[rows] - self.path_m[row]) < STRETCH_M
        return np.asarray(near & (self.run[rows] == self.run[row]))


def views_of(
    runs: Sequence[Run],
    on_images: Callable[[int], object] = lambda count: None,
    chosen: Indices | None = None,
) -> Textures:
    """The `chosen` images of all runs, by default all; `on_images` counts the images."""
    counts = [len(run.panoramas) for run in runs]
    chosen = np.arange(sum(counts)) if chosen is None else chosen
    run = np.repeat(np.arange(len(runs)), counts)[chosen]
    starts = np.cumsum([0, *counts])
    textures = []
    for image, number in zip(chosen.tolist(), run.tolist(), strict=True):
        at = image - int(starts[number])
        textures.append(texture(runs[number].panoramas.read(at, at + 1)[0]))
        on_images(1)
    path = np.concatenate([driven(r.odometry, r.panoramas.stamps_ns) for r in runs])[chosen]
    return Textures(quantized(np.stack(textures)), chosen, run, path)


def driven(odometry: Odometry, stamps_ns: Stamps) -> Array:
    """Distance (N,) m that odometry had driven at each of the stamps (N,) of images. A break counts
    as STRETCH_M, because the place after it may be any.
    """
    places = odometry.trajectory.at(stamps_ns)[:, :2]
    steps = np.hypot(*np.diff(places, axis=0, prepend=places[:1]).T)
    at = np.searchsorted(odometry.stamps_ns, stamps_ns, 'right') - 1
    part = odometry.part[np.maximum(at, 0)]
    return np.cumsum(np.where(np.diff(part, prepend=part[:1]) != 0, STRETCH_M, steps))


class ImageSearch:
    """Finds the images that are alike among those of `views`, by their `spectra` (S, rows, F)."""

    def __init__(self, views: Textures) -> None:
        self.views = views
        self.spectra = spectra_of(views.textures)
        self._coarse = coarse(self.spectra)

    def candidates(self, row: int, rows: Indices) -> Indices:
        """Those of the images `rows` (M,) with the highest coarse correlation with another one,
        except those of the same stretch of the drive.
        """
        rows = rows[~self.views.near(row, rows)]
        scores = coarse_scores(self.spectra[row], self._coarse[rows])
        return rows[np.argsort(-scores, kind='stable')[:_CANDIDATES]]

    def correlate(self, row: int, rows: Indices) -> Scores:
        """Correlations (M,) of an image with others, and the shifts (M,) of columns."""
        return correlate(self.spectra[row], self.spectra[rows], self.views.textures.shape[2])


def find_closures(views: Textures, clockwise: bool) -> Closures:
    """Images of two drives, or of a drive with itself, each of which is the best match of the
    other, or next to it, with a correlation of at least LIKE. All pairs of an even sample are
    compared. `clockwise`: whether columns grow clockwise seen from above.
    """
    views = views.take(evenly(len(views.images), SAMPLES))
    search = ImageSearch(views)
    rows = np.arange(len(views.images))
    numbers, drive = np.unique(views.run, return_inverse=True)
    # Of each drive and image the row that is likest, its correlation, and its shift.
    best = np.tile([0.0, -np.inf, 0.0], (len(numbers), len(rows), 1))
    for number in range(len(numbers)):
        for row in rows.tolist():
            others = search.candidates(row, np.flatnonzero(drive == number))
            if len(others):
                score, shift = search.correlate(row, others)
                top = score.argmax()
                best[number, row] = others[top], score[top], shift[top]
    likest = best[:, :, 0].astype(np.int64)
    back = likest[drive, likest]
    kept = (best[:, :, 1] >= LIKE) & (np.abs(back - rows) <= 1) & (rows < likest)
    first = np.broadcast_to(rows, kept.shape)[kept]
    pairs = views.images[np.column_stack([first, likest[kept]])]
    step = (2 if clockwise else -2) * np.pi / views.textures.shape[2]
    return Closures(pairs, step * best[kept, 2])
