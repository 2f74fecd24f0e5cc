# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write a rosbag2: images, odometry, yaw rates and poses as the messages a robot records."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores

from sfa_localization.bags.decoding import typestore
from sfa_localization.camera.encodings import encode_jpeg, encode_png
from sfa_localization.data.errors import BagError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image

STORAGES = ('mcap', 'sqlite3')
FOREVER = QosTime(9223372036, 854775807)
RELIABLE = Qos(
    history=QosHistory.KEEP_LAST,
    depth=10,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=FOREVER,
    lifespan=FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=FOREVER,
    avoid_ros_namespace_conventions=False,
)


class BagWriter:
    """Context manager that writes one bag; the folder `path` appears only when all is written.

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
        if self.path.exists():
            raise BagError(f'{self.path}: already exists; name another bag or remove it')
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix='.bag-', dir=self.path.parent))
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            self._writer = _open_writer(self._folder / self.path.name, self._storage)
        except BaseException as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            if isinstance(error, Exception):
                raise self._unwritable(error) from None
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._writer.__exit__(kind, error, trace)
            if kind is None:
                (self._folder / self.path.name).rename(self.path)
        except Exception as failure:
            # The error that ended the block is the cause; a failed write only follows from it.
            if kind is None:
                raise self._unwritable(failure) from None
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _unwritable(self, error: Exception) -> BagError:
        """The error to raise instead of one of the file system or of the database."""
        why = error.strerror if isinstance(error, OSError) else str(error)
        return BagError(f'{self.path}: cannot be written: {why or type(error).__name__}')

    def image(
        self,
        topic: str,
        stamp_ns: int,
        image: Image,
        frame_id: str,
        compressed: str | None = None,
        quality: int = 90,
    ) -> None:
        """Write a BGR image (H, W, 3) as Image, or as CompressedImage ('jpeg' or 'png')."""
        header = self._header(stamp_ns, frame_id)
        if compressed is not None:
            data = _encoded(image, compressed, quality)
            message = self._make(
                'sensor_msgs/msg/CompressedImage', header=header, format=compressed, data=data
            )
        else:
            message = self._raw_image(header, image)
        self.message(topic, stamp_ns, message)

    def _raw_image(self, header: Any, image: Image) -> Any:
        height, width = image.shape[:2]
        return self._make(
            'sensor_msgs/msg/Image',
            header=header,
            height=height,
            width=width,
            encoding='bgr8',
            is_bigendian=0,
            step=3 * width,
            data=np.ascontiguousarray(image, np.uint8).reshape(-1),
        )

    def odometry(
        self,
        topic: str,
        stamp_ns: int,
        pose: Array,
        twist: Array,
        twist_variance: Array,
        frame_id: str = 'odom',
        child_frame_id: str = 'base_link',
    ) -> None:
        """Write odometry: `pose` x m, y m, yaw rad; `twist` v m/s, omega rad/s; their variances."""
        covariance = _diagonal({0: twist_variance[0], 35: twist_variance[1]}, 36)
        velocity = self._twist(float(twist[0]), float(twist[1]))
        message = self._make(
            'nav_msgs/msg/Odometry',
            header=self._header(stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            pose=self._make(
                'geometry_msgs/msg/PoseWithCovariance',
                pose=self._pose(pose),
                covariance=np.zeros(36),
            ),
            twist=self._make(
                'geometry_msgs/msg/TwistWithCovariance', twist=velocity, covariance=covariance
            ),
        )
        self.message(topic, stamp_ns, message)

    def imu(
        self, topic: str, stamp_ns: int, omega: float, variance: float, frame_id: str = 'base_link'
    ) -> None:
        """Write a gyroscope's yaw rate (rad/s); orientation and acceleration are marked unknown."""
        unknown = _diagonal({0: -1.0}, 9)
        message = self._make(
            'sensor_msgs/msg/Imu',
            header=self._header(stamp_ns, frame_id),
            orientation=self._quaternion(0.0),
            orientation_covariance=unknown,
            angular_velocity=self._vector(0.0, 0.0, float(omega)),
            angular_velocity_covariance=_diagonal({8: variance}, 9),
            linear_acceleration=self._vector(0.0, 0.0, 0.0),
            linear_acceleration_covariance=unknown,
        )
        self.message(topic, stamp_ns, message)

    def pose(self, topic: str, stamp_ns: int, pose: Array, frame_id: str = 'world') -> None:
        """Write a PoseStamped: `pose` x m, y m, yaw rad."""
        message = self._make(
            'geometry_msgs/msg/PoseStamped',
            header=self._header(stamp_ns, frame_id),
            pose=self._pose(pose),
        )
        self.message(topic, stamp_ns, message)

    def message(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Write any message of the rosbags type store, received at `stamp_ns`."""
        kind = message.__msgtype__
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=[RELIABLE]
            )
            self._connections[topic] = connection
        if connection.msgtype != kind:
            raise BagError(f'{self.path}: topic {topic} is {connection.msgtype}, not {kind}')
        data = self._types.serialize_cdr(message, kind)
        try:
            self._writer.write(connection, stamp_ns, data)
        except Exception as error:
            raise self._unwritable(error) from None

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types.types[kind](**fields)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(int(stamp_ns), 10**9)
        stamp = self._make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
        return self._make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)

    def _pose(self, pose: Array) -> Any:
        position = self._make('geometry_msgs/msg/Point', x=float(pose[0]), y=float(pose[1]), z=0.0)
        orientation = self._quaternion(float(pose[2]))
        return self._make('geometry_msgs/msg/Pose', position=position, orientation=orientation)

    def _quaternion(self, yaw_rad: float) -> Any:
        z, w = float(np.sin(yaw_rad / 2)), float(np.cos(yaw_rad / 2))
        return self._make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=z, w=w)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)

    def _twist(self, v: float, omega: float) -> Any:
        linear, angular = self._vector(v, 0.0, 0.0), self._vector(0.0, 0.0, omega)
        return self._make('geometry_msgs/msg/Twist', linear=linear, angular=angular)


def _open_writer(path: Path, storage: str) -> Writer:
    plugin = StoragePlugin.MCAP if storage == 'mcap' else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if storage == 'mcap':
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    writer.open()
    return writer


def _encoded(image: Image, kind: str, quality: int) -> NDArray[np.uint8]:
    """The bytes (N,) of an image file."""
    data = encode_jpeg(image, quality) if kind == 'jpeg' else encode_png(image)
    return np.frombuffer(data, np.uint8)


def _diagonal(entries: dict[int, float], size: int) -> Array:
    matrix = np.zeros(size)
    matrix[list(entries)] = list(entries.values())
    return matrix
