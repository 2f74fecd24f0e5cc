# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the camera: source, lens, mounting, panorama, and which images are used."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.settings import Settings, setting
from sfa_localization.data.sphere import Sphere

NEEDS_CALIBRATION = ('mirror', 'fisheye', 'ocam', 'polar', 'dual_fisheye')
"""Camera models with parameters of their own, which a calibration finds."""
UNCALIBRATED = ('equirectangular', 'panorama')
"""Camera models that follow from the size of the image alone."""


@dataclass(frozen=True, slots=True)
class PanoramaConfig(Settings):
    """Size and geometry of the panorama, the input of the network.

    The center column looks along the robot's +x axis; columns grow clockwise seen from above.
    """

    width: int = setting(600, 'columns of the panorama', unit='px', low=16, high=8192)
    height: int = setting(60, 'rows of the panorama', unit='px', low=4, high=4096)
    elevation_min: float = setting(
        -12.0, 'elevation of the lower edge', unit='deg', low=-90.0, high=89.0, live=True
    )
    elevation_max: float = setting(
        24.0, 'elevation of the upper edge', unit='deg', low=-89.0, high=90.0, live=True
    )
    clockwise: bool = setting(True, 'columns grow clockwise seen from above')

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.elevation_min >= self.elevation_max:
            raise ConfigError('elevation_min of the panorama must be below elevation_max')

    @property
    def sphere(self) -> Sphere:
        """The directions of its pixels."""
        low = math.radians(self.elevation_min)
        high = math.radians(self.elevation_max)
        return Sphere(low, high, self.clockwise)

    def asked_differences(self, asked: PanoramaConfig) -> str:
        """What differs in what is `asked` otherwise than by default."""
        names = [item.name for item in dataclasses.fields(self)]
        given = {n: v for n in names if (v := getattr(asked, n)) != getattr(PanoramaConfig(), n)}
        return self.differences(dataclasses.replace(self, **given))

    def differences(self, other: PanoramaConfig) -> str:
        """What differs in `other`, as 'height 30 instead of 60'; '' when they are equal."""
        names = [item.name for item in dataclasses.fields(self)]
        pairs = [(name, getattr(other, name), getattr(self, name)) for name in names]
        return ', '.join(f'{name} {a} instead of {b}' for name, a, b in pairs if a != b)


