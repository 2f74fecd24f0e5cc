# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera sits on the robot, learned with the map.

Odometry moves base_link, images show places of a camera at a lever arm l, ahead + i left, of it.
Image m of segment n lies at

    x_nm = o_n + z_n (q_nm + l exp(i h_nm)),

and in drive d the camera is turned to the left by kappa_d since the first drive, and so are the
offsets. Wheels may slip in turns: a turn by t moves base_link by s (exp(i t) - 1), which looks like
a lever arm. Let r be the residuals of odometry and offsets, A and B their derivatives by the poses
and by v = [l, s, kappa], and N = A^T A. To first order, at the best poses,

    S = B^T B - B^T A N^-1 A^T B,    h = S v - B^T r.

There are two priors of equal probability: the camera sits above base_link, or where it was
measured, to 5 mm, and wheels may slip; or it sits anywhere on the robot and wheels do not slip.
With a prior's covariance C, the posterior has the covariance (S + C^-1)^-1 = D, the mean D h and
the evidence (|D| / |C|)^(1/2) exp(h^T D h / 2), times the likelihood of how images change in turns
on the spot (keyframes/turning.py). The lever arm that tracked points show is one more measurement
of l. The evidence mixes both. Where a drive never turns, l stays uncertain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import (
    CAMERA_STD_M,
    CONTRADICTS,
    GIVEN_STD_M,
    UNKNOWN_YAW_STD,
    Quantity,
)
from sfa_localization.keyframes.turning import UNSURE

SLIP_STD_M = 0.1
"""From base_link to the point about which the wheels turn the robot: a third of the track of a
small robot that slips on one side."""
LEVEL_M2 = 0.03**2
"""Robots sway: in turns, images of a camera above base_link change as if it were 3 cm beside it (0
and 4 cm in two gardens)."""
CAMERA_TURN_STD = 1.0
"""rad, of the yaw of a camera in a later drive, which may be mounted anew."""

MOUNTED_ANEW_RAD = 0.05
"""A camera that was turned by more between two drives was mounted anew, and its yaw on the robot
now is not known. A drive of 100 m shows it to 0.01."""


