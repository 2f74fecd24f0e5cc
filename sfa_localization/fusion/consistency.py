# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether images and odometry show the same motion, and whether the estimate had to be moved.

An image that repeats, a camera that was knocked or a clock that is seconds off gives poses that
pass the gate now and then. Images that stay in one place while the odometry drives half a meter
show it at once. Over some meters the others show: laid on the odometry's path, which is
turned and shifted as one piece, the images lie beside it, move farther or less far, or look into
another direction than the one in which they move. An estimate that was moved once has to be
confirmed by driving, and one that is moved again after that by driving far. Images that all lie on
one side of the estimate, each within what it claims, contradict it together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, align_complex, wrap_angle
from sfa_localization.fusion.belief import COMPARED_IMAGES, Evidence, Pull, Trust
from sfa_localization.fusion.evidence import (
    AGREEING_DISTANCE_M,
    AGREEING_VARIANCES,
    FEW_IMAGES,
    ODOMETRY_DRIFT,
)

SPACING_M = 0.1
"""Images nearer than this to the last one kept show no motion of their own."""
WINDOW_M = 1.5 * AGREEING_DISTANCE_M
"""The newest images over this distance are compared, or more where a slow camera took too few."""
AGREEING_HALF = 0.5
"""Fewer than half of the images on the odometry's path are no outliers: motions differ."""
STOOD_M, STOOD = 0.5, 0.1
"""Images within this part of so long a way, as the odometry drives it, stand: places of a moving
robot spread over half of it or more, over a sixth where images are worst; those of one that stands
over a fortieth at most."""
TURNED_RAD, STRETCHED, CHANCE_STDS = math.radians(12.0), 0.25, 3.5
"""Headings that differ from the direction of motion by more than both angle and standard deviations
were not drawn by chance, nor were images that move farther or less far than odometry by this part:
twice what maps of noisy odometry show in places."""
DOUBTED_STDS, YOUNG_M = 2.0, 4.0
"""The bar is lower once they did, and over this distance after a place has been confirmed: what
images alone have shown so far may be wrong from the start."""
APART_M = 2 * AGREEING_DISTANCE_M
"""Distance that confirms an estimate for the first time after images that were apart in time."""
NOISIEST_TURNS, UNLIKE_M = 6.0, 4 * AGREEING_DISTANCE_M
"""Factor on the noise of turns that real wheels do not need, and the distance that confirms an
estimate with such turns."""
FORGIVEN_M, LONGEST_M = 30.0, 16.0
"""Distance after which an estimate that stayed counts as never moved, and the longest distance
that must confirm one."""
WRONG_MOVE, LARGEST_JUMP_M = 0.22, 1.4
"""Standard deviation of an estimate that images have just moved, of the way by which they did: one
in twenty such moves is wrong, by all of it; and its limit (m), because a robot that was carried far
is not lost."""
LOST_M, LOST_RAD = 1.0, 0.3
"""Images that contradict by less leave the estimate near enough to find a way by."""
FAR_D2 = 3.3
"""One image that is farther off, by more than this squared distance, makes an estimate doubtful."""
SLACK_M = 0.5
"""By so much an estimate may be moved beside what wheels that spun explain: images err."""
PULLED_OVER_M = 5.0
"""Distance over which offsets of images are averaged: their errors are alike over about one."""
PULLED, PULLED_M, RELEASED = 0.6, 0.3, 0.5
"""Mean offset, in standard deviations and in m, from which the estimate is not trusted, and the
part of both below which it is again. One that follows its images is nearer, in any light: after
slip, offsets of 0.9 standard deviations were 0.1 m."""
LEAST_FACTOR = 0.05
"""Least factor by which images of a standing robot are taken to move beside its odometry."""
LEAST_APART_M = 0.1
"""Standard deviation of images about the odometry's path of which none is sure to be less."""
_HEADING_DRIFT_RAD = 0.05  # of odometry over the window
_FIT_STEPS = 5  # of reweighting, from where the fit hardly changes


