# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The way that wheels count wrongly, as images show it.

Wheels count more way in a turn than the robot drives: they slide, and controllers slow down. Four
small robots lost 0.07 to 0.1 m per radian, half of the error of their odometry. Some count too
little speed, also while they stand: by 0.02 m/s. In a map this averages out where tracks cross.
Over some decimeters its images move by scale D - loss L + offset T, where D is the odometry's
displacement in the frame of the map, L its change by a loss of 1 m/rad, and T that by 1 m/s.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from sfa_localization.data.geometry import Array, Complex, Indices, Mask
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Run, Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, evenly, outlier_factor
from sfa_localization.keyframes.closures import CLOSURES_MIN, Closures, driven
from sfa_localization.motion.dead_reckoning import OdometryTrack, Way, spaced, summed

STEP_M = 0.3
"""Images this far apart are compared: nearer ones hide a loss in their own errors."""
CHANCE_STDS = 4.0
"""A loss of fewer standard deviations may be chance."""
OFFSET_STD = 0.01
"""Prior of the offset of the speed, m/s: of five robots 0.003 to 0.023."""
LARGEST_LOSS = 0.3
LARGEST_SCALE = 1.5
"""m per radian, half the track of a large robot, and scale of the way: beyond them images do not
show a loss in turns."""
PAIRS_MIN = 50
"""Fewer pairs of images are no evidence."""
REACH_M = (3.0, 50.0)
UNEQUAL = 0.02
"""The scale of two drives is compared between places that are farther apart than the first, many
times the error of closures, with less way between them; that of equal wheels differs by less than
the third."""
# Closures of two drives that are paired, and rounds of reweighting until the fit settles.
_PAIRED = 400
_ROUNDS = 10


logger = logging.getLogger(__name__)


def way_of(
    track: OdometryTrack, stamps_ns: Stamps, poses: Array, before: Way | None = None
) -> Way | None:
    """The way of a drive by its images; None where they do not clearly show a loss in turns.

    `poses` (M, 3) are x m, y m, yaw rad by the images alone, in a map, at `stamps_ns` (M,) by the
    clock of the odometry. Images of a map that was learned with the way `before` show another loss,
    but no other scale.
    """
    moved, ways = _displacements(track, stamps_ns, poses)
    if len(moved) < PAIRS_MIN:
        return None
    way = _fitted(moved, ways, OFFSET_STD)
    if not _is_clear(way.offset):
        way = _fitted(moved, ways, 0.0)
    if not 1 / LARGEST_SCALE < way.scale < LARGEST_SCALE:
        return None
    if before is not None:
        shape = ways @ way.scaled(1 / way.scale).values
        whole = ways @ before.values
        scale = float(np.real(np.vdot(shape, whole)) / np.real(np.vdot(shape, shape)))
        way = way.scaled(scale / way.scale)
    clear = _is_clear(way.loss) or _is_clear(way.offset)
    return way if clear and abs(way.loss.value) < LARGEST_LOSS else None


def _displacements(
    track: OdometryTrack, stamps_ns: Stamps, poses: Array
) -> tuple[Complex, Complex]:
    """Displacements (K,) m between images that are STEP_M apart without a break, by their `poses`
    (M, 3), and those of `OdometryTrack.ways` (K, 3), in the frame of the map.
    """
    seconds = track.seconds
    time_s = (stamps_ns - track.stamps_ns[0]) * 1e-9
    part = track.part[np.searchsorted(seconds, time_s, 'right') - 1]
    rows = spaced(np.interp(time_s, seconds, track.length), STEP_M)
    whole = part[rows[:-1]] == part[rows[1:]]
    first = rows[:-1][whole]
    last = rows[1:][whole]
    turn = np.exp(1j * (poses[:, 2] - np.interp(time_s, seconds, track.yaw)))
    turn = np.exp(1j * np.angle(turn[first] + turn[last]))
    driven = np.column_stack([np.interp(time_s, seconds, summed(way)) for way in track.ways().T])
    places = poses[:, 0] + 1j * poses[:, 1]
    return places[last] - places[first], turn[:, None] * (driven[last] - driven[first])


def _is_clear(error: Quantity) -> bool:
    return CHANCE_STDS * error.std < abs(error.value)


