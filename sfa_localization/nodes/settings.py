# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings that only the nodes have."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class NodeConfig(Settings):
    """What every node has in common."""

    autostart: bool = setting(True, 'configure and activate without a lifecycle manager')
    diagnostics_period: float = setting(
        1.0, 'time between messages on /diagnostics', unit='s', low=0.1, high=60.0
    )


@dataclass(frozen=True, slots=True)
class OmnicamNodeConfig(Settings):
    """omnicam_node: camera images in, panoramas out."""

    image_transport: str = setting(
        'raw', 'which topic to take images from', choices=('raw', 'compressed')
    )
    frame_id: str = setting('', "frame of the panoramas; empty: the image's own, or omnicam")


@dataclass(frozen=True, slots=True)
class SfaNodeConfig(Settings):
    """sfa_node: panorama in, slow features and pose out."""

    model: str = setting('', 'file of the trained model', live=True)
    map_frame: str = setting('map', 'frame of the positions')
    feature_frame: str = setting('slow_feature_space', 'frame of the slow features')
    compressed: bool = setting(False, 'listen to panorama/compressed')
    novelty_warning: float = setting(
        1.5, 'novelty from which on a warning is given', low=1.0, high=1e6, live=True
    )
    camera_timeout: float = setting(
        2.0,
        'silence of the panoramas that is worth a warning',
        unit='s',
        low=0.1,
        high=3600.0,
        live=True,
    )


@dataclass(frozen=True, slots=True)
class EkfNodeConfig(Settings):
    """ekf_node: odometry and poses in, the robot's pose in the map out."""

    map_frame: str = setting('map', 'frame of the estimate')
    odom_frame: str = setting('odom', "the odometry's frame, where its messages tell none")
    base_frame: str = setting('base_link', "the robot's frame, where odometry tells none")
    publish_tf: bool = setting(True, 'broadcast map -> odom (needs tf2_msgs)')
    transform_tolerance: float = setting(
        0.1, 'the transform is dated so far ahead', unit='s', low=0.0, high=10.0, live=True
    )
    path_period: float = setting(
        0.5, 'time between poses of ekf/path', unit='s', low=0.01, high=3600.0
    )
    path_length: int = setting(2000, 'poses that ekf/path keeps', low=1, high=100_000)
    odometry_silence: float = setting(
        1.0,
        'silence of odometry on arrival that is worth a warning',
        unit='s',
        low=0.1,
        high=3600.0,
        live=True,
    )
    picture_silence: float = setting(
        3.0,
        'silence of pictures on arrival that is worth a warning',
        unit='s',
        low=0.1,
        high=3600.0,
        live=True,
    )
