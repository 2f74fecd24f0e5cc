# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The turns of a drive by odometry and by images, weighed by their noise, which the drive shows.

From image to image, odometry counts the turn w over dt seconds, and images show i over m meters.
Both measure the turn T:

    T = (1 + k) w - b dt + noise of variance A dt + B |w|
    T = i + noise of variance Q + P m min(m, 4 m)

with the factor k and the bias b of each drive. Things beside the way turn images by an angle that
depends on the place (0.01 to 0.05 rad per m of way, over about 4 m): a sum of shifts bends the map,
which closures cannot see, because they return to the place. The variances are fit to the squares of
what images turn more than the odometry, from image to image and over some meters; where bad wheels
hide P, its prior decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sfa_localization.data.geometry import Array, Indices, Mask, wrap_angle
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Stamps
from sfa_localization.data.statistics import outlier_factor
from sfa_localization.keyframes.closures import CLOSURES_MIN, Closures
from sfa_localization.motion.dead_reckoning import OdometryTrack, summed

REACH_M = 4.0
"""Way over which things beside it turn images by a constant angle per meter, at most."""
FOLLOWED_M = 1.0
"""Robots follow commands late: over less way, turns and what is counted of them hardly agree."""
NOISE: Array = np.array([0.003, 0.01, 0.003, 0.013]) ** 2
"""A, B, Q and P before any is learned. In three gardens Q is the square of 0.0013 to 0.005 rad, P
of 0.01 to 0.025 rad per m; of wheels, A is the square of 0.001 to 0.02 and B of 0.001 to 0.15."""
NOISE_FIRST: Array = np.array([0.03, 0.3, 0.01, 0.05]) ** 2
"""From which they are fit: larger than that of any robot, so that no error is far at first."""
NOISE_SPREAD: Array = np.array([3.0, 3.0, 1.0, 1.0])
"""Standard deviations of the logarithms of these."""
GYRO_NOISE: Array = np.array([0.001, 0.005]) ** 2
"""A and B of gyroscopes, where their spread is that of images: also cheap ones are no wheels."""
APART_M = 1.0
"""Images that are farther apart show other things, and match by chance."""
FACTOR_STD = 0.3
BIAS_STD = 0.003
"""Priors: of the factor of wheels on any ground, and of a bias, rad/s."""
FAR = 8.0
"""Standard deviations beyond which an error counts no more: images that match by chance."""
ALIKE = 0.7
"""Images whose turns correlate less with those of the odometry measure another motion."""
# Rounds of weights and variances, from where they hardly change.
_ROUNDS = 8
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Headings:
    """One drive at its N images: unwrapped headings, rad, by the `track` of the odometry, and by
    the sum of the shifts between `images`, whose sign may be either; the way driven, m."""

    stamps_ns: Stamps
    time_s: Array
    track: Array
    images: Array
    part: Indices
    way_m: Array
    bridged: Array
    """rad^2: variance of the odometry's yaw in bridged pauses."""
    by_gyro: bool = False
    """Whether `track` is by a gyroscope."""

    @classmethod
    def of(cls, track: OdometryTrack, stamps_ns: Stamps, images: Sequence[float]) -> Headings:
        """At stamps (N,) by the clock of the odometry; `images` (N,) rad."""
        time_s = (stamps_ns - track.stamps_ns[0]) * 1e-9
        yaw = np.interp(time_s, track.seconds, track.yaw)
        part = track.part[np.searchsorted(track.stamps_ns[1:], stamps_ns, 'right')]
        way_m = np.interp(time_s, track.seconds, track.length)
        bridged = np.interp(time_s, track.seconds, track.bridged[:, 1])
        shown = np.unwrap(np.asarray(images, float))
        return cls(stamps_ns, time_s, yaw, shown, part, way_m, bridged, track.by_gyro)


@dataclass(frozen=True, slots=True)
class Turns:
    """Of a drive at its N images: what to `add` to the yaw of its odometry, rad, and the `variance`
    of the sum of turns then, rad^2 since the start; true over counted turns is `factor`."""

    add: Array
    variance: Array
    factor: Quantity


