# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the messages of a bag mean: pictures, planar poses, twists, yaw rates and their stamps."""

from __future__ import annotations

import math
from typing import Any

from rosbags.typesys import Stores, get_typestore

from sfa_localization.errors import LocalizationError
from sfa_localization.pictures import decode_compressed, decode_image
from sfa_localization.run import Image

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
ODOMETRY, IMU, TF = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', 'tf2_msgs/msg/TFMessage'
STAMPED_POSES = (
    'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'geometry_msgs/msg/TransformStamped',
)
POSES = (ODOMETRY, *STAMPED_POSES, TF)
"""Types that tell where the robot is."""


class Unusable(LocalizationError):
    """A message that cannot be used; the text is the reason it is counted under."""


class Decoder:
    """Serialized messages to objects, by the standard definitions of ROS 2 or ROS 1."""

    def __init__(self) -> None:
        self._ros2 = get_typestore(Stores.ROS2_JAZZY)
        self._ros1 = get_typestore(Stores.ROS1_NOETIC)

    def __call__(self, data: bytes, kind: str, serialization: str) -> Any:
        """Decode `data` of message type `kind`. Raises Unusable for damaged data."""
        ros1 = serialization == 'ros1'
        decode = self._ros1.deserialize_ros1 if ros1 else self._ros2.deserialize_cdr
        try:
            return decode(data, kind)
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise Unusable(f'damaged message ({type(error).__name__})') from None


def header_stamp(message: Any, child_frame: str = '') -> int:
    """The stamp in nanoseconds that the sender gave; of a TFMessage its transform's."""
    stamp = stamped(message, child_frame).header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def stamped(message: Any, child_frame: str = '') -> Any:
    """The part of a message that carries the header: itself, or one transform of a TFMessage."""
    if message.__msgtype__ != TF:
        return message
    for transform in message.transforms:
        if not child_frame or _frame(transform.child_frame_id) == _frame(child_frame):
            return transform
    raise Unusable('another transform')


def _frame(name: str) -> str:
    return name.lstrip('/')


def image_of(message: Any) -> Image:
    """Picture (H, W, 3) BGR of an Image or CompressedImage. Raises CameraError."""
    if message.__msgtype__ == COMPRESSED:
        return decode_compressed(message.data, message.format)
    return decode_image(
        message.data,
        message.height,
        message.width,
        message.step,
        message.encoding,
        bool(message.is_bigendian),
    )


def pose_of(message: Any, child_frame: str = '') -> tuple[float, float, float]:
    """Planar pose x m, y m, yaw rad of any of the POSES types. Raises Unusable."""
    position, q = _position_orientation(stamped(message, child_frame))
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not (math.isfinite(position.x) and math.isfinite(position.y) and math.isfinite(norm)):
        raise Unusable('not a finite pose')
    if norm < 1e-3:
        raise Unusable('orientation is no quaternion')
    sine, cosine = q.w * q.z + q.x * q.y, (norm * norm) / 2 - (q.y * q.y + q.z * q.z)
    return position.x, position.y, math.atan2(sine, cosine)


def _position_orientation(message: Any) -> tuple[Any, Any]:
    kind = message.__msgtype__
    if kind == 'geometry_msgs/msg/TransformStamped':
        return message.transform.translation, message.transform.rotation
    pose = message.pose if kind == 'geometry_msgs/msg/PoseStamped' else message.pose.pose
    return pose.position, pose.orientation


def twist_of(message: Any) -> tuple[float, float, float, float]:
    """Of an Odometry: v m/s, omega rad/s and their variances (0: not told). Raises Unusable."""
    twist, covariance = message.twist.twist, message.twist.covariance
    values = (float(twist.linear.x), float(twist.angular.z))
    if not all(map(math.isfinite, values)):
        raise Unusable('not a finite twist')
    return (*values, _variance(covariance[0]), _variance(covariance[35]))


def yaw_rate_of(message: Any) -> tuple[float, float]:
    """Of an Imu: omega rad/s about its z axis, and its variance (0: not told)."""
    omega = float(message.angular_velocity.z)
    if message.angular_velocity_covariance[0] == -1.0:
        raise Unusable('the message marks its yaw rate as unknown')
    if not math.isfinite(omega):
        raise Unusable('not a finite yaw rate')
    return omega, _variance(message.angular_velocity_covariance[8])


def _variance(value: float) -> float:
    return float(value) if math.isfinite(value) and value > 0 else 0.0
