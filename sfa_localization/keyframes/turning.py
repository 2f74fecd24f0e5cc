# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far beside the axle a camera sits, by how its images change while the robot turns.

A robot that turns on the spot by an angle t moves a camera l beside its axle by |l| |exp(i t) - 1|.
The image, turned back, changes with the square of that way, as it does with the square of a short
way w ahead: by c + b |l|^2 |exp(i t) - 1|^2 and c + b w^2, with the noise c. This depends on no map
and no wheels, so that it tells a lever arm from wheels that slip in turns.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg
from scipy.ndimage import minimum_filter1d

from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.rig import Quantity
from sfa_localization.data.statistics import evenly
from sfa_localization.keyframes.closures import Textures
from sfa_localization.keyframes.hidden import turned_mask
from sfa_localization.keyframes.texture import Spectra, columns_of, correlate, spectra_of, turned

SPOT_M = 0.02
TURNS_RAD = (0.3, 1.5)
"""The two images of a turn are so near to each other, and turned by so much."""
AHEAD_M = (0.05, 0.65)
STRAIGHT_RAD = 0.08
"""Way and turn between two images that show what a way changes."""
FREQUENCIES = 10
"""Number of low frequencies compared: they change with the square of the distance, and do not
depend on shifts by a fraction of a column."""
UNSURE = 0.5
"""Relative error of the square: things are nearer in some places than in others (1.3 to 1.9 of what
it should be, in five drives)."""
# Pairs of images are up to so many images apart; so many pairs at most, and at least, in so many
# groups.
_LAGS = 13
_MOST = 2000
_FEWEST = 30
_GROUPS = 6


def lever_square(views: Textures, yaw: Array) -> Quantity | None:
    """|l|^2, m^2, with its standard deviation by the scatter, by views with headings (S,) rad of
    odometry; None where there are too few turns, or no way to compare them with.
    """
    pairs, way, turn = _pairs(views, yaw)
    spot = (way < SPOT_M) & _within(turn, TURNS_RAD)
    ahead = (turn < STRAIGHT_RAD) & _within(way, AHEAD_M)
    if min(spot.sum(), ahead.sum()) < _FEWEST:
        return None
    chord = np.abs(np.exp(1j * turn[spot]) - 1) ** 2
    turned = _medians(views, pairs[:, spot], chord)
    driven = _medians(views, pairs[:, ahead], way[ahead] ** 2)
    sizes = linalg.block_diag(turned[:, :1], driven[:, :1])
    rows = np.column_stack([np.ones(len(sizes)), sizes])
    changes = np.concatenate([turned[:, 1], driven[:, 1]])
    solution = np.linalg.lstsq(rows, changes, rcond=None)[0]
    _, by_turn, by_way = solution.tolist()
    if by_way <= 0:
        return None
    residual = (changes - rows @ solution)[:_GROUPS]
    spread = np.var(turned[:, 0]) * _GROUPS
    std = np.sqrt(residual @ residual / (_GROUPS - 2) / max(float(spread), 1e-12))
    return Quantity(max(by_turn, 0.0) / by_way, float(std) / by_way)


def _within(values: Array, bounds: tuple[float, float]) -> Mask:
    """Which values lie between both bounds."""
    return np.asarray((values > bounds[0]) & (values < bounds[1]))


def _pairs(views: Textures, yaw: Array) -> tuple[Indices, Array, Array]:
    """Pairs (2, P) of neighboring images of a drive, way, m, and turn, rad, between both."""
    lags = range(1, _LAGS + 1)
    first = np.concatenate([np.arange(len(yaw) - lag) for lag in lags])
    last = np.concatenate([np.arange(lag, len(yaw)) for lag in lags])
    pairs = np.array([first, last])[:, views.run[first] == views.run[last]]
    return pairs, np.diff(views.path_m[pairs], axis=0)[0], np.abs(np.diff(yaw[pairs], axis=0)[0])


def _medians(views: Textures, pairs: Indices, size: Array) -> Array:
    """Of pairs (2, P) of textures, in groups of one size (P,), the medians of that and of their
    change (groups, 2): minus the logarithm of their correlation at low frequencies, turned to be
    most alike.
    """
    rows = evenly(len(size), _MOST)
    size = size[rows]
    textures = views.textures
    columns = textures.shape[2]
    used, pairs = np.unique(pairs[:, rows], return_inverse=True)
    low = spectra_of(textures[used])
    low[:, :, [0, *range(FREQUENCIES + 1, low.shape[2])]] = 0
    norm = np.linalg.norm(low, axis=(1, 2), keepdims=True) * np.sqrt(2 / columns)
    low = np.asarray(low / np.maximum(norm, 1e-9), np.complex64)
    seen = views.seen
    if seen is not None:  # without that into which low frequencies carry what was not seen
        seen = minimum_filter1d(seen, 1 + columns // FREQUENCIES, mode='wrap')
    likeness = [_likeness(low[a], low[[b]], columns, seen) for a, b in pairs.reshape(2, -1).T]
    change = -np.log(np.maximum(np.array(likeness, np.float32), 0.05))
    groups = np.array_split(np.argsort(size, kind='stable'), _GROUPS)
    return np.array([[np.median(size[group]), np.median(change[group])] for group in groups])


def _likeness(first: Spectra, last: Spectra, columns: int, seen: Mask | None) -> float:
    """Correlation of spectra (rows, F) and (1, rows, F), turned to be most alike, where both were
    `seen` (rows, columns).
    """
    (score,), (shift,) = correlate(first, last, columns)
    if seen is None:
        return float(score)
    image = columns_of(first, columns)
    best = 0.0
    for angle in (shift + np.arange(-2, 2.1, 0.5)) * (2 * np.pi / columns):
        other = columns_of(turned(last, np.array([angle])), columns)[0]
        mask = seen & turned_mask(seen, angle)
        a = image[mask]
        b = other[mask]
        best = max(best, float(a @ b / np.sqrt(max((a @ a) * (b @ b), 1e-18))))
    return best
