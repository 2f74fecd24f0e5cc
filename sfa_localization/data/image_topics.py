# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Names of topics with images, as image_transport forms them."""

from __future__ import annotations

TRANSPORTS = {
    'raw': 'sensor_msgs/msg/Image',
    'compressed': 'sensor_msgs/msg/CompressedImage',
    'ffmpeg': 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket',
    'foxglove': 'foxglove_msgs/msg/CompressedVideo',
}
"""Types of messages by the names that image_transport gives to them."""
CAMERA_INFO = 'camera_info'
_BELOW = tuple(f'/{name}' for name in TRANSPORTS if name != 'raw')


def without_transport(topic: str) -> str:
    """The name of an image topic without that of its transport."""
    return next((topic.removesuffix(below) for below in _BELOW if topic.endswith(below)), topic)


def info_topic(topic: str) -> str:
    """The topic of the calibration beside images."""
    return f'{without_transport(topic).rpartition("/")[0]}/{CAMERA_INFO}'
