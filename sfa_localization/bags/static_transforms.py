# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The lever arm of a camera or an antenna from the static transforms of a bag."""

from __future__ import annotations

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import Bag
from sfa_localization.data.errors import MessageError
from sfa_localization.data.static_frames import TOPIC, StaticFrames


def lever_arm(bag: Bag, sensor_topic: str, odometry_topic: str) -> complex | None:
    """Place of a sensor, ahead + i left, m, from the odometry's child frame; None if unknown."""
    topic = bag.topics.get(TOPIC)
    if topic is None or not decoding.can_decode(topic):
        return None
    frames = dict[str, str]()
    tree = StaticFrames()
    transforms = 0
    for record, _, data in bag.messages({TOPIC, sensor_topic, odometry_topic}):
        if record.name in frames and record.name != TOPIC:
            continue
        try:
            message = decoding.decode(data, record)
            if record.name == TOPIC:
                tree.add(message)
                transforms += 1
            else:
                frame = getattr(message, 'child_frame_id', message.header.frame_id)
                frames[record.name] = frame
        except (MessageError, AttributeError):  # a topic without frames
            continue
        if len(frames) == 2 and transforms >= topic.count:
            break
    return tree.lever(frames[sensor_topic], frames[odometry_topic]) if len(frames) == 2 else None