def _fitted(moved: Complex, ways: Complex, offset_std: float) -> Way:
    """The way by least squares of displacements (K,) by those of `OdometryTrack.ways` (K, 3), with
    smaller weights of outliers among the places of images; `offset_std` m/s is a prior."""
    rows = np.vstack([ways.real, ways.imag])
    values = np.concatenate([moved.real, moved.imag])
    prior = np.diag([0.0, 0.0, max(offset_std, 1e-6) ** -2])
    weight = np.ones(len(values))
    std = 1.0
    for _ in range(_ROUNDS):
        weighted = (rows * weight[:, None]).T / std**2
        covariance = np.linalg.pinv(weighted @ rows + prior)
        way = covariance @ (weighted @ values)
        residual = values - rows @ way
        std = max(MEDIAN_TO_STD * float(np.median(np.abs(residual))), 1e-9)
        weight = 1 / outlier_factor((residual / std) ** 2)
    _, *stds = np.sqrt(np.diag(covariance)).tolist()
    scale, *errors = way.tolist()
    return Way(scale, *(Quantity(*both) for both in zip(errors, stds, strict=True)))


def same_scale(runs: Sequence[Run], closures: Closures) -> tuple[Run, ...]:
    """Drives with the median scale of their wheels: where two drives pass the same places, closures
    show which of them counts more way between these. The scales are those of least squares of all
    pairs; they are used if two drives differ clearly.
    """
    starts = np.cumsum([0, *(len(run.panoramas) for run in runs)])
    owner = np.searchsorted(starts, closures.images, 'right') - 1
    pairs = []
    ratios = []
    is_clear = False
    for first, second in combinations(range(len(runs)), 2):
        images = closures.images[(owner == [first, second]).all(axis=1)] - starts[[first, second]]
        ratio, std = _log_ratio(runs[first], runs[second], images)
        if np.isfinite(std):
            pairs.append(np.eye(len(runs))[second] - np.eye(len(runs))[first])
            ratios.append(ratio)
            is_clear |= abs(ratio) >= max(UNEQUAL, CHANCE_STDS * std)
    if not is_clear:
        return tuple(runs)
    scales = np.linalg.lstsq(np.array(pairs), np.array(ratios), rcond=None)[0]
    scales -= np.median(scales)
    scales[np.abs(scales) < UNEQUAL / 2] = 0.0
    return tuple(map(_rescaled, runs, np.exp(scales).tolist()))


def _log_ratio(first: Run, second: Run, images: Indices) -> tuple[float, float]:
    """The logarithm of how much more way the wheels of a second drive count than those of a first
    one, by images (L, 2) of both at the same places, and its standard deviation; infinite for too
    few.
    """
    images = images[evenly(len(images), _PAIRED)]
    by_first, near = _distances(first, images[:, 0])
    by_second, also_near = _distances(second, images[:, 1])
    usable = np.triu(near & also_near)
    if len(images) < CLOSURES_MIN or not usable.any():
        return 0.0, np.inf
    ratio = np.log(by_second[usable] / by_first[usable])
    middle = float(np.median(ratio))
    std = MEDIAN_TO_STD * float(np.median(np.abs(ratio - middle)))
    return middle, std / np.sqrt(len(images))  # pairs share images: only these are independent


def _rescaled(run: Run, factor: float) -> Run:
    """A drive whose wheels count so many times the way of the median drive."""
    if factor == 1.0:
        return run
    text = '%s: its wheels count %.3g times the way of the median drive: taken into account'
    logger.warning(text, run.name, factor)
    odometry = run.odometry
    scale = np.array([factor, factor, 1.0])
    poses = odometry.poses / scale
    twists = odometry.twists / scale[1:]
    return replace(run, odometry=replace(odometry, poses=poses, twists=twists))


def _distances(run: Run, images: Indices) -> tuple[Array, Mask]:
    """Distances (L, L) m by odometry between images (L,), and which of them are reliable."""
    x, y, _ = run.odometry.trajectory.at(run.panoramas.stamps_ns[images]).T
    distance = np.abs(np.subtract.outer(x + 1j * y, x + 1j * y))
    way = driven(run.odometry, run.panoramas.stamps_ns)[images]
    way = np.abs(np.subtract.outer(way, way))
    return distance, (distance > REACH_M[0]) & (way < REACH_M[1])
