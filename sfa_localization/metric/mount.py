# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera sits on the robot, learned with the map.

Odometry moves base_link, images show places of a camera that sits at a lever l, ahead + i left, of
it. Image m of segment n lies at

    x_nm = o_n + z_n (q_nm + l exp(i h_nm)),

and in drive d it looks kappa_d to the left of where it did in the first drive, so that closures
turn by kappa_d more. Wheels may slip in turns: a turn by t moves base_link by s (exp(i t) - 1)
beside, which links take for a lever. With v = [l, s, kappa], for the best [o, z, b] at some v what
is squared of links and closures is r, with derivatives A by [o, z, b] and B by v. To first order

    S = B^T B - B^T A N^-1 A^T B,    h = S v - B^T r,

with N the normal equations of [o, z, b]. Beside them stands what is known of robots: the camera
sits above base_link, or where it was measured, to 5 mm, and wheels may slip; or, as probable, they
do not, and it sits anywhere on the robot. With the prior's covariance C, either has the posterior
covariance (S + C^-1)^-1 = D, the mean D h and the evidence (|D| / |C|)^(1/2) exp(h^T D h / 2),
times the likelihood of how images change in turns on the spot (keyframes/turning.py); by these both
are mixed. A drive that never turns where it is seen again does not show l: it stays uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.data.rig import CAMERA_STD_M, UNKNOWN_YAW_STD, Quantity
from sfa_localization.keyframes.turning import UNSURE

GIVEN_STD_M = 0.005
"""Of a camera's place that was measured on the robot."""
SLIP_STD_M = 0.1
"""How far base_link may be from the point about which wheels turn the robot: a third of the track
of a small one that slips on one side."""
LEVEL_M2 = 0.03**2
"""Images of a camera above base_link may change in turns as if it were 3 cm beside it: robots sway
(two gardens: 0 and 4 cm)."""
CAMERA_TURN_STD = 1.0
"""rad, of the yaw of a camera in a later drive: it may have been taken off and put back anyhow."""

CONTRADICTS = 4.0
"""Standard deviations by which two measurements of a place never differ by chance, in the plane."""
MOUNTED_ANEW_RAD = 0.05
"""A camera turned by more between two drives was taken off: how it looks now, nobody knows. What a
drive of 100 m shows of it errs by 0.01."""


