# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the odometry that images show: its turns, and the way that wheels lose in turns.

Turns by slipping wheels err by tens of degrees a minute; the sums of shifts between images by one
degree, but by more than wheels among trees near and far. A loop closure measures the turn since the
robot was at the place before: its residuals give the noise of both, and the weights of their mean.

Wheels count more way in a turn than the robot drives: they slide, and controllers slow down. Four
small robots lost 0.07 to 0.1 m per radian, half of the error of their odometry. In a map this
averages out where tracks cross. Over some decimeters its images move by scale D - loss L, where D
is the odometry's displacement in the frame of the map, and L its change by a loss of 1 m/rad.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Run, Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, evenly, outlier_factor
from sfa_localization.keyframes.closures import Closures, driven
from sfa_localization.metric.dead_reckoning import OdometryTrack, Way, spaced, summed

CLOSURES_MIN = 30
"""Fewer closures show by chance that images turn better."""
BETTER = 2.0
"""Images are used if the noise of their turns is smaller by this factor: otherwise they gain
little, and their errors are less white than those of good odometry."""
# rad per square root of s: closures err by a fraction of a degree, and show no smaller noise.
_LEAST_NOISE = 1e-4
STEP_M = 0.3
"""Images this far apart are compared: nearer ones hide a loss in their own errors."""
CHANCE_STDS = 4.0
"""A loss of fewer standard deviations may be chance."""
LARGEST_LOSS, LARGEST_SCALE = 0.3, 1.5
"""m per radian, half the track of a large robot, and scale of the way: beyond them images do not
show a loss in turns."""
PAIRS_MIN = 50
"""Fewer pairs of images are no evidence."""
REACH_M, UNEQUAL = (3.0, 50.0), 0.02
"""The scale of two drives is compared between places that are farther apart than the first, many
times the error of closures, with less way between them; that of equal wheels differs by less than
the third."""
# Closures of two drives that are paired, and rounds of reweighting until the fit settles.
_PAIRED, _ROUNDS = 400, 10


logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Headings:
    """Unwrapped headings of one drive at its N images, rad: by the `track` of the odometry, and by
    the sum of the shifts between `images`, whose sign may be either.
    """

    time_s: Array
    track: Array
    images: Array
    part: Indices

    @classmethod
    def of(cls, track: OdometryTrack, stamps_ns: Stamps, images: Sequence[float]) -> Headings:
        """At stamps (N,) by the clock of the odometry; `images` (N,) rad."""
        time_s = (stamps_ns - track.stamps_ns[0]) * 1e-9
        yaw = np.interp(time_s, track.seconds, track.yaw)
        part = track.part[np.searchsorted(track.stamps_ns[1:], stamps_ns, 'right')]
        return cls(time_s, yaw, np.unwrap(np.asarray(images, float)), part)


def corrections(drives: Sequence[Headings], closures: Closures) -> tuple[list[Array], float] | None:
    """What to add to the yaw (N,) rad of each drive at its images, and the noise of the turns then,
    rad per square root of s; None if the closures do not show that images turn better.

    The closures number the images of all drives one after the other.
    """
    residuals, time_s = _residuals(drives, closures)
    if len(time_s) < CLOSURES_MIN:
        return None
    noise = MEDIAN_TO_STD * np.median(np.abs(residuals) / np.sqrt(time_s), axis=1)
    odometry, same, opposite = np.maximum(noise, _LEAST_NOISE).tolist()
    sign, images = min((1.0, same), (-1.0, opposite), key=lambda pair: pair[1])
    if BETTER * images > odometry:
        return None
    total = odometry**2 + images**2
    # Headings differ by whole turns, and between neighboring images by less than half of one.
    differences = [np.unwrap(sign * drive.images - drive.track) for drive in drives]
    share, noise = odometry**2 / total, odometry * images / np.sqrt(total)
    return [share * (each - each[0]) for each in differences], float(noise)


def _residuals(drives: Sequence[Headings], closures: Closures) -> tuple[Array, Array]:
    """Residuals (3, L) rad of the turns by odometry, images, and images of the other sign, at the
    closures inside an unbroken part of a drive, and their time (L,) s.
    """
    residuals, times, start = [np.zeros((3, 0))], [np.zeros(0)], 0
    for drive in drives:
        rows = closures.images - start
        inside = np.flatnonzero(((rows >= 0) & (rows < len(drive.time_s))).all(1))
        inside = inside[np.ptp(drive.part[rows[inside]], axis=1) == 0]
        first, last = rows[inside].T
        start += len(drive.time_s)
        turned = [h[last] - h[first] for h in (drive.track, drive.images, -drive.images)]
        residuals.append(np.asarray(wrap_angle(np.array(turned) - closures.turn[inside])))
        times.append(np.maximum(np.abs(drive.time_s[last] - drive.time_s[first]), 1.0))
    return np.concatenate(residuals, axis=1), np.concatenate(times)


