# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag: decoded by rosbags, and the values of their fields."""

from __future__ import annotations

import functools
import math
from types import SimpleNamespace
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from sfa_localization.bags.files import Topic
from sfa_localization.bags.satellite_fixes import fix_of
from sfa_localization.data.errors import BagError, MessageError
from sfa_localization.data.messages import read_odometry, read_planar, require_sane

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
PACKET = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'
VIDEO = 'foxglove_msgs/msg/CompressedVideo'
VIDEOS = (PACKET, VIDEO)
IMAGES = (IMAGE, COMPRESSED, *VIDEOS)
"""Types with an image of the camera; those without video are preferred, as they need no PyAV."""
ODOMETRY = 'nav_msgs/msg/Odometry'
IMU = 'sensor_msgs/msg/Imu'
TF = 'tf2_msgs/msg/TFMessage'
STAMPED_POSES = (
    'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'geometry_msgs/msg/TransformStamped',
)
POSES = (ODOMETRY, *STAMPED_POSES, TF)
"""Types with a pose of the robot."""
FIX = 'sensor_msgs/msg/NavSatFix'
TRUTHS = (*POSES, FIX)
PLACES = (*STAMPED_POSES[:2], 'geometry_msgs/msg/PointStamped', FIX)
"""Types with a measured point."""
SERIALIZATIONS = {'cdr': Stores.ROS2_JAZZY, 'ros1': Stores.ROS1_NOETIC}
"""The standard types of each wire format."""
_VIDEO_TYPES = {
    PACKET: 'std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n'
    'uint8 flags\nbool is_bigendian\nuint8[] data',
    VIDEO: 'time timestamp\nstring frame_id\nuint8[] data\nstring format',
}
"""Definitions of the messages that the standard types lack."""


@functools.cache
def typestore(store: Stores) -> Typestore:
    """The standard message types of a distribution, and those of video."""
    types = get_typestore(store)
    for kind, text in _VIDEO_TYPES.items():
        types.register(get_types_from_msg(text, kind))
    return types


def can_decode(topic: Topic) -> bool:
    """Whether the type of a topic is known."""
    store = SERIALIZATIONS.get(topic.serialization)
    return store is not None and topic.kind in typestore(store).fielddefs


def decode(data: bytes, topic: Topic) -> Any:
    """A message of a topic; a CompressedVideo gets a header. Raises MessageError if damaged."""
    types = typestore(SERIALIZATIONS[topic.serialization])
    ros1 = topic.serialization == 'ros1'
    try:
        message: Any = (types.deserialize_ros1 if ros1 else types.deserialize_cdr)(data, topic.kind)
    except Exception as error:  # a parser of foreign bytes fails in many ways
        raise MessageError(f'damaged message ({type(error).__name__})') from None
    if topic.kind == VIDEO:
        message.header = SimpleNamespace(stamp=message.timestamp, frame_id=message.frame_id)
    return message


def transform_to(frame: str, message: Any, topic: str) -> Any:
    """The TransformStamped of a TFMessage to a frame, or None. Raises BagError without a frame."""
    frames = {part.child_frame_id.lstrip('/'): part for part in message.transforms}
    if not frame:
        raise BagError(f'{topic} holds frames: {", ".join(sorted(frames))}, and perhaps others; '
                       f'choose one as {topic}:FRAME')  # fmt: skip
    return frames.get(frame.lstrip('/'))


def pose_of(message: Any, needs_yaw: bool = True) -> tuple[float, float, float]:
    """Planar pose x m, y m, yaw rad of a message or transform; latitude, longitude, 0 of a fix.

    A quaternion of zeros counts as yaw 0 if the yaw is not needed. Raises MessageError.
    """
    kind = message.__msgtype__
    if kind == FIX:
        return (*fix_of(message)[:2], 0.0)
    if kind == 'geometry_msgs/msg/TransformStamped':
        position = message.transform.translation
        q = message.transform.rotation
    else:
        pose = message.pose if kind == 'geometry_msgs/msg/PoseStamped' else message.pose.pose
        position = pose.position
        q = pose.orientation
    if needs_yaw or any((q.x, q.y, q.z, q.w)):
        return read_planar(position, q)
    require_sane('pose', position.x, position.y)
    return float(position.x), float(position.y), 0.0


true_pose_of = functools.partial(pose_of, needs_yaw=False)
"""The pose of a ground truth: trackers and receivers without headings leave zeros."""


def place_of(message: Any) -> tuple[float, float, float]:
    """Place x m, y m, or degrees of a fix, and its std, m, 0 if unknown. Raises MessageError."""
    kind = message.__msgtype__
    variance = 0.0
    if kind == FIX:
        return fix_of(message)
    if kind == 'geometry_msgs/msg/PointStamped':
        point = message.point
    elif kind == 'geometry_msgs/msg/PoseStamped':
        point = message.pose.position
    else:
        point = message.pose.pose.position
        spread = message.pose.covariance
        variance = max(float(spread[0]), float(spread[7]), 0.0)
    require_sane('place', point.x, point.y, variance)
    return float(point.x), float(point.y), math.sqrt(variance)


def odometry_of(message: Any) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """Pose, NaN where not filled, and of an Odometry, v, omega and variances, else None."""
    if message.__msgtype__ != ODOMETRY:
        return pose_of(message), None
    pose, twist = read_odometry(message)
    return pose or (math.nan,) * 3, twist