def watched(trust: Trust, newest: Evidence) -> Trust:
    """The trust after another image, accepted or not."""
    recent = trust.recent
    if recent and abs(newest.traveled_m - recent[-1].traveled_m) < SPACING_M:
        return trust
    recent = (*recent, newest)
    while len(recent) > COMPARED_IMAGES and newest.traveled_m - recent[1].traveled_m >= WINDOW_M:
        recent = recent[1:]
    since_m = newest.traveled_m - trust.moved_m - trust.confirming_m
    doubted = trust.problem or since_m < YOUNG_M
    problem, misfit = stood(recent)
    if not problem:
        problem, misfit = compared(recent, DOUBTED_STDS if doubted else CHANCE_STDS)
    settled = since_m > FORGIVEN_M
    moves = 0 if settled and not problem else trust.moves
    judged = comparable(recent)
    return trust._replace(recent=recent, judged=judged, problem=problem, misfit=misfit, moves=moves)


def hesitant(
    trust: Trust, traveled_m: float, rejected: int, apart: bool, turn_factor: float
) -> Trust:
    """The trust after another image: an estimate that is not confirmed yet is confirmed by what is
    driven from where images contradict the motion no more, nor several `rejected` in a row the
    estimate; one that never was, after such as are `apart` in time, over a longer way. It is longer
    still where turns of images and odometry differ by a `turn_factor` times what is expected, more
    than wheels slip, and contradictions end any confirmation then: images of another robot show
    such turns, and drive as straight as this one for meters, or in the same curves. So what was
    driven under contradictions has to be driven as far without.
    """
    unlike, unconfirmed = turn_factor > NOISIEST_TURNS, trust.unconfirmed(traveled_m)
    if not (unlike or unconfirmed):
        return trust
    if apart or trust.problem or rejected >= FEW_IMAGES:
        doubted_m = trust.doubted_m if unconfirmed else traveled_m
        trust = trust._replace(contradicted_m=traveled_m, doubted_m=doubted_m)
    longer_m = APART_M if apart and not trust.proven else 0.0
    if unlike:
        longer_m = min(max(UNLIKE_M, trust.contradicted_m - trust.doubted_m), LONGEST_M)
    return trust._replace(confirming_m=max(trust.confirming_m, longer_m))


def moved(
    trust: Trust, traveled_m: float, jump_m: float = 0.0, accepted_m: float = math.inf
) -> Trust:
    """The trust after images moved the estimate by a distance; the last that fitted it before came
    at `accepted_m`.

    What had not been confirmed yet is moved on, not again, if by no more than was driven since:
    wheels that spin or slip for seconds make images move an estimate many times, and all is well
    when they end.
    """
    slipped = jump_m <= traveled_m - trust.moved_m + SLACK_M
    unconfirmed = trust.unconfirmed(accepted_m)
    again = trust.moves == 0 or not (slipped and unconfirmed)
    moves = trust.moves + int(again)
    doubted_m, longer_m = traveled_m, AGREEING_DISTANCE_M * 2.0 ** (moves - 1)
    if unconfirmed:
        doubted_m = trust.doubted_m
        longer_m = max(longer_m, trust.confirming_m, traveled_m - doubted_m)
    return Trust(
        recent=trust.recent[-1:],
        moves=moves,
        moved_m=traveled_m,
        confirming_m=min(longer_m, LONGEST_M),
        jump_m=min(WRONG_MOVE * jump_m, LARGEST_JUMP_M),
        doubted_m=doubted_m,
        proven=trust.proven or not unconfirmed,
    )


def begun(traveled_m: float) -> Trust:
    """The trust in a start from an image alone: it may be of another place, or look elsewhere."""
    return Trust(moved_m=traveled_m, confirming_m=AGREEING_DISTANCE_M, doubted_m=traveled_m)


