# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the pose filter; numbers that no user turns are constants where they are used."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.settings import Settings, require_pose, setting


@dataclass(frozen=True, slots=True)
class FilterConfig(Settings):
    """The filter that fuses wheel odometry with positions, or poses, from images."""

    # fmt: off
    initial_pose: tuple[float, ...] = setting(
        (), 'start in the map: x (m), y (m), yaw (rad); empty: wait for images that show where',
        low=-1e6, high=1e6)
    initial_position_std: float = setting(
        0.1, 'standard deviation of the start along x and y', unit='m', low=1e-4, high=1e3)
    initial_yaw_std: float = setting(
        0.1, 'standard deviation of the heading at the start', unit='rad', low=1e-4, high=3.2)
    speed_std: float = setting(
        0.05, 'standard deviation of a speed whose message has no covariance', unit='m/s',
        low=1e-4, high=10.0, live=True)
    rate_std: float = setting(
        0.02, 'standard deviation of a turn rate whose message has no covariance', unit='rad/s',
        low=1e-4, high=10.0, live=True)
    odometry_scale: float = setting(
        1.0, 'factor on the way of odometry, beside that of a model with measured points',
        low=0.5, high=2.0)
    odometry_factor: float = setting(
        1.0, 'factor on the variances in odometry messages', low=1e-3, high=1e4, live=True)
    slip_per_meter: float = setting(
        0.03, 'position error by wheel slip', unit='m per sqrt(m)', low=0.0, high=10.0, live=True)
    yaw_per_radian: float = setting(
        0.04, 'heading error that grows with turning', unit='rad per sqrt(rad)',
        low=0.0, high=10.0, live=True)
    measurement_factor: float = setting(
        1.0, 'factor on the variances of the poses from images', low=1e-3, high=1e4, live=True)
    degraded_std: float = setting(
        0.5, 'standard deviation of the position above which the state is DEGRADED', unit='m',
        low=1e-3, high=1e6, live=True)
    lost_std: float = setting(
        2.0, 'standard deviation of the position above which the state is LOST', unit='m',
        low=1e-3, high=100.0, live=True)
    lost_yaw_std: float = setting(
        0.8, 'standard deviation of the heading above which the state is LOST', unit='rad',
        low=0.01, high=10.0, live=True)
    # fmt: on

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        require_pose('initial_pose', self.initial_pose)
        if self.degraded_std > self.lost_std:
            raise ConfigError('degraded_std must not exceed lost_std')
