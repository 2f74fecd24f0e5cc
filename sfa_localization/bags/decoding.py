# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag: decoded by rosbags, and the fields of them that are used."""

from __future__ import annotations

import functools
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from sfa_localization.bags.files import Topic
from sfa_localization.camera.encodings import read_compressed, read_raw
from sfa_localization.data.errors import BagError, MessageError
from sfa_localization.data.messages import read_planar, read_stamp, read_twist
from sfa_localization.data.run import Image

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
ODOMETRY, IMU, TF = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', 'tf2_msgs/msg/TFMessage'
STAMPED_POSES = (
    'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'geometry_msgs/msg/TransformStamped',
)
POSES = (ODOMETRY, *STAMPED_POSES, TF)
"""Types that hold a pose of the robot."""


@functools.cache
def typestore(store: Stores) -> Typestore:
    """The standard message types of a distribution, made once."""
    return get_typestore(store)


class Decoder:
    """Serialized messages to objects, by the standard definitions of ROS 2 or ROS 1."""

    def __init__(self) -> None:
        self._ros2 = typestore(Stores.ROS2_JAZZY)
        self._ros1 = typestore(Stores.ROS1_NOETIC)

    def can_decode(self, topic: Topic) -> bool:
        """Whether the messages of a topic can be decoded."""
        if topic.serialization == 'ros1':
            return topic.kind in self._ros1.fielddefs
        return topic.serialization == 'cdr' and topic.kind in self._ros2.fielddefs

    def __call__(self, data: bytes, topic: Topic) -> Any:
        """Decode a message of a topic. Raises MessageError for damaged data."""
        ros1 = topic.serialization == 'ros1'
        decode = self._ros1.deserialize_ros1 if ros1 else self._ros2.deserialize_cdr
        try:
            return decode(data, topic.kind)
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise MessageError(f'damaged message ({type(error).__name__})') from None


class TransformChooser:
    """Picks one transform of each TFMessage: the one to `child_frame`, or the only one."""

    def __init__(self, topic: str, child_frame: str) -> None:
        self._topic, self._wanted = topic, child_frame.lstrip('/')
        self._child_frames: set[str] = set()

    def __call__(self, message: Any) -> Any:
        """The TransformStamped, or None. Raises BagError when the choice is ambiguous."""
        for transform in message.transforms:
            child_frame = transform.child_frame_id.lstrip('/')
            if child_frame == self._wanted:
                return transform
            self._child_frames.add(child_frame)
        if self._wanted:
            return None
        if len(self._child_frames) > 1:
            names = ', '.join(sorted(self._child_frames))
            raise BagError(f'{self._topic} holds several frames: {names}; '
                           f'choose one as {self._topic}:FRAME')  # fmt: skip
        return message.transforms[0] if message.transforms else None


def header_stamp(message: Any) -> int | None:
    """The sender's stamp in nanoseconds; None of a type without a header.

    Raises MessageError.
    """
    header = getattr(message, 'header', None)
    if header is None:
        return None
    return read_stamp(header.stamp)


def image_of(message: Any) -> Image:
    """Image (H, W, 3) BGR of an Image or CompressedImage. Raises MessageError."""
    read = read_compressed if message.__msgtype__ == COMPRESSED else read_raw
    return read(message)


def pose_of(message: Any) -> tuple[float, float, float]:
    """Planar pose x m, y m, yaw rad of a message or transform. Raises MessageError."""
    kind = message.__msgtype__
    if kind == 'geometry_msgs/msg/TransformStamped':
        return read_planar(message.transform.translation, message.transform.rotation)
    pose = message.pose if kind == 'geometry_msgs/msg/PoseStamped' else message.pose.pose
    return read_planar(pose.position, pose.orientation)


def odometry_of(message: Any) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """Pose, and of an Odometry v, omega and their variances; other types have no twist."""
    return pose_of(message), read_twist(message) if message.__msgtype__ == ODOMETRY else None
