# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures: images of one place that were taken at different times, and the turn between them.

Correlation of local contrast finds them in any light (see keyframes.py), before anything has been
learned. They tie the stretches of a drive to each other, and drives in different lights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.run import Odometry, Run, Stamps
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.correlation import coarse, coarse_scores, correlate
from sfa_localization.keyframes.texture import Spectra, quantized, spectra_of, texture

LIKE = 0.55
"""Least correlation of a closure: images of other places reach 0.4, some a little more."""
STRETCH_M = 6.0
"""Images that are nearer along the same drive are alike because they are neighbors."""
SAMPLES = 3000
"""Images that are compared, however long the drives."""
# Each is the likest of the other, to so many images: neighbors are nearly equally like.
_NEXT = 1
# Of the coarse correlation, for the full one.
_CANDIDATES = 24
_AT_ONCE = 64  # bounds the memory


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
        """With the turns of the robot, on which the camera is turned by (N,) rad in N images."""
        first, second = camera_yaw[self.images].T
        return Closures(self.images, self.turn - second + first)


@dataclass(frozen=True, slots=True)
class Views:
    """Images in driving order: `textures` (S, rows, columns), their indices `images` (S,) among
    those of all drives, the drive `run` (S,) and the distance driven in it until each, (S,) m.
    """

    textures: NDArray[np.int8]
    images: Indices
    run: Indices
    path_m: Array

    def take(self, rows: NDArray[Any]) -> Views:
        """Some of them, by a mask (S,) or indices."""
        return Views(self.textures[rows], self.images[rows], self.run[rows], self.path_m[rows])


def views_of(
    runs: Sequence[Run],
    on_images: Callable[[int], object] = lambda count: None,
    chosen: Indices | None = None,
) -> Views:
    """Of the `chosen` images of all runs, by default of all; `on_images` counts the images."""
    counts = [len(run.panoramas) for run in runs]
    chosen = np.arange(sum(counts)) if chosen is None else chosen
    run = np.repeat(np.arange(len(runs)), counts)[chosen]
    starts, textures = np.cumsum([0, *counts]), []
    for image, owner in zip(chosen.tolist(), run.tolist(), strict=True):
        at = image - int(starts[owner])
        textures += [
            quantized(texture(one)[None]) for one in runs[owner].panoramas.read(at, at + 1)
        ]
        on_images(1)
    path = np.concatenate([driven(r.odometry, r.panoramas.stamps_ns) for r in runs])[chosen]
    return Views(np.concatenate(textures), chosen, run, path)


def driven(odometry: Odometry, stamps_ns: Stamps) -> Array:
    """Distance (N,) m that odometry had driven at each of the stamps (N,) of images; over a break
    STRETCH_M, because the place after it may be any."""
    places = odometry.trajectory.at(stamps_ns)[:, :2]
    steps = np.hypot(*np.diff(places, axis=0, prepend=places[:1]).T)
    at = np.searchsorted(odometry.stamps_ns, stamps_ns, 'right') - 1
    part = odometry.part[np.maximum(at, 0)]
    return np.cumsum(np.where(np.diff(part, prepend=part[:1]) != 0, STRETCH_M, steps))


@dataclass(frozen=True, slots=True)
class _Drive:
    """The views of one drive, ready to be correlated: `spectra` of the columns, and their `rough`
    part."""

    views: Views
    spectra: Spectra
    rough: NDArray[np.float32]

    @classmethod
    def of(cls, views: Views) -> _Drive:
        spectra = spectra_of(views.textures)
        return cls(views, spectra, coarse(spectra))


def find_closures(views: Views, clockwise: bool) -> Closures:
    """Images of two drives, or of a drive with itself, each of which is the likest of the other,
    if they are like enough; of an even sample, for each is compared with all. `clockwise`: whether
    columns grow clockwise seen from above.
    """
    views = views.take(evenly(len(views.images), SAMPLES))
    drives = [_Drive.of(views.take(views.run == run)) for run in np.unique(views.run).tolist()]
    images, turns = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    step = (2 if clockwise else -2) * np.pi / views.textures.shape[2]
    for number, one in enumerate(drives):
        for other in drives[number:]:
            rows, shifts = _mutual(one, other)
            first, second = one.views.images[rows[:, 0]], other.views.images[rows[:, 1]]
            images.append(np.column_stack([first, second]))
            turns.append(step * shifts)
    return Closures(np.concatenate(images), np.concatenate(turns))


def _mutual(one: _Drive, other: _Drive) -> tuple[Indices, Array]:
    """Rows (L, 2) of closures between two drives, and the shifts (L,) of their columns."""
    there, score, shift = _likest(one, other)
    same = one is other
    back = there if same else _likest(other, one)[0]
    at = np.arange(len(there))
    kept = (score >= LIKE) & (np.abs(back[there] - at) <= _NEXT) & (not same or at < there)
    return np.column_stack([at, there])[kept], shift[kept]


def _likest(one: _Drive, other: _Drive) -> tuple[Indices, Array, Array]:
    """For each image (S,) of one drive the row of the likest of another, the correlation, -inf
    without any, and the shift of the columns.
    """
    count, columns = len(one.spectra), one.views.textures.shape[2]
    best, score, shift = np.zeros(count, np.int64), *np.full((2, count), -np.inf)
    for row, rows in enumerate(_candidates(one, other)):
        if len(rows):
            image = one.spectra[row : row + 1]
            found, shifts = correlate(image, other.spectra[rows], columns)
            top = int(found[0].argmax())
            best[row], score[row], shift[row] = rows[top], found[0, top], shifts[0, top]
    return best, score, shift


def _candidates(one: _Drive, other: _Drive) -> Iterator[Indices]:
    """For each image of one drive the rows of another that are likest by the rough correlation."""
    number = min(_CANDIDATES, len(other.spectra))
    for start in range(0, len(one.spectra), _AT_ONCE):
        scores = coarse_scores(one.spectra[start : start + _AT_ONCE], other.rough)
        if one is other:
            path = one.views.path_m[start : start + _AT_ONCE]
            scores[np.abs(path[:, None] - other.views.path_m) < STRETCH_M] = -np.inf
        likely = np.sort(np.argpartition(-scores, number - 1, axis=1)[:, :number])
        for own, rows in zip(scores, likely, strict=True):
            yield rows[np.isfinite(own[rows])]
