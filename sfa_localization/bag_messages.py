# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the messages of a bag mean: pictures, planar poses, twists, yaw rates and their stamps."""

from __future__ import annotations

import functools
import math
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from sfa_localization.errors import BagError, LocalizationError
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


@functools.cache
def typestore(store: Stores) -> Typestore:
    """The standard message types of a distribution, made once."""
    return get_typestore(store)


class Decoder:
    """Serialized messages to objects, by the standard definitions of ROS 2 or ROS 1."""

    def __init__(self) -> None:
        self._ros2 = typestore(Stores.ROS2_JAZZY)
        self._ros1 = typestore(Stores.ROS1_NOETIC)

    def knows(self, kind: str, serialization: str) -> bool:
        """Whether messages of this type can be decoded."""
        if serialization == 'ros1':
            return kind in self._ros1.fielddefs
        return serialization == 'cdr' and kind in self._ros2.fielddefs

    def __call__(self, data: bytes, kind: str, serialization: str) -> Any:
        """Decode `data` of message type `kind`. Raises Unusable for damaged data."""
        ros1 = serialization == 'ros1'
        decode = self._ros1.deserialize_ros1 if ros1 else self._ros2.deserialize_cdr
        try:
            return decode(data, kind)
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise Unusable(f'damaged message ({type(error).__name__})') from None


class TransformChooser:
    """Picks one transform of each TFMessage: that to `child_frame`, or the only one there is."""

    def __init__(self, topic: str, child_frame: str) -> None:
        self._topic, self._wanted = topic, child_frame.lstrip('/')
        self._seen: set[str] = set()

    def __call__(self, message: Any) -> Any:
        """The TransformStamped, or None. Raises BagError when it is not clear which is meant."""
        for transform in message.transforms:
            child_frame = transform.child_frame_id.lstrip('/')
            if child_frame == self._wanted:
                return transform
            self._seen.add(child_frame)
        if self._wanted:
            return None
        if len(self._seen) > 1:
            names = ', '.join(sorted(self._seen))
            raise BagError(f'{self._topic} tells of several frames: {names}; '
                           f'choose one as {self._topic}:FRAME')  # fmt: skip
        return message.transforms[0] if message.transforms else None


def header_stamp(message: Any) -> int | None:
    """The stamp in nanoseconds that the sender gave; None of a type that has none."""
    header = getattr(message, 'header', None)
    if header is None:
        return None
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


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


def pose_of(message: Any) -> tuple[float, float, float]:
    """Planar pose x m, y m, yaw rad of a message or transform. Raises Unusable."""
    position, q = _position_orientation(message)
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


def odometry_of(message: Any) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """Pose, and of an Odometry v, omega and their variances; other types tell no twist."""
    return pose_of(message), twist_of(message) if message.__msgtype__ == ODOMETRY else None


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
