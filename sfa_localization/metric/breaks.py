# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where a drive's odometry breaks: between two parts of it nothing is assumed of the motion.

Poses break where they jump (data/odometry_steps.py) and the twist does not say that the robot drove
on as before; wheels and images contradict each other where images stand while wheels turn, and
where they show another place after the wheels stood. Sums over a drive hide that; the change of the
images over each step of the odometry, compared with the usual one, shows when it was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, Mask, relative, wrap_angle
from sfa_localization.data.odometry_steps import beyond, tolerance
from sfa_localization.data.run import Odometry, Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD, quantile
from sfa_localization.keyframes.closures import LIKE
from sfa_localization.metric.dead_reckoning import pauses, summed

Textures = tuple[Stamps, NDArray[np.int8]]
"""Stamps (N,) of images, and what is kept of each (N, rows, columns): small, and of zero mean
around the robot."""
STEP = 0.2
"""m or rad, by odometry, between two images that are compared."""
STILL, STRAIGHT = 1 / 20, 0.25
"""Images that change by less than this share of what is usual for a way stand: a standing robot's
change by 1/500 of it, a driving robot's by 1/7 or more (two gardens, four real logs). So much of
the ways ahead is straight: where the robot also turns, images change more."""
STANDING, STOOD_S = 0.01, 1.0
"""Wheels slower than this, m/s or rad/s, stand; a robot that stood so long may have been lifted."""
OTHER = 0.05
"""Images of another place are less alike than this share of all that are as far apart."""
# s around a step in which its usual speed is measured.
_AROUND_S = 0.5
# Correlations below are those of noise.
_LEAST_LIKE = 1e-2


def jumps(odometry: Odometry) -> tuple[Mask, Array, float]:
    """Mask (N - 1,) of the steps that no speed around them explains, the steps (N - 1, 3) that the
    motion around them does, and the standard deviation, m, of the others about these.
    """
    step, dt = relative(odometry.poses[:-1], odometry.poses[1:]), np.diff(odometry.stamps_ns) * 1e-9
    period = max(float(np.median(dt)), 1e-3)
    at = summed(dt)[:-1] + dt / 2
    reach = max(_AROUND_S, 3 * period)
    here = np.arange(len(step))
    first, last = np.searchsorted(at, at - reach), np.searchsorted(at, at + reach, 'right')
    # Messages may be stamped in bundles, or late: nobody knows how long a step took.
    unsure_s = float(np.percentile(np.abs(dt - period), 90))
    shortest_s = np.maximum(dt - unsure_s, 0.0)
    more_s = np.maximum(dt, period) + unsure_s - shortest_s
    single = np.pad(step / np.maximum(dt, period)[:, None], ((1, 1), (0, 0)), 'edge')
    values, found = np.column_stack([step, dt]), np.zeros(len(step), bool)
    for _ in range(2):
        sums = np.vstack([np.zeros(4), np.cumsum(values * ~found[:, None], axis=0)])
        before, after = sums[here] - sums[first], sums[last] - sums[here + 1]
        mean = [each[:, :3] / np.maximum(each[:, 3:], period) for each in (before, after)]
        usual = (before + after)[:, :3] / np.maximum((before + after)[:, 3:], period) * dt[:, None]
        noise = MEDIAN_TO_STD * float(np.median(np.abs(step - usual)[:, :2].max(1)))
        speeds = [*mean, single[:-2], single[2:]]
        allowed = tolerance(np.maximum(dt, period), noise)
        missed = [
            [
                beyond(
                    step[:, axes] - speed[:, axes] * shortest_s[:, None], more_s, [speed[:, axes]]
                )
                for speed in speeds
            ]
            for axes in (slice(0, 2), slice(2, 3))
        ]
        found = np.min(missed, axis=1).max(axis=0) > allowed
    return found, usual, noise


def parted(odometry: Odometry) -> tuple[Odometry, str]:
    """Odometry that breaks at its pauses and jumps, and a sentence on the jumps; '' for none.

    Where the twist says that the robot drove on as before, only the pose has jumped: it goes on.
    """
    if len(odometry.stamps_ns) < 3:
        return odometry, ''
    gap = pauses(odometry)
    found, usual, noise = jumps(odometry)
    found &= ~gap
    step = relative(odometry.poses[:-1], odometry.poses[1:])
    far = float(np.hypot(*(step - usual)[found, :2].T).max(initial=0.0))
    seconds = np.diff(odometry.stamps_ns) * 1e-9
    v, omega = (odometry.twists[1:] * seconds[:, None]).T
    twisted = np.column_stack([v, 0 * v, omega]) - usual
    explained = np.abs(twisted).max(axis=1) < tolerance(seconds, noise)
    broken = found & ~(explained & odometry.twists.any())
    step = np.where(found[:, None], usual, step)
    yaw = odometry.poses[0, 2] + summed(step[:, 2])
    moved = (step[:, 0] + 1j * step[:, 1]) * np.exp(1j * yaw[:-1])
    place = odometry.poses[0, 0] + 1j * odometry.poses[0, 1] + summed(moved)
    part = summed(gap | broken).astype(np.int64)
    if not found.any():
        return replace(odometry, part=part), ''
    poses = np.column_stack([place.real, place.imag, wrap_angle(yaw)])
    return replace(odometry, poses=poses, part=part), _sentence(found, broken, far, seconds.sum())


