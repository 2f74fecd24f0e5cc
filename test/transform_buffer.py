# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What tf2 does with the transforms of a pair of frames: it interpolates between neighbors."""

import json

import numpy as np
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from sfa_localization.data.messages import read_stamp, read_yaw


class AsText(String):
    """Stands in for tf2_msgs, which the wheels of ROS lack: stamps and transforms as text."""

    def __new__(cls, transforms):
        sent = []
        for message in transforms:
            t = message.transform
            pose = t.translation.x, t.translation.y, read_yaw(t.rotation)
            sent.append((read_stamp(message.header.stamp), pose))
        return serialize_message(String(data=json.dumps(sent)))


class TransformBuffer:
    """tf2's buffer in the plane."""

    def __init__(self):
        self._poses = {}

    def add(self, message):
        """Insert what an AsText holds."""
        self._poses.update(json.loads(message.data))

    @property
    def newest_ns(self):
        return max(self._poses)

    def lookup(self, stamp_ns):
        """The transform (3,) at a time; LookupError outside of what is held."""
        stamps_ns = np.array(sorted(self._poses))
        if not stamps_ns[0] <= stamp_ns <= stamps_ns[-1]:
            raise LookupError(f'{stamp_ns} would require extrapolation')
        poses = np.array([self._poses[stamp] for stamp in stamps_ns.tolist()])
        poses[:, 2] = np.unwrap(poses[:, 2])
        times = (stamps_ns - stamp_ns).astype(float)
        return np.array([np.interp(0.0, times, column) for column in poses.T])
