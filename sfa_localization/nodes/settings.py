# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings that only the nodes have."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.image_topics import TRANSPORTS
from sfa_localization.data.settings import Settings, setting
from sfa_localization.data.transforms import BASE

_TRANSPORTS = tuple(TRANSPORTS)


@dataclass(frozen=True, slots=True)
class NodeConfig(Settings):
    """What every node has in common."""

    autostart: bool = setting(True, 'configure and activate without a lifecycle manager')


@dataclass(frozen=True, slots=True)
class OmnicamNodeConfig(Settings):
    """omnicam_node: camera images in, panoramas out."""

    model: str = setting(
        '', 'file of the trained model: its lens and panorama are used; empty: the parameters'
    )
    image_transport: str = setting('raw', 'which topic to take images from', choices=_TRANSPORTS)
    frame_id: str = setting('', "frame of the panoramas; empty: the image's own, or omnicam")


@dataclass(frozen=True, slots=True)
class TeachNodeConfig(Settings):
    """teach_node: a drive in, a model out."""

    output: str = setting(
        '', 'model to write, GARDEN.npz; drives are recorded into GARDEN_drive1 and so on beside it'
    )
    localize: bool = setting(
        False, 'configure and activate omnicam_node, sfa_node and ekf_node when a model is written'
    )
    odom_frame: str = setting('odom', 'frame of teach/map and teach/hints')
    share: float = setting(
        0.2, 'share of a core for looking at the drive while it is driven', low=0.01, high=1.0,
        live=True,
    )  # fmt: skip
    silence_timeout: float = setting(
        2.0, 'time without messages of an input that is named', unit='s', low=0.1, high=3600.0,
        live=True,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class SfaNodeConfig(Settings):
    """sfa_node: panorama in, slow features and pose out."""

    model: str = setting('', 'file of the trained model', live=True)
    map_frame: str = setting('map', 'frame of the poses')
    base_frame: str = setting(
        BASE, "the robot's frame, from which /tf_static is compared with the camera's place"
    )
    image_transport: str = setting(
        'raw', 'listen to panorama, or to panorama/compressed and so on', choices=_TRANSPORTS
    )
    silence_timeout: float = setting(
        2.0, 'time without panoramas that is an error', unit='s', low=0.1, high=3600.0, live=True
    )


@dataclass(frozen=True, slots=True)
class EkfNodeConfig(Settings):
    """ekf_node: odometry and poses in, the robot's pose in the map out."""

    map_frame: str = setting('map', 'frame of the estimate')
    odom_frame: str = setting('odom', "the odometry's frame, where its messages have none")
    base_frame: str = setting(BASE, "the robot's frame, where odometry messages have none")
    publish_tf: bool = setting(True, 'broadcast map -> odom (needs tf2_msgs)')
    transform_tolerance: float = setting(
        0.1, 'how long map -> odom holds beyond odometry', unit='s', low=0.0, high=10.0, live=True
    )
    pose_file: str = setting(
        '',
        'file of the last sure pose: written while LOCALISED, and where to look first after a '
        'restart; empty: none',
    )
    silence_timeout: float = setting(
        1.0,
        'time without odometry, or three times this without images, after which the state is '
        'DEGRADED',
        unit='s',
        low=0.1,
        high=1200.0,
        live=True,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        frames = self.map_frame, self.odom_frame, self.base_frame
        if len(set(frames)) < len(frames):
            raise ConfigError('map_frame, odom_frame and base_frame must be three different frames')
