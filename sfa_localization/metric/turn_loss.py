# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How much way the wheels of a drive lose in turns, by a map of its images.

Odometry of real robots counts more way in a turn than they drive: wheels slide, and controllers
slow down. Four small robots lost 0.07 to 0.1 m per radian, half of all that their odometry missed.
A map averages over that where tracks cross, so that its images show it: between images some
decimeters apart they move by D - loss L, with the odometry's displacement D turned into the map,
and what one m/rad takes from it, L.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.features.rotation_spread import MEDIAN_TO_STD
from sfa_localization.metric.dead_reckoning import LENGTH, OdometryTrack, Way, seconds_since_start

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]

STEP_M = 0.3
"""Images this far apart are compared: nearer ones hide a loss in their own errors."""
CHANCE_STDS = 4.0
"""A loss below so many standard deviations may be chance."""
LARGEST_LOSS, LARGEST_SCALE = 0.3, 1.5
"""m per radian, half the track of a large robot, and the scale of its way: beyond them the images
show something else than a loss in turns."""
PAIRS_MIN = 50
"""Fewer pairs of images are no evidence."""
_ROUNDS = 10  # of reweighting, from where the fit hardly changes
_HALF = 2.4  # residual, in standard deviations, at which an image counts half


@dataclass(frozen=True, slots=True)
class Shown:
    """Images (M,) of a drive in their order: stamps s since the start of the odometry, `places`
    (M,) x + i y m by the images alone, `yaw` (M,) rad in the map.
    """

    time_s: Array
    places: Complex
    yaw: Array


def way_of(track: OdometryTrack, shown: Shown, before: Way | None = None) -> Way | None:
    """The way of a drive by its images; None where they do not clearly show a loss in turns.

    Images of a map that was learned with the way `before` show another loss, but no other scale.
    """
    seconds = seconds_since_start(track.stamps_ns)
    driven = np.interp(shown.time_s, seconds, track.sums[:, LENGTH])
    part = track.part[np.searchsorted(seconds, shown.time_s, 'right') - 1]
    first, last = _pairs(driven, part)
    if len(first) < PAIRS_MIN:
        return None
    turn = np.exp(1j * (shown.yaw - np.interp(shown.time_s, seconds, track.yaw)))
    turn = turn[first] + turn[last]
    turn /= np.maximum(np.abs(turn), 1e-9)
    by_odometry, by_loss = (
        turn * (way[last] - way[first])
        for way in (
            _interpolated(shown.time_s, seconds, steps)
            for steps in (track.steps(), track.way_per_loss())
        )
    )
    moved = shown.places[last] - shown.places[first]
    way, std = _fitted(moved, by_odometry, -by_loss)
    if not 1 / LARGEST_SCALE < way.scale < LARGEST_SCALE:
        return None
    if before is not None:
        shape = by_odometry - way.loss / way.scale * by_loss
        whole = before.scale * by_odometry - before.loss * by_loss
        scale = float(np.real(np.vdot(shape, whole)) / np.real(np.vdot(shape, shape)))
        way, std = Way(scale, way.loss / way.scale * scale), std * scale / way.scale
    clear = CHANCE_STDS * std < abs(way.loss) < LARGEST_LOSS
    return way if clear else None


def _interpolated(at: Array, seconds: Array, steps: Complex) -> Complex:
    """The sum of steps (N - 1,) until some times (M,)."""
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(np.interp(at, seconds, total.real) + 1j * np.interp(at, seconds, total.imag))


def _fitted(moved: Complex, by_odometry: Complex, by_loss: Complex) -> tuple[Way, float]:
    """The way, and the standard deviation of its loss, by Cauchy's weights: some places of the
    images are outliers.
    """
    columns = np.column_stack([by_odometry, by_loss])
    rows = np.vstack([columns.real, columns.imag])
    values = np.concatenate([moved.real, moved.imag])
    weight, std = np.ones(len(values)), 0.0
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
        missed = values - rows @ found
        std = max(MEDIAN_TO_STD * float(np.median(np.abs(missed))), 1e-9)
        weight = 1 / (1 + (missed / (_HALF * std)) ** 2)
    variance = np.linalg.pinv((rows * weight[:, None]).T @ rows) * std**2
    return Way(float(found[0]), float(found[1])), float(np.sqrt(variance[1, 1]))


def _pairs(driven: Array, part: Indices) -> tuple[Indices, Indices]:
    """Pairs of images at least STEP_M of way apart, each beginning where the one before ended."""
    first, last, start = [], [], 0
    for k in range(1, len(driven)):
        if part[k] != part[start]:
            start = k
        elif driven[k] - driven[start] >= STEP_M:
            first.append(start)
            last.append(k)
            start = k
    return np.array(first, np.int64), np.array(last, np.int64)
