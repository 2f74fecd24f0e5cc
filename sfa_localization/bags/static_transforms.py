# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera sits on the robot, by the static transforms that a bag holds."""

from __future__ import annotations

import numpy as np

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import require_sane

TOPIC = '/tf_static'


def camera_place(bag: Bag, image_topic: str, odometry_topic: str) -> complex | None:
    """Ahead + i left of the odometry's child frame, m, of the frame of the images; None where
    static transforms do not connect these two.
    """
    topic = bag.topics.get(TOPIC)
    if topic is None or not decoding.can_decode(topic):
        return None
    frames, parents, transforms = dict[str, str](), dict[str, tuple[str, Array]](), 0
    for record, _, data in bag.messages({TOPIC, image_topic, odometry_topic}):
        if record.name in frames and record.name != TOPIC:
            continue
        try:
            message = decoding.decode(data, record)
            if record.name == TOPIC:
                parents |= _links(message)
                transforms += 1
            else:
                frame = getattr(message, 'child_frame_id', message.header.frame_id)
                frames[record.name] = frame.lstrip('/')
        except (MessageError, AttributeError):  # a topic without frames
            continue
        if len(frames) == 2 and transforms >= topic.count:
            break
    camera = _to_root(frames.get(image_topic, ''), parents)
    base = _to_root(frames.get(odometry_topic, ''), parents)
    if len(frames) < 2 or camera[0] != base[0]:
        return None
    ahead, left = np.linalg.solve(base[1], camera[1])[:2, 3].tolist()
    return complex(ahead, left)


def _links(message: object) -> dict[str, tuple[str, Array]]:
    """By frame its parent, and the transform (4, 4) to that. Raises MessageError."""
    links = {}
    for part in message.transforms:  # type: ignore[attr-defined]
        moved, turned = part.transform.translation, part.transform.rotation
        require_sane('transform', moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w)
        matrix = np.eye(4)
        matrix[:3, :3] = _rotation(np.array([turned.x, turned.y, turned.z]), float(turned.w))
        matrix[:3, 3] = moved.x, moved.y, moved.z
        parent = part.header.frame_id.lstrip('/')
        links[part.child_frame_id.lstrip('/')] = parent, matrix
    return links


def _rotation(axis: Array, real: float) -> Array:
    """The rotation (3, 3) of a quaternion of any length. Raises MessageError for none."""
    square = float(axis @ axis) + real**2
    if square == 0.0:
        raise MessageError('quaternion is zero')
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * (real * cross + cross @ cross) / square)


def _to_root(frame: str, parents: dict[str, tuple[str, Array]]) -> tuple[str, Array]:
    """The root of a frame's tree, and the transform (4, 4) to it; a loop ends where it began."""
    matrix, passed = np.eye(4), set[str]()
    while frame in parents and frame not in passed:
        passed.add(frame)
        frame, step = parents[frame]
        matrix = step @ matrix
    return frame, matrix
