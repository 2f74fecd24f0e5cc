# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures with measured offsets: an image lies among those of other tracks around it.

The place that local regression (local_regression.py) gives an image is linear in those of the
others, sum_k c_k p_k. The shares c_k are of the images alone: they hold in any frame, however bent
the map is, so that they tie the segments of a drive (metric/loops.py) before there is a map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, wrap_angle
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.closures import STRETCH_M, Views
from sfa_localization.keyframes.keyframes import Keyframes

# Of the views that are located, along a drive or in a turn, which shows where the camera sits:
# nearer ones err alike.
_APART_M, _APART_RAD = 0.5, 0.5
# Views that one is located among, the least number, and of how many the own track's are left out.
_AMONG, _FEWEST, _NEAREST = 64, 12, 256
# An image of which more than this part is unlike all around is of another place, or beside them.
_UNLIKE = 0.5


@dataclass(frozen=True, slots=True)
class Offsets:
    """R of the images of all drives that lie at the mixture, by `shares` (R, K) of sum 1, of the
    places of `others` (R, K), and are turned by `turn` (R, K) rad from each; `unlike` (R,) is that
    of the fit.
    """

    images: Indices
    others: Indices
    shares: Array
    turn: Array
    unlike: Array

    @classmethod
    def none(cls) -> Offsets:
        """Of no images."""
        none = np.zeros((0, 1))
        return cls(np.zeros(0, np.int64), none.astype(np.int64), none, none, np.zeros(0))

    def of_robot(self, camera_yaw: Array) -> Offsets:
        """With the turns of the robot, on which the camera is turned by (N,) rad in N images."""
        turn = self.turn - camera_yaw[self.images][:, None] + camera_yaw[self.others]
        return replace(self, turn=turn)


def find_offsets(views: Views, poses: Array, sphere: Sphere) -> Offsets:
    """Of views whose poses (S, 3) are about known, in any frame; NaN for the others."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if len(known) < _FEWEST:
        return Offsets.none()
    drives = views.run[known].astype(np.int32)
    own = views.textures[known], poses[known]
    among = Keyframes.of(*own, sphere, drives, rounded=False)
    path, found = views.path_m[known], []
    for row in _spaced(path, among.poses[:, 2], drives):
        apart = np.hypot(*(among.poses[:, :2] - among.poses[row, :2]).T)
        near = np.argsort(apart, kind='stable')[:_NEAREST]
        own = (drives[near] == drives[row]) & (np.abs(path[near] - path[row]) < STRETCH_M)
        near = near[~own][:_AMONG]
        if len(near) < _FEWEST:
            continue
        fit = among.fit(among.spectra([row])[0], among.poses[row, 2], near)
        if fit.unlike < _UNLIKE:
            shares, turn = np.zeros((2, _AMONG))
            others = np.full(_AMONG, near[0])
            others[: len(near)], shares[: len(near)] = near, fit.shares
            turn[: len(near)] = fit.yaw - among.poses[near, 2]
            found.append((row, others, shares, turn, fit.unlike))
    if not found:
        return Offsets.none()
    rows, others, shares, turn, unlike = map(np.array, zip(*found, strict=True))
    return Offsets(views.images[known][rows], views.images[known][others], shares, turn, unlike)


def _spaced(path_m: Array, yaw: Array, drives: NDArray[np.int32]) -> list[int]:
    """Rows of views (S,) in driving order, each so far from the one before, or turned so far."""
    rows = [0]
    for row in range(1, len(path_m)):
        driven = path_m[row] - path_m[rows[-1]]
        turned = abs(wrap_angle(yaw[row] - yaw[rows[-1]]))
        if drives[row] != drives[rows[-1]] or driven >= _APART_M or turned >= _APART_RAD:
            rows.append(row)
    return rows
