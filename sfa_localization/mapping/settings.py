# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of metric learning, and of the map of the driven ground."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.settings import Settings, require_pose, setting


@dataclass(frozen=True, slots=True)
class MetricConfig(Settings):
    """How meters are learned from slow features and segments of odometry."""

    solver: str = setting(
        'certified',
        'certified: global optimum with proof; paper: momentum descent on equations 1-8',
        choices=('certified', 'paper'),
    )
    metric_map: str = setting(
        'gp', 'Gaussian process, or monomials up to degree 2', choices=('gp', 'monomials')
    )
    slow_features: int = setting(
        0, 'slowest features used; 0: all, of monomials 8 as in the paper', low=0, high=1000
    )
    start_pose: tuple[float, ...] = setting(
        (),
        'pose in the map at the start of the first run: x (m), y (m), yaw (rad); empty: as in the '
        'odometry frame',
    )
    camera_xy: tuple[float, ...] = setting(
        (),
        'where the camera sits on the robot, ahead (m) and left (m) of base_link; empty: learned '
        'from places that are seen in several headings',
    )
    points: str = setting(
        '', 'file of measured points of the drives, which give the map its place, heading and scale'
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        require_pose('start_pose', self.start_pose)
        if len(self.camera_xy) not in (0, 2):
            raise ConfigError(f'camera_xy: {self.camera_xy} is not empty, and not ahead, left')


@dataclass(frozen=True, slots=True)
class GroundConfig(Settings):
    """The driven ground as a map of cells; by default lanes that are 1 m apart join."""

    width: float = setting(
        1.0, 'width of the robot with its margin', unit='m', low=0.05, high=100.0
    )
    cell: float = setting(0.05, 'size of a cell', unit='m', low=0.01, high=10.0)
