# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Choose keyframes among the training images, and locate some that are left out."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.correlation import LIKE_A_PLACE
from sfa_localization.keyframes.keyframes import FEWEST, Keyframes
from sfa_localization.keyframes.regression import BORDER, Fit

LEAST, DENSITY = 2000, 2
"""Keyframes of a model, 3 kB each: so many, or more where there are so many to a square meter: with
a third of them, 16 m x 18 m are known as well; smaller places show nearer things."""
STRETCH_M = 3.0
"""A keyframe is located without those of the same stretch of driving: they are too alike."""
# Stretches of which keyframes are left out in turn, and how many neighbors of each, which show how
# alike errors are.
_STRETCHES, _OF_EACH = 130, 3
# Keyframes of a drive that are compared with those of others, and the least number; and the part of
# images, by squares, that is alike everywhere and that no place explains, from which lights differ:
# 0.03 to 0.1 between day, morning and overcast, 0.005 at most in one light.
_COMPARED, _FEWEST, _OF_LIGHT = 60, 20, 0.01


def choose_keyframes(
    textures: NDArray[np.int8], poses: Array, sphere: Sphere, drives: NDArray[np.int32]
) -> Keyframes:
    """Of textures (N, rows, columns) of training images, their poses (N, 3) in the map, and the
    numbers (N,) of their drives those of `spread`. Drives in one light become one.

    Raises DataError for too few images.
    """
    kept = spread(poses)
    of_kept = np.asarray(poses[kept], float), sphere, drives[kept]
    return _by_light(Keyframes.of(textures[kept], *of_kept))


def spread(poses: Array) -> Indices:
    """Some of N images, by their poses (N, 3), spread over the ground: of each square meter as
    many, chosen at random, always the same.
    """
    cells, cell = np.unique(np.floor(poses[:, :2]), axis=0, return_inverse=True)
    number, cell = max(LEAST, DENSITY * len(cells)), cell.reshape(-1)
    order = np.random.default_rng(0).permutation(len(poses))
    order = order[np.argsort(cell[order], kind='stable')]
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.argsort(rank, kind='stable')[:number]])


def located_without(
    keyframes: Keyframes, path_m: Array
) -> tuple[Indices, list[Fit], NDArray[np.float64]]:
    """Some keyframes (M,), where those of other stretches of driving put them, and how far the
    nearest of these are, (M,) m. `path_m` (K,) is the distance driven until each.
    """
    first = evenly(len(keyframes.poses), _STRETCHES)[:, None] + np.arange(_OF_EACH)
    kept, fits, near = list[int](), list[Fit](), list[float]()
    for row in np.unique(first[first < len(keyframes.poses)]).tolist():
        others = np.abs(path_m - path_m[row]) >= STRETCH_M
        fit = fit_among(keyframes, row, others)
        if fit is not None:
            apart = keyframes.poses[others, :2] - keyframes.poses[row, :2]
            kept.append(row)
            fits.append(fit)
            near.append(float(np.hypot(*apart.T).min()))
    return np.array(kept, np.int64), fits, np.array(near)


def fit_among(keyframes: Keyframes, row: int, among: NDArray[np.bool_]) -> Fit | None:
    """Where those `among` the keyframes (K,) put another one; None where it is like none of them,
    or they are too few.
    """
    rows, image = np.flatnonzero(among), keyframes.spectra([row])
    if len(rows) < FEWEST:
        return None
    scores, yaws = (found[0] for found in keyframes.correlated(image, rows))
    best = int(scores.argmax())
    if scores[best] < LIKE_A_PLACE:
        return None
    all_scores = keyframes.unmatched()[0]
    all_scores[rows] = scores
    about = image[0], keyframes.poses[rows[best], :2], float(yaws[best])
    lights = keyframes.likeliest_lights(all_scores, among)
    fits = [keyframes.fit_about(*about, light, among) for light in lights]
    return min(fits, key=lambda fit: fit.unlike, default=None)


def _by_light(keyframes: Keyframes) -> Keyframes:
    """With one number for all drives in one light: together they are nearer to any place."""
    lights, known = np.full(len(keyframes.drives), -1, np.int32), 0
    for drive in np.unique(keyframes.drives).tolist():
        own = np.flatnonzero(keyframes.drives == drive)
        apart = [_of_light(keyframes, own, lights == light) for light in range(known)]
        same = [light for light in range(known) if apart[light] < _OF_LIGHT]
        lights[own] = min(same, key=apart.__getitem__, default=known)
        known = int(lights.max()) + 1
    return dataclasses.replace(keyframes, drives=lights, trained=known)


def _of_light(keyframes: Keyframes, rows: Indices, of_light: NDArray[np.bool_]) -> float:
    """The part of the keyframes `rows` that those in a light do not explain and that is alike
    everywhere: 0 in the same light, more in another; 1 where they do not meet.
    """
    compared = rows[evenly(len(rows), _COMPARED)].tolist()
    fits = [fit_among(keyframes, row, of_light) for row in compared]
    residuals = [fit.residual for fit in fits if fit is not None and fit.outward <= BORDER]
    if len(residuals) < _FEWEST:
        return 1.0
    # Two halves, so that the errors of single images are not alike by being the same.
    one, other = np.mean(residuals[::2], axis=0), np.mean(residuals[1::2], axis=0)
    whole = np.square(np.abs(keyframes.aligned(rows))).sum(axis=(1, 2)).mean()
    return float((one * other.conj()).sum().real / whole)