@dataclass(frozen=True, slots=True)
class CaptureConfig(Settings):
    """Where the omnicam node takes its images from."""

    source: str = setting(
        'topic',
        'topic (image_raw, or image_raw/compressed), device (V4L2), video (a file) or folder (of '
        'images, in the order of their names)',
        choices=('topic', 'device', 'video', 'folder'),
    )
    source_path: str = setting('', 'device (a path or a number), video file or folder')
    source_rate: float = setting(
        0.0,
        'images per second of a video or folder, or requested from a device; 0: its own, or 10',
        unit='Hz',
        low=0.0,
        high=1000.0,
    )
    source_size: tuple[float, ...] = setting(
        (),
        'columns and rows requested from a device; empty: its own',
        unit='px',
        low=1.0,
        high=32767.0,
    )
    silence_timeout: float = setting(
        2.0,
        'time without an image after which the camera counts as silent; a device is then reopened',
        unit='s',
        low=0.05,
        high=3600.0,
        live=True,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if len(self.source_size) not in (0, 2):
            raise ConfigError('source_size: give columns and rows, or nothing')


@dataclass(frozen=True, slots=True)
class CameraConfig(Settings):
    """The omnidirectional camera on the robot, and what hides its view."""

    camera_model: str = setting(
        '',
        'camera without a calibration_file: mirror (that of the simulator), equirectangular, or '
        'panorama (the image is a panorama already); empty: the lens that training has learned, '
        'or that camera_info describes; images 3.5 times as wide as high are panoramas',
        choices=('', 'mirror', *UNCALIBRATED),
    )
    calibration_file: str = setting(
        '',
        'calibration of the camera, which replaces camera_model: the file that the command '
        'calibrate writes, OCamCalib calib_results.txt, or that of camera_info, OpenCV, Kalibr, '
        'camodocal, stella_vslam or ORB-SLAM3; empty: none',
    )
    mount_rpy: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        'roll, pitch and yaw of the camera on the robot',
        unit='deg',
        low=-360.0,
        high=360.0,
        live=True,
    )
    level_by_imu: bool = setting(
        False,
        'level panoramas by the orientation in Imu messages (imu/data), of the axes of the robot',
    )
    mask_file: str = setting(
        '', 'mask of the camera image, black where it shows the robot; empty: none', live=True
    )
    blind_sectors: tuple[float, ...] = setting(
        (),
        'azimuths hidden by the robot: start and end of each sector, counterclockwise from the '
        "robot's forward axis; empty: none",
        unit='deg',
        low=-360.0,
        high=720.0,
        live=True,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        require_angles('mount_rpy', self.mount_rpy)

    @property
    def is_described(self) -> bool:
        """Whether it names a lens."""
        return bool(self.calibration_file or self.camera_model)

    @property
    def name(self) -> str:
        """The described lens in words."""
        return self.calibration_file.rpartition('/')[2] or f'camera_model {self.camera_model}'


@dataclass(frozen=True, slots=True)
class SurroundConfig(Settings):
    """Several cameras around the robot, whose images make one panorama."""

    cameras: tuple[str, ...] = setting(
        (),
        'names of 2 to 8 cameras: images on NAME/image_raw, lenses by NAME/camera_info, places by '
        '/tf_static; empty: those of the model, or one camera',
        texts=True,
    )
    camera_files: tuple[str, ...] = setting(
        (), 'calibration file of each of the cameras; empty: NAME/camera_info', texts=True
    )
    camera_poses: tuple[float, ...] = setting(
        (),
        'place ahead, left and up (m), roll, pitch and yaw (deg) of each of the cameras on the '
        'robot, six numbers a camera; with angles of 0 it looks ahead; empty: /tf_static',
        low=-360.0,
        high=360.0,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        count = len(self.cameras)
        if len(self.camera_files) not in (0, count):
            raise ConfigError(f'camera_files: {len(self.camera_files)} for {count} cameras')
        if len(self.camera_poses) not in (0, 6 * count):
            numbers = len(self.camera_poses)
            raise ConfigError(f'camera_poses: {numbers} numbers; give six for each camera')


def require_angles(name: str, angles: tuple[float, ...]) -> None:
    """Raise ConfigError unless there are three angles."""
    if len(angles) != 3:
        raise ConfigError(f'{name}: give three angles: roll, pitch and yaw')


@dataclass(frozen=True, slots=True)
class WatchConfig(Settings):
    """Which images the localization uses, live and offline."""

    least_explained: float = setting(
        0.25,
        'images are rejected if their place explains a smaller share of them (foreign images: 0.1, '
        'at most 0.28)',
        low=0.0,
        high=1.0,
        live=True,
    )


@dataclass(frozen=True, slots=True)
class LensCalibration(Settings):
    """The lens of a camera as its calibration file describes it; no parameter of a node.

    The default is the simulator's hyperbolic mirror seen from below, 640 x 640.
    """

    camera_model: str = setting(
        'mirror',
        'mirror (unified model of Mei: central mirrors, and pinhole cameras with xi = 0), fisheye '
        '(equidistant or Kannala-Brandt, as in OpenCV), ocam (polynomial of Scaramuzza), polar '
        '(uncalibrated: angle linear in radius), dual_fisheye, equirectangular, or panorama',
        choices=NEEDS_CALIBRATION + UNCALIBRATED,
    )
    image_width: int = setting(
        640, 'columns of the calibration images; 0: any', unit='px', low=0, high=32767
    )
    image_height: int = setting(
        640, 'rows of the calibration images; 0: any', unit='px', low=0, high=32767
    )
    fx: float = setting(150.0, 'focal length along columns', unit='px', low=0.01, high=1e5)
    fy: float = setting(150.0, 'focal length along rows', unit='px', low=0.01, high=1e5)
    cx: float = setting(319.5, 'column of the center', unit='px', low=-1e5, high=1e5)
    cy: float = setting(319.5, 'row of the center', unit='px', low=-1e5, high=1e5)
    xi: float = setting(0.9, 'mirror parameter of the mirror model', low=0.0, high=10.0)
    distortion: tuple[float, ...] = setting(
        (),
        'lens distortion: k1 k2 p1 p2 (mirror), k1 k2 k3 k4 (fisheye), or none',
        low=-1e3,
        high=1e3,
    )
    polynomial: tuple[float, ...] = setting(
        (), 'coefficients a0 a1 ... of the ocam model, as in calib_results.txt', low=-1e6, high=1e6
    )
    affine: tuple[float, ...] = setting(
        (1.0, 0.0, 0.0), 'affine parameters c d e of the ocam model', low=-100.0, high=100.0
    )
    radius_min: float = setting(
        40.0, 'radius about the center below which nothing is visible', unit='px', low=0, high=1e5
    )
    radius_max: float = setting(
        318.0,
        'radius about the center beyond which nothing is visible; 0: no limit',
        unit='px',
        low=0.0,
        high=1e5,
    )
    angle_min: float = setting(
        78.0, 'polar model: angle from the axis at radius_min', unit='deg', low=0.0, high=180.0
    )
    angle_max: float = setting(
        114.0, 'polar model: angle from the axis at radius_max', unit='deg', low=0.0, high=180.0
    )
    second_cx: float = setting(
        0.0, 'dual_fisheye: column of the second center', unit='px', low=-1e5, high=1e5
    )
    second_cy: float = setting(
        0.0, 'dual_fisheye: row of the second center', unit='px', low=-1e5, high=1e5
    )
    second_focal: float = setting(
        0.0, 'dual_fisheye: focal length of the second; 0: fx', unit='px', low=0.0, high=1e5
    )
    second_distortion: tuple[float, ...] = setting(
        (), 'dual_fisheye: distortion of the second; none: that of the first', low=-1e3, high=1e3
    )
    second_roll: float = setting(
        0.0, 'dual_fisheye: rotation of the second image', unit='deg', low=-180.0, high=180.0
    )
    second_tilt: tuple[float, ...] = setting(
        (0.0, 0.0),
        'dual_fisheye: pitch and yaw of the second lens, against looking back from the first',
        unit='deg',
        low=-180.0,
        high=180.0,
    )
    elevation_min: float = setting(
        -90.0, 'equirectangular: elevation of the lower edge', unit='deg', low=-90.0, high=89.0
    )
    elevation_max: float = setting(
        90.0, 'equirectangular: elevation of the upper edge', unit='deg', low=-89.0, high=90.0
    )
    axis: str = setting(
        'auto',
        'where the center of the image looks before mounting angles: down (a mirror seen from '
        'below), up, or forward; with up and down the top of the image is forward; auto: down '
        'for mirror and polar, up for fisheye and ocam, forward for dual_fisheye',
        choices=('auto', 'down', 'up', 'forward'),
    )
    mirrored: str = setting(
        'auto',
        'the image shows the world reversed, as the image of one mirror does; auto: yes for '
        'mirror and polar',
        choices=('auto', 'yes', 'no'),
    )
    mount_rpy: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        'roll, pitch and yaw of the camera on the robot, unless omnicam_node sets mount_rpy',
        unit='deg',
        low=-360.0,
        high=360.0,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        require_angles('mount_rpy', self.mount_rpy)
        if len(self.second_tilt) != 2:
            raise ConfigError('second_tilt: give two angles: pitch and yaw')

    @property
    def is_mirrored(self) -> bool:
        """Whether the image shows the world reversed."""
        if self.mirrored == 'auto':
            return self.camera_model in ('mirror', 'polar')
        return self.mirrored == 'yes'
