# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far beside the axle a camera sits, by how its images change while the robot turns.

A robot that turns on the spot by an angle t moves a camera l beside its axle by |l| |exp(i t) - 1|,
and the image, turned back, changes with the square of that, as it does with the square of a short
way w ahead: by c + b |l|^2 |exp(i t) - 1|^2 and c + b w^2, with the noise c. No map and no wheels
have a part in it, so that it tells a lever from wheels that slip in turns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.rig import Quantity
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.closures import Views
from sfa_localization.keyframes.texture import columns_of, spectra_of

SPOT_M, TURNS_RAD = 0.02, (0.3, 1.5)
"""Pairs of images of a turn are so near to each other, and turned by so much."""
AHEAD_M, STRAIGHT_RAD = (0.05, 0.65), 0.08
"""Pairs of images that show what a way changes."""
FREQUENCIES = 10
"""The lowest ones change with the square of the way, and without error by a part of a column."""
UNSURE = 0.5
"""Relative error of the square: things are nearer in some places than in others (1.3 to 1.9 of what
it should be, in five drives)."""
_LAGS, _MOST, _GROUPS, _FEWEST, _FINER = 13, 2000, 6, 30, 16


def lever_square(views: Views, yaw: Array) -> Quantity | None:
    """|l|^2, m^2, with the standard deviation of what chance makes of it, by views with headings
    (S,) rad of odometry; None where there are too few turns, or no way to compare them with.
    """
    first = np.concatenate([np.arange(len(yaw) - lag) for lag in range(1, _LAGS + 1)])
    last = first + np.repeat(np.arange(1, _LAGS + 1), len(yaw) - np.arange(1, _LAGS + 1))
    same = views.run[first] == views.run[last]
    way, turn = views.path_m[last] - views.path_m[first], np.abs(yaw[last] - yaw[first])
    spot = same & (way < SPOT_M) & (turn > TURNS_RAD[0]) & (turn < TURNS_RAD[1])
    ahead = same & (turn < STRAIGHT_RAD) & (way > AHEAD_M[0]) & (way < AHEAD_M[1])
    turned = _medians(views, first[spot], last[spot], np.abs(np.exp(1j * turn[spot]) - 1) ** 2)
    driven = _medians(views, first[ahead], last[ahead], way[ahead] ** 2)
    if turned is None or driven is None:
        return None
    none = np.zeros(_GROUPS)
    parts = [[none + 1, turned[0], none], [none + 1, none, driven[0]]]
    rows = np.concatenate([np.column_stack(part) for part in parts])
    changes = np.concatenate([turned[1], driven[1]])
    _, by_turn, by_way = found = np.linalg.lstsq(rows, changes, rcond=None)[0]
    missed = (changes - rows @ found)[:_GROUPS]
    around = turned[0] - turned[0].mean()
    std = float(np.sqrt(missed @ missed / (_GROUPS - 2) / max(float(around @ around), 1e-12)))
    if by_way <= 0:
        return None
    return Quantity(max(float(by_turn), 0.0) / float(by_way), std / float(by_way))


def _medians(
    views: Views, first: Indices, last: Indices, size: Array
) -> tuple[Array, Array] | None:
    """Of pairs of images (P,) in groups of one size (P,) its median and that of their change; None
    for too few.
    """
    rows = evenly(len(size), _MOST)
    if len(rows) < _FEWEST:
        return None
    change = _change(views.textures, first[rows], last[rows])
    groups = np.array_split(np.argsort(size[rows], kind='stable'), _GROUPS)
    medians = np.array([[np.median(each[g]) for g in groups] for each in (size[rows], change)])
    return medians[0], medians[1]


def _change(textures: NDArray[np.int8], first: Indices, last: Indices) -> Array:
    """Minus the logarithm of the correlation (P,) of pairs of textures (S, rows, columns) at the
    lowest frequencies, turned to be most alike."""
    columns, changes = textures.shape[2], []
    used, pairs = np.unique([first, last], return_inverse=True)
    low = spectra_of(textures[used])[:, :, 1 : FREQUENCIES + 1]
    low = low / np.maximum(np.linalg.norm(low, axis=(1, 2), keepdims=True), 1e-9)
    for one, other in pairs.reshape(2, -1).T.tolist():
        product = np.append(0.0, (low[one] * low[other].conj()).sum(0)).astype(np.complex64)
        curve = columns_of(product, _FINER * columns) * (_FINER * columns / 2)
        changes.append(-np.log(max(float(curve.max()), 0.05)))
    return np.array(changes)
