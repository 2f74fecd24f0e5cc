# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lever arm of a camera or an antenna from the static transforms of a bag."""

from __future__ import annotations

import contextlib
from typing import Any

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import MessageError
from sfa_localization.data.transforms import TOPIC, TransformTree


class Frames:
    """Frames of a bag: the frame of each topic in its messages, and the tree of /tf_static."""

    def __init__(self) -> None:
        self.of_topic = dict[str, str]()
        self.tree = TransformTree()
        self.transforms = 0

    def add(self, topic: str, message: Any) -> None:
        """Take a message. Raises MessageError for transforms that are none."""
        if topic == TOPIC:
            self.tree.add(message)
            self.transforms += 1
            return
        frame = getattr(message, 'child_frame_id', message.header.frame_id)
        self.of_topic[topic] = frame.lstrip('/')


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
    return frames.tree.lever(frames.of_topic[sensor_topic], frames.of_topic[odometry_topic])
