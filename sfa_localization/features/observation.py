# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What one image shows of the robot's pose: by keyframes, by slow features, and by both together.

Slow features and keyframes look at the same image in different ways, so that their errors are
largely independent: together they are better than each, and where they contradict each other, one
of them is known to be wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import UNKNOWN_YAW_STD
from sfa_localization.data.run import Image

Spectra = NDArray[np.complex64]

UNKNOWN_YAW_VARIANCE = UNKNOWN_YAW_STD**2
"""rad^2, of an angle of which nothing is known."""
# Correlations that unknown places do not reach (foreign gardens: 0.35, mirrored ones: 0.35, one
# image 0.43).
LOWEST = 0.42
# Above this `Match.aside` a place is at the border of the keyframes: a straight one has 0.64.
_BORDER = 0.6
# Slow features extrapolate from the same image: they lack so much of what its place adds to the
# standard deviation of a match. (Between keyframes, where it adds little, this changes little.)
_SLOW_SHARE = 0.5
# Squared Mahalanobis distance in the plane that 1 of 400 right estimates exceeds.
_CONTRADICTS = 12.0


@dataclass(frozen=True, slots=True)
class Match:
    """What keyframes show of an image; `MatchNoise.covariance` says how well.

    `pose` (3,) is [x m, y m, yaw rad] in the map. `unlike` is how much of the image no place among
    the keyframes explains: 0 for an image between them in their light, 1 for as much as what they
    have in common; `left` (rows, F) is its spectrum as of an image with yaw 0, None where unknown.
    `variation` is how much the keyframes that are like the image differ, in the unit of `unlike`:
    much where none of them is near, in any light. `aside` is how far the place is from the middle
    of them, of their mean distance: 0 among them, 0.64 at a straight border of theirs, 1 far beside
    all. `noise` (2, 2) m^2 is the covariance of the place by what is left of the image, `apart`
    (2, 2) m^2 how far apart several drives put it (in a map they are shifted), and `elsewhere`
    (3, 3) the scatter of [x, y, yaw] about it of other poses that are as like the image. The
    place is that of the keyframes by `shares` (N,) of sum 1; None where several drives say so.
    `facing` is the mean of exp(i yaw) of these keyframes by their shares.

    `score` is the correlation with the best keyframe, 1 for the same image, and `known` whether it
    is high enough for a known place. `tilt` (2,) rad is the roll and pitch of the robot that the
    image shows against the keyframes.
    """

    pose: Array
    unlike: float
    variation: float
    aside: float
    noise: Array = field(default_factory=lambda: np.zeros((2, 2)))
    apart: Array = field(default_factory=lambda: np.zeros((2, 2)))
    elsewhere: Array = field(default_factory=lambda: np.zeros((3, 3)))
    left: Spectra | None = None
    shares: Array | None = None
    facing: complex = 0j
    score: float = 0.0
    known: bool = False
    tilt: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def at_border(self) -> bool:
        """Whether the place is at the border of the keyframes: it may be farther out."""
        return self.aside > _BORDER