def pulled(pull: Pull | None, traveled_m: float, offset_m: complex, variance: float) -> Pull:
    """After another accepted image, at an offset x + i y of this variance m^2 along each axis."""
    if pull is None:
        return Pull(0j, 0j, traveled_m)
    new = -math.expm1(-abs(traveled_m - pull.traveled_m) / PULLED_OVER_M)
    mean = pull.mean + new * (offset_m / math.sqrt(max(variance, 1e-12)) - pull.mean)
    offset_m = pull.offset_m + new * (offset_m - pull.offset_m)
    part = RELEASED if pull.suspected else 1.0
    suspected = abs(mean) > part * PULLED and abs(offset_m) > part * PULLED_M
    return Pull(mean, offset_m, traveled_m, suspected)


def lies_far(offset: Array, covariance: Array, last: bool) -> bool:
    """Whether an image at an offset (2,) or (3,) [m, m, rad] from the estimate, of this covariance,
    shows that the estimate is LOST; after one that did (`last`), until one lies much nearer. That
    it may err as the images before it does not excuse it: of a robot that is pushed while it
    stands, all images after the first seem to repeat one error.
    """
    (x, y, *yaw), part = offset.tolist(), RELEASED if last else 1.0
    far = math.hypot(x, y) > part * LOST_M or any(abs(turn) > part * LOST_RAD for turn in yaw)
    return bool(far and offset @ np.linalg.solve(covariance, offset) > part**2 * FAR_D2)


def doubts(trust: Trust, accepted_m: float, pull: Pull | None = None) -> list[str]:
    """Why an estimate is not trusted, in words; the last image that fits it came at `accepted_m`
    of the distance traveled.
    """
    found = [trust.problem] if trust.problem else []
    if pull is not None and pull.suspected:
        found.append(f'images lie {abs(pull.offset_m):.1f} m to one side of the estimate')
    if trust.unconfirmed(accepted_m):
        since_m = max(accepted_m - trust.since_m, 0.0)
        times = f' {trust.moves} times in a row' if trust.moves > 1 else ''
        again = f' anew{times}' if trust.moves else ''
        found.append(f'placed{again}, confirmed over {since_m:.1f} m: driving on confirms it')
    return found


def stood(recent: Sequence[Evidence]) -> tuple[str, tuple[float, float]]:
    """The contradiction where the newest images stay in one place while the odometry drives, and
    how far (m, rad) it did; '' where they move, or are too few.
    """
    path = np.array([complex(*item.dead_reckoned[:2]) for item in recent])
    places = np.array([complex(*item.position) for item in recent])
    driven = np.abs(path - path[-1])
    moves = np.abs(places - places[-1]) > STOOD * np.maximum(driven, STOOD_M)
    first = int(np.flatnonzero(moves)[-1]) + 1 if moves.any() else 0
    way_m = float(driven[first:].max())
    if way_m < STOOD_M or len(recent) - first < FEW_IMAGES:
        return '', (0.0, 0.0)
    return 'images stay in one place while the odometry drives', (way_m, 0.0)


def contradiction(recent: Sequence[Evidence]) -> str:
    """How images contradict the odometry's motion; '' where they do not, or are too few."""
    return compared(recent)[0]


def comparable(recent: Sequence[Evidence]) -> bool:
    """Whether images are enough, and over a distance long enough, to show a motion."""
    span_m = recent[-1].traveled_m - recent[0].traveled_m
    return len(recent) >= COMPARED_IMAGES and span_m >= AGREEING_DISTANCE_M


