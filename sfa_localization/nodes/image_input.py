# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An input of images: each alone in its message, or packets of a video."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from sfa_localization.camera.video import ImageReader
from sfa_localization.data.errors import CameraError, ConfigError, LocalizationError
from sfa_localization.data.image_topics import TRANSPORTS, info_topic
from sfa_localization.data.messages import read_stamp
from sfa_localization.data.run import Image
from sfa_localization.nodes.lifecycle import LocalizationNode, sensor_qos

_PACKETS = 30
"""Packets of a video that wait, a second of most: a lost one costs all images until a key frame. Of
other images only the newest waits, as they may come faster than they are used."""


def calibration_topic(node: LocalizationNode, info: str, images: str) -> str:
    """The topic of the calibration of images: the one beside them, unless `info` is remapped."""
    return info if node.is_remapped(info) else info_topic(node.full_name(images))


class ImageInput:
    """Calls `use` with stamp, ns, image (H, W, 3) uint8 BGR and frame of each image on `topic`.

    Raises ConfigError where the messages of the transport are not installed.
    """

    def __init__(
        self,
        node: LocalizationNode,
        transport: str,
        topic: str,
        use: Callable[[int, Image, str], None],
    ) -> None:
        self._node = node
        self._topic = topic
        self._use = use
        self._transport = transport
        self._kind = _message_class(transport)
        self.types = sorted(TRANSPORTS.values(), key=lambda kind: kind != TRANSPORTS[transport])
        """Types of image messages, this input's first."""
        self._holds_video = False
        self._subscription: Any = None
        self._substitute = '', ''

    def start(self, substitute: str = '', kind: str = '') -> None:
        """Subscribe to the topic, or to a substitute for it, of another kind of message. Raises
        ConfigError where such messages are not installed.
        """
        transports = {each: name for name, each in TRANSPORTS.items()}
        transport = transports.get(kind, self._transport)
        if self._substitute != (substitute, kind):
            self._kind = _message_class(transport)
            self._holds_video = False
        self._reader = ImageReader(self._kind.__name__)
        self._substitute = substitute, kind
        self._holds_video |= transport in ('ffmpeg', 'foxglove')
        depth, entity = (_PACKETS, 'video') if self._holds_video else (1, None)
        self._subscription = self._node.subscribe(
            self._kind, self._topic, self._receive, sensor_qos(depth), substitute, entity
        )

    def stop(self) -> None:
        """End the subscription, if any."""
        self._node.unsubscribe(self._subscription)
        self._subscription = None

    def _receive(self, message: Any) -> None:
        is_foxglove = self._kind.__name__ == 'CompressedVideo'
        source = message if is_foxglove else message.header
        stamp_ns = read_stamp(source.timestamp if is_foxglove else source.stamp)
        images = self._reader.add(stamp_ns, message)
        if self._reader.is_video and not self._holds_video:
            self._holds_video = True
            self.stop()
            self.start(*self._substitute)
        problem: LocalizationError | None = None
        for image_ns, image in images:
            try:
                if isinstance(image, CameraError):
                    raise image
                self._use(image_ns, image, source.frame_id)
            except LocalizationError as error:
                problem = error
        if problem is not None:
            raise problem


def _message_class(transport: str) -> Any:
    package, _, name = TRANSPORTS[transport].split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except ImportError:
        apt = f'ros-$ROS_DISTRO-{package.replace("_", "-")}'
        raise ConfigError(
            f'image_transport {transport} needs {package}: sudo apt install {apt}'
        ) from None
