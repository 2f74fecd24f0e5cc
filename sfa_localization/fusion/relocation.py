# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the pose at the start, and again where images contradict the estimate.

A measurement that the filter rejects may be wrong, or the filter may be. What decides is whether
the rejected ones agree among themselves: laid along the odometry's path, which is turned and
shifted as one piece, they must match over a number of images and a distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.belief import ENOUGH_IMAGES, Belief
from sfa_localization.fusion.motion import YAW, wrap
from sfa_localization.fusion.track import Image

FEW_IMAGES = 3
"""Agreement that is no coincidence: two images always agree on some motion, the third checks."""
AGREEING_M = 2.0
"""Distance over which images must agree: beyond it the errors that neighbors share differ."""
CAPACITY, REMEMBERED_STDS = 60, 30.0
"""Images remembered at most, and the distance after which one is forgotten, in its standard
deviations: about twice what any decision here asks for, so that agreement may begin late."""
AGREEING_STDS = 3.0
"""Standard deviations within which two images agree."""
ODOMETRY_DRIFT = 0.05
"""Error of odometry that agreement allows for, per meter: m, and rad; a poor robot's 5 %."""
START_YAW_STD = 0.3
"""rad: what positions alone must determine the heading to; up to there the EKF is linear enough."""
AGREEING_PER_OTHER = 3
"""With fewer agreeing images per accepted one on the same path, the estimate is rather right."""
OBVIOUS_STDS, OBVIOUS_JUMP_M, OBVIOUS_TURN_RAD = 8.0, 1.5, 0.5
"""A displacement larger than both 8 standard deviations of an image and this (m, rad) has no
other explanation than that the robot was moved; a smaller one may be the map's own error."""
_TINY = 1e-12  # keeps the variance finite where a lone position shows no turn


class Relocation(NamedTuple):
    """Where agreeing images put the robot now: pose (3,), covariance (3, 3).

    Over the same distance, `contradicting` counts what the filter accepted, `dissenting` what it
    rejected but does not agree either. `position_std` and `yaw_std` are the mean claimed ones.
    """

    pose: Array
    covariance: Array
    images: int
    distance_m: float
    position_std: float
    yaw_std: float
    contradicting: int = 0
    dissenting: int = 0

    def shows_heading(self, remembered: int) -> bool:
        """Whether positions determine the heading, and most of those remembered agree."""
        certain = self.covariance[YAW, YAW] < START_YAW_STD**2
        return bool(certain and self.images >= max(FEW_IMAGES, remembered / 2))

    def outweighs(self, belief: Belief) -> bool:
        """Whether agreeing images outweigh the estimate that they contradict."""
        memory, images = belief.memory, self.images
        if images < AGREEING_PER_OTHER * self.contradicting or self.dissenting >= images:
            return False
        if self.covariance[YAW, YAW] > START_YAW_STD**2:
            return False
        # A young estimate is overruled by one image more than it rests on.
        enough = images >= min(ENOUGH_IMAGES, max(2, memory.support + 1))
        if self.distance_m >= max(AGREEING_M, OBVIOUS_STDS * self.position_std):
            return enough
        obvious = memory.support < ENOUGH_IMAGES or self._displaced(belief.mean)
        return enough and obvious and math.isfinite(self.yaw_std)

    def _displaced(self, mean: Array) -> bool:
        """The robot is elsewhere, or turned, by so much that no error of images explains it."""
        jump_m = math.hypot(*(self.pose[:2] - mean[:2]))
        turn = abs(wrap(float(self.pose[YAW] - mean[YAW])))
        elsewhere = jump_m >= max(OBVIOUS_JUMP_M, OBVIOUS_STDS * self.position_std)
        return elsewhere or turn >= max(OBVIOUS_TURN_RAD, OBVIOUS_STDS * self.yaw_std)


def remembered(images: tuple[Image, ...], newest: Image) -> tuple[Image, ...]:
    """The images with one more, without what lies far behind; of too many, the older half is
    thinned out.
    """
    first, half = 0, CAPACITY // 2
    reach_m = max(3 * AGREEING_M, REMEMBERED_STDS * math.sqrt(newest.variance))
    while first < len(images) and newest.traveled_m - images[first].traveled_m > reach_m:
        first += 1
    kept = (*images[first:], newest)
    return kept if len(kept) <= CAPACITY else kept[:half:2] + kept[half:]