def compared(
    recent: Sequence[Evidence], stds: float = CHANCE_STDS
) -> tuple[str, tuple[float, float]]:
    """The contradiction, and by how much (m, rad) the images differ; see `contradiction`. Within
    so many `stds` headings differ by chance.
    """
    if not comparable(recent):
        return '', (0.0, 0.0)
    span_m = recent[-1].traveled_m - recent[0].traveled_m
    path = np.array([complex(*item.dead_reckoned[:2]) for item in recent])
    places = np.array([complex(*item.position) for item in recent])
    variance = np.array([item.variance for item in recent]) + (ODOMETRY_DRIFT * span_m / 2) ** 2
    weight = 1 / variance
    for _ in range(_FIT_STEPS):
        turn, shift = align_complex(path, places, weight)
        apart = np.abs(turn * path + shift - places)
        square = apart**2 / variance
        weight = 1 / (variance * (1 + square))
    agree = square <= AGREEING_VARIANCES
    if agree.mean() < AGREEING_HALF:
        return 'images and odometry show different motions', (math.sqrt(np.mean(apart**2)), 0.0)
    # Neighboring images err alike, over about a meter: those of a robot that stands, all of them.
    extent_m = min(2 * float(np.abs(path - path.mean()).max()), span_m)
    dependence = max(1.0, len(recent) / (1 + extent_m))
    factor, spread = _stretch(path[agree], places[agree], variance[agree], dependence)
    stretch, std = abs(factor) - 1, math.sqrt(spread + ODOMETRY_DRIFT**2)
    if abs(stretch) > max(STRETCHED, CHANCE_STDS * std):
        shown = f'images move {abs(factor):.1f} times as far as the odometry'
        return shown, (abs(stretch) * span_m, 0.0)
    # Images that hardly move show no direction.
    spread /= max(abs(factor), LEAST_FACTOR) ** 2
    return _turned(recent, agree, float(np.angle(turn)), spread, stds)


def _stretch(
    path: NDArray[np.complex128],
    places: NDArray[np.complex128],
    variance: Array,
    dependence: float,
) -> tuple[complex, float]:
    """The factor that turns and stretches the odometry's path (N,) m to the places (N,) m of
    images, and the variance of its logarithm.

    Weak images may claim meters, `variance` (N,) m^2, and lie on a line: then they show well where
    it leads, as far as `dependence` images that err alike count as one.
    """
    weight = 1 / variance
    along, placed = (each - np.average(each, weights=weight) for each in (path, places))
    lever = max(float(np.sum(weight * np.abs(along) ** 2)), 1e-9)
    factor = complex(np.sum(weight * np.conj(along) * placed)) / lever
    independent = len(path) / dependence
    free = max(independent - 2.0, 0.5)  # the path is turned, stretched, and shifted along both axes
    apart = float(np.mean(np.abs(placed - factor * along) ** 2)) / 2 * independent / free
    excess = min(max(apart, LEAST_APART_M**2) / float(np.mean(variance)), 1.0)
    return factor, excess * dependence / lever


def _turned(
    recent: Sequence[Evidence],
    agree: NDArray[np.bool_],
    turn: float,
    variance: float,
    stds: float,
) -> tuple[str, tuple[float, float]]:
    """Whether headings of images differ from the direction in which their positions move."""
    items = [item for item, fits in zip(recent, agree, strict=True) if fits]
    off = [item.yaw - item.dead_reckoned[2] - turn for item in items if math.isfinite(item.yaw)]
    if not off:
        return '', (0.0, 0.0)
    # Angles have no median; those about their mean direction do.
    mean = float(np.angle(np.mean(np.exp(1j * np.array(off)))))
    angle = float(wrap_angle(mean + np.median(wrap_angle(np.array(off) - mean))))
    yaw_variance = float(np.mean([item.yaw_variance for item in items if math.isfinite(item.yaw)]))
    std = math.sqrt(variance + yaw_variance + _HEADING_DRIFT_RAD**2)
    if abs(angle) < max(TURNED_RAD, stds * std):
        return '', (0.0, 0.0)
    degrees = f'{math.degrees(angle):.0f} degrees'
    return f'images look {degrees} off the motion: was the camera turned?', (0.0, abs(angle))