def _sentence(found: Mask, broken: Mask, far: float, seconds: float) -> str:
    number, cut = int(found.sum()), int(broken.sum())
    times = 'once' if number == 1 else f'{number} times'
    how = ['joined by its motion around'] * (cut < number) + ['cut there'] * (cut > 0)
    text = f'odometry pose jumps {times}, by up to {far:.2f} m: {" or ".join(how)}'
    if number - cut > max(seconds / 60, 1.0):  # not the reset of a driver
        text += '; if a localization corrects it, record the frame odom instead of map'
    return text


def contradicted(
    odometry: Odometry, stamps_ns: Stamps, textures: NDArray[np.int8]
) -> tuple[Odometry, list[str]]:
    """Odometry that breaks where images at stamps (N,) contradict the wheels, and sentences on it.

    `textures` (N, rows, columns) of the images are small, and of zero mean around the robot.
    """
    stamps, step = odometry.stamps_ns, relative(odometry.poses[:-1], odometry.poses[1:])
    seconds = np.diff(stamps) * 1e-9
    moved = np.hypot(step[:, 0], step[:, 1]) + np.abs(step[:, 2])
    still_s = np.where(moved < STANDING * seconds, seconds, 0.0)
    rows, odometer = _apart(stamps_ns, stamps, summed(moved))
    at = (stamps_ns[rows] - stamps[0]) * 1e-9
    if len(rows) < 3:
        return odometry, []
    held, turned = _likeness(textures[rows])
    way = np.diff(np.interp(at, summed(seconds), summed(np.hypot(step[:, 0], step[:, 1]))))
    stands = _stand(-np.log(held), way, way > np.diff(odometer[rows]) / 2)
    stood = np.diff(np.interp(at, summed(seconds), summed(still_s))) > STOOD_S
    other = stood & (turned < min(LIKE, float(np.quantile(turned, OTHER))))
    said = {
        'the wheels turn from {:.1f} s to {:.1f} s while the images stand: cut there': stands,
        'images from {:.1f} s to {:.1f} s, while the wheels stand, move: cut there': other,
    }
    texts = [text.format(*at[pair]) for text, mask in said.items() for pair in _runs(mask)]
    # What contradicts has begun since the image before, and ends before the next one.
    around = np.pad(stands, 1)
    unknown = np.pad(stands | other | around[:-2] | around[2:], 1)
    inside = unknown[np.searchsorted(stamps_ns[rows], stamps, 'right')]
    breaks = (np.diff(odometry.part) != 0) | inside[1:] | inside[:-1]
    return replace(odometry, part=summed(breaks).astype(np.int64)), texts


def _apart(stamps_ns: Stamps, stamps: Stamps, odometer: Array) -> tuple[Indices, Array]:
    """Rows of images that odometry puts STEP apart, and its `odometer` (N,) at all their stamps."""
    start = stamps[0]
    driven = np.interp((stamps_ns - start) * 1e-9, (stamps - start) * 1e-9, odometer)
    rows = np.flatnonzero((stamps_ns >= start) & (stamps_ns <= stamps[-1]))[:1].tolist()
    for row in range(rows[0] if rows else 0, len(driven)):
        if driven[row] - driven[rows[-1]] >= STEP:
            rows.append(row)
    return np.array(rows, np.int64), driven


def _stand(change: Array, way: Array, ahead: Mask) -> Mask:
    """Which steps (N,) change the images by less than their `way` (N,) m alone would, by the steps
    that are mostly `ahead`: wheels may well say that a robot turns which does not.
    """
    if not ahead.any():
        return np.zeros(len(way), bool)
    usual = quantile(change[ahead] / way[ahead], STRAIGHT)
    return np.asarray(change < STILL * usual * way)


def _likeness(textures: NDArray[np.int8]) -> tuple[Array, Array]:
    """Correlations (N - 1,) of neighbors (N, rows, columns) as they are, and where one is turned to
    be most like the other; at least _LEAST_LIKE.
    """
    spectra = np.fft.rfft(textures.astype(np.float32))
    power = np.maximum(np.sum(textures.astype(np.float32) ** 2, axis=(1, 2)), 1e-6)
    products = np.sum(spectra[1:] * spectra[:-1].conj(), axis=1)
    alike = np.fft.irfft(products, textures.shape[2]) / np.sqrt(power[1:] * power[:-1])[:, None]
    alike = np.clip(alike, _LEAST_LIKE, 1.0)
    return alike[:, 0], alike.max(axis=1)


def _runs(mask: Mask) -> NDArray[np.int64]:
    """First and last image (R, 2) of the runs of marked steps (N,) between N + 1 images."""
    return np.flatnonzero(np.diff(np.pad(mask, 1).astype(int))).reshape(-1, 2)
