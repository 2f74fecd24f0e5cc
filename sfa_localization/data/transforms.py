# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Static transforms between the frames of a robot, from messages of ROS or of bags."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfa_localization.data.errors import MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import require_sane

TOPIC = '/tf_static'
BASE = 'base_link'
"""The robot's frame where nothing names it (REP 105)."""


class TransformTree:
    """The frames of TFMessages, each with its parent."""

    def __init__(self) -> None:
        self._parents = dict[str, tuple[str, Array]]()

    def add(self, message: Any) -> None:
        """Take a TFMessage. Raises MessageError for transforms that are none."""
        self._parents |= _links(message)

    def pose(self, frame: str, base: str) -> Array | None:
        """The pose (4, 4) of a frame in another; None where no transforms connect them."""
        root, from_frame = self._to_root(frame.lstrip('/'))
        base_root, from_base = self._to_root(base.lstrip('/'))
        if root != base_root:
            return None
        return np.asarray(np.linalg.solve(from_base, from_frame))

    def lever(self, frame: str, base: str) -> complex | None:
        """Place of a frame, ahead + i left, m, in another; None where nothing connects them."""
        pose = self.pose(frame, base)
        return None if pose is None else complex(*pose[:2, 3])

    def _to_root(self, frame: str) -> tuple[str, Array]:
        """The root of a frame's tree, and the transform (4, 4) to it; a loop ends at its start."""
        matrix = np.eye(4)
        passed = set[str]()
        while frame in self._parents and frame not in passed:
            passed.add(frame)
            frame, step = self._parents[frame]
            matrix = step @ matrix
        return frame, matrix


def _links(message: Any) -> dict[str, tuple[str, Array]]:
    """The parent of each frame, and the transform (4, 4) to it. Raises MessageError."""
    links = {}
    for part in message.transforms:
        moved = part.transform.translation
        turned = part.transform.rotation
        require_sane('transform', moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w)
        matrix = np.eye(4)
        matrix[:3, :3] = _rotation(np.array([turned.x, turned.y, turned.z]), float(turned.w))
        matrix[:3, 3] = moved.x, moved.y, moved.z
        parent = part.header.frame_id.lstrip('/')
        links[part.child_frame_id.lstrip('/')] = parent, matrix
    return links


def _rotation(axis: Array, real: float) -> Array:
    """Rotation (3, 3) of a quaternion of any length but zero. Raises MessageError."""
    square = float(axis @ axis) + real**2
    if square == 0.0:
        raise MessageError('quaternion is zero')
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * (real * cross + cross @ cross) / square)
