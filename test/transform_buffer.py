# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What tf2 does with the transforms of one pair of frames: sorted by time, interpolated between."""

import json
import math

import numpy as np
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from sfa_localization.data.messages import read_stamp, read_yaw

KEPT_NS = 10_000_000_000


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
    """tf2's buffer in the plane; of equal stamps the one that came last is the later one."""

    def __init__(self):
        self._entries = []

    def add(self, message):
        """Insert what an AsText holds."""
        for stamp_ns, pose in json.loads(message.data):
            self.insert(stamp_ns, np.array(pose))

    def insert(self, stamp_ns, pose):
        """Insert a transform (3,); too old a one is dropped, as those that it makes too old."""
        if self._entries and stamp_ns < self.newest_ns - KEPT_NS:
            return
        place = sum(stamp <= stamp_ns for stamp, _ in self._entries)
        self._entries.insert(place, (stamp_ns, pose))
        newest_ns = self.newest_ns
        self._entries = [entry for entry in self._entries if entry[0] >= newest_ns - KEPT_NS]

    @property
    def newest_ns(self):
        return self._entries[-1][0]

    def lookup(self, stamp_ns):
        """The transform (3,) at a time; LookupError outside of what is held."""
        if stamp_ns == self.newest_ns:
            return self._entries[-1][1]
        if not self._entries[0][0] <= stamp_ns < self.newest_ns:
            raise LookupError(f'{stamp_ns} would require extrapolation')
        after = sum(stamp <= stamp_ns for stamp, _ in self._entries)
        (early_ns, early), (late_ns, late) = self._entries[after - 1 : after + 1]
        step = late - early
        step[2] = math.remainder(step[2], 2 * math.pi)
        return early + step * (stamp_ns - early_ns) / (late_ns - early_ns)
