# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What images show of the odometry's errors: its turns, and the way that its wheels lose in them.

Wheels that slip err in turns by tens of degrees a minute, where the shifts of neighboring images
err by one; of trees near and far they err more than any wheel. A loop closure measures what the
robot turned since it was at the place before, however long ago, so that the errors of both sources
need not be assumed. Their mean is weighted by the inverse of their variances.

Odometry of real robots counts more way in a turn than they drive: wheels slide, and controllers
slow down. Four small robots lost 0.07 to 0.1 m per radian, half of all that their odometry missed.
A map averages over that where tracks cross, so that its images show it: between images some
decimeters apart they move by D - loss L, with the odometry's displacement D turned into the map,
and what one m/rad takes from it, L.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Run, Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, evenly, outlier_factor
from sfa_localization.keyframes.closures import Closures, driven
from sfa_localization.metric.dead_reckoning import (
    LENGTH,
    OdometryTrack,
    TurnCorrection,
    Way,
    seconds_since_start,
    summed,
)

CLOSURES_MIN = 30
"""With fewer in the drives, chance decides which source is better."""
BETTER = 2.0
"""Images are used where the noise of their turns is smaller by this factor: others change little,
and their errors are not as white as those of good odometry."""
# rad per square root of s: closures, exact to a fraction of a degree, show no smaller noise.
_LEAST_NOISE = 1e-4
STEP_M = 0.3
"""Images this far apart are compared: nearer ones hide a loss in their own errors."""
CHANCE_STDS = 4.0
"""A loss below so many standard deviations may be chance."""
LARGEST_LOSS, LARGEST_SCALE = 0.3, 1.5
"""m per radian, half the track of a large robot, and the scale of its way: beyond them the images
show something else than a loss in turns."""
PAIRS_MIN = 50
"""Fewer pairs of images are no evidence."""
REACH_M, UNEQUAL = (3.0, 50.0), 0.02
"""Least m between two places that two drives have passed, many times what closures are apart, and
most m driven between them; two pairs of wheels of one size differ by less than the second."""
# Closures of two drives that are paired.
_PAIRED = 400
_ROUNDS = 10  # of reweighting, from where the fit hardly changes


logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Headings:
    """Two headings of one drive at its N images, rad, unwrapped: by the odometry's `track`, and
    by the sum of the shifts between images, `seen`, whose sign may be either.
    """

    stamps_ns: Stamps
    time_s: Array
    track: Array
    seen: Array
    part: Indices

    @classmethod
    def of(cls, track: OdometryTrack, stamps_ns: Stamps, seen: Sequence[float]) -> Headings:
        """At stamps (N,) by the clock of the odometry; `seen` (N,) rad."""
        times = (stamps_ns - track.stamps_ns[0]) * 1e-9
        own = np.interp(times, seconds_since_start(track.stamps_ns), track.yaw)
        part = track.part[np.searchsorted(track.stamps_ns[1:], stamps_ns, 'right')]
        return cls(stamps_ns, times, own, np.unwrap(np.asarray(seen, float)), part)

    def correction(self, sign: float, share: float, noise: float) -> TurnCorrection:
        """What to add to the track's yaw, that the images have this share of the mean."""
        # Shifts are known to whole turns: between neighboring images both differ by less than half.
        apart = np.unwrap(sign * self.seen - self.track)
        return TurnCorrection(self.stamps_ns, share * (apart - apart[0]), noise)


def corrections(drives: Sequence[Headings], closures: Closures) -> list[TurnCorrection] | None:
    """Of each drive; None where the closures do not show that its images turn better.

    The images of drive k follow those of the drives before in the indices of the closures.
    """
    errors, time_s = _errors(drives, closures)
    if len(time_s) < CLOSURES_MIN:
        return None
    noise = MEDIAN_TO_STD * np.median(np.abs(errors) / np.sqrt(time_s), axis=1)
    odometry, same, opposite = np.maximum(noise, _LEAST_NOISE).tolist()
    sign, images = min((1.0, same), (-1.0, opposite), key=lambda pair: pair[1])
    if BETTER * images > odometry:
        return None
    total = odometry**2 + images**2
    share, left = odometry**2 / total, odometry * images / np.sqrt(total)
    return [drive.correction(sign, share, left) for drive in drives]


def _errors(drives: Sequence[Headings], closures: Closures) -> tuple[Array, Array]:
    """By how much odometry, images, and images of the other sign miss the turn (3, L) rad of each
    closure of an unbroken part of a drive with itself, and its time (L,) s.
    """
    missed, times, start = [np.zeros((3, 0))], [np.zeros(0)], 0
    for drive in drives:
        own = closures.images - start
        inside = ((own >= 0) & (own < len(drive.time_s))).all(1)
        first, last = own[inside].T
        whole = drive.part[first] == drive.part[last]
        first, last, inside = first[whole], last[whole], np.flatnonzero(inside)[whole]
        start += len(drive.time_s)
        turned = [h[last] - h[first] for h in (drive.track, drive.seen, -drive.seen)]
        elapsed = np.abs(drive.time_s[last] - drive.time_s[first])
        missed.append(np.asarray(wrap_angle(np.array(turned) - closures.turn[inside])))
        times.append(np.maximum(elapsed, 1.0))
    return np.concatenate(missed, axis=1), np.concatenate(times)