def relocate(images: Sequence[Image], decorrelation_m: float) -> Relocation | None:
    """The pose at the newest image that most others agree with; None without agreement.

    Only images that the filter rejected count. Hypotheses come from the newest one's own heading
    and from its pairs with others. `decorrelation_m`: see ErrorCorrelation.distance_m.
    """
    table = _Table([item for item in images if not item.accepted])
    best: NDArray[np.bool_] | None = None
    turn = 0.0
    for turn_h, variance in table.hypotheses():
        agree = table.agreeing(turn_h, variance)
        if best is None or agree.sum() > best.sum():
            best, turn = agree, turn_h
    if best is None:
        return None
    found = table.relocation(best, turn, decorrelation_m)
    oldest_m = images[-1].traveled_m - found.distance_m
    recent = [item for item in images if item.traveled_m >= oldest_m]
    against = sum(item.accepted for item in recent)
    return found._replace(contradicting=against, dissenting=len(recent) - against - found.images)


class _Table:
    """Images as arrays, the newest last; positions in the plane as complex numbers."""

    def __init__(self, images: Sequence[Image]) -> None:
        self.dead_reckoned = np.array([item.dead_reckoned for item in images])
        self.position = np.array([item.place for item in images])
        self.yaw = np.array([item.yaw for item in images])
        self.has_yaw = np.isfinite(self.yaw)
        self.variance = np.array([item.variance for item in images])
        self.yaw_variance = np.array([item.yaw_variance for item in images])
        traveled = np.array([item.traveled_m for item in images])
        self.behind_m = traveled[-1] - traveled
        self.drift = (ODOMETRY_DRIFT * self.behind_m) ** 2
        step = self.dead_reckoned[:, :2] - self.dead_reckoned[-1, :2]
        self.path = step[:, 0] + 1j * step[:, 1]
        self.shift = self.position - self.position[-1]

    def hypotheses(self) -> list[tuple[float, float]]:
        """Turns from dead reckoning to the map, with their variances."""
        found = []
        if self.has_yaw[-1]:
            turn = float(wrap_angle(self.yaw[-1] - self.dead_reckoned[-1, 2]))
            found.append((turn, float(self.yaw_variance[-1])))
        both = self.variance + self.variance[-1]
        length = np.abs(self.path)
        for i in np.flatnonzero(length > AGREEING_STDS * np.sqrt(both)):
            turn = float(np.angle(self.shift[i] * np.conj(self.path[i])))
            found.append((turn, float(both[i] / length[i] ** 2)))
        return found

    def yaw_residual(self, turn: float) -> Array:
        """Measured headings minus those of dead reckoning after a turn; 0 where none is known."""
        difference = self.yaw - self.dead_reckoned[:, 2] - turn
        return np.asarray(wrap_angle(np.where(self.has_yaw, difference, 0.0)))

    def agreeing(self, turn: float, turn_variance: float) -> NDArray[np.bool_]:
        """Mask of the images that agree with the newest one under a turn."""
        residual = self.shift - np.exp(1j * turn) * self.path
        allowed = self.variance + self.variance[-1] + self.drift
        allowed = allowed + turn_variance * np.abs(self.path) ** 2
        agree = np.abs(residual) ** 2 <= AGREEING_STDS**2 * allowed
        allowed_yaw = self.yaw_variance + turn_variance + self.drift
        near = self.yaw_residual(turn) ** 2 <= AGREEING_STDS**2 * allowed_yaw
        return np.asarray(agree & (~self.has_yaw | near))

    def relocation(
        self, agree: NDArray[np.bool_], turn: float, decorrelation_m: float
    ) -> Relocation:
        """Weighted least squares over the agreeing images: see health._Window for the solution."""
        has_yaw = agree & self.has_yaw
        weight = agree / (self.variance + self.drift)
        yaw_weight = has_yaw / (self.yaw_variance + self.drift)
        total = weight.sum()
        path, shift = (x - (weight @ x) / total for x in (self.path, self.shift))
        off = np.exp(1j * (turn + self.yaw_residual(turn)))
        turn = float(np.angle(weight @ (np.conj(path) * shift) + yaw_weight @ off))
        place = self.position[-1] + (weight @ self.shift) / total + np.exp(1j * turn) * path[-1]
        turn_variance = 1 / (weight @ np.abs(path) ** 2 + yaw_weight.sum() + _TINY)
        lever = 1j * np.exp(1j * turn) * path[-1]
        by_turn = np.array([lever.real, lever.imag, 1.0])
        covariance = np.diag([1 / total, 1 / total, 0.0]) + turn_variance * np.outer(
            by_turn, by_turn
        )
        count, distance_m = int(agree.sum()), float(self.behind_m[agree].max())
        # Neighboring images err alike and count as fewer.
        dependence = max(1.0, count / (1 + distance_m / decorrelation_m))
        yaw_variance = self.yaw_variance[has_yaw].mean() if has_yaw.any() else math.inf
        return Relocation(
            np.array([place.real, place.imag, wrap_angle(self.dead_reckoned[-1, 2] + turn)]),
            covariance * dependence,
            count,
            distance_m,
            math.sqrt(float(self.variance[agree].mean())),
            math.sqrt(float(yaw_variance)),
        )