@dataclass(frozen=True, slots=True)
class Mount:
    """The camera at a `lever`, ahead + i left of base_link, m, turned by `yaw` (D,) rad in each of
    D drives, with their `covariance` (2 + D, 2 + D); `given` is a lever that was measured, and
    `learned` what the closures say of it."""

    lever: complex = 0j
    yaw: tuple[float, ...] = (0.0,)
    given: complex | None = None
    covariance: Array | None = None
    turning: Quantity | None = None
    """|l|^2, m^2, by how images change in turns on the spot."""
    learned: tuple[complex, float] | None = None
    """The lever by closures alone, and the standard deviation of its coordinates, m."""

    @classmethod
    def at(cls, place: complex | None) -> Mount:
        """Of a camera at a measured place, ahead + i left, m; None for an unknown one."""
        return cls(place or 0j, given=place)

    @property
    def known(self) -> Array:
        """The covariance, or that of the prior."""
        if self.covariance is not None:
            return self.covariance
        lever_std = CAMERA_STD_M if self.given is None else GIVEN_STD_M
        return np.diag([lever_std**2] * 2 + [CAMERA_TURN_STD**2] * len(self.yaw))

    def _priors(self) -> tuple[Array, Array]:
        """Variances (3 + D,) of [l, s, kappa], of all but the first drive's yaw, which is 0 by
        definition: of a camera above base_link, or measured, and of one anywhere.
        """
        later = [CAMERA_TURN_STD**2] * (len(self.yaw) - 1)
        placed, anywhere, slip = GIVEN_STD_M**2, CAMERA_STD_M**2, SLIP_STD_M**2
        above = [placed, placed, slip, slip, *later]
        return np.array(above), np.array([anywhere, anywhere, placed, placed, *later])

    def of(self, drives: int) -> Mount:
        """The same of so many drives; nothing is known of the yaw in later ones."""
        return replace(self, yaw=(*self.yaw, *[0.0] * (drives - len(self.yaw))))

    def base(self, poses: Array, drive: int) -> Array:
        """Poses (N, 3) of base_link by those (N, 3) of the camera in a drive."""
        yaw = poses[:, 2] - self.yaw[drive]
        place = poses[:, 0] + 1j * poses[:, 1] - self.lever * np.exp(1j * yaw)
        return np.column_stack([place.real, place.imag, yaw])

    def stepped(self, missed: Complex, by_mount: Complex, by_rest: Array, solve: Solve) -> Mount:
        """After a step from what links and closures miss (L,) by, its derivative (L, 4 + D), and
        the products (P, 4 + D) of that with the derivative by the rest, whose covariance (P, P)
        times columns `solve` gives.
        """
        mount, center = self.of(by_mount.shape[1] - 4), self.given or 0j
        moved = self.lever - center
        value = np.array([moved.real, moved.imag, 0.0, 0.0, *mount.yaw[1:]])
        free = np.flatnonzero(np.arange(len(value) + 1) != 4)
        columns, rest = by_mount[:, free], by_rest[:, free]
        shown = np.real(columns.conj().T @ columns) - rest.T @ solve(rest)
        pull = shown @ value - np.real(columns.conj().T @ missed)
        means, spreads, evidence = [], [], []
        for prior in mount._priors():
            spread = np.linalg.inv(shown + np.diag(1 / prior))
            size = np.linalg.slogdet(spread)[1] - np.log(prior).sum()
            means.append(spread @ pull)
            spreads.append(spread)
            lever = center + complex(*means[-1][:2])
            evidence.append((size + pull @ means[-1]) / 2 + self._by_turns(lever))
        share = np.array([1.0, 0.0]) if self.given is not None else special.softmax(evidence)
        mean = share @ np.array(means)
        spread = sum(
            part * (each + np.outer(one - mean, one - mean))
            for part, each, one in zip(share, spreads, means, strict=True)
        )
        # Of the lever and all yaws, the first of which is 0.
        kept = np.r_[0, 1, 4 : len(mean)]
        rows = np.r_[0, 1, 3 : len(kept) + 1]
        covariance = np.zeros((2 + len(mount.yaw), 2 + len(mount.yaw)))
        covariance[np.ix_(rows, rows)] = spread[np.ix_(kept, kept)]
        return replace(
            self,
            lever=center + complex(mean[0], mean[1]),
            yaw=(0.0, *mean[4:].tolist()),
            covariance=covariance,
            learned=(lever, float(np.sqrt(spreads[1].diagonal()[:2].mean()))),
        )

    def _by_turns(self, lever: complex) -> float:
        """Logarithm of the likelihood of the changes of images in turns, for a lever."""
        if self.turning is None:
            return 0.0
        square, (seen, std) = abs(lever) ** 2, self.turning
        variance = std**2 + LEVEL_M2**2 + (UNSURE * square) ** 2
        return -(((square - seen) ** 2) / variance + math.log(variance)) / 2

    @property
    def contradiction(self) -> str:
        """How the closures contradict a measured place, in words; '' where they do not."""
        if self.given is None or self.learned is None:
            return ''
        (lever, std), given = self.learned, self.given
        if abs(lever - given) < CONTRADICTS * math.hypot(std, GIVEN_STD_M):
            return ''
        return (
            f'the camera is said to sit {given.real:.2f} m ahead and {given.imag:.2f} m left of '
            f'base_link, the images show {lever.real:.2f} and {lever.imag:.2f} m (+- {std:.2f}): '
            'check camera_xy, or /tf_static'
        )

    def differs(self, other: Mount, least_m: float) -> bool:
        """Whether another one is so far off, or turned by as much of a meter away."""
        turned = np.abs(np.subtract(self.yaw, other.yaw)).max()
        return max(abs(self.lever - other.lever), float(turned)) > least_m

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Of `Rig`: where the camera sits, and how it looks on average of the drives."""
        ahead, left = np.sqrt(np.diag(self.known)[:2]).tolist()
        spread = float(np.std(self.yaw, ddof=1)) if len(self.yaw) > 1 else 0.0
        # A filter takes an angle that stays for noise that does not.
        spread = spread if max(map(abs, self.yaw)) < MOUNTED_ANEW_RAD else UNKNOWN_YAW_STD
        return {
            'camera_ahead': Quantity(self.lever.real, ahead),
            'camera_left': Quantity(self.lever.imag, left),
            'camera_yaw': Quantity(float(np.mean(self.yaw)), spread),
        }


Solve = Callable[[Array], Array]
