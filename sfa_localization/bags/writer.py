# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write a rosbag2: images, odometry, yaw rates and poses as the messages a robot records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Connection,
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores
from rosbags.typesys.store import Typestore

from sfa_localization.bags.decoding import typestore
from sfa_localization.camera.encodings import encode_jpeg, encode_png
from sfa_localization.camera.sectors import MountedCamera
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.errors import BagError
from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.messages import TWIST, full_covariance
from sfa_localization.data.run import Image, Stamps
from sfa_localization.data.transforms import BASE

STORAGES = ('mcap', 'sqlite3')
_NEVER = QosTime(2147483647, 4294967295)  # as ROS writes that a time is not limited
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NEVER,
    _NEVER,
    QosLiveliness.AUTOMATIC,
    _NEVER,
    avoid_ros_namespace_conventions=False,
)
"""`ros2 bag play` keeps the last message of such a topic for those who subscribe later."""


def require_new_bag(path: Path) -> None:
    """Raise BagError if a bag would replace something."""
    if path.exists():
        raise BagError(f'{path}: already exists; name another bag or remove it')


class BagWriter:
    """Context manager that writes one bag; the folder `path` appears when all is written.

    `storage` is 'mcap' (chunks compressed with zstd) or 'sqlite3'. The same calls give the same
    bytes. Raises BagError when `path` exists or cannot be written.
    """

    def __init__(self, path: Path | str, storage: str = 'mcap') -> None:
        self.path = Path(path)
        if storage not in STORAGES:
            raise BagError(f'bag storage {storage!r} is not one of {", ".join(STORAGES)}')
        self._storage = storage
        self._types = typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        require_new_bag(self.path)
        with self._named(), ExitStack() as stack:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            folder = TemporaryDirectory(prefix='.bag-', dir=self.path.parent)
            self._part = Path(stack.enter_context(folder)) / self.path.name
            plugin = StoragePlugin.MCAP if self._storage == 'mcap' else StoragePlugin.SQLITE3
            self._writer = Writer(self._part, version=9, storage_plugin=plugin)
            if self._storage == 'mcap':
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
            self._folder = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: Any) -> None:
        # After an error in the block, a failed write is only its consequence.
        with self._folder, suppress(Exception) if kind else self._named():
            self._writer.__exit__(kind, *error)
            if kind is None:
                self._part.rename(self.path)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Turn any error into one that names the bag."""
        try:
            yield
        except Exception as error:
            why = getattr(error, 'strerror', None) or str(error) or type(error).__name__
            raise BagError(f'{self.path}: cannot be written: {why}') from None

    def image(
        self,
        topic: str,
        stamp_ns: int,
        image: Image,
        frame_id: str,
        compressed: str | None = None,
    ) -> None:
        """Write a BGR image (H, W, 3) as Image, or as CompressedImage ('jpeg' or 'png')."""
        if compressed is not None:
            message = self._stamped('sensor_msgs/msg/CompressedImage', stamp_ns, frame_id)
            data = encode_jpeg(image) if compressed == 'jpeg' else encode_png(image)
            message.format = compressed
            message.data = np.frombuffer(data, np.uint8)
        else:
            message = self._stamped('sensor_msgs/msg/Image', stamp_ns, frame_id)
            message.height, message.width = image.shape[:2]
            message.encoding = 'bgr8'
            message.step = 3 * message.width
            message.data = np.ascontiguousarray(image, np.uint8).reshape(-1)
        self.message(topic, stamp_ns, message)

    def odometry(
        self, topic: str, stamp_ns: int, pose: Array, twist: Array, twist_variance: Array
    ) -> None:
        """Write odometry: `pose` x m, y m, yaw rad; `twist` v m/s, omega rad/s; their variances."""
        message = self._stamped('nav_msgs/msg/Odometry', stamp_ns, 'odom')
        message.child_frame_id = BASE
        _place(message.pose.pose, pose)
        message.twist.twist.linear.x, message.twist.twist.angular.z = map(float, twist)
        message.twist.covariance[[0, 35]] = twist_variance
        self.message(topic, stamp_ns, message)

    def estimate(
        self,
        topic: str,
        stamp_ns: int,
        pose: Array,
        covariance: Array,
        twist: Array | None = None,
        twist_covariance: Array | None = None,
        frames: tuple[str, str] = ('map', BASE),
    ) -> None:
        """Write a pose (3,) with covariance (3, 3) as PoseWithCovarianceStamped in frames[0], or
        with a twist (2,) of frames[1] and its covariance (2, 2) as Odometry. A NaN yaw becomes 0.
        """
        if twist is None or twist_covariance is None:
            kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
            message = self._stamped(kind, stamp_ns, frames[0])
        else:
            message = self._stamped('nav_msgs/msg/Odometry', stamp_ns, frames[0])
            message.child_frame_id = frames[1]
            message.twist.twist.linear.x, message.twist.twist.angular.z = map(float, twist)
            message.twist.covariance = full_covariance(twist_covariance, TWIST)
        _place(message.pose.pose, np.nan_to_num(pose))
        message.pose.covariance = full_covariance(covariance)
        self.message(topic, stamp_ns, message)

    def trail(self, topic: str, stamps_ns: Stamps, poses: Array, frame_id: str) -> None:
        """Write poses (N, 3) at stamps (N,) as one latched Path, received at the first stamp."""
        message = self._stamped('nav_msgs/msg/Path', stamps_ns[0], frame_id)
        for stamp_ns, pose in zip(stamps_ns.tolist(), poses, strict=True):
            one = self._stamped('geometry_msgs/msg/PoseStamped', stamp_ns, frame_id)
            _place(one.pose, pose)
            message.poses.append(one)
        self.message(topic, int(stamps_ns[0]), message, latched=True)

    def grid(
        self, topic: str, stamp_ns: int, free: Mask, corner: Array, cell_m: float, frame_id: str
    ) -> None:
        """Write cells (H, W), row 0 at the lowest y, as a latched OccupancyGrid: free or unknown;
        `corner` (2,) m is the lower left corner of the first cell.
        """
        message = self._stamped('nav_msgs/msg/OccupancyGrid', stamp_ns, frame_id)
        message.info.map_load_time = message.header.stamp
        message.info.resolution = cell_m
        message.info.height, message.info.width = free.shape
        _place(message.info.origin, np.append(corner, 0.0))
        message.data = np.where(free, 0, -1).astype(np.int8).ravel()
        self.message(topic, stamp_ns, message, latched=True)

    def lines(
        self, topic: str, stamp_ns: int, ends: Array, red: Array, width_m: float, frame_id: str
    ) -> None:
        """Write lines between every two `ends` (2 L, 2) m as one marker in a latched MarkerArray,
        from green to `red` (2 L,), 0 to 1.
        """
        marker = self._stamped('visualization_msgs/msg/Marker', stamp_ns, frame_id)
        marker.ns = 'driven'
        marker.type = marker.LINE_LIST
        marker.scale.x = width_m
        marker.pose.orientation.w = 1.0
        for place, share in zip(ends.tolist(), red.tolist(), strict=True):
            point = blank(self._types, 'geometry_msgs/msg/Point')
            point.x, point.y = place
            color = blank(self._types, 'std_msgs/msg/ColorRGBA')
            color.r = share
            color.g = 1.0 - share
            color.a = 1.0
            marker.points.append(point)
            marker.colors.append(color)
        message = blank(self._types, 'visualization_msgs/msg/MarkerArray')
        message.markers = [marker]
        self.message(topic, stamp_ns, message, latched=True)

    def text(self, topic: str, stamp_ns: int, text: str) -> None:
        """Write a latched String."""
        message = blank(self._types, 'std_msgs/msg/String')
        message.data = text
        self.message(topic, stamp_ns, message, latched=True)

    def array(self, topic: str, stamp_ns: int, values: Array) -> None:
        """Write a vector as Float64MultiArray."""
        message = blank(self._types, 'std_msgs/msg/Float64MultiArray')
        message.data = np.asarray(values, float)
        self.message(topic, stamp_ns, message)

    def static_transform(self, stamp_ns: int, pose: Array, frames: tuple[str, str]) -> None:
        """Write the pose (3,) of frames[1] in frames[0] on /tf_static."""
        transform = self._stamped('geometry_msgs/msg/TransformStamped', stamp_ns, frames[0])
        transform.child_frame_id = frames[1]
        x, y, yaw_rad = map(float, pose)
        transform.transform.translation.x = x
        transform.transform.translation.y = y
        transform.transform.rotation.z = float(np.sin(yaw_rad / 2))
        transform.transform.rotation.w = float(np.cos(yaw_rad / 2))
        message = blank(self._types, 'tf2_msgs/msg/TFMessage')
        message.transforms = [transform]
        self.message('/tf_static', stamp_ns, message, latched=True)

    def imu(self, topic: str, stamp_ns: int, omega: float, variance: float) -> None:
        """Write a gyroscope's yaw rate (rad/s); orientation and acceleration are marked unknown."""
        message = self._stamped('sensor_msgs/msg/Imu', stamp_ns, BASE)
        message.orientation.w = 1.0
        message.angular_velocity.z = float(omega)
        message.angular_velocity_covariance[8] = variance
        message.orientation_covariance[0] = message.linear_acceleration_covariance[0] = -1.0
        self.message(topic, stamp_ns, message)

    def pose(self, topic: str, stamp_ns: int, pose: Array, frame_id: str = 'world') -> None:
        """Write a PoseStamped: `pose` x m, y m, yaw rad."""
        message = self._stamped('geometry_msgs/msg/PoseStamped', stamp_ns, frame_id)
        _place(message.pose, pose)
        self.message(topic, stamp_ns, message)

    def camera_info(self, topic: str, stamp_ns: int, lens: LensCalibration, frame_id: str) -> None:
        """Write the calibration of a pinhole camera or a fisheye."""
        message = self._stamped('sensor_msgs/msg/CameraInfo', stamp_ns, frame_id)
        message.width = lens.image_width
        message.height = lens.image_height
        is_fisheye = lens.camera_model == 'fisheye'
        message.distortion_model = 'equidistant' if is_fisheye else 'plumb_bob'
        message.d = np.zeros(4 if is_fisheye else 5)
        message.d[: len(lens.distortion)] = lens.distortion
        matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
        message.k = matrix.ravel()
        message.r = np.eye(3).ravel()
        message.p = np.column_stack([matrix, np.zeros(3)]).ravel()
        self.message(topic, stamp_ns, message)

    def static_transforms(
        self, stamp_ns: int, parent: str, cameras: Mapping[str, MountedCamera]
    ) -> None:
        """Write, latched, the transforms from the optical frames of cameras to their `parent`."""
        message = blank(self._types, 'tf2_msgs/msg/TFMessage')
        for frame, camera in cameras.items():
            part = self._stamped('geometry_msgs/msg/TransformStamped', stamp_ns, parent)
            part.child_frame_id = frame
            moved = part.transform.translation
            turned = part.transform.rotation
            moved.x, moved.y, moved.z = camera.place
            turned.x, turned.y, turned.z, turned.w = _quaternion(np.array(camera.rotation))
            message.transforms.append(part)
        self.message('/tf_static', stamp_ns, message, latched=True)

    def message(self, topic: str, stamp_ns: int, message: Any, latched: bool = False) -> None:
        """Write any message of the rosbags type store, received at `stamp_ns`; a `latched` topic
        keeps its last one for those who subscribe later.
        """
        kind = message.__msgtype__
        connection = self._connections.get(topic)
        if connection is None:
            qos = [LATCHED] if latched else []
            connection = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=qos
            )
            self._connections[topic] = connection
        if connection.msgtype != kind:
            raise BagError(f'{self.path}: topic {topic} is {connection.msgtype}, not {kind}')
        data = self._types.serialize_cdr(message, kind)
        with self._named():
            self._writer.write(connection, stamp_ns, data)

    def _stamped(self, kind: str, stamp_ns: int, frame_id: str) -> Any:
        """A message of zeros with a header."""
        message = blank(self._types, kind)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(stamp_ns), 10**9)
        message.header.frame_id = frame_id
        return message


