# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: small training images with known poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.correlation import COARSE, Scores, coarse, least, peaks
from sfa_localization.keyframes.errors import ErrorModel
from sfa_localization.keyframes.regression import Fit, Neighbors, vectors_of
from sfa_localization.keyframes.texture import (
    Spectra,
    Texture,
    channels,
    columns_of,
    spectra_of,
    spectrum,
    turned,
)
from sfa_localization.keyframes.tilt import derivatives

FEWEST = 6
"""Keyframes of a regression, at least: a place, its slopes along both axes, and as many to spare.
"""
NEIGHBORS = 64
"""Keyframes of a regression, of each light."""
LIGHTS = 3
"""Lights of the training, at most, in which an image is located."""
# An image that is farther from where its keyframes were chosen is located again about its place: of
# 0 to 0.2 m the errors are the same.
_NEAR_M = 0.2
# Spectra have one byte a number.
_LARGEST, _LEAST_STEP = 127, 1e-9
# Sets of neighbors that are kept, 0.8 MB each; keyframes that are read at once.
_KEPT, _AT_ONCE = 9, 512


@dataclass(frozen=True, slots=True)
class Keyframes:
    """K textures of so many `columns`, with their `poses` (K, 3) [x m, y m, yaw rad] in the map.

    They are held as the spectra of images with yaw 0: `values` (K, F, 2 rows) int8, real and
    imaginary parts in turn, in units of `step`; and as `coarse` ones. `drives` (K,) are the
    numbers of their drives, of which the first `trained` were those of the training; drives of the
    training in one light have one number. `errors` says how well images are located among them.
    """

    values: NDArray[np.int8] | Texture
    step: float
    columns: int
    poses: Array
    errors: ErrorModel
    sphere: Sphere
    drives: NDArray[np.int32]
    trained: int
    coarse: Texture = field(init=False, repr=False)
    _last: dict[bytes, Neighbors] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        blocks = range(0, len(self.values), _AT_ONCE)
        rough = [coarse(self.aligned(slice(at, at + _AT_ONCE), COARSE + 1)) for at in blocks]
        object.__setattr__(self, 'coarse', np.concatenate(rough, axis=2))
        object.__setattr__(self, '_last', {})

    @classmethod
    def of(
        cls,
        textures: NDArray[np.int8],
        poses: Array,
        sphere: Sphere,
        drives: NDArray[np.int32] | None = None,
        rounded: bool = True,
    ) -> Keyframes:
        """Of quantized textures (K, rows, columns), by default of one drive; all are of the
        training. Raises DataError for too few. Those that nobody saves need not be `rounded`.
        """
        if len(poses) < FEWEST:
            raise DataError(f'{len(poses)} images are too few for keyframes')
        drives = np.zeros(len(poses), np.int32) if drives is None else drives
        parts = parts_of(textures, poses, sphere)
        values, step = encoded(parts) if rounded else (parts, 1.0)
        of_all = textures.shape[2], poses, ErrorModel(), sphere, drives, int(drives.max()) + 1
        return cls(values, step, *of_all)

    def spectra(self, rows: Any = slice(None)) -> Spectra:
        """The spectra (M, rows, F) of the textures of some keyframes, by default of all."""
        return turned(self.aligned(rows), -self.sign * self.poses[rows, 2])

    def aligned(self, rows: Any, frequencies: int | None = None) -> Spectra:
        """The same with yaw 0, by default at all frequencies."""
        held = self.values[rows, :frequencies].astype(np.float32)
        held *= self.step
        return np.asarray(held.view(np.complex64).swapaxes(1, 2))

    @property
    def first(self) -> NDArray[np.bool_]:
        """Which keyframes are of the training (K,)."""
        return self.drives < self.trained

    @property
    def sign(self) -> int:
        """Of the angle by which `turned` makes of an image at some yaw that at another."""
        return 1 if self.sphere.clockwise else -1

    @property
    def channels(self) -> tuple[slice, ...]:
        """The rows of a texture that may be unlike for reasons of their own."""
        return channels(self.values.shape[2] // 2)

    def correlated(self, spectra: Spectra, rows: Indices) -> Scores:
        """Largest correlations (T, M) of spectra (T, rows, F) with some keyframes (M,), and the
        yaws (T, M) rad at which they are reached.
        """
        images = np.conj(spectra).transpose(2, 1, 0) * np.float32(self.step)
        held = self.values[rows].astype(np.float32).view(np.complex64)
        scores, shifts = peaks(held.swapaxes(0, 1) @ images, self.columns)
        return scores, shifts * np.float32(-2 * self.sign * np.pi / self.columns)

    def unmatched(self) -> Scores:
        """Correlations (K,) that are all unknown, and yaws (K,)."""
        count = len(self.poses)
        return np.full(count, -np.inf, np.float32), np.zeros(count, np.float32)

    def likeliest_lights(
        self, scores: NDArray[np.float32], among: NDArray[np.bool_] | None = None
    ) -> list[int]:
        """The lights of the training that the likeliest keyframes are of, by correlations (K,), or
        some by a mask (K,) `among`.
        """
        usable = self.first if among is None else self.first & among
        lights, counts = np.unique(self.drives[usable], return_counts=True)
        # Lights of which too few keyframes are there count where no other one does.
        lights = lights[counts >= min(FEWEST, counts.max(initial=0))]
        likest = [-scores[usable & (self.drives == light)].max() for light in lights.tolist()]
        return list(lights[np.argsort(likest, kind='stable')[:LIGHTS]].tolist())

    def around(self, place: Array, light: int, among: NDArray[np.bool_] | None = None) -> Indices:
        """The keyframes of the regression about a place (2,) m: the nearest of a light of the
        training, and of those that later drives added as many that are no farther; by a mask (K,)
        `among` some.
        """
        x, y = self.poses[:, 0] - place[0], self.poses[:, 1] - place[1]
        squares = np.square(x) + np.square(y)
        usable = np.ones(len(x), bool) if among is None else among
        own = np.flatnonzero((self.drives == light) & usable)
        own = own[least(squares[own], NEIGHBORS)]
        added = np.flatnonzero(~self.first & usable & (squares <= squares[own].max(initial=0.0)))
        return np.sort(np.concatenate([own, added[least(squares[added], NEIGHBORS)]]))

    def fit_about(
        self,
        image: Spectra,
        place: Array,
        yaw: float,
        light: int,
        among: NDArray[np.bool_] | None = None,
    ) -> Fit:
        """Where the spectrum (rows, F) of an image is among the keyframes of a light about a place
        (2,) m; again about where that is, if it is not near.
        """
        changes = self._with_changes(image)
        fit = self._fit(changes, yaw, self.around(place, light, among))
        if np.hypot(*(fit.place - place)) > _NEAR_M:
            fit = self._fit(changes, fit.yaw, self.around(fit.place, light, among))
        return fit

    def fit(self, image: Spectra, yaw: float, rows: Indices) -> Fit:
        """Where the spectrum (rows, F) of an image with about this yaw rad is among some keyframes.

        What roll, pitch and a turn change of it is taken out, and says how much of each it has.
        """
        return self._fit(self._with_changes(image), yaw, rows)

    def _with_changes(self, image: Spectra) -> Spectra:
        """Of an image (rows, F) and of its derivatives by roll, pitch and a turn: (4, rows, F)."""
        slopes = derivatives(columns_of(image, self.columns), self.channels, self.sphere)
        by_turn = image * (1j * np.arange(image.shape[1])).astype(np.complex64)
        return np.concatenate([image[None], spectrum(slopes), by_turn[None]])

    def _fit(self, changes: Spectra, yaw: float, rows: Indices) -> Fit:
        """The same of what `_with_changes` gives."""
        fit = self._neighbors(rows).fit(turned(changes, self.sign * yaw))
        facing, turn = complex(fit.shares @ np.exp(1j * self.poses[rows, 2])), float(fit.changes[2])
        residual = turned(fit.residual, -turn)
        return dataclasses.replace(
            fit, yaw=yaw - self.sign * turn, facing=facing, residual=residual
        )

    def _neighbors(self, rows: Indices) -> Neighbors:
        """Some keyframes. Their products are costly, and a robot stays among them for a while."""
        key = rows.tobytes()
        neighbors = self._last.pop(key, None)
        if neighbors is None:
            of_rows = self.poses[rows, :2], self.drives[rows], self.channels, self.columns
            neighbors = Neighbors(vectors_of(self.aligned(rows), self.columns), *of_rows)
        self._last[key] = neighbors
        if len(self._last) > _KEPT:
            self._last.pop(next(iter(self._last)), None)
        return neighbors

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        kept = 'values', 'step', 'columns', 'poses', 'drives', 'trained'
        arrays = {name: np.asarray(getattr(self, name)) for name in kept}
        return {**arrays, 'errors': np.array(dataclasses.astuple(self.errors))}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]], sphere: Sphere) -> Keyframes:
        """Read the arrays of `to_arrays`, of panoramas that show so much of the `sphere`."""
        values, step = np.asarray(arrays['values'], np.int8), float(arrays['step'])
        poses, drives = arrays['poses'].astype(float), arrays['drives'].astype(np.int32)
        errors = ErrorModel(*arrays['errors'].astype(float).tolist())
        columns, trained = int(arrays['columns']), int(arrays['trained'])
        return cls(values, step, columns, poses, errors, sphere, drives, trained)


def parts_of(textures: NDArray[np.int8], poses: Array, sphere: Sphere) -> Texture:
    """`Keyframes.values` of textures (K, rows, columns) with poses (K, 3), as they are."""
    spectra = turned(spectra_of(textures), poses[:, 2] * (1 if sphere.clockwise else -1))
    return spectra.swapaxes(1, 2).copy().view(np.float32)


def encoded(parts: Texture, step: float = 0.0) -> tuple[NDArray[np.int8], float]:
    """The same (K, F, 2 rows) with one byte each, and the step, by default the one with which the
    largest is 127: one thousandth of their squares is lost.
    """
    step = step or max(float(np.abs(parts).max()) / _LARGEST, _LEAST_STEP)
    return np.rint(parts / step).clip(-_LARGEST, _LARGEST).astype(np.int8), step
