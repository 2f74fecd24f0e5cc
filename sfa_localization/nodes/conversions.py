# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to and from plain values; malformed ones raise MessageError, images CameraError.

Messages are filled here and nowhere else; their fields are read in `data.messages`. Stamps are
integer nanoseconds, poses are (x m, y m, yaw rad), covariances of poses are (3, 3) in that order.
"""

from __future__ import annotations

import array
import dataclasses
import json
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs import msg as geometry
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike, NDArray
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String

from sfa_localization.camera.encodings import encode_jpeg, read_compressed, read_raw
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data import messages
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import ConfigError, DataError, MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import NANOSECONDS, read_stamp, require_sane
from sfa_localization.data.rig import Rig
from sfa_localization.data.run import Image

_FIXED_VARIANCE = 1e-6
"""Variance of what a planar estimate does not hold: z, roll and pitch are fixed, not unknown."""
_FIXED = np.diag([_FIXED_VARIANCE] * 6)
_PLANAR, _TWIST = np.ix_([0, 1, 5], [0, 1, 5]), np.ix_([0, 5], [0, 5])
_CORRELATION = 'error_correlation'


def to_stamp(stamp_ns: int) -> Time:
    """A message's stamp from nanoseconds >= 0."""
    seconds, rest = divmod(int(stamp_ns), NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def to_quaternion(yaw_rad: float) -> geometry.Quaternion:
    """Turn about the vertical."""
    return geometry.Quaternion(z=float(math.sin(yaw_rad / 2)), w=float(math.cos(yaw_rad / 2)))


def read_image(message: ImageMessage | CompressedImage) -> tuple[int, Image]:
    """Stamp and image (H, W, 3) uint8 BGR of either image message."""
    read = read_compressed if isinstance(message, CompressedImage) else read_raw
    return read_stamp(message.header.stamp), read(message)


def to_image(image: Image, stamp_ns: int, frame: str) -> ImageMessage:
    """A bgr8 message of an image (H, W, 3) uint8."""
    image = np.ascontiguousarray(image, np.uint8)
    message = ImageMessage(encoding='bgr8', is_bigendian=0)
    _head(message, stamp_ns, frame)
    message.height, message.width = int(image.shape[0]), int(image.shape[1])
    message.step = message.width * 3
    message.data = array.array('B', image.tobytes())
    return message


def to_compressed(image: Image, stamp_ns: int, frame: str, quality: int) -> CompressedImage:
    """A JPEG message of an image (H, W, 3) uint8 BGR."""
    message = CompressedImage(format='bgr8; jpeg compressed bgr8')
    _head(message, stamp_ns, frame)
    message.data = array.array('B', encode_jpeg(image, quality))
    return message


def to_info(panorama: PanoramaConfig) -> String:
    """What a panorama shows, for panorama/info: the settings as a JSON object."""
    return String(data=json.dumps(dataclasses.asdict(panorama)))


def read_info(message: String) -> PanoramaConfig:
    """The settings of a panorama, from panorama/info."""
    try:
        return PanoramaConfig.from_mapping(_read_json(message), 'is no panorama')
    except ConfigError as error:
        raise MessageError(str(error)) from None


def read_odometry(message: Odometry) -> tuple[int, tuple[float, ...], tuple[float, float, float]]:
    """Stamp, twist (v m/s, omega rad/s and their variances, 0 where unknown), odometry's pose."""
    pose = messages.read_planar(message.pose.pose.position, message.pose.pose.orientation)
    return read_stamp(message.header.stamp), messages.read_twist(message), pose


def read_pose(message: geometry.PoseWithCovarianceStamped) -> tuple[int, Array, Array]:
    """Stamp, pose (3,) and covariance (3, 3) of [x, y, yaw]; all zeros where it is unknown."""
    pose = np.array(messages.read_planar(message.pose.pose.position, message.pose.pose.orientation))
    covariance = np.asarray(message.pose.covariance, float).reshape(6, 6)[_PLANAR]
    a, b, c, d, e, f, g, h, i = covariance.ravel().tolist()  # floats: arrays this small cost more
    require_sane('covariance', a, b, c, d, e, f, g, h, i)
    if min(a, e, i) < 0:
        raise MessageError('negative variance')
    largest = max(a, e, i, abs(b), abs(c), abs(f))
    if max(abs(b - d), abs(c - g), abs(f - h)) > 1e-6 * (1 + largest):
        raise MessageError('covariance is not symmetric')
    return read_stamp(message.header.stamp), pose, covariance


def to_pose(pose: ArrayLike, stamp_ns: int, frame: str) -> geometry.PoseStamped:
    """A pose (3,) as a message; an unknown (NaN) yaw becomes 0, because a pose has none."""
    message = geometry.PoseStamped()
    _head(message, stamp_ns, frame)
    _fill(message.pose, pose)
    return message


def to_pose_with_covariance(
    pose: ArrayLike, covariance: Array, stamp_ns: int, frame: str
) -> geometry.PoseWithCovarianceStamped:
    """A pose (3,) and its covariance (3, 3) as a message."""
    message = geometry.PoseWithCovarianceStamped()
    _head(message, stamp_ns, frame)
    _fill(message.pose.pose, pose)
    message.pose.covariance = _full(covariance, _PLANAR)
    return message


def to_odometry(
    pose: ArrayLike,
    covariance: Array,
    twist: ArrayLike,
    twist_covariance: Array,
    stamp_ns: int,
    frames: tuple[str, str],
) -> Odometry:
    """Pose in frames[0] and twist (v, omega) in frames[1], with (3, 3) and (2, 2) covariances."""
    message = Odometry(child_frame_id=frames[1])
    _head(message, stamp_ns, frames[0])
    _fill(message.pose.pose, pose)
    message.pose.covariance = _full(covariance, _PLANAR)
    message.twist.twist.linear.x, message.twist.twist.angular.z = np.asarray(twist, float).tolist()
    message.twist.covariance = _full(twist_covariance, _TWIST)
    return message


def to_transform(pose: ArrayLike, stamp_ns: int, frames: tuple[str, str]) -> Any:
    """Pose (3,) of frames[1] in frames[0] as a transform from the one to the other."""
    x, y, yaw = np.asarray(pose, float).tolist()
    require_sane('output', x, y, yaw)
    message = geometry.TransformStamped(child_frame_id=frames[1])
    _head(message, stamp_ns, frames[0])
    message.transform.translation.x, message.transform.translation.y = x, y
    message.transform.rotation = to_quaternion(yaw)
    return message


def to_array(values: ArrayLike, label: str) -> Float64MultiArray:
    """A vector with the name of its only dimension."""
    numbers = np.asarray(values, float).ravel()
    message = Float64MultiArray(data=array.array('d', numbers))
    message.layout.dim = [MultiArrayDimension(label=label, size=len(numbers), stride=len(numbers))]
    return message


def to_turned(yaw_rad: float, stamp_ns: int, frame: str) -> geometry.QuaternionStamped:
    """How far images have turned about the vertical, from any start."""
    require_sane('output', yaw_rad)
    message = geometry.QuaternionStamped(quaternion=to_quaternion(yaw_rad))
    _head(message, stamp_ns, frame)
    return message


def read_turned(message: geometry.QuaternionStamped) -> tuple[int, float]:
    """Stamp ns and yaw rad. Raises MessageError."""
    return read_stamp(message.header.stamp), messages.read_yaw(message.quaternion)


def to_rig(rig: Rig, correlation: ErrorCorrelation) -> String:
    """What ekf_node needs to know of a model, for sfa/rig, as a JSON object: the robot, and how the
    errors of neighboring images correlate."""
    shared = {_CORRELATION: [correlation.share, correlation.distance_m]}
    return String(data=json.dumps(rig.to_mapping() | shared))


def read_rig(message: String) -> tuple[Rig, ErrorCorrelation]:
    """The same from sfa/rig. Raises MessageError."""
    values = _read_json(message)
    try:
        share, distance_m = map(float, values.pop(_CORRELATION))
        return Rig.from_mapping(values), ErrorCorrelation(share, distance_m)
    except (KeyError, TypeError, ValueError, DataError) as error:
        raise MessageError(f'is no record of a robot: {error}') from None


def _read_json(message: String) -> dict[str, Any]:
    """The JSON object in a message. Raises MessageError."""
    try:
        values = json.loads(message.data)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise MessageError('is no JSON object')
    return values


def _full(covariance: Array, places: Any) -> NDArray[np.float64]:
    """The 36 numbers of a message, of which those at these places are known."""
    full = _FIXED.copy()
    full[places] = covariance
    return full.ravel()


def _head(message: Any, stamp_ns: int, frame: str) -> None:
    message.header.stamp, message.header.frame_id = to_stamp(stamp_ns), frame


def _fill(message: Any, pose: ArrayLike) -> None:
    x, y, yaw = np.asarray(pose, float).tolist()
    require_sane('output', x, y)
    message.position.x, message.position.y = x, y
    message.orientation = to_quaternion(yaw if math.isfinite(yaw) else 0.0)
