# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lever arm of a camera or an antenna from the static transforms of a bag."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import require_sane

TOPIC = '/tf_static'


class Frames:
    """Frames of a bag: the frame of each topic in its messages, and the tree of /tf_static."""

    def __init__(self) -> None:
        self.of_topic = dict[str, str]()
        self._parents = dict[str, tuple[str, Array]]()
        self.transforms = 0

    def add(self, topic: str, message: Any) -> None:
        """Take a message. Raises MessageError for transforms that are none."""
        if topic == TOPIC:
            self._parents |= _links(message)
            self.transforms += 1
            return
        frame = getattr(message, 'child_frame_id', message.header.frame_id)
        self.of_topic[topic] = frame.lstrip('/')

    def pose(self, sensor: str, base: str) -> Array | None:
        """The pose (4, 4) of one frame in another; None where transforms do not connect them."""
        sensor_root, from_sensor = _to_root(sensor, self._parents)
        base_root, from_base = _to_root(base, self._parents)
        if sensor_root != base_root:
            return None
        return np.asarray(np.linalg.solve(from_base, from_sensor))


def lever_arm(bag: Bag, sensor_topic: str, odometry_topic: str) -> complex | None:
    """Place of a sensor, ahead + i left, m, from the odometry's child frame; None if unknown."""
    topic = bag.topics.get(TOPIC)
    if topic is None or not decoding.can_decode(topic):
        return None
    frames = Frames()
    for record, _, data in bag.messages({TOPIC, sensor_topic, odometry_topic}):
        if record.name in frames.of_topic and record.name != TOPIC:
            continue
        with contextlib.suppress(MessageError, AttributeError):  # a topic without frames
            frames.add(record.name, decoding.decode(data, record))
        if len(frames.of_topic) == 2 and frames.transforms >= topic.count:
            break
    if len(frames.of_topic) < 2:
        return None
    pose = frames.pose(frames.of_topic[sensor_topic], frames.of_topic[odometry_topic])
    return None if pose is None else complex(*pose[:2, 3])


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
