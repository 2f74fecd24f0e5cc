# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lever arm of a camera or an antenna from the static transforms of a bag."""

from __future__ import annotations

import numpy as np

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import require_sane

TOPIC = '/tf_static'


def lever_arm(bag: Bag, sensor_topic: str, odometry_topic: str) -> complex | None:
    """Place of a sensor, ahead + i left, m, from the odometry's child frame; None if unknown."""
    topic = bag.topics.get(TOPIC)
    if topic is None or not decoding.can_decode(topic):
        return None
    frames = dict[str, str]()
    parents = dict[str, tuple[str, Array]]()
    transforms = 0
    for record, _, data in bag.messages({TOPIC, sensor_topic, odometry_topic}):
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
    sensor = _to_root(frames.get(sensor_topic, ''), parents)
    base = _to_root(frames.get(odometry_topic, ''), parents)
    if len(frames) < 2 or sensor[0] != base[0]:
        return None
    return complex(*np.linalg.solve(base[1], sensor[1])[:2, 3])


def _links(message: object) -> dict[str, tuple[str, Array]]:
    """The parent of each frame, and the transform (4, 4) to it. Raises MessageError."""
    links = {}
    for part in message.transforms:  # type: ignore[attr-defined]
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


def _to_root(frame: str, parents: dict[str, tuple[str, Array]]) -> tuple[str, Array]:
    """The root of a frame's tree, and the transform (4, 4) to it; a loop ends at its start."""
    matrix = np.eye(4)
    passed = set[str]()
    while frame in parents and frame not in passed:
        passed.add(frame)
        frame, step = parents[frame]
        matrix = step @ matrix
    return frame, matrix
