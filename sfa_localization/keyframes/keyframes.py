# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: small training images with known poses."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.errors import ErrorModel
from sfa_localization.keyframes.hidden import completed, masked, seen_in, turned_mask
from sfa_localization.keyframes.regression import Fit, regress
from sfa_localization.keyframes.texture import (
    COARSE,
    Scores,
    Spectra,
    channels,
    coarse,
    columns_of,
    correlate,
    spectra_of,
    spectrum,
    turned,
)
from sfa_localization.keyframes.tilt import derivatives

FEWEST = 6
"""Fewest keyframes of a regression: three parameters, and as many spare."""
NEIGHBORS = 64
"""Keyframes of a regression, of each light."""
LIGHTS = 3
"""Most lights of the training in which an image is located."""
# An image that is farther from the place about which its keyframes were chosen is located again.
# From 0 to 0.2 m the errors are the same.
_NEAR_M = 0.2


@dataclass(frozen=True)
class Keyframes:
    """K textures of so many `columns`, with their `poses` (K, 3) [x m, y m, yaw rad] in the map.

    They are stored as the spectra of images with yaw 0: `values` (K, F, 2 rows) int8, real and
    imaginary parts in turn, in units of `step`. `lights` (K,) are the numbers of their lights, of
    which the first `trained` were those of the training, whose drives share a light where it is the
    same; each later drive has its own. `errors` says how well images are located among them. Images
    show what is `seen` (rows, columns), by default all; what keyframes did not see is filled in:
    see hidden.py.
    """

    values: NDArray[np.int8]
    step: float
    columns: int
    poses: Array
    errors: ErrorModel
    sphere: Sphere
    lights: NDArray[np.int32]
    trained: int
    seen: Mask | None = None

    @classmethod
    def of(
        cls,
        textures: NDArray[np.int8],
        poses: Array,
        sphere: Sphere,
        lights: NDArray[np.int32],
        seen: Mask | None = None,
    ) -> Keyframes:
        """Keyframes of the training by quantized textures (K, rows, columns). Raises DataError for
        too few.
        """
        if len(poses) < FEWEST:
            raise DataError(f'{len(poses)} images are too few for keyframes')
        values, step = encoded(textures, poses, sphere, seen)
        return cls(
            values,
            step,
            textures.shape[2],
            poses,
            ErrorModel(),
            sphere,
            lights,
            int(lights.max()) + 1,
            seen,
        )

    def take(self, rows: NDArray[Any]) -> Keyframes:
        """Some of the keyframes, by a mask (K,) or indices."""
        return dataclasses.replace(
            self, values=self.values[rows], poses=self.poses[rows], lights=self.lights[rows]
        )

    def seeing(self, panorama: Mask) -> Keyframes:
        """The same for an image that shows only some pixels (H, W) of the panorama."""
        known = seen_in(panorama, self.channels[-1].stop, self.columns)
        _ = self.coarse  # so that the copy has it, too
        changed = copy.copy(self)
        object.__setattr__(changed, 'seen', known if self.seen is None else known & self.seen)
        return changed

    def spectrum(self, row: int) -> Spectra:
        """The spectrum (rows, F) of the texture of a keyframe."""
        return turned(self.aligned([row])[0], -self.sign * self.poses[row, 2])

    def aligned(self, rows: Any) -> Spectra:
        """The spectra (M, rows, F) of some keyframes, turned to yaw 0."""
        parts = np.multiply(self.values[rows], np.float32(self.step), dtype=np.float32)
        return np.asarray(parts.view(np.complex64).swapaxes(1, 2))

    @cached_property
    def coarse(self) -> Spectra:
        """The `coarse` spectra of all keyframes at yaw 0; their unit does not matter."""
        low = np.ascontiguousarray(self.values[:, : COARSE + 1], np.float32)
        return coarse(low.view(np.complex64).swapaxes(1, 2))

    @property
    def first(self) -> NDArray[np.bool_]:
        """Which keyframes are of the training (K,)."""
        return self.lights < self.trained

    @property
    def sign(self) -> int:
        """Sign of the angle by which `turned` takes an image from yaw 0 to a positive yaw."""
        return 1 if self.sphere.clockwise else -1

    @property
    def channels(self) -> tuple[slice, ...]:
        """The rows of brightness and of both color differences in a texture."""
        return channels(self.values.shape[2] // 2)

    def correlated(self, image: Spectra, rows: Any = slice(None)) -> Scores:
        """Largest correlations (M,) of a spectrum (rows, F) with some keyframes (M,), and the yaws
        (M,) rad of the image at which they are reached.
        """
        scores, shifts = correlate(image, self.aligned(rows), self.columns)
        return scores, shifts * np.float32(-2 * self.sign * np.pi / self.columns)

    def likeliest_lights(self, scores: NDArray[np.float32]) -> list[int]:
        """The lights of the training that the likeliest keyframes are of, by correlations (K,)."""
        lights, counts = np.unique(self.lights[self.first], return_counts=True)
        # Lights of which too few keyframes are there count where no other one does.
        enough: list[int] = lights[counts >= min(FEWEST, counts.max(initial=0))].tolist()
        return sorted(enough, key=lambda light: -scores[self.lights == light].max())[:LIGHTS]

    def around(self, place: Array, light: int) -> Indices:
        """The keyframes of the regression about a place (2,) m: the nearest of a light of the
        training, and as many of later drives that are no farther.
        """
        distance = np.hypot(*(self.poses[:, :2] - place).T)
        nearest = np.argsort(distance, kind='stable')
        of_light = nearest[self.lights[nearest] == light][:NEIGHBORS]
        reach = distance[of_light].max(initial=0.0)
        added = nearest[~self.first[nearest] & (distance[nearest] <= reach)][:NEIGHBORS]
        return np.sort(np.concatenate([of_light, added]))

    def changes(self, image: Spectra) -> Spectra:
        """The spectrum (rows, F) of an image, and its derivatives by roll, pitch and heading: (4,
        rows, F).
        """
        slopes = spectrum(derivatives(columns_of(image, self.columns), self.channels, self.sphere))
        by_turn = image * (1j * np.arange(image.shape[1])).astype(np.complex64)
        return np.concatenate([image[None], slopes, by_turn[None]])

    def fit_about(self, changes: Spectra, place: Array, yaw: float, light: int) -> Fit:
        """Locate an image with its `changes` (4, rows, F) by the keyframes of one light around a
        place (2,) m; repeat around the result if that is far away.
        """
        fit = self.fit(changes, yaw, self.around(place, light))
        if np.hypot(*(fit.place - place)) > _NEAR_M:
            fit = self.fit(changes, fit.yaw, self.around(fit.place, light))
        return fit

    def fit(self, changes: Spectra, yaw: float, rows: Indices) -> Fit:
        """Where an image with about this yaw rad is among some keyframes, by its `changes` (4,
        rows, F): those by roll, pitch and heading are projected out, and estimated.
        """
        changes = turned(changes, self.sign * yaw)
        keyframes = self.aligned(rows)
        if self.seen is not None:
            seen = turned_mask(self.seen, self.sign * yaw)
            changes = masked(changes, seen)
            keyframes = masked(keyframes, seen)
        fit = regress(
            changes,
            keyframes,
            self.poses[rows, :2],
            self.lights[rows],
            self.channels,
            self.columns,
        )
        facing = complex(fit.shares @ np.exp(1j * self.poses[rows, 2]))
        turn = float(fit.changes[2])
        return dataclasses.replace(
            fit,
            yaw=yaw - self.sign * turn,
            facing=facing,
            residual=turned(fit.residual, -turn),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        names = 'values', 'step', 'columns', 'poses'
        arrays = {name: np.asarray(getattr(self, name)) for name in names}
        arrays |= {'drives': self.lights, 'trained': np.asarray(self.trained)}
        arrays |= {} if self.seen is None else {'seen': self.seen}
        return {**arrays, 'errors': np.array(dataclasses.astuple(self.errors))}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]], sphere: Sphere) -> Keyframes:
        """Read the arrays of `to_arrays`, of panoramas that show so much of the `sphere`."""
        return cls(
            np.asarray(arrays['values'], np.int8),
            float(arrays['step']),
            int(arrays['columns']),
            arrays['poses'].astype(float),
            ErrorModel(*arrays['errors'].astype(float).tolist()),
            sphere,
            arrays['drives'].astype(np.int32),
            int(arrays['trained']),
            np.asarray(arrays['seen'], bool) if 'seen' in arrays else None,
        )


def encoded(
    textures: NDArray[np.int8],
    poses: Array,
    sphere: Sphere,
    seen: Mask | None = None,
    others: Keyframes | None = None,
) -> tuple[NDArray[np.int8], float]:
    """`Keyframes.values` of textures (K, rows, columns) with poses (K, 3), and their step: the one
    of `others`, or the one with which the largest value is 127: one thousandth of their squares is
    lost. What textures have not `seen` (rows, columns) is filled in from all these keyframes.
    """
    sign = 1 if sphere.clockwise else -1
    spectra = turned(spectra_of(textures), sign * poses[:, 2])
    if seen is not None:
        known = spectra
        at = poses
        if others is not None:
            known = np.concatenate([spectra, others.aligned(slice(None))])
            at = np.concatenate([poses, others.poses])
        masks = np.stack([turned_mask(seen, sign * yaw) for yaw in at[:, 2].tolist()])
        spectra = completed(known, masks, at[:, :2])[: len(poses)]
    parts = spectra.swapaxes(1, 2).copy().view(np.float32)
    step = others.step if others is not None else max(float(np.abs(parts).max()) / 127, 1e-9)
    return np.rint(parts / step).clip(-127, 127).astype(np.int8), step
