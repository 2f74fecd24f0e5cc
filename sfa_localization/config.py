# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of the project: typed, described, ranged, and with its only default.

ROS nodes declare their parameters from these classes, the trainer reads the same names from
the same YAML file, and ``config/localization.yaml`` is written from them.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from sfa_localization.errors import ConfigError

S = TypeVar('S', bound='Settings')


def setting(
    default: Any,
    doc: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Declare one parameter: `doc` describes it, [low, high] or `choices` bound it.

    `live` parameters may change while a node runs; the others are read-only after start.
    """
    bounds = {'low': low, 'high': high, 'choices': choices}
    return dataclasses.field(
        default=default, metadata={'doc': doc, 'unit': unit, 'live': live, **bounds}
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """Base of the parameter groups: immutable and checked when made."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = _checked(type(self).__name__, item, getattr(self, item.name))
            object.__setattr__(self, item.name, value)

    @classmethod
    def from_mapping(cls: type[S], mapping: Mapping[str, Any], where: str) -> S:
        """Build from plain names and values; `where` names their origin in errors.

        Raises ConfigError for an unknown name, a wrong type or a value out of range.
        """
        known = {item.name for item in dataclasses.fields(cls)}
        for name in mapping:
            if name not in known:
                raise ConfigError(f'{where}: unknown parameter {name!r}{_did_you_mean(name, known)}')
        try:
            return cls(**mapping)
        except ConfigError as error:
            raise ConfigError(f'{where}: {error}') from None


def _did_you_mean(name: str, known: set[str]) -> str:
    close = difflib.get_close_matches(name, sorted(known), n=1)
    if close:
        return f'; did you mean {close[0]!r}?'
    return f'; known are {", ".join(sorted(known))}'


def _checked(group: str, item: dataclasses.Field[Any], value: Any) -> Any:
    """Return the value in the default's type, or raise ConfigError."""
    where = f'{group}.{item.name}'
    value = _converted(where, item.default, value)
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        _check_bounds(where, item.metadata, number)
    return value


def _converted(where: str, default: Any, value: Any) -> Any:
    """Accept an int where a float is expected, a list where a tuple is, and nothing else."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        kind = default[0] if default else 0.0
        return tuple(_converted(where, kind, entry) for entry in value)
    if isinstance(default, bool) or isinstance(value, bool):
        matches = isinstance(default, bool) and isinstance(value, bool)
    elif isinstance(default, float) and isinstance(value, (int, float)):
        return float(value)
    else:
        matches = isinstance(value, type(default))
    if not matches:
        raise ConfigError(f'{where}: {value!r} is not of type {type(default).__name__}')
    return value


def _check_bounds(where: str, metadata: Mapping[str, Any], value: Any) -> None:
    if metadata['choices'] and value not in metadata['choices']:
        raise ConfigError(f'{where}: {value!r} is not one of {", ".join(metadata["choices"])}')
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return
    if not math.isfinite(value):
        raise ConfigError(f'{where}: {value!r} is not a finite number')
    low, high = metadata['low'], metadata['high']
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{where}: {value!r} is outside [{low}, {high}] {metadata["unit"]}')


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
class TopicNames(Settings):
    """Topics of a bag; an empty name is found by its type. Of /tf, name '/tf:CHILD_FRAME'."""

    image: str = setting('', 'pictures: Image or CompressedImage')
    odometry: str = setting('', 'wheel odometry: Odometry, or any pose when named')
    imu: str = setting('', 'yaw rate: Imu')
    ground_truth: str = setting('', 'true poses, read for evaluation only')


@dataclass(frozen=True, slots=True)
class BagConfig(Settings):
    """How the messages of a bag become a run."""

    stamp_source: str = setting(
        'header', 'time of a message: its header or its reception', choices=('header', 'receive')
    )
    odometry_tolerance: float = setting(
        0.5, 'pictures farther from an odometry message are skipped', unit='s', low=0.0, high=60.0
    )
    clock_jump: float = setting(
        10.0, 'a stamp off by more, against reception, is a jump', unit='s', low=0.1, high=1e6
    )
    odometry_jump: float = setting(
        2.0, 'odometry that moves this far beyond its twist was reset', unit='m', low=0.1, high=1e3
    )


@dataclass(frozen=True, slots=True)
class SegmentConfig(Settings):
    """How a drive is cut into pieces, and how far its odometry is trusted inside and between."""

    segments: str = setting(
        'any',
        'pieces of any drive, or only straight lines between turns on the spot',
        choices=('any', 'straight'),
    )
    piece_length: float = setting(3.0, 'longest piece of any drive', unit='m', low=0.2, high=100.0)
    piece_std: float = setting(
        0.1, 'largest odometry error inside a piece', unit='m', low=0.001, high=10.0
    )
    line_length_min: float = setting(
        2.0, 'shortest straight line', unit='m', low=0.1, high=100.0
    )
    line_bend_max: float = setting(
        8.0, 'heading change at which a straight line ends', unit='deg', low=0.1, high=90.0
    )
    segment_images_min: int = setting(5, 'fewest pictures of a segment', low=3, high=1000)
    image_step_max: float = setting(
        1.5, 'longest stretch without a picture inside a segment', unit='m', low=0.01, high=1e2
    )
    image_step_min: float = setting(
        0.02, 'pictures closer to the last one, and turned less, are left out', unit='m', low=0.0,
        high=10.0,
    )
    image_turn_min: float = setting(
        3.0, 'turn on the spot after which a picture counts again', unit='deg', low=0.0, high=180.0
    )
    speed_min: float = setting(
        0.05, 'below this speed the robot stands still', unit='m/s', low=0.0, high=10.0
    )
    turn_rate_min: float = setting(
        0.2, 'above this yaw rate the robot turns', unit='rad/s', low=0.01, high=10.0
    )
    odometry_gap_max: float = setting(
        0.5, 'longer pauses of the odometry break the drive', unit='s', low=0.01, high=60.0
    )
    odometry_jump_max: float = setting(
        0.3, 'a pose this far from where the twist leads is an odometry reset', unit='m', low=0.01,
        high=100.0,
    )
    yaw_source: str = setting(
        'auto',
        'where turns come from; auto: the gyroscope where there is one',
        choices=('auto', 'odometry', 'gyro'),
    )
    distance_noise: float = setting(
        0.02, 'random error of driven distance', unit='m/sqrt(m)', low=0.0, high=1.0
    )
    yaw_noise: float = setting(
        0.003, 'random error of yaw, where the messages tell none', unit='rad/sqrt(s)', low=0.0,
        high=1.0,
    )
    yaw_slip: float = setting(0.01, 'error of a turn per turn', unit='rad/rad', low=0.0, high=1.0)
    turn_slide: float = setting(
        0.05, 'sideways slide of the wheels per turn', unit='m/rad', low=0.0, high=10.0
    )


@dataclass(frozen=True, slots=True)
class NodeConfig(Settings):
    """What every node has in common."""

    autostart: bool = setting(True, 'configure and activate without a lifecycle manager')
    diagnostics_period: float = setting(
        1.0, 'time between messages on /diagnostics', unit='s', low=0.1, high=60.0
    )
