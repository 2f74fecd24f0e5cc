# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of odometry and its segments."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class SegmentConfig(Settings):
    """How a drive is cut into segments, and where its turns come from."""

    segments: str = setting(
        'any',
        'short pieces of any drive, or only straight lines between turns on the spot',
        choices=('any', 'straight'),
    )
    yaw_source: str = setting(
        'auto',
        'where turns come from; auto: the gyroscope where there is one',
        choices=('auto', 'odometry', 'gyro'),
    )
    yaw_noise: float = setting(
        0.003,
        'random error of yaw where the messages state no variance',
        unit='rad/sqrt(s)',
        low=0.0,
        high=1.0,
    )