@dataclass(frozen=True, slots=True)
class Mount:
    """The camera at a `lever` arm, ahead + i left of base_link, m, turned by `yaw` (D,) rad in each
    of D drives, with their `covariance` (2 + D, 2 + D); `given` is a lever arm that was
    measured."""

    lever: complex = 0j
    yaw: tuple[float, ...] = (0.0,)
    given: complex | None = None
    covariance: Array | None = None
    turning: Quantity | None = None
    """|l|^2, m^2, by how images change in turns on the spot."""
    tracked: tuple[complex, float] | None = None
    """The lever arm by the points that images show (`camera/learned_lens.py`), and its standard
    deviation along each axis, m."""
    learned: tuple[complex, float] | None = None
    """The lever arm by images alone, and the standard deviation of its coordinates, m."""

    @classmethod
    def at(cls, place: complex | None) -> Mount:
        """Of a camera at a measured place, ahead + i left, m; None for an unknown one."""
        return cls(place or 0j, given=place)

    @property
    def uncertainty(self) -> Array:
        """The covariance (2 + D, 2 + D), or that of the prior."""
        if self.covariance is not None:
            return self.covariance
        lever_std = CAMERA_STD_M if self.given is None else GIVEN_STD_M
        return np.diag([lever_std**2] * 2 + [CAMERA_TURN_STD**2] * len(self.yaw))

    def _priors(self) -> tuple[Array, Array]:
        """Variances (3 + D,) of [l, s, kappa] without the first drive's yaw, which is 0: of a
        camera above base_link, or at the measured place, and of a camera anywhere on the robot."""
        later = [CAMERA_TURN_STD**2] * (len(self.yaw) - 1)
        placed = GIVEN_STD_M**2
        anywhere = CAMERA_STD_M**2
        slip = SLIP_STD_M**2
        above = [placed, placed, slip, slip, *later]
        return np.array(above), np.array([anywhere, anywhere, placed, placed, *later])

    def of(self, drives: int) -> Mount:
        """The same for so many drives, with yaw 0 in those not seen yet."""
        return replace(self, yaw=(*self.yaw, *[0.0] * (drives - len(self.yaw))))

    def base(self, poses: Array, drive: int) -> Array:
        """Poses (N, 3) of base_link by those (N, 3) of the camera in a drive."""
        yaw = poses[:, 2] - self.yaw[drive]
        place = poses[:, 0] + 1j * poses[:, 1] - self.lever * np.exp(1j * yaw)
        return np.column_stack([place.real, place.imag, yaw])

    def stepped(self, information: Array, gradient: Array) -> Mount:
        """One step on, by S (4 + D, 4 + D) and B^T r (4 + D,) at the mount of the segments."""
        # Of all but the yaw in the first drive, which is 0.
        free = np.delete(np.arange(len(gradient)), 4)
        mount = self.of(len(gradient) - 4)
        center = self.given or 0j
        information, pull = mount._measured(information[np.ix_(free, free)], gradient[free])
        estimates = [_posterior(prior, information, pull) for prior in mount._priors()]
        means, spreads, evidence = map(np.array, zip(*estimates, strict=True))
        levers = center + means[:, 0] + 1j * means[:, 1]
        share = np.array([1.0, 0.0])
        if self.given is None:
            share = special.softmax(evidence + [self._by_turns(lever) for lever in levers])
        mean = share @ means
        deviations = means - mean
        spread = np.einsum('p,pij->ij', share, spreads)
        spread += np.einsum('p,pi,pj->ij', share, deviations, deviations)
        # Without the slip, and with the yaw in the first drive.
        stated = np.delete(np.eye(len(gradient)), (2, 3), axis=0)[:, free]
        return replace(
            self,
            lever=center + complex(*mean[:2]),
            yaw=(0.0, *mean[4:].tolist()),
            covariance=stated @ spread @ stated.T,
            learned=(complex(levers[1]), float(np.sqrt(spreads[1].diagonal()[:2].mean()))),
        )

    def _measured(self, information: Array, gradient: Array) -> tuple[Array, Array]:
        """The information on [l, s, kappa] (3 + D, 3 + D), with that of tracked points, and its
        product with the likeliest values, counted from the center of the priors."""
        center = self.given or 0j
        moved = self.lever - center
        pull = information @ [moved.real, moved.imag, 0.0, 0.0, *self.yaw[1:]] - gradient
        if self.tracked is not None:
            tracked, std = self.tracked
            information[[0, 1], [0, 1]] += 1 / std**2
            pull[:2] += (tracked - center).real / std**2, (tracked - center).imag / std**2
        return information, pull

    def _by_turns(self, lever: complex) -> float:
        """Logarithm of the likelihood of the changes of images in turns, for a lever."""
        if self.turning is None:
            return 0.0
        square = abs(lever) ** 2
        measured, std = self.turning
        variance = std**2 + LEVEL_M2**2 + (UNSURE * square) ** 2
        return -(((square - measured) ** 2) / variance + math.log(variance)) / 2

    @property
    def contradiction(self) -> str:
        """The sentence that says how images contradict a measured lever arm, or ''."""
        if self.given is None or self.learned is None:
            return ''
        lever, std = self.learned
        given = self.given
        if abs(lever - given) < CONTRADICTS * math.hypot(std, GIVEN_STD_M):
            return ''
        return (
            f'the camera is stated to be {given.real:.2f} m ahead and {given.imag:.2f} m left of '
            f'base_link, but images show {lever.real:.2f} and {lever.imag:.2f} m (+- {std:.2f}): '
            'check camera_xy, or /tf_static'
        )

    def differs(self, other: Mount, least_m: float) -> bool:
        """Whether another mount moves what is a meter away by more than this."""
        turned = np.abs(np.subtract(self.yaw, other.yaw)).max()
        return max(abs(self.lever - other.lever), float(turned)) > least_m

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Of `Rig`: the lever arm, and the mean yaw of the drives."""
        ahead_std, left_std = np.sqrt(np.diag(self.uncertainty)[:2]).tolist()
        spread = float(np.std(self.yaw, ddof=1)) if len(self.yaw) > 1 else 0.0
        # A filter would take a constant angle for noise.
        spread = spread if max(map(abs, self.yaw)) < MOUNTED_ANEW_RAD else UNKNOWN_YAW_STD
        return {
            'camera_ahead': Quantity(self.lever.real, ahead_std),
            'camera_left': Quantity(self.lever.imag, left_std),
            'camera_yaw': Quantity(float(np.mean(self.yaw)), spread),
        }


def _posterior(prior: Array, information: Array, pull: Array) -> tuple[Array, Array, float]:
    """Mean (3 + D,) of [l, s, kappa] without the first drive's yaw, covariance, and logarithm of
    the evidence, with the variances (3 + D,) of a prior."""
    spread = np.asarray(np.linalg.inv(information + np.diag(1 / prior)), float)
    mean = spread @ pull
    size = np.linalg.slogdet(spread)[1] - np.log(prior).sum()
    return mean, spread, (size + pull @ mean) / 2