def estimated(drives: Sequence[Headings], closures: Closures) -> list[Turns] | None:
    """The turns of each drive; None where images turn otherwise than the odometry, and where
    `closures`, which number the images of all drives, show that the odometry turns better.
    """
    if not all(len(drive.track) for drive in drives) or _odometry_is_better(drives, closures):
        return None
    steps = _Steps.of(drives)
    if steps.correlation < ALIKE:
        return None
    add, variance, values, stds = steps.settled()
    ends = np.cumsum([len(drive.track) - 1 for drive in drives])
    parts = zip(np.split(add, ends[:-1]), np.split(variance, ends[:-1]), values, stds, strict=False)
    return [
        Turns(summed(added), summed(variances), Quantity(1 + float(value), float(std)))
        for added, variances, value, std in parts
    ]


def by_images(
    tracks: Sequence[OdometryTrack], headings: Sequence[Headings], closures: Closures
) -> list[OdometryTrack]:
    """The tracks with the turns of their images, where these are `estimated`."""
    turns = estimated(headings, closures)
    if turns is None:
        return list(tracks)
    changes = zip(tracks, headings, turns, strict=True)
    return [track.corrected(at.stamps_ns, each.add, each.variance) for track, at, each in changes]


def _odometry_is_better(drives: Sequence[Headings], closures: Closures) -> bool:
    """Whether odometry misses the turns of closures by less than images of either sign."""
    start = 0
    misses = [np.zeros((3, 0))]
    for drive in drives:
        rows = closures.images - start
        inside = np.flatnonzero(((rows >= 0) & (rows < len(drive.track))).all(1))
        inside = inside[np.ptp(drive.part[rows[inside]], axis=1) == 0]
        headings = np.stack([drive.track, drive.images, -drive.images])
        turned = np.diff(headings[:, rows[inside]])[..., 0]
        misses.append(np.asarray(wrap_angle(turned - closures.turn[inside])))
        start += len(drive.track)
    miss = np.abs(np.concatenate(misses, axis=1))
    if miss.shape[1] < CLOSURES_MIN:
        return False
    by_odometry, same, opposite = np.median(miss, axis=1).tolist()
    return bool(by_odometry < min(same, opposite))


