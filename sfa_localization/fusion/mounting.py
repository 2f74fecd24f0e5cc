# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether images show the robot's place, or one beside it that turns with the robot.

A camera that was mounted elsewhere after the training, or whose mirror has slipped, shows places
that lie ahead of the robot, or to one side of it, by a constant lever. On a straight line that is
like another position; with the first turn the odometry shows it. A Kalman filter of two points in
the plane holds the robot's place and the lever; the place moves with the odometry, and images show
the sum: z = place + exp(i yaw) lever.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING, NamedTuple

from sfa_localization.data.geometry import wrap_angle

if TYPE_CHECKING:
    from sfa_localization.fusion.belief import Evidence

LEVER_STD_M, WALK_M = 1.0, 0.03
"""Standard deviation of the lever before anything is known, and of its change per root of a meter:
more than any camera moves, so that a mean over the last twenty meters or so remains."""
SUSPECTED_M, SUSPECTED_STDS, RELEASED = 0.4, 3.5, 0.5
"""A lever beyond both is none by chance, and until it is below this part of both. On honest drives,
in any light, it is at most 0.11 m; such places are wrong by up to twice the lever after turning."""
_DEPENDENCE = 4.0  # images a quarter of a meter apart, of errors that are alike over a meter
_SPACING_M, _SPACING_RAD = 0.25, 0.26  # nearer ones show nothing of their own
_DRIFT_M, _SLIP_M = 0.05, 0.14  # of the odometry: m per m of a bias, and per root of a m
_LEAST_KNOWN_RAD = 0.3  # images less certain of the heading show no lever
# Standard deviation of a lever that is still believed where the robot is found again.
_KNOWN_M = 0.3
# Standard deviation of a lever that is known to be none of a meter; none is longer than 3 sigma.
_TESTED_M, _FARTHEST_STDS = 0.4, 3.0
# An image beyond this d2 shows neither; so many in a row show that nothing is known any more.
_OUTLIER_D2, _OUTLIERS = 9.0, 2


class Mounting(NamedTuple):
    """The robot's place by images and odometry, and the `lever`, both x + i y in m; the lever's
    axes are ahead and left. With it the variances of both along each axis, m^2, and their
    covariance, at the last image that counted, and how many `outliers` came since. `moved`: images
    have moved the robot as far as an unknown lever may.
    """

    place: complex
    lever: complex
    place_variance: float
    covariance: complex
    lever_variance: float
    dead_reckoned: tuple[float, float, float]
    traveled_m: float
    driven_variance: float
    outliers: int = 0
    suspected: bool = False
    moved: bool = False

    @property
    def variance(self) -> float:
        """Of the position along each axis, on top, while the estimate is not trusted."""
        return abs(self.lever) ** 2 / 2 if self.suspected else 0.0

    @property
    def untested(self) -> bool:
        """Whether a lever may explain why images moved the robot: it has not turned since."""
        return self.moved and self.lever_variance > _TESTED_M**2

    @property
    def problem(self) -> str:
        """What is the matter, in words; '' if nothing."""
        if not self.suspected:
            return ''
        ahead = f'{abs(self.lever.real):.1f} m {"ahead" if self.lever.real > 0 else "behind"}'
        aside = f'{abs(self.lever.imag):.1f} m {"left" if self.lever.imag > 0 else "right"}'
        return f'images show places {ahead} and {aside} of the robot: was the camera moved?'


def mounted(last: Mounting | None, image: Evidence, driven_variance: float) -> Mounting | None:
    """After another image, accepted or not; `driven_variance`, m^2, is what driving has added to
    the variance of the position along each axis since the start.
    """
    if not image.yaw_variance < _LEAST_KNOWN_RAD**2:
        return last
    if last is None:
        return _unknown(image, driven_variance)
    way_m = abs(image.traveled_m - last.traveled_m)
    turned = abs(wrap_angle(image.dead_reckoned[2] - last.dead_reckoned[2]))
    if way_m < _SPACING_M and turned < _SPACING_RAD:
        return last
    return _corrected(_driven(last, image, way_m, driven_variance), image)


