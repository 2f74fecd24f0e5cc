# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Choose keyframes among the training images, and locate some that are left out."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.closures import STRETCH_M
from sfa_localization.keyframes.hidden import correlated_part
from sfa_localization.keyframes.keyframes import FEWEST, Keyframes
from sfa_localization.keyframes.regression import BORDER, Fit
from sfa_localization.keyframes.texture import LIKE_A_PLACE, columns_of

LEAST = 2000
DENSITY = 2
"""Keyframes of a model, 3 kB each: so many, or in large places so many per square meter. A third of
them does as well on 16 m x 18 m; smaller places show nearer things."""
# Keyframes are left out at so many places, and so many neighbors at each, whose errors are
# correlated.
_STRETCHES = 130
_OF_EACH = 3
# Keyframes of a drive that are compared with those of others, and the least number. Lights differ
# where this part of images, by squares, is a residual that is the same everywhere: 0.03 to 0.1
# between day, morning and overcast, 0.005 at most in the same light.
_COMPARED = 60
_FEWEST = 20
_OF_LIGHT = 0.01


def choose_keyframes(
    textures: NDArray[np.int8],
    poses: Array,
    sphere: Sphere,
    drives: NDArray[np.int32],
    seen: Mask | None = None,
) -> tuple[Keyframes, Indices]:
    """Of textures (N, rows, columns) of training images, their poses (N, 3) in the map, and the
    numbers (N,) of their drives, choose some evenly over the ground: equally many per square meter,
    at random with a fixed seed. Drives in the same light get one number.

    The keyframes, and which images (K,) they are. Raises DataError for too few images.
    """
    cells, cell = np.unique(np.floor(poses[:, :2]), axis=0, return_inverse=True)
    number = max(LEAST, DENSITY * len(cells))
    cell = cell.reshape(-1)
    order = np.random.default_rng(0).permutation(len(poses))
    order = order[np.argsort(cell[order], kind='stable')]
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    rows = np.sort(order[np.argsort(rank, kind='stable')[:number]])
    chosen = Keyframes.of(
        textures[rows], np.asarray(poses[rows], float), sphere, drives[rows], seen
    )
    return _by_light(chosen), rows


def located_without(
    keyframes: Keyframes, path_m: Array
) -> tuple[Indices, list[Fit], NDArray[np.float64]]:
    """Some keyframes (M,), their fits among those of other stretches of driving, and the distance
    (M,) m of the nearest of these. `path_m` (K,) is the distance driven until each keyframe.
    """
    first = evenly(len(keyframes.poses), _STRETCHES)[:, None] + np.arange(_OF_EACH)
    rows = list[int]()
    fits = list[Fit]()
    nearest = list[float]()
    for row in np.unique(first[first < len(keyframes.poses)]).tolist():
        others = np.abs(path_m - path_m[row]) >= STRETCH_M
        fit = fit_among(keyframes, row, others)
        if fit is not None:
            difference = keyframes.poses[others, :2] - keyframes.poses[row, :2]
            rows.append(row)
            fits.append(fit)
            nearest.append(np.hypot(*difference.T).min())
    return np.array(rows, np.int64), fits, np.array(nearest)


def fit_among(keyframes: Keyframes, row: int, among: NDArray[np.bool_]) -> Fit | None:
    """The fit of a keyframe among others, by a mask (K,); None where it is like none of them, or
    they are too few.
    """
    image = keyframes.spectrum(row)
    others = keyframes.take(among)
    if len(others.poses) < FEWEST:
        return None
    part = image
    if keyframes.seen is not None:  # what was filled in is of the others
        part = correlated_part(columns_of(image, keyframes.columns), keyframes.seen)
    scores, yaws = others.correlated(part)
    best = int(scores.argmax())
    if scores[best] < LIKE_A_PLACE:
        return None
    place = others.poses[best, :2]
    changes = others.changes(image)
    fits = [
        others.fit_about(changes, place, float(yaws[best]), light)
        for light in others.likeliest_lights(scores)
    ]
    return min(fits, key=lambda fit: fit.unlike, default=None)


def _by_light(keyframes: Keyframes) -> Keyframes:
    """With one number for all drives in the same light: together they are nearer to any place."""
    lights = np.full(len(keyframes.lights), -1, np.int32)
    count = 0
    for drive in np.unique(keyframes.lights).tolist():
        rows = np.flatnonzero(keyframes.lights == drive)
        shares = [_of_light(keyframes, rows, lights == light) for light in range(count)]
        same = [light for light in range(count) if shares[light] < _OF_LIGHT]
        lights[rows] = min(same, key=shares.__getitem__, default=count)
        count = int(lights.max()) + 1
    return dataclasses.replace(keyframes, lights=lights, trained=count)


def _of_light(keyframes: Keyframes, rows: Indices, of_light: NDArray[np.bool_]) -> float:
    """The part of the keyframes `rows` that is the same residual everywhere when they are fitted
    among those of a light: 0 in the same light, more in another; 1 where they do not meet.
    """
    compared = rows[evenly(len(rows), _COMPARED)]
    fits = [fit_among(keyframes, row, of_light) for row in compared.tolist()]
    residuals = [fit.residual for fit in fits if fit is not None and fit.outward <= BORDER]
    if len(residuals) < _FEWEST:
        return 1.0
    # Two halves: the errors of single images are not counted as alike.
    half, other_half = (np.mean(residuals[start::2], axis=0) for start in range(2))
    whole = np.square(np.abs(keyframes.aligned(rows))).sum(axis=(1, 2)).mean()
    return float((half * other_half.conj()).sum().real / whole)
