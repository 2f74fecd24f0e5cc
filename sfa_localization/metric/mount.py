# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera sits on the robot, learned with the map.

Odometry moves base_link, images show places of a camera that sits at a lever l, ahead + i left, of
it. Image m of segment n lies at

    x_nm = o_n + z_n (q_nm + l exp(i h_nm)),

and in drive d it looks kappa_d to the left of where it did in the first drive, so that closures
turn by kappa_d more. For the best [o, z, b] at some l and kappa, what is squared of the closures is
r, with derivatives A by [o, z, b] and B by [l, kappa]. Gauss and Newton's step for all together is
for [l, kappa] alone

    S = B^T B + P - B^T A N^-1 A^T B,    step = -S^-1 (B^T r + P (value - prior)),

with N the normal equations of [o, z, b], P the inverse of the prior's covariance, and S^-1 the
covariance. A drive that never turns where it is seen again does not show l: its variance stays that
of the prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.data.rig import CAMERA_STD_M, Quantity

GIVEN_STD_M = 0.01
"""Of a camera's place that was measured on the robot."""
CAMERA_TURN_STD = 1.0
"""rad, of the yaw of a camera in a later drive: it may have been taken off and put back anyhow."""


@dataclass(frozen=True, slots=True)
class Mount:
    """The camera at a `lever`, ahead + i left of base_link, m, turned by `yaw` (D,) rad in each of
    D drives, with their `covariance` (2 + D, 2 + D); `given` is a lever that was measured."""

    lever: complex = 0j
    yaw: tuple[float, ...] = (0.0,)
    given: complex | None = None
    covariance: Array | None = None

    @classmethod
    def at(cls, place: Sequence[float]) -> Mount:
        """Of a camera's measured place, ahead and left, m; empty for an unknown one."""
        if not place:
            return cls()
        return cls(complex(*place), given=complex(*place))

    @property
    def known(self) -> Array:
        """The covariance, or that of the prior."""
        if self.covariance is not None:
            return self.covariance
        return np.diag(self.prior_variances)

    @property
    def prior_variances(self) -> Array:
        """(2 + D,) m^2, m^2, rad^2: of the first drive's yaw 0, by definition."""
        lever_std = CAMERA_STD_M if self.given is None else GIVEN_STD_M
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
        variances = mount.prior_variances
        free = np.flatnonzero(variances)
        prior = 0j if self.given is None else self.given
        value = np.array([mount.lever.real, mount.lever.imag, *mount.yaw])
        center = np.zeros(len(value))
        center[:2] = prior.real, prior.imag
        columns = by_mount[:, free]
        inverse = np.real(columns.conj().T @ columns) - by_rest[:, free].T @ solve(by_rest[:, free])
        inverse += np.diag(1 / variances[free])
        pull = np.real(columns.conj().T @ missed) + (value - center)[free] / variances[free]
        covariance = np.zeros((len(value), len(value)))
        covariance[np.ix_(free, free)] = np.linalg.inv(inverse)
        value[free] -= covariance[np.ix_(free, free)] @ pull
        lever, yaw = complex(value[0], value[1]), tuple(value[2:].tolist())
        return replace(self, lever=lever, yaw=yaw, covariance=covariance)

    def differs(self, other: Mount, least_m: float) -> bool:
        """Whether another one is so far off, or turned by as much of a meter away."""
        turned = np.abs(np.subtract(self.yaw, other.yaw)).max()
        return max(abs(self.lever - other.lever), float(turned)) > least_m

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Of `Rig`: where the camera sits, and how it looks on average of the drives."""
        ahead, left = np.sqrt(np.diag(self.known)[:2]).tolist()
        spread = float(np.std(self.yaw, ddof=1)) if len(self.yaw) > 1 else 0.0
        return {
            'camera_ahead': Quantity(self.lever.real, ahead),
            'camera_left': Quantity(self.lever.imag, left),
            'camera_yaw': Quantity(float(np.mean(self.yaw)), spread),
        }


Solve = Callable[[Array], Array]