def elsewhere(
    last: Mounting | None, image: Evidence, driven_variance: float, jump_m: float
) -> Mounting | None:
    """After the estimate was moved, by `jump_m`: the place is known anew, and the lever stays as it
    was, where images that showed the robot elsewhere did not make it uncertain, and no lever
    explains them as well.
    """
    if last is None or not image.yaw_variance < _LEAST_KNOWN_RAD**2:
        return last
    as_lever = last.untested or LEVER_STD_M < jump_m < _FARTHEST_STDS * LEVER_STD_M
    if last.lever_variance > _KNOWN_M**2 or (as_lever and not last.suspected):
        return _unknown(image, driven_variance)._replace(moved=as_lever)
    begun = _placed(last.lever, last.lever_variance, image, driven_variance)
    return begun._replace(suspected=last.suspected)


def _unknown(image: Evidence, driven_variance: float) -> Mounting:
    """Nothing is known but one image."""
    return _placed(0j, LEVER_STD_M**2, image, driven_variance)


def _placed(
    lever: complex, lever_variance: float, image: Evidence, driven_variance: float
) -> Mounting:
    """The place by one image and a lever that is known from before."""
    toward = cmath.exp(1j * image.yaw)
    return Mounting(
        complex(*image.position) - toward * lever,
        lever,
        lever_variance + _DEPENDENCE * image.variance,
        -toward * lever_variance,
        lever_variance,
        image.dead_reckoned,
        image.traveled_m,
        driven_variance,
    )


def _driven(last: Mounting, image: Evidence, way_m: float, driven_variance: float) -> Mounting:
    """The place moved by the odometry since the last image, in the direction that images show."""
    before, now = complex(*last.dead_reckoned[:2]), complex(*image.dead_reckoned[:2])
    step = cmath.exp(1j * (image.yaw - image.dead_reckoned[2])) * (now - before)
    added = max(driven_variance - last.driven_variance, 0.0) + _SLIP_M**2 * way_m
    added += (_DRIFT_M * way_m) ** 2 + image.yaw_variance * abs(step) ** 2
    return last._replace(
        place=last.place + step,
        place_variance=last.place_variance + added,
        lever_variance=min(last.lever_variance + WALK_M**2 * way_m, LEVER_STD_M**2),
        dead_reckoned=image.dead_reckoned,
        traveled_m=image.traveled_m,
        driven_variance=driven_variance,
    )


def _corrected(driven: Mounting, image: Evidence) -> Mounting:
    """The place and the lever after what an image shows of their sum."""
    toward = cmath.exp(1j * image.yaw)
    innovation = complex(*image.position) - driven.place - toward * driven.lever
    of_place = driven.place_variance + driven.covariance * toward.conjugate()
    of_lever = driven.covariance.conjugate() + driven.lever_variance * toward.conjugate()
    expected = (of_place + toward * of_lever).real + _DEPENDENCE * image.variance
    if abs(innovation) ** 2 > _OUTLIER_D2 * expected:
        if driven.outliers + 1 >= _OUTLIERS:
            return _unknown(image, driven.driven_variance)._replace(moved=driven.moved)
        return driven._replace(outliers=driven.outliers + 1)
    place_gain, lever_gain = of_place / expected, of_lever / expected
    lever = driven.lever + lever_gain * innovation
    variance = driven.lever_variance - expected * abs(lever_gain) ** 2
    return driven._replace(
        place=driven.place + place_gain * innovation,
        lever=lever,
        place_variance=driven.place_variance - expected * abs(place_gain) ** 2,
        covariance=driven.covariance - expected * place_gain * lever_gain.conjugate(),
        lever_variance=variance,
        outliers=0,
        suspected=_is_none_by_chance(lever, variance, RELEASED if driven.suspected else 1.0),
    )


def _is_none_by_chance(lever: complex, variance: float, part: float) -> bool:
    least_m = max(SUSPECTED_M, SUSPECTED_STDS * math.sqrt(max(variance, 0.0)))
    return abs(lever) > part * least_m
