# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The input of a robot with several cameras: their images, lenses and places, joined to panoramas.

Cameras are those of the model, where it was trained on several; else lenses come from calibration
files or camera_info, and places from parameters or /tf_static.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo

from sfa_localization.camera.calibration_files import calibration_of_info, read_calibration
from sfa_localization.camera.sectors import MountedCamera, optical_pose
from sfa_localization.camera.settings import LensCalibration, SurroundConfig
from sfa_localization.camera.surround import Surround, require_rig
from sfa_localization.data.errors import ConfigError, MessageError
from sfa_localization.data.geometry import Array
from sfa_localization.data.image_topics import CAMERA_INFO
from sfa_localization.data.messages import read_odometry, read_stamp
from sfa_localization.data.run import Image
from sfa_localization.data.transforms import BASE, TOPIC, TransformTree
from sfa_localization.nodes.discovery import Discovery
from sfa_localization.nodes.image_input import ImageInput, calibration_topic
from sfa_localization.nodes.lifecycle import (
    ERROR,
    OK,
    WARN,
    LocalizationNode,
    TFMessage,
    sensor_qos,
    static_qos,
)

_ODOM = 'odom'


class Descriptions:
    """Lenses and places of cameras by parameters, or by camera_info beside their images and
    /tf_static.
    """

    def __init__(self, node: LocalizationNode, topics: Mapping[str, str], config: SurroundConfig):
        self._node = node
        self._topics = topics
        self._lenses = dict(zip(topics, map(_read, config.camera_files), strict=False))
        self._poses = dict(zip(topics, _poses(config.camera_poses), strict=False))
        self._tree = TransformTree()
        self._subscriptions: list[Any] = []

    def start(self) -> None:
        """Subscribe to what is not known."""
        for name in self._topics.keys() - self._lenses.keys():
            info = f'{name}/{CAMERA_INFO}'
            topic = calibration_topic(self._node, info, self._topics[name])
            take = partial(self._take_info, name)
            described = self._node.subscribe(CameraInfo, info, take, sensor_qos(1), topic)
            self._subscriptions.append(described)
        if TFMessage is not None and self._topics.keys() - self._poses.keys():
            transforms = self._node.subscribe(TFMessage, TOPIC, self._tree.add, static_qos())
            self._subscriptions.append(transforms)

    def stop(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            self._node.unsubscribe(subscription)
        self._subscriptions.clear()

    def _take_info(self, name: str, message: CameraInfo) -> None:
        self._lenses[name] = calibration_of_info(message)

    def place(self, name: str, frame: str, base: str) -> None:
        """Look where the frame of a camera's images sits on the robot's frame."""
        if name not in self._poses:
            pose = self._tree.pose(frame, base)
            pose = self._tree.pose(frame, BASE) if pose is None else pose
            if pose is not None:
                self._poses[name] = pose

    @property
    def missing(self) -> str:
        """What is not known of the cameras yet, with what to do; '' if all is."""
        lenses = ', '.join(name for name in self._topics if name not in self._lenses)
        poses = ', '.join(name for name in self._topics if name not in self._poses)
        parts = [f'no camera_info of {lenses}: publish it, or set camera_files'] if lenses else []
        if poses:
            parts.append(
                f'no pose of {poses} on /tf_static from {BASE}: publish it, or set camera_poses'
            )
        return '; '.join(parts)

    def cameras(self) -> list[MountedCamera]:
        """The cameras, of which nothing is missing."""
        return [
            MountedCamera.at(name, self._lenses[name], self._poses[name]) for name in self._topics
        ]


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
        self._base = BASE
        self._odometry: Any = None
        self._odometry_topic = ''
        self._listens = False
        self.surround = make(trained) if trained else None
        names = _names(config, trained)
        self.topics = {name: _image_topic(node, name, transport) for name in names}
        self._descriptions = Descriptions(node, self.topics, config)
        self._substitutes = dict.fromkeys(names, ('', ''))
        self._inputs = {
            name: ImageInput(node, transport, topic, partial(self._take, name))
            for name, topic in self.topics.items()
        }
        self._searches = [self._search(name) for name in names]
        Discovery(node, _ODOM, ['nav_msgs/msg/Odometry'], [_ODOM], self._take_odometry_of)

    def _search(self, name: str) -> Discovery:
        """The search for another transport of a camera's images."""
        types = self._inputs[name].types
        given = [f'{name}/image_raw']
        take = partial(self._substitute, name)
        return Discovery(self._node, self.topics[name], types, given, take, fixed=True)

    # Subscriptions, while somebody listens.

    def start(self) -> None:
        """Subscribe to the images, and to what describes the cameras as far as it is not known."""
        self._listens = True
        for name, images in self._inputs.items():
            images.start(*self._substitutes[name])
        if self.surround is None:
            self._descriptions.start()
        self._listen_to_odometry()

    def stop(self) -> None:
        """End all subscriptions."""
        self._listens = False
        for images in self._inputs.values():
            images.stop()
        self._node.unsubscribe(self._odometry)
        self._odometry = None
        self._descriptions.stop()

    def _substitute(self, name: str, topic: str, kind: str) -> None:
        """Take a camera's images by another transport."""
        self._substitutes[name] = topic, kind
        self._node.require_input(self.topics[name], topic)
        if self._listens:
            self._inputs[name].stop()
            self._inputs[name].start(topic, kind)

    def _take_odometry_of(self, topic: str, _: str) -> None:
        """Take odometry from a substitute for its topic."""
        self._odometry_topic = topic
        if self._listens:
            self._listen_to_odometry()

    def _listen_to_odometry(self) -> None:
        self._node.unsubscribe(self._odometry)
        given = self._take_motion, sensor_qos(20), self._odometry_topic
        self._odometry = self._node.subscribe(Odometry, _ODOM, *given)

    # Messages.

    def _take_motion(self, message: Odometry) -> None:
        """Use the turn, which corrects images of different times, and the pose, which shows whether
        cameras were turned.
        """
        pose, (_, omega, *_) = read_odometry(message)
        stamp_ns = read_stamp(message.header.stamp)
        self._base = message.child_frame_id or BASE
        if self.surround is not None:
            self.surround.add_turn_rate(stamp_ns, omega)
        if self.surround is not None and pose is not None:
            self.surround.add_pose(stamp_ns, np.array(pose))

    def _take(self, name: str, stamp_ns: int, image: Image, frame: str) -> None:
        """Use an image. Raises MessageError before all cameras are described, and CameraError."""
        if self.surround is None:
            self._descriptions.place(name, frame, self._base)
            if missing := self._descriptions.missing:
                raise MessageError(missing)
            self.surround = self._make(self._descriptions.cameras())
            self._descriptions.stop()
        for panorama_ns, panorama in self.surround.add(name, stamp_ns, image):
            self._use(panorama_ns, panorama)

    def remake(self) -> None:
        """Begin anew with the same cameras after a change of parameters. Raises CameraError."""
        if self.surround is not None:
            self.surround = self._make(self.surround.cameras)

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
            hints = [search.hint for search in self._searches if search.hint]
            return ERROR, '; '.join(hints) or f'no image on {names}'
        if self.surround is None:
            return ERROR if listening_s > patience_s else WARN, self._descriptions.missing
        troubles = self.surround.troubles
        for name in self.topics:
            details[f'camera {name}'] = troubles[name].reason if name in troubles else 'used'
        visible = self.surround.visible
        if visible is not None:
            details['panorama visible [%]'] = f'{100 * visible.mean():.0f}'
        texts = [f'camera {name}: {reason}' for name, (reason, _) in troubles.items()]
        texts += self.surround.knocked
        return (WARN, '; '.join(texts)) if texts else (OK, '')


def _names(config: SurroundConfig, trained: Sequence[MountedCamera]) -> tuple[str, ...]:
    """The names of the cameras. Raises ConfigError for others than those of a model."""
    names = config.cameras or tuple(camera.name for camera in trained)
    require_rig(names)
    if trained and {*names} != {camera.name for camera in trained}:
        listed = ', '.join(camera.name for camera in trained)
        raise ConfigError(f'cameras: the model was trained on {listed}; name these, or none')
    return names


def _image_topic(node: LocalizationNode, name: str, transport: str) -> str:
    """The topic of a camera's images. Raises ConfigError for one that the node publishes."""
    base = f'{name}/image_raw'
    topic = base if transport == 'raw' else node.following(f'{base}/{transport}')
    node.require_input(topic)
    return topic


def _poses(numbers: Sequence[float]) -> list[Array]:
    """The poses (4, 4) of `camera_poses`."""
    return [optical_pose(row[:3], row[3:]) for row in np.reshape(numbers, (-1, 6)).tolist()]


def _read(path: str) -> LensCalibration:
    return read_calibration(Path(path))