@dataclass(frozen=True, slots=True)
class _Steps:
    """The M steps from image to image of all D drives, rad: turns of the odometry, and how much
    `more` images turn. `sources` (M, 4) multiply the noise A to P, rad^2 in `bridged` pauses add
    to it; `short` and `windows` are the first steps of 1 m and of 4 m. Where the odometry breaks,
    or images are far apart, steps are not `unbroken`."""

    odometry: Array
    more: Array
    own: Mask
    """(M, D) whether a step is of the drive."""
    time_s: Array
    sources: Array
    bridged: Array
    unbroken: Mask
    short: Indices
    windows: Indices
    by_gyro: bool

    @classmethod
    def of(cls, drives: Sequence[Headings]) -> _Steps:
        def steps(name: str) -> NDArray[Any]:
            columns: list[NDArray[Any]] = [np.diff(getattr(drive, name)) for drive in drives]
            return np.concatenate(columns)

        odometry = steps('track')
        images = steps('images')
        time_s = steps('time_s')
        way_m = steps('way_m')
        unbroken = (steps('part') == 0) & (way_m <= APART_M)
        images = wrap_angle(images if images @ odometry >= 0 else -images)
        drive = np.repeat(np.arange(len(drives)), [len(each.track) - 1 for each in drives])
        own = np.equal.outer(drive, np.arange(len(drives)))
        sources = np.column_stack([time_s, np.abs(odometry), np.ones(len(drive)), way_m * REACH_M])
        short, windows = (
            np.append(0, np.flatnonzero(np.diff(summed(way_m)[:-1] // length + drive / 2)) + 1)
            for length in (FOLLOWED_M, REACH_M)
        )
        return cls(
            odometry,
            wrap_angle(images - odometry),
            own,
            time_s,
            sources,
            steps('bridged'),
            unbroken,
            short,
            windows,
            all(drive.by_gyro for drive in drives),
        )

    def settled(self) -> tuple[Array, Array, Array, Array]:
        """What to add to the turns of the odometry (M,) rad, the variances (M,) of the sums, and
        the factors and biases (2 D,) of the drives with their standard deviations.
        """
        prior = np.diag(np.repeat([FACTOR_STD, BIAS_STD], self.own.shape[1]) ** -2)
        noise = NOISE_FIRST
        turns = self.odometry + self.more
        outlier = np.ones(len(self.short))
        errors = self.errors(self.odometry)
        more = self.in_short_windows(self.more)
        counted = self.in_short_windows(errors)
        for _ in range(_ROUNDS):
            by_odometry, total = self.variances(noise)
            # Noise of the turns counted would make their factor too small: they are multiplied by
            # the turns estimated instead (instrumental variables).
            uncertain = self.in_short_windows(total)
            weight = self.whole / (uncertain * outlier)
            weighted = self.in_short_windows(self.errors(turns)).T * weight
            values = np.linalg.solve(weighted @ counted + prior, weighted @ more)
            outlier = outlier_factor((more - counted @ values) ** 2 / uncertain)
            corrected = errors @ values
            residual = self.more - corrected
            add = corrected + self.unbroken * by_odometry / total * residual
            turns = self.odometry + add
            noise = self.noise(residual, noise)
        variance = by_odometry * np.where(self.unbroken, 1 - by_odometry / total, 1.0)
        covariance = np.linalg.inv((counted.T * weight) @ counted + prior)
        return add, variance, values, np.sqrt(np.diag(covariance))

    def variances(self, noise: Array) -> tuple[Array, Array]:
        """Of the turns by odometry, and of odometry and images together, (M,) rad^2."""
        by_odometry = self.sources[:, :2] @ noise[:2] + self.bridged
        return by_odometry, by_odometry + self.sources[:, 2:] @ noise[2:]

    def errors(self, turns: Array) -> Array:
        """(M, 2 D): derivatives of turns (M,) rad by the factors and biases of the drives."""
        return np.hstack([self.own * turns[:, None], self.own * -self.time_s[:, None]])

    def in_short_windows(self, values: NDArray[Any]) -> NDArray[Any]:
        """Sums (W, ...) of steps (M, ...) over short windows."""
        return np.asarray(np.add.reduceat(values, self.short, axis=0))

    @property
    def whole(self) -> Mask:
        """(W,) whether the odometry does not break in short windows."""
        return np.asarray(np.logical_and.reduceat(self.unbroken, self.short))

    @property
    def correlation(self) -> float:
        """Of the turns of images and odometry."""
        x = self.odometry[self.unbroken]
        y = (self.odometry + self.more)[self.unbroken]
        fastest = float(np.max(np.abs(x), initial=0.0))
        y = np.clip(y, -fastest, fastest)  # images that match by chance
        power = float(x @ x) * float(y @ y)
        return float(x @ y / np.sqrt(max(power, _TINY)))

    def _usual_noise(self) -> tuple[Array, Array]:
        """A to P before any is learned, and standard deviations of their logarithms, (4,)."""
        if not self.by_gyro:
            return NOISE, NOISE_SPREAD
        return np.append(GYRO_NOISE, NOISE[2:]), np.tile(NOISE_SPREAD[2:], 2)

    def noise(self, residual: Array, before: Array) -> Array:
        """The likeliest A to P by the `residual` (M,) rad between images and odometry, in steps and
        windows, near those of `before`."""
        single = self.unbroken & (self.bridged == 0)
        whole = np.logical_and.reduceat(single, self.windows)
        rows = np.vstack([self.sources[single], np.add.reduceat(self.sources, self.windows)[whole]])
        rows[:, 3] *= np.minimum(rows[:, 3] / REACH_M**2, 1.0)
        in_windows = np.add.reduceat(residual, self.windows)[whole]
        squares = np.append(residual[single], in_windows) ** 2

        usual, spread = self._usual_noise()

        def cost(logarithms: Array) -> tuple[float, Array]:
            noise = np.exp(logarithms)
            variance = rows @ noise
            ratio = squares / variance
            beside = (logarithms - np.log(usual)) / spread
            near = np.minimum(ratio, FAR**2)
            slope = (1 - near) / variance @ rows * noise / 2 + beside / spread
            misfit = near * (1 + np.log(np.maximum(ratio / near, 1.0)))
            total = (np.log(variance) + misfit).sum() + beside @ beside
            return float(total) / 2, np.asarray(slope)

        best = minimize(cost, np.log(before), jac=True, method='L-BFGS-B')
        return np.asarray(np.exp(best.x))