def blank(types: Typestore, kind: str) -> Any:
    """A message of zeros, empty texts and empty lists."""

    def value(node: Nodetype, detail: Any) -> Any:
        if node == Nodetype.NAME:
            return blank(types, detail)
        if node == Nodetype.BASE:
            return {'string': '', 'float64': 0.0}.get(detail[0], 0)
        (inner, base), length = detail
        return np.zeros(length, base[0]) if inner == Nodetype.BASE else []

    return types.types[kind](**{name: value(*field) for name, field in types.fielddefs[kind][1]})


def _place(pose: Any, values: Array) -> None:
    """Fill in a Pose from x m, y m, yaw rad."""
    x, y, yaw_rad = map(float, values)
    pose.position.x = x
    pose.position.y = y
    pose.orientation.z = float(np.sin(yaw_rad / 2))
    pose.orientation.w = float(np.cos(yaw_rad / 2))


def _quaternion(rotation: Array) -> list[float]:
    """The unit quaternion x, y, z, w of a rotation (3, 3).

    It is the eigenvector of the largest eigenvalue: I. Bar-Itzhack, JGCD 23(6), 2000.
    """
    off = rotation - rotation.T
    form = np.zeros((4, 4))
    form[:3, :3] = rotation + rotation.T - np.trace(rotation) * np.eye(3)
    form[:3, 3] = form[3, :3] = off[2, 1], off[0, 2], off[1, 0]
    form[3, 3] = np.trace(rotation)
    return list(map(float, np.linalg.eigh(form)[1][:, -1]))
