# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras around a simulated robot: pinholes, or fisheyes where their view is wide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfa_localization.camera.lenses import CameraModel, make_camera
from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.geometry import Array
from sfa_localization.simulation.garden import CAMERA_HEIGHT_M
from sfa_localization.simulation.rendering import View, pixel_view
from sfa_localization.simulation.settings import SimulationConfig

WIDEST_PINHOLE_DEG = 120.0
"""A wider view is that of a fisheye: in a pinhole's image its edges are four times as large."""
NAMES = {2: ('front', 'rear'), 4: ('front', 'left', 'rear', 'right')}


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera on the robot: its lens, its place ahead + i left, m, and the direction in which it
    looks. Its images are `exposure` times as bright, and are taken `skew_ns` later than planned.
    """

    name: str
    lens: LensCalibration
    place: complex
    yaw_rad: float
    exposure: float
    skew_ns: int

    @property
    def _model(self) -> CameraModel:
        """The lens in the robot's axes."""
        size = self.lens.image_height, self.lens.image_width
        return make_camera(self.lens, size, mount_rpy=(0.0, 0.0, float(np.degrees(self.yaw_rad))))

    @property
    def view(self) -> View:
        """The kind of its images."""
        model = self._model
        plain = pixel_view(model.unproject, model.size, 1.0 / self.lens.fx)
        exposure = np.float32(self.exposure)
        return View(plain.dome, lambda dome, gain: plain.image(dome, gain * exposure))

    @property
    def frame(self) -> str:
        """The name of its optical frame (REP 103)."""
        return f'{self.name}_optical_frame'

    @property
    def pose(self) -> Array:
        """The transform (4, 4) from its optical frame to base_link."""
        transform = np.eye(4)
        transform[:3, :3] = self._model.rotation
        transform[:3, 3] = self.place.real, self.place.imag, CAMERA_HEIGHT_M
        return transform


def cameras_of(config: SimulationConfig) -> list[MountedCamera]:
    """The cameras of a robot, evenly around it, the first looking ahead. Raises ConfigError."""
    count = config.cameras
    if count and config.images == 'panorama':
        raise ConfigError('images: panorama is that of one camera; leave it or cameras out')
    names = NAMES.get(count, tuple(f'camera{number}' for number in range(count)))
    exposures = _each(config.camera_exposures, 1.0, count, 'camera_exposures')
    skews_ms = _each(config.camera_skew, 0.0, count, 'camera_skew')
    lens = lens_of(config)
    cameras = []
    for number, name in enumerate(names):
        yaw = 2 * np.pi * number / count
        place = config.camera_radius * np.exp(1j * yaw)
        skew_ns = round(1e6 * skews_ms[number])
        cameras.append(MountedCamera(name, lens, place, yaw, exposures[number], skew_ns))
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