def way_of(
    track: OdometryTrack, stamps_ns: Stamps, poses: Array, before: Way | None = None
) -> Way | None:
    """The way of a drive by its images; None where they do not clearly show a loss in turns.

    `poses` (M, 3) are x m, y m, yaw rad by the images alone, in a map, at `stamps_ns` (M,) by the
    clock of the odometry. Images of a map that was learned with the way `before` show another loss,
    but no other scale.
    """
    seconds, time_s = track.seconds, (stamps_ns - track.stamps_ns[0]) * 1e-9
    part = track.part[np.searchsorted(seconds, time_s, 'right') - 1]
    rows = spaced(np.interp(time_s, seconds, track.length), STEP_M)
    whole = part[rows[:-1]] == part[rows[1:]]
    first, last = rows[:-1][whole], rows[1:][whole]
    if len(first) < PAIRS_MIN:
        return None
    turn = np.exp(1j * (poses[:, 2] - np.interp(time_s, seconds, track.yaw)))
    turn = np.exp(1j * np.angle(turn[first] + turn[last]))
    by_odometry, by_loss, moved = (
        way[last] - way[first]
        for way in (
            np.interp(time_s, seconds, summed(track.steps())),
            np.interp(time_s, seconds, summed(track.way_per_loss())),
            poses[:, 0] + 1j * poses[:, 1],
        )
    )
    by_odometry, by_loss = turn * by_odometry, turn * by_loss
    way = _fitted(moved, by_odometry, -by_loss)
    if not 1 / LARGEST_SCALE < way.scale < LARGEST_SCALE:
        return None
    if before is not None:
        shape = by_odometry - way.loss / way.scale * by_loss
        whole_way = before.scale * by_odometry - before.loss * by_loss
        scale = float(np.real(np.vdot(shape, whole_way)) / np.real(np.vdot(shape, shape)))
        way = way.scaled(scale / way.scale)
    clear = CHANCE_STDS * way.loss_std < abs(way.loss) < LARGEST_LOSS
    return way if clear else None


def _fitted(moved: Complex, by_odometry: Complex, by_loss: Complex) -> Way:
    """The way by least squares, with smaller weights of outliers among the places of images."""
    columns = np.column_stack([by_odometry, by_loss])
    rows = np.vstack([columns.real, columns.imag])
    values = np.concatenate([moved.real, moved.imag])
    weight = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        (scale, loss), *_ = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)
        residual = values - rows @ [scale, loss]
        std = max(MEDIAN_TO_STD * float(np.median(np.abs(residual))), 1e-9)
        weight = 1 / outlier_factor((residual / std) ** 2)
    variance = np.linalg.pinv((rows * weight[:, None]).T @ rows) * std**2
    return Way(float(scale), float(loss), float(np.sqrt(variance[1, 1])))


def same_scale(runs: Sequence[Run], closures: Closures) -> tuple[Run, ...]:
    """Drives with the median scale of their wheels: where two drives pass the same places, closures
    show which of them counts more way between these. The scales are those of least squares of all
    pairs; they are used if two drives differ clearly.
    """
    starts = np.cumsum([0, *(len(run.panoramas) for run in runs)])
    owner = np.searchsorted(starts, closures.images, 'right') - 1
    pairs, ratios, is_clear = [], [], False
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
    odometry, scale = run.odometry, np.array([factor, factor, 1.0])
    poses, twists = odometry.poses / scale, odometry.twists / scale[1:]
    return replace(run, odometry=replace(odometry, poses=poses, twists=twists))


def _distances(run: Run, images: Indices) -> tuple[Array, Mask]:
    """Distances (L, L) m by odometry between images (L,), and which of them are reliable."""
    x, y, _ = run.odometry.trajectory.at(run.panoramas.stamps_ns[images]).T
    distance = np.abs(np.subtract.outer(x + 1j * y, x + 1j * y))
    way = driven(run.odometry, run.panoramas.stamps_ns)[images]
    way = np.abs(np.subtract.outer(way, way))
    return distance, (distance > REACH_M[0]) & (way < REACH_M[1])
