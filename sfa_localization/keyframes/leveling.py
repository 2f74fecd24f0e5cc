# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Drives over uneven ground, leveled before anything is learned from them.

Two images of one place show how much one robot was tilted more than the other, with their
headings turned to each other. No image says what is level; but all together, each is level as
surely as one such pair is right: the tilts t_i, roll + j pitch in rad, minimize

    sum_ij |t_i - exp(j a_ij) t_j - r_ij|^2 + sum_i |t_i|^2

with a_ij the heading at image j minus that at i, and r_ij the tilt of i against j, turned so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from sfa_localization.camera.leveling import TILTED_RAD, LeveledPanoramas
from sfa_localization.data.geometry import Complex
from sfa_localization.data.run import Run
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.closures import LIKE, SAMPLES, STRETCH_M, Views, views_of
from sfa_localization.keyframes.correlation import coarse, coarse_scores, correlate
from sfa_localization.keyframes.texture import channels, spectra_of
from sfa_localization.keyframes.tilt import find_tilt

_LIKEST = 24
"""Images that each is compared with; of 12 half as much of the tilt is found."""
_PASSES = 3
"""Each finds three quarters of what is left."""


def leveled_runs(
    runs: Sequence[Run],
    sphere: Sphere,
    on_images: Callable[[int], object] = lambda count: None,
) -> tuple[Run, ...]:
    """The runs with leveled panoramas; unchanged where most images are as tilted as those they are
    likest. Of many images each set of `SAMPLES`, from all over the drives, is leveled by itself.
    """
    count = sum(len(run.panoramas) for run in runs)
    sets = -(-count // SAMPLES)
    tilts, level = np.zeros(count, complex), tuple(runs)
    for one in range(sets):
        rows = np.arange(one, count, sets)
        for _ in range(_PASSES):
            links = links_between(views_of(level, on_images, rows), sphere)
            if links.usual < TILTED_RAD / 2:
                break
            tilts[rows] = links.tilts(tilts[rows])
            level = _without(runs, tilts, sphere)
    return level


def _without(runs: Sequence[Run], tilts: Complex, sphere: Sphere) -> tuple[Run, ...]:
    starts = np.cumsum([len(run.panoramas) for run in runs])[:-1]
    pairs = zip(runs, np.split(np.column_stack([tilts.real, tilts.imag]), starts), strict=True)
    return tuple(
        replace(run, panoramas=LeveledPanoramas(run.panoramas, own, sphere)) for run, own in pairs
    )


@dataclass(frozen=True, slots=True)
class Links:
    """L pairs of images: rows `first` and `second` (L,), the tilt `found` (L,) of the first against
    the second, roll + j pitch rad at the heading of the first, and the `turn` (L,) exp(j a) to it
    from that of the second, which differs by a.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    found: Complex
    turn: Complex

    @property
    def usual(self) -> float:
        """How much, rad, one image is tilted more than another, half of the time; 0 without any."""
        return float(np.median(np.abs(self.found))) if len(self.found) else 0.0

    def tilts(self, known: Complex) -> Complex:
        """The tilts (S,) of images from which `known` ones (S,) were taken out already."""
        count, rows = len(known), np.arange(len(self.found))
        shape = len(rows), count
        one = sparse.csr_matrix((np.ones(len(rows)), (rows, self.first)), shape)
        apart = one - sparse.csr_matrix((self.turn, (rows, self.second)), shape)
        squares = (apart.conj().T @ apart + sparse.identity(count)).tocsc()
        return np.asarray(spsolve(squares, apart.conj().T @ (self.found + apart @ known)))


def links_between(views: Views, sphere: Sphere) -> Links:
    """Each image and those that it is likest, along other stretches of driving."""
    spectra, columns = spectra_of(views.textures), views.textures.shape[2]
    rough, parts = coarse(spectra), channels(views.textures.shape[1])
    found = [np.zeros((0, 5))]
    for row, image in enumerate(spectra):
        scores = coarse_scores(image[None], rough)[0]
        near = np.abs(views.path_m - views.path_m[row]) < STRETCH_M
        scores[near & (views.run == views.run[row])] = -np.inf
        likely = np.argsort(-scores, kind='stable')[:_LIKEST]
        likely = likely[np.isfinite(scores[likely])]
        if not len(likely):
            continue
        shifts = correlate(image[None], spectra[likely], columns)[1][0]
        turn = np.asarray(shifts, float) * (2 * np.pi / columns)
        tilts, alike = find_tilt(image, spectra[likely], turn, columns, parts, sphere)
        heading = turn if sphere.clockwise else -turn
        both = np.column_stack([np.full(len(likely), row), likely, tilts, heading])
        found.append(both[alike >= LIKE])
    first, second, roll, pitch, heading = np.concatenate(found).T
    rows = first.astype(np.int64), second.astype(np.int64)
    return Links(*rows, roll + 1j * pitch, np.exp(1j * heading))
