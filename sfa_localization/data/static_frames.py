# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where frames lie on the robot, by its static transforms, recorded or live."""

from __future__ import annotations

import numpy as np

from sfa_localization.data.errors import MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import require_sane

TOPIC = '/tf_static'


class StaticFrames:
    """The trees of frames that messages with the fields of tf2_msgs/TFMessage describe."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, message: object) -> None:
        """Take the transforms of a message. Raises MessageError."""
        links = {}
        for part in message.transforms:  # type: ignore[attr-defined]
            moved = part.transform.translation
            turned = part.transform.rotation
            quaternion = turned.x, turned.y, turned.z, turned.w
            require_sane('transform', moved.x, moved.y, moved.z, *quaternion)
            matrix = np.eye(4)
            matrix[:3, :3] = _rotation(np.array(quaternion[:3]), float(turned.w))
            matrix[:3, 3] = moved.x, moved.y, moved.z
            parent = part.header.frame_id.lstrip('/')
            links[part.child_frame_id.lstrip('/')] = parent, matrix
        self._parents |= links

    def lever(self, frame: str, base: str) -> complex | None:
        """Place of a frame, ahead + i left, m, in a base frame; None if nothing connects them."""
        root, of_frame = self._to_root(frame.lstrip('/'))
        base_root, of_base = self._to_root(base.lstrip('/'))
        if root != base_root:
            return None
        return complex(*np.linalg.solve(of_base, of_frame)[:2, 3])

    def _to_root(self, frame: str) -> tuple[str, Array]:
        """The root of a frame's tree, and the transform (4, 4) to it; a loop ends at its start."""
        matrix = np.eye(4)
        passed = set[str]()
        while frame in self._parents and frame not in passed:
            passed.add(frame)
            frame, step = self._parents[frame]
            matrix = step @ matrix
        return frame, matrix


def _rotation(axis: Array, real: float) -> Array:
    """Rotation (3, 3) of a quaternion of any length but zero. Raises MessageError."""
    square = float(axis @ axis) + real**2
    if square == 0.0:
        raise MessageError('quaternion is zero')
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * (real * cross + cross @ cross) / square)