def way_of(
    track: OdometryTrack, stamps_ns: Stamps, poses: Array, before: Way | None = None
) -> Way | None:
    """The way of a drive by its images; None where they do not clearly show a loss in turns.

    `poses` (M, 3) are x m, y m by the images alone and yaw rad, in a map, at `stamps_ns` (M,) by
    the clock of the odometry.
    Images of a map that was learned with the way `before` show another loss, but no other scale.
    """
    seconds, time_s = seconds_since_start(track.stamps_ns), (stamps_ns - track.stamps_ns[0]) * 1e-9
    places, yaw = poses[:, 0] + 1j * poses[:, 1], poses[:, 2]
    driven = np.interp(time_s, seconds, track.sums[:, LENGTH])
    part = track.part[np.searchsorted(seconds, time_s, 'right') - 1]
    first, last = _pairs(driven, part)
    if len(first) < PAIRS_MIN:
        return None
    turn = np.exp(1j * (yaw - np.interp(time_s, seconds, track.yaw)))
    turn = turn[first] + turn[last]
    turn /= np.maximum(np.abs(turn), 1e-9)
    ways = (np.interp(time_s, seconds, summed(s)) for s in (track.steps(), track.way_per_loss()))
    by_odometry, by_loss = (turn * (way[last] - way[first]) for way in ways)
    moved = places[last] - places[first]
    way = _fitted(moved, by_odometry, -by_loss)
    if not 1 / LARGEST_SCALE < way.scale < LARGEST_SCALE:
        return None
    if before is not None:
        shape = by_odometry - way.loss / way.scale * by_loss
        whole = before.scale * by_odometry - before.loss * by_loss
        scale = float(np.real(np.vdot(shape, whole)) / np.real(np.vdot(shape, shape)))
        way = way.scaled(scale / way.scale)
    clear = CHANCE_STDS * way.loss_std < abs(way.loss) < LARGEST_LOSS
    return way if clear else None


def _fitted(moved: Complex, by_odometry: Complex, by_loss: Complex) -> Way:
    """The way without outliers among the places of the images."""
    columns = np.column_stack([by_odometry, by_loss])
    rows = np.vstack([columns.real, columns.imag])
    values = np.concatenate([moved.real, moved.imag])
    weight, std = np.ones(len(values)), 0.0
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
        missed = values - rows @ found
        std = max(MEDIAN_TO_STD * float(np.median(np.abs(missed))), 1e-9)
        weight = 1 / outlier_factor((missed / std) ** 2)
    variance = np.linalg.pinv((rows * weight[:, None]).T @ rows) * std**2
    return Way(float(found[0]), float(found[1]), float(np.sqrt(variance[1, 1])))


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


def same_scale(runs: Sequence[Run], closures: Closures) -> tuple[Run, ...]:
    """Drives whose wheels count the way alike, as those of the first one: where two drives pass the
    same places, closures show which of them counts more between these.
    """
    counts = np.array([len(run.panoramas) for run in runs])
    even = [runs[0]]
    for number, run in enumerate(runs[1:], 1):
        images = closures.images - [0, counts[:number].sum()]
        images = images[((images >= 0) & (images < counts[[0, number]])).all(axis=1)]
        even.append(_rescaled(runs[0], run, images) if len(images) >= CLOSURES_MIN else run)
    return tuple(even)


def _rescaled(first: Run, run: Run, images: Indices) -> Run:
    """A drive with the scale of a first one, by images (L, 2) that both took at the same places."""
    pairs = images[evenly(len(images), _PAIRED)].T
    (there, well), (here, also) = _distances(first, pairs[0]), _distances(run, pairs[1])
    usable = np.triu(well & also)
    if not usable.any():
        return run
    ratio = np.log(here[usable] / there[usable])
    middle = float(np.median(ratio))
    # Pairs share their closures.
    std = MEDIAN_TO_STD * float(np.median(np.abs(ratio - middle))) / np.sqrt(pairs.shape[1])
    if abs(middle) < max(UNEQUAL, CHANCE_STDS * std):
        return run
    factor = float(np.exp(middle))
    logger.warning(
        '%s: its wheels count %.3g times the way of those of %s: taken into account',
        run.name, factor, first.name,
    )  # fmt: skip
    odometry, way = run.odometry, np.array([factor, factor, 1.0])
    poses, twists = odometry.poses / way, odometry.twists / way[1:]
    return replace(run, odometry=replace(odometry, poses=poses, twists=twists))


def _distances(run: Run, images: Indices) -> tuple[Array, Mask]:
    """Distances (L, L) m by odometry between images (L,), and which of them it knows well."""
    odometry, stamps = run.odometry, run.panoramas.stamps_ns[images]
    x, y, _ = odometry.trajectory.at(stamps).T
    apart = np.abs(np.subtract.outer(x + 1j * y, x + 1j * y))
    way = driven(odometry, run.panoramas.stamps_ns)[images]
    way = np.abs(np.subtract.outer(way, way))
    return apart, (apart > REACH_M[0]) & (way < REACH_M[1])
