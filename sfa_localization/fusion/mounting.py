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
in any light, it is below 0.1 m; such places are wrong by up to twice the lever after turning."""
_DEPENDENCE = 4.0  # images a quarter of a meter apart, of errors that are alike over a meter
_SPACING_M, _SPACING_RAD = 0.25, 0.26  # nearer ones show nothing of their own
_DRIFT_M, _SLIP_M = 0.05, 0.14  # of the odometry: m per m of a bias, and per root of a m
_LEAST_KNOWN_RAD = 0.3  # images less certain of the heading show no lever
# Standard deviation of a lever that is still believed where the robot is found again.
_KNOWN_M = 0.3
# Images beyond this d2 show neither; they make both less certain, by this factor on the variances,
# the place at most by so much (m).
_OUTLIER_D2, _WIDENING, _LARGEST_M = 9.0, 4.0, 100.0


class Mounting(NamedTuple):
    """The robot's place by images and odometry, and the `lever`, both x + i y in m; the lever's
    axes are ahead and left. With it the variances of both along each axis, m^2, and their
    covariance, at the last image that counted.
    """

    place: complex
    lever: complex
    place_variance: float
    covariance: complex
    lever_variance: float
    dead_reckoned: tuple[float, float, float]
    traveled_m: float
    driven_variance: float
    suspected: bool = False

    @property
    def variance(self) -> float:
        """Of the position along each axis, on top, while the estimate is not trusted."""
        return abs(self.lever) ** 2 / 2 if self.suspected else 0.0

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
        return _placed(0j, LEVER_STD_M**2, image, driven_variance)
    way_m = abs(image.traveled_m - last.traveled_m)
    turned = abs(wrap_angle(image.dead_reckoned[2] - last.dead_reckoned[2]))
    if way_m < _SPACING_M and turned < _SPACING_RAD:
        return last
    return _corrected(_driven(last, image, way_m, driven_variance), image)


def elsewhere(last: Mounting | None, image: Evidence, driven_variance: float) -> Mounting | None:
    """After the estimate was moved: the place is known anew, and the lever stays as it was, where
    images that showed the robot elsewhere did not make it uncertain.
    """
    if last is None or not image.yaw_variance < _LEAST_KNOWN_RAD**2:
        return last
    if last.lever_variance > _KNOWN_M**2:
        return _placed(0j, LEVER_STD_M**2, image, driven_variance)
    begun = _placed(last.lever, last.lever_variance, image, driven_variance)
    return begun._replace(suspected=last.suspected)


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
        return _widened(driven)
    place_gain, lever_gain = of_place / expected, of_lever / expected
    return _judged(
        driven._replace(
            place=driven.place + place_gain * innovation,
            lever=driven.lever + lever_gain * innovation,
            place_variance=driven.place_variance - expected * abs(place_gain) ** 2,
            covariance=driven.covariance - expected * place_gain * lever_gain.conjugate(),
            lever_variance=driven.lever_variance - expected * abs(lever_gain) ** 2,
        )
    )


def _widened(driven: Mounting) -> Mounting:
    """Both less certain: the robot may have been carried, the camera moved, or the image wrong.

    What is known of the lever fades into what was before, and the place moves with it.
    """
    before = max(driven.lever_variance, 1e-9)
    variance = _WIDENING / (1 / before + (_WIDENING - 1) / LEVER_STD_M**2)
    lever = driven.lever * variance / (_WIDENING * before)
    of_lever = variance / before
    of_place = min(_WIDENING, _LARGEST_M**2 / max(driven.place_variance, 1e-9))
    return _judged(
        driven._replace(
            place=driven.place + driven.covariance / before * (lever - driven.lever),
            lever=lever,
            place_variance=of_place * driven.place_variance,
            covariance=math.sqrt(of_place * of_lever) * driven.covariance,
            lever_variance=variance,
        )
    )


def _judged(mounting: Mounting) -> Mounting:
    """Whether the lever is none by chance."""
    part = RELEASED if mounting.suspected else 1.0
    least_m = part * max(SUSPECTED_M, SUSPECTED_STDS * math.sqrt(max(mounting.lever_variance, 0.0)))
    return mounting._replace(suspected=abs(mounting.lever) > least_m)