@dataclass(frozen=True, slots=True)
class MatchNoise:
    """How well keyframes of other stretches of driving are found, learned by `fit_keyframes`.

    `temperature` is the difference of correlation that matters, `floor_m` the least standard
    deviation of a position, `slope_m` what it grows by with `Match.unlike`, `factor` what the
    variances of positions lack, `yaw_std` rad the least standard deviation of a heading, which
    grows by as much when `unlike` grows by 1. `lowest` is the correlation below which a place is
    unknown, `usual` the one that 19 of 20 images of known places reach. `joint_factor` is what
    the variances lack of estimates that slow features and keyframes agree on. `by_variation`
    times the square of `Match.variation` is how unlike images in the light of the keyframes are.
    `away_m` times the logarithm of 1 + `unlike` is how far out along each axis an image is that
    seems to be at the border of the keyframes: likeness decays exponentially with the distance.
    """

    temperature: float = 0.02
    floor_m: float = 0.3
    slope_m: float = 0.5
    factor: float = 1.0
    yaw_std: float = 0.03
    lowest: float = LOWEST
    usual: float = 0.6
    joint_factor: float = 1.0
    by_variation: float = 10.0
    away_m: float = 0.8

    def with_map(self, common_m: float, turn_std: float) -> MatchNoise:
        """With the errors of a map, which keyframes that are left out share: standard deviations
        along each axis, m, and of its directions, rad.
        """
        floor, yaw_std = np.hypot(self.floor_m, common_m), np.hypot(self.yaw_std, turn_std)
        return replace(self, floor_m=float(floor), yaw_std=float(yaw_std))

    def by_place(self, match: Match, light: float = 0.0) -> float:
        """How unlike the place makes an image, which is the more unlike because of its `light`; of
        one that is less usual than the left-out ones `novelty` says the rest.
        """
        most = unlikeness(self.usual)
        return min(max((1 + match.unlike) / (1 + light) - 1, 0.0), most)

    def variance(self, by_place: float) -> float:
        """Variance m^2 of a position along each axis, where the place makes images so unlike."""
        return self.floor_m**2 + (self.slope_m * by_place) ** 2

    def covariance(self, match: Match, light: float = 0.0) -> Array:
        """Covariance (3, 3) of the pose of a match in a light that makes images so unlike, see
        `OtherLight`: that moves places less than what is unlike because no keyframe is near.
        """
        covariance = match.elsewhere.copy()
        own = self.variance(self.by_place(match, light)) * np.eye(2) + match.noise
        # Left-out keyframes, which teach the factor, are in the light of a drive: it decides there.
        covariance[:2, :2] = self.factor * (own + match.elsewhere[:2, :2]) + match.apart
        covariance[2, 2] += (self.yaw_std * (1 + match.unlike)) ** 2
        return covariance

    def beyond(self, match: Match, light: float = 0.0) -> float:
        """Standard deviation m along each axis of how far an image, in such a light, is beyond
        the keyframes; 0 among them.
        """
        if not match.at_border:
            return 0.0
        return self.away_m * max(math.log1p(match.unlike) - math.log1p(light), 0.0)

    def expected_unlike(self, variation: float) -> float:
        """How unlike an image in the light of the keyframes is, among such that vary so much."""
        return self.by_variation * variation**2

    def novelty(self, score: float) -> float:
        """1 for a correlation that is just usual, 3 for the lowest of a known place, more below."""
        exponent = (self.usual - score) / (self.usual - self.lowest)
        return float(3.0 ** min(exponent, 4.0))


def unlikeness(score: float) -> float:
    """What an image has beside its correlation with another, as a share of what both have."""
    return max(score, 0.1) ** -2 - 1


@dataclass(frozen=True, slots=True)
class Leveled:
    """The `panorama` (H, W, 3) that a `tilt`, roll and pitch (2,) rad, made the one that was
    `seen`, and what is known of it: the `spectrum` (rows, F) of its texture, that of the part that
    was `visible`, so that its correlations are those of the whole; the `scores` (K,), correlations
    with the keyframes, -inf where unknown, and the `yaws` (K,) rad at which they are reached.
    """

    seen: Image
    panorama: Image
    tilt: Array
    spectrum: Spectra
    visible: Spectra
    scores: NDArray[np.float32]
    yaws: NDArray[np.float32]

    @property
    def score(self) -> float:
        """The correlation with the likest keyframe."""
        return float(self.scores.max())


