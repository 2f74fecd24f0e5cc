# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the camera: its lens and mounting, the panorama, and which images are believed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class PanoramaConfig(Settings):
    """Size and geometry of the panorama: what the network sees.

    The centre column looks along the robot's +x axis; columns grow clockwise seen from above.
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

    def differences(self, other: PanoramaConfig) -> str:
        """What is other in `other`, as 'height 30 instead of 60'; '' when they are the same."""
        names = [item.name for item in dataclasses.fields(self)]
        found = [(name, getattr(other, name), getattr(self, name)) for name in names]
        return ', '.join(f'{name} {a} instead of {b}' for name, a, b in found if a != b)


@dataclass(frozen=True, slots=True)
class CameraConfig(Settings):
    """The omnidirectional camera: how a pixel of its picture looks into the world.

    The default is the simulator's: a hyperbolic mirror seen from below, 640 x 640. The command
    `calibrate` writes these parameters from a calibration file or from pictures.
    """

    camera_model: str = setting(
        'mirror',
        'mirror (unified model of Mei: central mirrors, and pinhole cameras with xi = 0), fisheye '
        '(equidistant or Kannala-Brandt, as in OpenCV), ocam (polynomial of Scaramuzza), polar '
        '(uncalibrated: angle linear in radius), equirectangular, dual_fisheye, or panorama '
        '(the picture is a panorama already)',
        choices=(
            'mirror',
            'fisheye',
            'ocam',
            'polar',
            'equirectangular',
            'dual_fisheye',
            'panorama',
        ),
    )
    calibration_file: str = setting(
        '',
        'calibration to read instead of the lens parameters below: camera_info, OpenCV or Kalibr '
        'YAML, or OCamCalib calib_results.txt; empty: none',
    )
    image_width: int = setting(
        640, 'columns of the pictures calibrated with; 0: any', unit='px', low=0, high=32767
    )
    image_height: int = setting(
        640, 'rows of the pictures calibrated with; 0: any', unit='px', low=0, high=32767
    )
    fx: float = setting(150.0, 'focal length along columns', unit='px', low=0.01, high=1e5)
    fy: float = setting(150.0, 'focal length along rows', unit='px', low=0.01, high=1e5)
    cx: float = setting(319.5, 'column of the center', unit='px', low=-1e5, high=1e5)
    cy: float = setting(319.5, 'row of the center', unit='px', low=-1e5, high=1e5)
    xi: float = setting(0.9, 'mirror parameter of the mirror model', low=0.0, high=10.0)
    distortion: tuple[float, ...] = setting(
        (), 'lens distortion: k1 k2 p1 p2 (mirror), k1 k2 k3 k4 (fisheye), or none'
    )
    polynomial: tuple[float, ...] = setting(
        (), 'coefficients a0 a1 ... of the ocam model, as in calib_results.txt'
    )
    affine: tuple[float, ...] = setting(
        (1.0, 0.0, 0.0), 'affine parameters c d e of the ocam model'
    )
    radius_min: float = setting(
        40.0, 'radius about the center below which nothing is seen', unit='px', low=0.0, high=1e5
    )
    radius_max: float = setting(
        318.0,
        'radius about the center beyond which nothing is seen; 0: no limit',
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
    second_roll: float = setting(
        0.0, 'dual_fisheye: turn of the second picture', unit='deg', low=-180.0, high=180.0
    )
    axis: str = setting(
        'auto',
        'where the center of the picture looks before mounting angles: down (a mirror seen from '
        'below), up, or forward; with up and down the top of the picture is forward; auto: down '
        'for mirror and polar, up for fisheye and ocam, forward for dual_fisheye',
        choices=('auto', 'down', 'up', 'forward'),
    )
    mirrored: str = setting(
        'auto',
        'the picture shows the world reversed, as a picture of one mirror does; auto: yes for '
        'mirror and polar',
        choices=('auto', 'yes', 'no'),
    )
    mount_roll: float = setting(
        0.0, 'roll of the camera on the robot', unit='deg', low=-180.0, high=180.0, live=True
    )
    mount_pitch: float = setting(
        0.0, 'pitch of the camera on the robot', unit='deg', low=-180.0, high=180.0, live=True
    )
    mount_yaw: float = setting(
        0.0, 'yaw of the camera on the robot', unit='deg', low=-360.0, high=360.0, live=True
    )
    mask_file: str = setting(
        '', 'picture of the camera picture, black where it shows the robot; empty: none', live=True
    )
    blind_sectors: tuple[float, ...] = setting(
        (),
        'azimuths hidden by the robot: start and end of each sector, counter-clockwise from the '
        "robot's forward axis",
        unit='deg',
        low=-360.0,
        high=720.0,
        live=True,
    )
    supersampling: int = setting(
        1, 'samples per panorama pixel along each axis, averaged; costs its square', low=1, high=4
    )
    normalization: str = setting(
        'off',
        'brightness: off, exposure (one gain per panorama), local (by the surrounding brightness)',
        choices=('off', 'exposure', 'local'),
        live=True,
    )


@dataclass(frozen=True, slots=True)
class CalibrationConfig(Settings):
    """What the command `calibrate` cannot see in the pictures."""

    model: str = setting(
        'polar', 'camera model made from circles alone', choices=('polar', 'fisheye')
    )
    field_of_view: float = setting(
        185.0, 'fisheye: field of view within the rim', unit='deg', low=10.0, high=360.0
    )


@dataclass(frozen=True, slots=True)
class WatchConfig(Settings):
    """Which panoramas are not believed, live and offline."""

    dark_level: float = setting(
        8.0, 'a picture of lower mean is dark', unit='grey levels', low=0.0, high=255.0, live=True
    )
    flat_level: float = setting(
        3.0,
        'a picture of lower deviation is covered',
        unit='grey levels',
        low=0.0,
        high=255.0,
        live=True,
    )
    frozen_pictures: int = setting(
        5, 'equal pictures in a row that mean a frozen camera', low=2, high=10_000, live=True
    )
    novelty_unusable: float = setting(
        3.0, 'pictures of more novelty are not used', low=1.0, high=1e6, live=True
    )


@dataclass(frozen=True, slots=True)
class OmnicamNodeConfig(Settings):
    """Where the omnicam node takes pictures from, and how it watches over the camera."""

    source: str = setting(
        'topic',
        'topic (image_raw, or image_raw/compressed), device (V4L2), video (a file) or folder (of '
        'pictures, in the order of their names)',
        choices=('topic', 'device', 'video', 'folder'),
    )
    source_path: str = setting('', 'device (a path or a number), video file or folder')
    image_transport: str = setting(
        'raw', 'which topic to take pictures from', choices=('raw', 'compressed')
    )
    frame_id: str = setting('', "frame of the panoramas; empty: the picture's own, or omnicam")
    lazy: bool = setting(True, 'do nothing while nobody listens to the panorama', live=True)
    jpeg_quality: int = setting(
        90, 'quality of panorama/compressed', unit='%', low=1, high=100, live=True
    )
    silence_timeout: float = setting(
        2.0,
        'time without a picture after which the camera counts as silent',
        unit='s',
        low=0.05,
        high=3600.0,
        live=True,
    )
    frozen_timeout: float = setting(
        5.0,
        'time of equal pictures after which the camera counts as frozen; 0: never',
        unit='s',
        low=0.0,
        high=3600.0,
        live=True,
    )
    reopen_min: float = setting(
        0.5, 'pause before the first attempt to reopen a device', unit='s', low=0.01, high=60.0
    )
    reopen_max: float = setting(
        30.0, 'longest pause between attempts; they double', unit='s', low=0.01, high=3600.0
    )
    source_rate: float = setting(
        0.0,
        'pictures per second of a video or folder, or asked of a device; 0: its own, or 10',
        unit='Hz',
        low=0.0,
        high=1000.0,
    )
    source_loop: bool = setting(False, 'start a video or folder again at its end')
    source_width: int = setting(
        0, 'columns asked of a device; 0: its own', unit='px', low=0, high=32767
    )
    source_height: int = setting(
        0, 'rows asked of a device; 0: its own', unit='px', low=0, high=32767
    )
