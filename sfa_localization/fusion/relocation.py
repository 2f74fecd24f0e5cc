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
from sfa_localization.fusion.track import Columns, Image

FEW_IMAGES = 3
"""Agreement that is no coincidence: two images always agree on some motion, the third checks."""
AGREEING_M = 2.0
"""Distance over which images must agree: beyond it the errors that neighbors share differ."""
AGREEING_STDS = 3.0
"""Standard deviations within which two images agree."""
START_YAW_STD = 0.3
"""rad: what positions alone must determine the heading to; up to there the EKF is linear enough."""
AGREEING_PER_OTHER = 3
"""With fewer agreeing images per accepted one on the same path, the estimate is rather right."""
OBVIOUS_STDS, OBVIOUS_JUMP_M = 8.0, 1.5
"""A displacement larger than both 8 standard deviations of an image and this (m) has no
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
        images, support = self.images, belief.memory.support
        if images < AGREEING_PER_OTHER * self.contradicting or images <= self.dissenting:
            return False
        # A young estimate is overruled by one image more than it rests on.
        enough = images >= min(ENOUGH_IMAGES, max(2, support + 1))
        if not enough or self.covariance[YAW, YAW] > START_YAW_STD**2:
            return False
        if self.distance_m >= max(AGREEING_M, OBVIOUS_STDS * self.position_std):
            return True
        # Turned where it is may be the camera alone: then the way must agree.
        jump_m = math.hypot(*(self.pose[:2] - belief.mean[:2]))
        elsewhere = jump_m >= max(OBVIOUS_JUMP_M, OBVIOUS_STDS * self.position_std)
        return (support < ENOUGH_IMAGES or elsewhere) and self.yaw_std < math.inf


def relocate(images: Sequence[Image], decorrelation_m: float) -> Relocation | None:
    """The pose at the newest image that most others agree with; None without agreement.

    Only images that the filter rejected count. `decorrelation_m`: see ErrorCorrelation.distance_m.
    """
    seen = Columns([image for image in images if not image.accepted])
    tried = [(_agreeing(seen, *turn), turn[0]) for turn in _turns(seen)]
    if not tried:
        return None
    agree, turn = max(tried, key=lambda one: int(one[0].sum()))
    found = _fitted(seen, agree, turn, decorrelation_m)
    oldest_m = images[-1].traveled_m - found.distance_m
    recent = [image for image in images if image.traveled_m >= oldest_m]
    against = sum(image.accepted for image in recent)
    return found._replace(contradicting=against, dissenting=len(recent) - against - found.images)


def _turns(seen: Columns) -> list[tuple[float, float]]:
    """Turns from dead reckoning to the map, with their variances: by the newest image's heading,
    and by its pairs with others.
    """
    found = []
    if seen.has_yaw[-1]:
        turn = float(wrap_angle(seen.yaw[-1] - seen.path_yaw[-1]))
        found.append((turn, float(seen.yaw_variance[-1])))
    both, reach = seen.variance + seen.variance[-1], np.abs(seen.path)
    for i in np.flatnonzero(reach > AGREEING_STDS * np.sqrt(both)):
        turn = float(np.angle((seen.place[i] - seen.place[-1]) * np.conj(seen.path[i])))
        found.append((turn, float(both[i] / reach[i] ** 2)))
    return found


def _yaw_residual(seen: Columns, turn: float) -> Array:
    """Measured headings minus those of dead reckoning after a turn; 0 where none is known."""
    return np.asarray(wrap_angle(seen.yaw - seen.path_yaw - turn) * seen.has_yaw)


def _agreeing(seen: Columns, turn: float, turn_variance: float) -> NDArray[np.bool_]:
    """Mask of the images that agree with the newest one under a turn."""
    residual = seen.place - seen.place[-1] - np.exp(1j * turn) * seen.path
    allowed = seen.variance + seen.variance[-1] + seen.drift
    allowed = allowed + turn_variance * np.abs(seen.path) ** 2
    allowed_yaw = seen.yaw_variance + turn_variance + seen.drift
    near = _yaw_residual(seen, turn) ** 2 <= AGREEING_STDS**2 * allowed_yaw
    return np.asarray(near & (np.abs(residual) ** 2 <= AGREEING_STDS**2 * allowed))


def _fitted(
    seen: Columns, agree: NDArray[np.bool_], turn: float, decorrelation_m: float
) -> Relocation:
    """Weighted least squares over the agreeing images: see health._Window for the solution."""
    has_yaw = agree & seen.has_yaw
    weight = agree / (seen.variance + seen.drift)
    yaw_weight = has_yaw / (seen.yaw_variance + seen.drift)
    total = weight.sum()
    middle = (weight @ seen.place) / total
    path, place = seen.path - (weight @ seen.path) / total, seen.place - middle
    seen_turns = np.exp(1j * (turn + _yaw_residual(seen, turn)))
    turn = float(np.angle(weight @ (np.conj(path) * place) + yaw_weight @ seen_turns))
    reach = np.exp(1j * turn) * path[-1]
    turn_variance = 1 / (weight @ np.abs(path) ** 2 + yaw_weight.sum() + _TINY)
    by_turn = np.array([-reach.imag, reach.real, 1.0])
    covariance = np.diag([1 / total, 1 / total, 0.0]) + turn_variance * np.outer(by_turn, by_turn)
    count, distance_m = int(agree.sum()), float(seen.behind_m[agree].max())
    # Neighboring images err alike and count as fewer.
    dependence = max(1.0, count / (1 + distance_m / decorrelation_m))
    x, y, yaw_variance = (middle + reach).real, (middle + reach).imag, math.inf
    if has_yaw.any():
        yaw_variance = float(seen.yaw_variance[has_yaw].mean())
    return Relocation(
        np.array([x, y, wrap(float(seen.path_yaw[-1]) + turn)]),
        covariance * dependence,
        count,
        distance_m,
        math.sqrt(float(seen.variance[agree].mean())),
        math.sqrt(yaw_variance),
    )