@dataclass(frozen=True, slots=True)
class Observation:
    """What one image shows: `pose` (3,) [x m, y m, yaw rad] in the map and its `covariance` (3, 3).

    Of an unknown yaw the variance is UNKNOWN_YAW_VARIANCE. `slow_features` (K,); `novelty` is at
    most 1 for a familiar image. `problem` is why the image at `stamp_ns` is unusable, '' where it
    is usable: the covariance then means that nothing is known. `turned` is the heading (rad, from
    any start) that the shifts between the images of a drive add up to, NaN for an unusable one: it
    needs no map, and shows the camera's delay. `tilt` (2,) rad is the roll and pitch of the robot,
    against those of the training.
    """

    pose: Array
    covariance: Array
    slow_features: Array
    novelty: float = 0.0
    stamp_ns: int = 0
    problem: str = ''
    turned: float = math.nan
    tilt: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def position(self) -> Array:
        """Where the robot is, (2,) m."""
        return self.pose[:2]

    @property
    def yaw(self) -> float:
        """Its heading, rad; NaN where unknown."""
        return float(self.pose[2]) if self.covariance[2, 2] < UNKNOWN_YAW_VARIANCE else math.nan

    @property
    def finite(self) -> bool:
        """Whether all of its numbers are."""
        known = (self.slow_features, self.pose, self.covariance)
        return all(bool(np.isfinite(part).all()) for part in known)


def combine(
    slow: Observation, match: Match, noise: MatchNoise, light: float = 0.0, doubt: float = 1.0
) -> tuple[Array, Array]:
    """Pose (3,) and covariance (3, 3) of an image by slow features and keyframes together.

    Slow features show p_s with covariance C_s, keyframes p_k with C_k (`MatchNoise.covariance`).
    Where the place makes the image unlike by u (`MatchNoise.by_place`), slow features extrapolate
    as well; they get a share of what that adds to a match, with b its slope in m:

        C_s' = doubt C_s + (b u / 2)^2 I

    Both are weighted by their information, and where they are farther apart than that allows, by
    their squared Mahalanobis distance d^2 = (p_s - p_k)^T (C_k + C_s')^-1 (p_s - p_k) over its
    mean, 2 in the plane, the covariance grows; j is `MatchNoise.joint_factor`:

        G = C_k (C_k + C_s')^-1,    p = p_k + G (p_s - p_k),
        C = j max(1, d^2 / 2) (G C_s' G^T + (I - G) C_k (I - G)^T)

    The yaw is that of keyframes. Slow features count alone at a place that the keyframes do not
    know; keyframes alone where slow features give no position, contradict them (d^2 > 12), or
    lately did (`doubt` > 1).
    """
    mine, its = noise.covariance(match, light), _slow_covariance(slow, match, noise, light, doubt)
    if not match.known:
        return slow.pose, its
    apart, own, other = slow.position - match.pose[:2], mine[:2, :2], its[:2, :2]
    if doubt > 1 or not (np.isfinite(apart).all() and np.isfinite(other).all()):
        return match.pose, mine
    squared = _squared(apart, own + other)
    if squared > _CONTRADICTS:
        return match.pose, mine
    gain = own @ np.linalg.inv(own + other)
    rest = np.eye(2) - gain
    both = gain @ other @ gain.T + rest @ own @ rest.T
    covariance = np.diag([0.0, 0.0, mine[2, 2]])
    covariance[:2, :2] = noise.joint_factor * max(1.0, squared / 2) * both
    return match.pose + np.append(gain @ apart, 0.0), covariance


def distance(
    slow: Observation, match: Match, noise: MatchNoise, light: float
) -> tuple[float, float]:
    """Half the squared Mahalanobis distance of both positions, 1 on average where both variances
    are right, NaN for an unknown one; and the share that slow features have in the variance.
    """
    if not match.known or not np.isfinite(slow.pose[:2]).all():
        return math.nan, 0.0
    apart, own = slow.pose[:2] - match.pose[:2], noise.covariance(match, light)[:2, :2]
    its = _slow_covariance(slow, match, noise, light)[:2, :2]
    return _squared(apart, own + its) / 2, float(np.trace(its) / np.trace(own + its))


def _slow_covariance(
    slow: Observation, match: Match, noise: MatchNoise, light: float, doubt: float = 1.0
) -> Array:
    """C_s' of `combine`."""
    wider = slow.covariance * doubt
    extrapolated = _SLOW_SHARE * noise.slope_m * noise.by_place(match, light)
    wider[:2, :2] += extrapolated**2 * np.eye(2)
    return wider


def _squared(apart: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance."""
    return float(apart @ np.linalg.solve(covariance, apart))
