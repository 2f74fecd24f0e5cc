# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras around a simulated robot: pinholes, or fisheyes where their view is wide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfa_localization.camera.lenses import turned_camera
from sfa_localization.camera.sectors import MountedCamera, optical_pose
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.camera.yaws import turned
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.sphere import directions
from sfa_localization.simulation.garden import CAMERA_HEIGHT_M
from sfa_localization.simulation.rendering import View, pixel_view
from sfa_localization.simulation.settings import SimulationConfig

WIDEST_PINHOLE_DEG = 120.0
"""A wider view is that of a fisheye: in a pinhole's image its edges are four times as large."""
NAMES = {2: ('front', 'rear'), 4: ('front', 'left', 'rear', 'right')}


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """A camera on the robot. Its images are `exposure` times as bright as others, and are taken
    `skew_ns` later than planned; it looks `yaw_deg` further left than it is `mounted` on paper.
    """

    mounted: MountedCamera
    exposure: float
    skew_ns: int
    yaw_deg: float

    @property
    def view(self) -> View:
        """The kind of its images."""
        lens = self.mounted.lens
        size = lens.image_height, lens.image_width
        true = turned(self.mounted, np.radians(self.yaw_deg))
        model = turned_camera(lens, size, np.array(true.rotation))
        plain = pixel_view(model.unproject, size, 1.0 / lens.fx)
        exposure = np.float32(self.exposure)
        return View(plain.dome, lambda dome, gain: plain.image(dome, gain * exposure))

    @property
    def place(self) -> complex:
        """Where it sits, ahead + i left, m."""
        return complex(*self.mounted.place[:2])

    @property
    def frame(self) -> str:
        """The name of its optical frame (REP 103)."""
        return f'{self.mounted.name}_optical_frame'


def simulated_cameras(config: SimulationConfig) -> list[SimulatedCamera]:
    """The cameras of a robot, evenly around it, the first looking ahead. Raises ConfigError."""
    count = config.cameras
    if count and config.images == 'panorama':
        raise ConfigError('images: panorama is that of one camera; leave it or cameras out')
    names = NAMES.get(count, tuple(f'camera{number}' for number in range(count)))
    exposures = _each(config.camera_exposures, 1.0, count, 'camera_exposures')
    skews_ms = _each(config.camera_skew, 0.0, count, 'camera_skew')
    yaws_deg = _each(config.camera_yaws, 0.0, count, 'camera_yaws')
    lens = lens_of(config)
    cameras = []
    for number, name in enumerate(names):
        yaw_deg = 360.0 * number / count
        x, y, _ = config.camera_radius * directions(np.radians(yaw_deg), 0.0)
        pose = optical_pose((x, y, CAMERA_HEIGHT_M), (0.0, 0.0, yaw_deg))
        mounted = MountedCamera.at(name, lens, pose)
        skew_ns = round(1e6 * skews_ms[number])
        cameras.append(SimulatedCamera(mounted, exposures[number], skew_ns, yaws_deg[number]))
    return cameras


def lens_of(config: SimulationConfig) -> LensCalibration:
    """A lens that sees `camera_fov` degrees across the columns of its image. Raises ConfigError."""
    if len(config.camera_size) != 2:
        raise ConfigError('camera_size: give columns x rows, as in 400x240')
    width, height = map(int, config.camera_size)
    half = np.radians(config.camera_fov / 2)
    is_fisheye = config.camera_fov > WIDEST_PINHOLE_DEG
    focal = width / 2 / float(half if is_fisheye else np.tan(half))
    return LensCalibration(
        camera_model='fisheye' if is_fisheye else 'mirror',
        image_width=width,
        image_height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        xi=0.0,
        radius_min=0.0,
        radius_max=width / 2 if is_fisheye else 0.0,
        axis='forward',
        mirrored='no',
    )


def _each(values: tuple[float, ...], usual: float, count: int, name: str) -> tuple[float, ...]:
    """A number for each camera. Raises ConfigError unless there are as many, or none."""
    if len(values) not in (0, count):
        raise ConfigError(
            f'{name}: {len(values)} numbers for {count} cameras; give as many, or none'
        )
    return values or (usual,) * count
