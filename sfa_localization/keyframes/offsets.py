# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures with measured offsets: positions of images relative to images of other tracks.

The place that local regression (regression.py) gives an image is linear in those of the others,
sum_k c_k p_k. The shares c_k depend on the images alone: they hold in any frame, however bent the
map is, so that they tie the segments of a drive (metric/loops.py) before there is a map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Indices, wrap_angle
from sfa_localization.data.sphere import Sphere
from sfa_localization.keyframes.closures import Textures
from sfa_localization.keyframes.keyframes import FEWEST, NEIGHBORS, Keyframes

# Spacing of the views that are located, along a drive or in a turn, which shows where the camera
# sits: the errors of nearer ones are alike.
_SPACING_M = 0.5
_SPACING_RAD = 0.5
# An image whose unexplained part exceeds this was taken at another place, or outside of the others.
_UNLIKE = 0.5


@dataclass(frozen=True, slots=True)
class Offsets:
    """R images, each of which lies at the weighted mean, by `shares` (R, K) of sum 1, of the
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
        empty = np.zeros((0, 1))
        return cls(np.zeros(0, np.int64), empty.astype(np.int64), empty, empty, np.zeros(0))

    def of_robot(self, camera_yaw: Array) -> Offsets:
        """With the turns of the robot, on which the camera is turned by (N,) rad in N images."""
        turn = self.turn - camera_yaw[self.images][:, None] + camera_yaw[self.others]
        return replace(self, turn=turn)


def find_offsets(views: Textures, poses: Array, sphere: Sphere) -> Offsets:
    """Offsets of views by their rough poses (S, 3) in any frame; NaN for views without one."""
    placed = np.flatnonzero(np.isfinite(poses).all(axis=1))
    views = views.take(placed)
    poses = poses[placed]
    if len(poses) < FEWEST:
        return Offsets.none()
    drives = views.run.astype(np.int32)
    keyframes = Keyframes.of(views.textures, poses, sphere, drives, views.seen)
    offsets = []
    for row in _spaced(views.path_m, poses[:, 2], drives):
        distance = np.hypot(*(poses[:, :2] - poses[row, :2]).T)
        near = np.argsort(distance, kind='stable')
        near = near[~views.near(row, near)][:NEIGHBORS]
        if len(near) < FEWEST:
            continue
        fit = keyframes.fit(keyframes.changes(keyframes.spectrum(row)), poses[row, 2], near)
        if fit.unlike < _UNLIKE:
            missing = (0, NEIGHBORS - len(near))  # filled up with neighbors of no share
            others = np.pad(near, missing, constant_values=near[0])
            shares = np.pad(fit.shares, missing)
            turn = np.pad(fit.yaw - poses[near, 2], missing)
            offsets.append((row, others, shares, turn, fit.unlike))
    if not offsets:
        return Offsets.none()
    rows, others, shares, turn, unlike = map(np.array, zip(*offsets, strict=True))
    return Offsets(views.images[rows], views.images[others], shares, turn, unlike)


def _spaced(path_m: Array, yaw: Array, drives: NDArray[np.int32]) -> list[int]:
    """Rows of views (S,) in driving order, each so far from the one before, or turned so far."""
    rows = [0]
    for row in range(1, len(path_m)):
        last = rows[-1]
        way = path_m[row] - path_m[last]
        turned = abs(wrap_angle(yaw[row] - yaw[last]))
        if drives[row] != drives[last] or way >= _SPACING_M or turned >= _SPACING_RAD:
            rows.append(row)
    return rows
