# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Drives over uneven ground, leveled before anything is learned from them.

Two images of one place, turned to one heading, show the difference of their tilts. No image shows
what is level. Together all pairs determine the tilts, with level images as prior: t_i, roll + j
pitch in rad, minimize

    sum_ij |t_i - exp(j a_ij) t_j - r_ij|^2 + sum_i |t_i|^2

with a_ij the heading at image j minus that at i, and r_ij the tilt of i against j, turned so. A
camera that leans on the robot has the same tilt c in all images: it minimizes

    sum_ij |c - exp(j a_ij) c - r_ij|^2 + |c|^2
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from sfa_localization.camera.leveling import TILTED_RAD, LeveledPanoramas, leveled
from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.data.run import Run
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.closures import LIKE, SAMPLES, ImageSearch, Textures, views_of
from sfa_localization.keyframes.texture import channels
from sfa_localization.keyframes.tilt import find_tilt, visible

_PASSES = 3
"""Each pass finds three quarters of the remaining tilt."""
_CERTAIN = 8.0
"""Standard errors of a lean, as neighbors share the slope of their ground: on slopes of 4 degrees
level cameras seemed to lean by up to 4.4 of them; one that leaned by 8 degrees did by 10."""


def camera_lean(runs: Sequence[Run], sphere: Sphere) -> Array:
    """Roll and pitch (2,) rad of the camera on the robot; 0 where it does not lean for certain."""
    chosen = evenly(sum(len(run.panoramas) for run in runs), SAMPLES)
    lean = np.zeros(2)
    for _ in range(_PASSES):
        level = [upright_run(run, lean, sphere) for run in runs]
        pairs = tilt_pairs(views_of(level, chosen=chosen), sphere)
        if not (lean.any() or pairs.leans):
            break
        lean += pairs.lean.real, pairs.lean.imag
    return lean


def upright_run(run: Run, lean: Array, sphere: Sphere) -> Run:
    """A run as by an upright camera, from one that leans by roll and pitch (2,) rad."""
    if not lean.any():
        return run
    size = run.panoramas.shape[:2]
    tilts = np.tile(lean, (len(run.panoramas), 1))
    seen = visible(lean, *size, sphere)
    if run.seen is not None:
        seen &= leveled(run.seen.astype(np.uint8) * 255, lean, sphere) == 255
    return replace(run, panoramas=LeveledPanoramas.of(run.panoramas, tilts, sphere), seen=seen)


def leveled_runs(
    runs: Sequence[Run],
    sphere: Sphere,
    on_images: Callable[[int], object] = lambda count: None,
) -> tuple[Run, ...]:
    """The runs with leveled panoramas; unchanged if most images have the same tilt as their best
    matches. Of many images each set of `SAMPLES`, from all over the drives, is leveled by itself.
    """
    counts = [len(run.panoramas) for run in runs]
    sets = -(-sum(counts) // SAMPLES)
    tilts = np.zeros(sum(counts), complex)
    level = tuple(runs)
    for start in range(sets):
        rows = np.arange(start, len(tilts), sets)
        for _ in range(_PASSES):
            pairs = tilt_pairs(views_of(level, on_images, rows), sphere)
            if pairs.median < TILTED_RAD / 2:
                break
            tilts[rows] = pairs.tilts(tilts[rows])
            of_runs = np.split(np.column_stack([tilts.real, tilts.imag]), np.cumsum(counts)[:-1])
            level = tuple(
                replace(run, panoramas=LeveledPanoramas.of(run.panoramas, tilt, sphere))
                for run, tilt in zip(runs, of_runs, strict=True)
            )
    return level


@dataclass(frozen=True, slots=True)
class TiltPairs:
    """L pairs of images: rows `first` and `second` (L,), the `tilt` (L,) of the first against the
    second, roll + j pitch rad at the heading of the first, and the `turn` (L,) exp(j a) to it from
    that of the second, which differs by a.
    """

    first: Indices
    second: Indices
    tilt: Complex
    turn: Complex

    @property
    def lean(self) -> complex:
        """The tilt of the camera on the robot, roll + j pitch rad."""
        change = 1 - self.turn
        return complex(np.vdot(change, self.tilt) / (np.sum(np.abs(change) ** 2) + 1))

    @property
    def leans(self) -> bool:
        """Whether the camera leans for certain, and by enough to matter."""
        images = max(len(np.unique(self.first)), 1)
        rest = self.upright().tilt
        squares = np.sum(np.abs(rest) ** 2) / (np.sum(np.abs(1 - self.turn) ** 2) + 1) / images
        return abs(self.lean) > max(float(TILTED_RAD), _CERTAIN * float(np.sqrt(squares)))

    def upright(self) -> TiltPairs:
        """The pairs as by a camera that does not lean."""
        return replace(self, tilt=self.tilt - self.lean * (1 - self.turn))

    @property
    def median(self) -> float:
        """Median of the tilts of one image against another, rad; 0 without any pair."""
        return float(np.median(np.abs(self.tilt))) if len(self.tilt) else 0.0

    def tilts(self, removed: Complex) -> Complex:
        """The tilts (S,) of images from which tilts (S,) were `removed` already."""
        count = len(removed)
        rows = np.arange(len(self.tilt))
        shape = len(rows), count
        difference = sparse.csr_matrix((np.ones(len(rows)), (rows, self.first)), shape)
        difference = difference - sparse.csr_matrix((self.turn, (rows, self.second)), shape)
        squares = (difference.conj().T @ difference + sparse.identity(count)).tocsc()
        right = difference.conj().T @ (self.tilt + difference @ removed)
        return np.asarray(spsolve(squares, right))


def tilt_pairs(views: Textures, sphere: Sphere) -> TiltPairs:
    """Pairs of each image and those that it is likest, along other stretches of driving."""
    search = ImageSearch(views)
    rows = np.arange(len(views.images))
    _, height, columns = views.textures.shape
    pairs = [np.zeros((0, 5))]
    for row in rows.tolist():
        others = search.candidates(row, rows)
        if not len(others):
            continue
        turn = search.correlate(row, others)[1] * (2 * np.pi / columns)
        tilts, scores = find_tilt(
            search.spectra[row], search.spectra[others], turn, columns, channels(height), sphere
        )
        heading = turn if sphere.clockwise else -turn
        pair = np.column_stack([np.full(len(others), row), others, tilts, heading])
        pairs.append(pair[scores >= LIKE])
    first, second, roll, pitch, heading = np.concatenate(pairs).T
    return TiltPairs(
        first.astype(np.int64), second.astype(np.int64), roll + 1j * pitch, np.exp(1j * heading)
    )
