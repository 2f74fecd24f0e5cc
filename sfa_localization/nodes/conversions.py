# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to and from plain values; malformed ones raise MessageError.

Messages are filled here and nowhere else; `data.messages` reads their fields. Stamps are integer
nanoseconds, poses are (x m, y m, yaw rad), covariances of poses are (3, 3) in that order.
"""

from __future__ import annotations

import array
import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs import msg as geometry
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry
from numpy.typing import ArrayLike
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import ColorRGBA, Float64MultiArray, Header, MultiArrayDimension, String
from visualization_msgs.msg import Marker, MarkerArray

from sfa_localization.camera.encodings import encode_jpeg
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data import messages
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import ConfigError, DataError, MessageError
from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.messages import NANOSECONDS, read_stamp, require_sane
from sfa_localization.data.rig import Rig
from sfa_localization.data.run import Image
from sfa_localization.mapping.driven_ground import LINE_M, Cells, DrivenGround

_CORRELATION = 'error_correlation'
_OCCUPIED = 100
_TEXT_M = 0.4
_TEXT_UP_M = 1.0


def to_stamp(stamp_ns: int) -> Time:
    """A message's stamp from nanoseconds >= 0."""
    seconds, rest = divmod(int(stamp_ns), NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def to_quaternion(yaw_rad: float) -> geometry.Quaternion:
    """Rotation about the vertical."""
    return geometry.Quaternion(z=math.sin(yaw_rad / 2), w=math.cos(yaw_rad / 2))


def to_image(image: Image, stamp_ns: int, frame: str) -> ImageMessage:
    """A bgr8 message of an image (H, W, 3) uint8."""
    height, width = image.shape[:2]
    message = ImageMessage(header=_header(stamp_ns, frame), encoding='bgr8')
    message.height = height
    message.width = width
    message.step = width * 3
    message.data = array.array('B', image.tobytes())
    return message


def to_compressed(image: Image, stamp_ns: int, frame: str, quality: int) -> CompressedImage:
    """A JPEG message of an image (H, W, 3) uint8 BGR."""
    message = CompressedImage(format='bgr8; jpeg compressed bgr8')
    message.header = _header(stamp_ns, frame)
    message.data = array.array('B', encode_jpeg(image, quality))
    return message


def to_info(panorama: PanoramaConfig) -> String:
    """The settings of panoramas as a JSON object, for panorama/info."""
    return String(data=json.dumps(dataclasses.asdict(panorama)))


def read_info(message: String) -> PanoramaConfig:
    """The settings of panoramas from panorama/info."""
    try:
        return PanoramaConfig.from_mapping(_read_json(message), 'is no panorama')
    except ConfigError as error:
        raise MessageError(str(error)) from None


def read_odometry(
    message: Odometry,
) -> tuple[int, tuple[float, ...], tuple[float, float, float] | None]:
    """Stamp, twist (v m/s, omega rad/s, and their variances, 0 if unknown) and odometry's pose;
    None where it is not filled.
    """
    pose, twist = messages.read_odometry(message)
    return read_stamp(message.header.stamp), twist, pose


def read_pose(message: geometry.PoseWithCovarianceStamped) -> tuple[int, Array, Array]:
    """Stamp, pose (3,) and its covariance (3, 3), all zeros if unknown."""
    pose = np.array(messages.read_planar(message.pose.pose.position, message.pose.pose.orientation))
    covariance = np.asarray(message.pose.covariance, float).reshape(6, 6)[messages.PLANAR]
    require_sane('covariance', *covariance.ravel().tolist())
    if covariance.diagonal().min() < 0:
        raise MessageError('negative variance')
    if np.abs(covariance - covariance.T).max() > 1e-6 * (1 + np.abs(covariance).max()):
        raise MessageError('covariance is not symmetric')
    return read_stamp(message.header.stamp), pose, covariance


def to_pose(pose: ArrayLike, stamp_ns: int, frame: str) -> geometry.PoseStamped:
    """A pose (3,) as a message; an unknown (NaN) yaw becomes 0, because a pose has none."""
    message = geometry.PoseStamped(header=_header(stamp_ns, frame))
    _fill(message.pose, pose)
    return message


def to_pose_with_covariance(
    pose: ArrayLike, covariance: Array, stamp_ns: int, frame: str
) -> geometry.PoseWithCovarianceStamped:
    """A pose (3,) and its covariance (3, 3) as a message."""
    message = geometry.PoseWithCovarianceStamped(header=_header(stamp_ns, frame))
    _fill(message.pose.pose, pose)
    message.pose.covariance = messages.full_covariance(covariance)
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
    message = Odometry(header=_header(stamp_ns, frames[0]), child_frame_id=frames[1])
    _fill(message.pose.pose, pose)
    message.pose.covariance = messages.full_covariance(covariance)
    message.twist.twist.linear.x, message.twist.twist.angular.z = np.asarray(twist, float).tolist()
    message.twist.covariance = messages.full_covariance(twist_covariance, messages.TWIST)
    return message


def to_transform(
    pose: ArrayLike, stamp_ns: int, frames: tuple[str, str]
) -> geometry.TransformStamped:
    """The transform frames[0] -> frames[1] of a pose (3,) of frames[1] in frames[0]."""
    x, y, yaw = np.asarray(pose, float).tolist()
    require_sane('output', x, y, yaw)
    message = geometry.TransformStamped(header=_header(stamp_ns, frames[0]))
    message.child_frame_id = frames[1]
    message.transform.translation.x = x
    message.transform.translation.y = y
    message.transform.rotation = to_quaternion(yaw)
    return message


def to_array(values: ArrayLike, label: str) -> Float64MultiArray:
    """A vector, and the name of its only dimension."""
    numbers = np.asarray(values, float).ravel()
    message = Float64MultiArray(data=array.array('d', numbers))
    message.layout.dim = [MultiArrayDimension(label=label, size=len(numbers), stride=len(numbers))]
    return message


def to_turned(yaw_rad: float, stamp_ns: int, frame: str) -> geometry.QuaternionStamped:
    """The rotation of images about the vertical, relative to any of them."""
    require_sane('output', yaw_rad)
    header = _header(stamp_ns, frame)
    quaternion = to_quaternion(yaw_rad)
    return geometry.QuaternionStamped(header=header, quaternion=quaternion)


def read_turned(message: geometry.QuaternionStamped) -> tuple[int, float]:
    """Stamp ns and yaw rad. Raises MessageError."""
    return read_stamp(message.header.stamp), messages.read_yaw(message.quaternion)


def to_grid(cells: Cells, stamp_ns: int, frame: str, to_drive: Mask | None = None) -> OccupancyGrid:
    """Cells as a map: free where the robot drove, occupied where it is `to_drive` still, else
    unknown.
    """
    info = MapMetaData(map_load_time=to_stamp(stamp_ns), resolution=cells.size_m)
    info.height, info.width = cells.driven.shape
    info.origin.position.x, info.origin.position.y = cells.corner.tolist()
    values = np.where(cells.driven, 0, -1).astype(np.int8)
    if to_drive is not None:
        values[to_drive & ~cells.driven] = _OCCUPIED
    data = array.array('b', values.tobytes())
    return OccupancyGrid(header=_header(stamp_ns, frame), info=info, data=data)


def to_hints(drives: Sequence[Array], text: str, stamp_ns: int, frame: str) -> MarkerArray:
    """The places (M, 3) of images of each part of a drive as lines, and a sentence at the last."""
    markers = []
    for number, places in enumerate(drives):
        line = Marker(header=_header(stamp_ns, frame), ns='drive', type=Marker.LINE_STRIP)
        line.id = number
        line.scale.x = LINE_M
        line.pose.orientation.w = 1.0
        line.color = ColorRGBA(g=1.0, a=1.0)
        line.points = [geometry.Point(x=x, y=y) for x, y in places[:, :2].tolist()]
        markers.append(line)
    said = Marker(header=_header(stamp_ns, frame), ns='said', type=Marker.TEXT_VIEW_FACING)
    said.pose.position.x, said.pose.position.y = drives[-1][-1, :2].tolist()
    said.pose.position.z = _TEXT_UP_M
    said.scale.z = _TEXT_M
    said.color = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
    said.text = text
    return MarkerArray(markers=[*markers, said])


def to_lines(ground: DrivenGround, stamp_ns: int, frame: str) -> MarkerArray:
    """The paths of the training as lines, by the error of one image from green to red."""
    marker = Marker(header=_header(stamp_ns, frame), ns='driven', type=Marker.LINE_LIST)
    marker.scale.x = LINE_M
    marker.pose.orientation.w = 1.0
    ends = ground.lines.ravel()
    marker.points = [geometry.Point(x=x, y=y) for x, y in ground.places[ends].tolist()]
    marker.colors = [ColorRGBA(r=share, g=1.0 - share, a=1.0) for share in ground.red.tolist()]
    return MarkerArray(markers=[marker])


def to_rig(rig: Rig, correlation: ErrorCorrelation) -> String:
    """The model's record of the robot, and the correlation of neighboring images' errors, as a JSON
    object for sfa/rig."""
    numbers = [correlation.share, correlation.distance_m]
    return String(data=json.dumps(rig.to_mapping() | {_CORRELATION: numbers}))


def read_rig(message: String) -> tuple[Rig, ErrorCorrelation]:
    """The robot and the correlation from sfa/rig. Raises MessageError."""
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


def _header(stamp_ns: int, frame: str) -> Header:
    return Header(stamp=to_stamp(stamp_ns), frame_id=frame)


def _fill(message: Any, pose: ArrayLike) -> None:
    x, y, yaw = np.asarray(pose, float).tolist()
    require_sane('output', x, y)
    message.position.x = x
    message.position.y = y
    message.orientation = to_quaternion(yaw if math.isfinite(yaw) else 0.0)
