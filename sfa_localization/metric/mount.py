# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera sits on the robot, learned with the map.

Odometry moves base_link, images show places of a camera that sits at a lever l, ahead + i left, of
it. Image m of segment n lies at

    x_nm = o_n + z_n (q_nm + l exp(i h_nm)),

and in drive d it looks kappa_d to the left of where it did in the first drive, so that closures
turn by kappa_d more. With v = [l, kappa], for the best [o, z, b] at some v what is squared of the
closures is r, with derivatives A by [o, z, b] and B by v. To first order the closures say of v

    S = B^T B - B^T A N^-1 A^T B,    h = S v - B^T r,

with N the normal equations of [o, z, b]. Beside them stands what is known of robots: the camera
sits above base_link, or where it was measured, to 5 mm; or, as probable, anywhere on the
robot. With the prior's covariance C, either has the posterior covariance (S + C^-1)^-1 = D, the
mean D h and the evidence (|D| / |C|)^(1/2) exp(h^T D h / 2), by which both are mixed. A drive that
never turns where it is seen again does not show l: its variance stays large.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.data.rig import CAMERA_STD_M, UNKNOWN_YAW_STD, Quantity

GIVEN_STD_M = 0.005
"""Of a camera's place that was measured on the robot."""
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
        return np.diag(self._variances(CAMERA_STD_M if self.given is None else GIVEN_STD_M))

    def _variances(self, lever_std: float) -> Array:
        """(2 + D,) of a prior, m^2, m^2, rad^2: of the first drive's yaw 0, by definition."""
        later = [CAMERA_TURN_STD**2] * (len(self.yaw) - 1)
        return np.array([lever_std**2, lever_std**2, 0.0, *later])

    def of(self, drives: int) -> Mount:
        """The same of so many drives; nothing is known of the yaw in later ones."""
        return replace(self, yaw=(*self.yaw, *[0.0] * (drives - len(self.yaw))))

    def base(self, poses: Array, drive: int) -> Array:
        """Poses (N, 3) of base_link by those (N, 3) of the camera in a drive."""
        yaw = poses[:, 2] - self.yaw[drive]
        place = poses[:, 0] + 1j * poses[:, 1] - self.lever * np.exp(1j * yaw)
        return np.column_stack([place.real, place.imag, yaw])

    def stepped(self, missed: Complex, by_mount: Complex, by_rest: Array, solve: Solve) -> Mount:
        """After a step from what the closures miss (L,) by, its derivative (L, 2 + D), and the
        products (P, 2 + D) of that with the derivative by the rest, whose covariance (P, P) times
        columns `solve` gives.
        """
        mount = self.of(by_mount.shape[1] - 2)
        center, tight = self.given or 0j, self.given is not None
        moved = self.lever - center
        value = np.array([moved.real, moved.imag, *mount.yaw])
        free = np.flatnonzero(np.arange(len(value)) != 2)
        columns, value = by_mount[:, free], value[free]
        shown = np.real(columns.conj().T @ columns) - by_rest[:, free].T @ solve(by_rest[:, free])
        pull = shown @ value - np.real(columns.conj().T @ missed)
        means, spreads, evidence = [], [], []
        for std in (GIVEN_STD_M, CAMERA_STD_M):
            prior = mount._variances(std)[free]
            spread = np.linalg.inv(shown + np.diag(1 / prior))
            size = np.linalg.slogdet(spread)[1] - np.log(prior).sum()
            means.append(spread @ pull)
            spreads.append(spread)
            evidence.append((size + pull @ means[-1]) / 2)
        learned = center + complex(*means[1][:2]), float(np.sqrt(spreads[1].diagonal()[:2].mean()))
        share = np.array([1.0, 0.0]) if tight else special.softmax(evidence)
        mean = share @ np.array(means)
        covariance = np.zeros((len(value) + 1, len(value) + 1))
        covariance[np.ix_(free, free)] = sum(
            part * (spread + np.outer(one - mean, one - mean))
            for part, spread, one in zip(share, spreads, means, strict=True)
        )
        lever, yaw = center + complex(mean[0], mean[1]), (0.0, *mean[2:].tolist())
        return replace(self, lever=lever, yaw=yaw, covariance=covariance, learned=learned)

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
