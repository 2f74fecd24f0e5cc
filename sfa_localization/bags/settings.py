# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of reading bags."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class TopicNames(Settings):
    """Topics of a bag; an empty name is found by its type. Of /tf, name '/tf:CHILD_FRAME'."""

    image: str = setting('', 'images: Image, CompressedImage, CompressedVideo or FFMPEGPacket')
    odometry: str = setting('', 'wheel odometry: Odometry, or any pose when named')
    imu: str = setting('', 'yaw rate: Imu')
    points_topic: str = setting(
        '', 'measured places: NavSatFix, PoseWithCovarianceStamped, PoseStamped or PointStamped'
    )
    ground_truth: str = setting('', 'true poses, read for evaluation only')


@dataclass(frozen=True, slots=True)
class BagConfig(Settings):
    """How the messages of a bag become a run."""

    stamp_source: str = setting(
        'header', 'time of a message: its header or its reception', choices=('header', 'receive')
    )
