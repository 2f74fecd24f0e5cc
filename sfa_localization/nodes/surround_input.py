# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The input of a robot with several cameras: their images, lenses and places, joined to panoramas.

Cameras are those of the model, where it was trained on several; else lenses come from calibration
files or camera_info, and places from parameters or /tf_static.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo

from sfa_localization.camera.calibration_files import calibration_of_info, read_calibration
from sfa_localization.camera.sectors import MountedCamera, optical_pose
from sfa_localization.camera.settings import LensCalibration, SurroundConfig
from sfa_localization.camera.surround import Surround, require_rig
from sfa_localization.data.errors import ConfigError, MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.messages import read_odometry, read_stamp
from sfa_localization.data.run import Image
from sfa_localization.data.transforms import TOPIC, TransformTree
from sfa_localization.nodes.discovery import Discovery, without_transport
from sfa_localization.nodes.image_input import ImageInput
from sfa_localization.nodes.lifecycle import ERROR, OK, WARN, LocalizationNode, sensor_qos

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the pip wheels of ROS have none
    TFMessage = None

_ODOM = 'odom'
_BASE = 'base_link'
"""The robot's frame, where odometry names none."""
_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Of /tf_static, which has a latched message of each of its publishers."""


class SurroundInput:
    """Calls `use` with stamp, ns, and panorama (H, W, 3) of the images of several cameras.

    `trained` are the cameras of a model, or none; `make` makes panoramas of cameras. Raises
    ConfigError where parameters name other cameras than the model's.
    """

    def __init__(
        self,
        node: LocalizationNode,
        transport: str,
        config: SurroundConfig,
        trained: Sequence[MountedCamera],
        make: Callable[[Sequence[MountedCamera]], Surround],
        use: Callable[[int, Image], None],
    ) -> None:
        self._node = node
        self._make = make
        self._use = use
        self.names = config.cameras or tuple(camera.name for camera in trained)
        require_rig(self.names)
        if trained and set(self.names) != {camera.name for camera in trained}:
            listed = ', '.join(camera.name for camera in trained)
            raise ConfigError(f'cameras: the model was trained on {listed}; name these, or none')
        self._lenses = dict[str, LensCalibration]()
        self._poses = dict[str, Array]()
        if not trained:
            self._lenses |= zip(self.names, map(_read, config.camera_files), strict=False)
            self._poses |= zip(self.names, _poses(config.camera_poses), strict=False)
        self._frames = dict[str, str]()
        self._base = _BASE
        self._tree = TransformTree()
        self.surround = make(trained) if trained else None
        self._described: list[Any] = []
        self._odometry: Any = None
        self._substitute_odometry = ''
        self._listens = False
        raw = transport == 'raw'
        self.topics = dict[str, str]()
        self._inputs = dict[str, ImageInput]()
        self._substitutes = dict.fromkeys(self.names, ('', ''))
        self._searches = dict[str, Discovery]()
        for name in self.names:
            base = f'{name}/image_raw'
            topic = base if raw else node.following(f'{base}/{transport}')
            node.require_input(topic)
            self.topics[name] = topic
            self._inputs[name] = ImageInput(node, transport, topic, partial(self._take, name))
            types = self._inputs[name].types
            take = partial(self._substitute, name)
            self._searches[name] = Discovery(node, topic, types, [base], take, fixed=True)
        odometry = ['nav_msgs/msg/Odometry']
        Discovery(node, _ODOM, odometry, [_ODOM], self._take_odometry_of)

    # Subscriptions, while somebody listens.

    def start(self) -> None:
        """Subscribe to the images, and to what describes the cameras as far as it is not known."""
        self._listens = True
        for name, images in self._inputs.items():
            images.start(*self._substitutes[name])
        if self.surround is None:
            self._listen_to_descriptions()
        self._follow_odometry()

    def stop(self) -> None:
        """End all subscriptions."""
        self._listens = False
        for images in self._inputs.values():
            images.stop()
        self._follow_odometry()
        self._end_descriptions()

    def _substitute(self, name: str, topic: str, kind: str) -> None:
        """Take a camera's images by another transport."""
        self._substitutes[name] = topic, kind
        self._node.require_input(self.topics[name], topic)
        if self._listens:
            self._inputs[name].stop()
            self._inputs[name].start(topic, kind)

    def _take_odometry_of(self, topic: str, _: str) -> None:
        """Take odometry from a substitute for its topic."""
        self._substitute_odometry = topic
        self._node.require_input(_ODOM, topic)
        self._node.unsubscribe(self._odometry)
        self._odometry = None
        self._follow_odometry()

    def _follow_odometry(self) -> None:
        """Subscribe to the odometry while it is of use: its messages are the most frequent ones."""
        is_of_use = self._listens and (self.surround is None or self.surround.is_skewed)
        if is_of_use and self._odometry is None:
            qos = sensor_qos(20)
            topic = self._substitute_odometry
            take = self._take_turn
            self._odometry = self._node.subscribe(Odometry, _ODOM, take, qos, topic)
        elif not is_of_use:
            self._node.unsubscribe(self._odometry)
            self._odometry = None

    def _listen_to_descriptions(self) -> None:
        """Subscribe to camera_info beside the images, and to /tf_static."""
        for name in set(self.names) - set(self._lenses):
            images = without_transport(self._node.full_name(self.topics[name]))
            info = f'{name}/camera_info'
            beside = f'{images.rpartition("/")[0]}/camera_info'
            topic = info if self._node.is_remapped(info) else beside
            take = partial(self._take_info, name)
            qos = sensor_qos(1)
            self._described.append(self._node.subscribe(CameraInfo, info, take, qos, topic))
        if TFMessage is not None and set(self.names) - set(self._poses):
            transforms = self._node.subscribe(TFMessage, TOPIC, self._tree.add, _STATIC)
            self._described.append(transforms)

    def _end_descriptions(self) -> None:
        for subscription in self._described:
            self._node.unsubscribe(subscription)
        self._described.clear()

    # Messages.

    def _take_info(self, name: str, message: CameraInfo) -> None:
        self._lenses[name] = calibration_of_info(message)

    def _take_turn(self, message: Odometry) -> None:
        _, (_, omega, *_) = read_odometry(message)
        self._base = message.child_frame_id or _BASE
        if self.surround is not None:
            self.surround.add_turn_rate(read_stamp(message.header.stamp), omega)

    def _take(self, name: str, stamp_ns: int, image: Image, frame: str) -> None:
        """Use an image. Raises MessageError before all cameras are described, and CameraError."""
        self._frames[name] = frame
        if self.surround is None:
            self._describe()
        if self.surround is None:
            raise MessageError(self.missing())
        for panorama_ns, panorama in self.surround.add(name, stamp_ns, image):
            self._use(panorama_ns, panorama)
            self._follow_odometry()

    def _describe(self) -> None:
        """Begin with panoramas, if all cameras are described. Raises CameraError."""
        for name in set(self._frames) - set(self._poses):
            for base in dict.fromkeys((self._base, _BASE)):
                pose = self._tree.pose(self._frames[name], base)
                if pose is not None:
                    self._poses.setdefault(name, pose)
        if not self.missing():
            cameras = [MountedCamera.at(n, self._lenses[n], self._poses[n]) for n in self.names]
            self.surround = self._make(cameras)
            self._end_descriptions()

    def missing(self) -> str:
        """What is not known of the cameras yet, with what to do; '' if all is."""
        if self.surround is not None:
            return ''
        without_lens = [name for name in self.names if name not in self._lenses]
        without_pose = [name for name in self.names if name not in self._poses]
        parts = []
        if without_lens:
            parts.append(f'no camera_info of {", ".join(without_lens)}: publish it, or set '
                         'camera_files')  # fmt: skip
        if without_pose:
            parts.append(f'no pose of {", ".join(without_pose)} on /tf_static from {self._base}: '
                         'publish it, or set camera_poses')  # fmt: skip
        return '; '.join(parts)

    def remake(self) -> None:
        """Begin anew with the same cameras after a change of parameters. Raises CameraError."""
        if self.surround is not None:
            self.surround = self._make(self.surround.cameras)

    def look(self) -> None:
        """Look for other transports of the images that nobody publishes."""
        for search in self._searches.values():
            search.look()

    # State.

    def judge(
        self, details: dict[str, str], patience_s: float, listening_s: float
    ) -> tuple[int, str]:
        """Diagnostic level and text, '' if all is well, after `listening_s` seconds; all cameras
        may be silent for `patience_s`.
        """
        silent = [self._node.monitors[topic].silent_for_s() for topic in self.topics.values()]
        if min(*silent, listening_s) > patience_s:
            names = ', '.join(map(self._node.full_name, self.topics.values()))
            hints = [search.hint for search in self._searches.values() if search.hint]
            return ERROR, '; '.join(hints) or f'no image on {names}'
        if self.surround is None:
            return ERROR if listening_s > patience_s else WARN, self.missing()
        troubles = self.surround.troubles
        for name in self.names:
            details[f'camera {name}'] = troubles[name].reason if name in troubles else 'used'
        visible = self.surround.visible
        if visible is not None:
            details['panorama visible [%]'] = f'{100 * visible.mean():.0f}'
        text = '; '.join(f'camera {name}: {reason}' for name, (reason, _) in troubles.items())
        return (WARN, text) if troubles else (OK, '')


def _poses(numbers: Sequence[float]) -> list[Array]:
    """The poses (4, 4) of `camera_poses`."""
    return [optical_pose(row[:3], row[3:]) for row in np.reshape(numbers, (-1, 6)).tolist()]


def _read(path: str) -> LensCalibration:
    return read_calibration(Path(path))
