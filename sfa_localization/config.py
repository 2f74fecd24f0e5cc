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
from collections.abc import Collection, Mapping
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
                raise ConfigError(
                    f'{where}: unknown parameter {name!r}'
                    f'{nearest(name, known) or "; known are " + ", ".join(sorted(known))}'
                )
        try:
            return cls(**mapping)
        except ConfigError as error:
            raise ConfigError(f'{where}: {error}') from None


def nearest(name: str, known: Collection[str]) -> str:
    """The end of a message about an unknown name: which known one may be meant; '' if none."""
    close = difflib.get_close_matches(name, sorted(known), n=1)
    return f'; did you mean {close[0]!r}?' if close else ''


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
    line_length_min: float = setting(2.0, 'shortest straight line', unit='m', low=0.1, high=100.0)
    line_bend_max: float = setting(
        8.0, 'heading change at which a straight line ends', unit='deg', low=0.1, high=90.0
    )
    segment_images_min: int = setting(3, 'fewest pictures of a segment', low=2, high=1000)
    image_step_max: float = setting(
        1.5, 'longest stretch without a picture inside a segment', unit='m', low=0.01, high=1e2
    )
    image_step_min: float = setting(
        0.02,
        'pictures closer to the last one, and turned less, are left out',
        unit='m',
        low=0.0,
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
        0.3,
        'a pose this far from where the twist leads is an odometry reset',
        unit='m',
        low=0.01,
        high=100.0,
    )
    yaw_source: str = setting(
        'auto',
        'where turns come from; auto: the gyroscope where there is one',
        choices=('auto', 'odometry', 'gyro'),
    )
    distance_noise: float = setting(
        0.01, 'random error of driven distance', unit='m/sqrt(m)', low=0.0, high=1.0
    )
    yaw_noise: float = setting(
        0.003,
        'random error of yaw, where the messages tell none',
        unit='rad/sqrt(s)',
        low=0.0,
        high=1.0,
    )
    yaw_slip: float = setting(0.005, 'error of a turn per turn', unit='rad/rad', low=0.0, high=1.0)
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


@dataclass(frozen=True, slots=True)
class SimulationConfig(Settings):
    """The simulated garden, the robot in it, and the errors of its sensors."""

    trajectory: str = setting(
        'coverage',
        'coverage (criss-crossing straight legs), lines (straight lines, no pictures between), '
        'mower (a grid of lanes), test (one smooth closed curve), curves (wandering, no straight '
        'line)',
        choices=('coverage', 'lines', 'mower', 'test', 'curves'),
    )
    seed: int = setting(1, 'drive, sensor errors and light', low=0, high=2**63 - 1)
    world: int = setting(1, 'garden', low=0, high=2**63 - 1)
    area: tuple[float, ...] = setting(
        (16.0, 18.0), 'driven area along x and y', unit='m', low=6.0, high=100.0
    )
    length: float = setting(
        0.0, 'length of coverage, test and curves; 0: by the area', unit='m', low=0.0, high=1e5
    )
    images: str = setting(
        'raw', 'picture of the mirror, or the panorama itself', choices=('raw', 'panorama')
    )
    images_every: float = setting(0.2, 'way between pictures', unit='m', low=0.02, high=10.0)
    images_every_turn: float = setting(
        30.0, 'turn on the spot between pictures', unit='deg', low=1.0, high=360.0
    )
    compression: str = setting(
        'none', 'of the pictures, published below /compressed', choices=('none', 'jpeg', 'png')
    )
    storage: str = setting('mcap', 'storage of the bag', choices=('mcap', 'sqlite3'))
    camera_height: float = setting(0.45, 'camera above the lawn', unit='m', low=0.1, high=2.0)
    image_noise: float = setting(1.5, 'deviation of pixels', unit='grey levels', low=0.0, high=50.0)
    illumination: float = setting(
        0.1, 'change of light: 0 none, 1 clouds and exposure at their worst', low=0.0, high=1.0
    )
    speed: float = setting(1.0, 'driving speed', unit='m/s', low=0.05, high=3.0)
    turn_rate: float = setting(0.6, 'turning speed on the spot', unit='rad/s', low=0.05, high=3.0)
    odometry_rate: float = setting(
        50.0, 'odometry, gyroscope, truth', unit='Hz', low=5.0, high=500.0
    )
    odometry_frame: str = setting(
        'random',
        'where the odometry frame lies: anywhere, as of a robot that was switched on earlier, or '
        'at the start of the recording',
        choices=('random', 'start'),
    )
    test_drift: float = setting(
        0.31,
        "mean odometry error of a test drive, the paper's robot's; 0: as the errors are drawn",
        unit='m',
        low=0.0,
        high=10.0,
    )
    scale_error: float = setting(
        0.005, "deviation of a run's factor of wheel radius and of gyroscope", low=0.0, high=0.2
    )
    slip: float = setting(0.02, 'deviation of wheel slip, about 2 s long', low=0.0, high=0.5)
    speed_noise: float = setting(0.01, 'white noise of the speed', unit='m/s', low=0.0, high=1.0)
    gyro_bias: float = setting(
        0.0016, 'deviation of the wandering gyroscope bias', unit='rad/s', low=0.0, high=0.1
    )
    gyro_bias_time: float = setting(
        40.0, 'time in which the bias wanders off', unit='s', low=0.1, high=1e5
    )
    gyro_noise: float = setting(
        0.005, 'white noise of the yaw rate', unit='rad/s', low=0.0, high=1.0
    )


@dataclass(frozen=True, slots=True)
class MetricConfig(Settings):
    """How metres are learnt from slow features and segments of odometry."""

    solver: str = setting(
        'certified',
        'certified: global optimum with proof; paper: momentum descent on equations 1-8',
        choices=('certified', 'paper'),
    )
    metric_map: str = setting(
        'gp', 'Gaussian process, or monomials up to degree 2', choices=('gp', 'monomials')
    )
    slow_features: int = setting(
        0, 'slowest features used; 0: chosen by leaving out segments', low=0, high=1000
    )
    ridge: float = setting(
        -1.0, 'penalty of the monomials; -1: chosen by leaving out segments', low=-1.0, high=1e6
    )
    gp_length: float = setting(
        0.0, 'length of the process in standardized features; 0: chosen', low=0.0, high=1e3
    )
    gp_noise: float = setting(
        0.0, 'variance of a picture over the variance of the process; 0: chosen', low=0.0, high=1e3
    )
    inducing_points: int = setting(
        1500, 'most pictures that span the process; more are exact, but slow', low=10, high=20000
    )
    use_turns: bool = setting(True, 'use signed turns between segments')
    use_displacements: bool = setting(True, 'use displacements between segments')
    link_weight: float = setting(
        2.0, 'weight of odometry between segments over what its noise says', low=0.0, high=1e3
    )
    yaw_bias_std: float = setting(
        0.003,
        'yaw-rate bias to expect, estimated per run; 0: none',
        unit='rad/s',
        low=0.0,
        high=1.0,
    )
    robust: bool = setting(False, 'give pictures and turns that fit badly less weight')
    left_out_folds: int = setting(8, 'parts of the drive left out in turn', low=2, high=100)
    left_out_length: float = setting(
        10.0, 'most of a drive that is left out as a whole', unit='m', low=0.1, high=1e4
    )
    angle_std_max: float = setting(
        10.0,
        'uncertainty of a direction beyond which the data do not suffice',
        unit='deg',
        low=0.01,
        high=180.0,
    )
    require_certificate: bool = setting(True, 'refuse a map whose optimality is not proven')
    use_anchor: bool = setting(False, 'start the map at the anchor, not at the odometry frame')
    anchor_x: float = setting(0.0, 'where the first run starts in the map', unit='m')
    anchor_y: float = setting(0.0, 'where the first run starts in the map', unit='m')
    anchor_yaw: float = setting(0.0, 'heading at the start of the first run', unit='rad')
    paper_start: str = setting(
        'odometry', 'where the descent starts', choices=('odometry', 'random')
    )
    paper_area_x: float = setting(16.0, 'span of a random start', unit='m', low=0.1, high=1e4)
    paper_area_y: float = setting(18.0, 'span of a random start', unit='m', low=0.1, high=1e4)
    paper_iterations: int = setting(1000, 'most iterations of the descent', low=1, high=10000000)
    paper_learning_rate: float = setting(1e-5, 'beta of equation 7', low=1e-12, high=1.0)
    paper_momentum: float = setting(0.95, 'gamma of equation 7', low=0.0, high=1.0)
    paper_change_min: float = setting(
        0.0, 'the descent stops when the cost changes less', low=0.0, high=1e6
    )
    paper_turns: bool = setting(True, "use the turns' cosines, equation 5, not equation 1")
    metric_seed: int = setting(0, 'seed of random starts and of the left-out parts', low=0)


@dataclass(frozen=True, slots=True)
class FilterConfig(Settings):
    """The filter that fuses odometry with positions, or poses, seen in pictures."""

    set_initial_pose: bool = setting(
        False, 'start from the pose below; else from the pictures alone'
    )
    initial_x: float = setting(0.0, 'start in the map', unit='m', low=-1e6, high=1e6)
    initial_y: float = setting(0.0, 'start in the map', unit='m', low=-1e6, high=1e6)
    initial_yaw: float = setting(0.0, 'heading at the start', unit='rad', low=-7.0, high=7.0)
    initial_position_std: float = setting(
        0.1, 'standard deviation of the start along x and y', unit='m', low=1e-4, high=1e3
    )
    initial_yaw_std: float = setting(
        0.1, 'standard deviation of the heading at the start', unit='rad', low=1e-4, high=3.2
    )
    estimate_bias: bool = setting(True, "estimate the bias of the odometry's turn rate")
    bias_std: float = setting(
        0.01, 'deviation of the bias before any is learnt', unit='rad/s', low=0.0, high=1.0
    )
    bias_walk: float = setting(
        1e-4, 'random walk of the bias', unit='rad/s per sqrt(s)', low=0.0, high=1.0, live=True
    )
    estimate_scale: bool = setting(True, 'estimate true speed over wheel speed')
    scale_std: float = setting(
        0.03, 'deviation of the wheel scale before any is learnt', low=0.0, high=0.5
    )
    scale_walk: float = setting(
        1e-3, 'random walk of the scale', unit='1/sqrt(m)', low=0.0, high=1.0, live=True
    )
    odometry_factor: float = setting(
        1.0, "factor on the odometry's own variances", low=1e-3, high=1e4, live=True
    )
    speed_std_floor: float = setting(
        0.01, 'least deviation of a speed reading', unit='m/s', low=1e-4, high=10.0, live=True
    )
    rate_std_floor: float = setting(
        0.005,
        'least deviation of a turn-rate reading',
        unit='rad/s',
        low=1e-4,
        high=10.0,
        live=True,
    )
    speed_std: float = setting(
        0.05,
        'deviation of a speed reading whose message tells none',
        unit='m/s',
        low=1e-4,
        high=10.0,
        live=True,
    )
    rate_std: float = setting(
        0.02,
        'deviation of a turn-rate reading whose message tells none',
        unit='rad/s',
        low=1e-4,
        high=10.0,
        live=True,
    )
    odometry_correlation: float = setting(
        0.1, 'time for which odometry readings err alike', unit='s', low=0.0, high=100.0, live=True
    )
    slip_per_metre: float = setting(
        0.02, 'slip of the wheels', unit='m per sqrt(m)', low=0.0, high=10.0, live=True
    )
    yaw_per_metre: float = setting(
        0.005, 'turn that goes unnoticed', unit='rad per sqrt(m)', low=0.0, high=10.0, live=True
    )
    yaw_per_radian: float = setting(
        0.02, 'error of turns', unit='rad per sqrt(rad)', low=0.0, high=10.0, live=True
    )
    acceleration: float = setting(
        1.0,
        'change of speed to expect between odometry messages',
        unit='m/s per sqrt(s)',
        low=0.0,
        high=100.0,
        live=True,
    )
    angular_acceleration: float = setting(
        1.0,
        'change of turn rate to expect between odometry messages',
        unit='rad/s per sqrt(s)',
        low=0.0,
        high=100.0,
        live=True,
    )
    standstill_speed: float = setting(
        1e-3, 'a robot slower and turning slower than this stands', unit='m/s', low=0.0, high=1.0
    )
    standstill_rate: float = setting(
        2e-3, 'a robot slower and turning slower than this stands', unit='rad/s', low=0.0, high=1.0
    )
    odometry_timeout: float = setting(
        0.5,
        'silence of the odometry that is worth a warning',
        unit='s',
        low=0.01,
        high=60.0,
        live=True,
    )
    coast_time: float = setting(
        2.0, 'silence for which the last speed is believed', unit='s', low=0.0, high=60.0, live=True
    )
    unknown_speed: float = setting(
        0.5,
        'speed to reckon with when odometry is silent',
        unit='m/s',
        low=0.0,
        high=50.0,
        live=True,
    )
    unknown_rate: float = setting(
        0.5, 'turning to reckon with then', unit='rad per sqrt(s)', low=0.0, high=10.0, live=True
    )
    turn_radius: float = setting(
        0.25, 'way that one radian of turning counts as', unit='m/rad', low=0.0, high=10.0
    )
    measurement_factor: float = setting(
        1.0, "factor on the pictures' variances", low=1e-3, high=1e4, live=True
    )
    position_std: float = setting(
        0.3,
        'deviation of a position whose message tells none',
        unit='m',
        low=1e-3,
        high=1e3,
        live=True,
    )
    position_std_floor: float = setting(
        0.05, 'least deviation of a measured position', unit='m', low=1e-4, high=1e2, live=True
    )
    yaw_std_floor: float = setting(
        0.02, 'least deviation of a measured heading', unit='rad', low=1e-4, high=3.0, live=True
    )
    yaw_std_limit: float = setting(
        1.0, 'a heading less sure than this is not used', unit='rad', low=0.01, high=3.2, live=True
    )
    correlated_share: float = setting(
        -1.0,
        'share of the picture error that neighbouring places have in common (variance); '
        '-1: as learnt with the model, else 0.7',
        low=-1.0,
        high=0.99,
        live=True,
    )
    decorrelation: float = setting(
        0.0,
        'way over which the picture error changes; 0: as learnt with the model, else 1',
        unit='m',
        low=0.0,
        high=1e3,
    )
    gate_probability: float = setting(
        0.999,
        'share of right measurements that the gate lets in',
        low=0.5,
        high=0.999999,
        live=True,
    )
    history: float = setting(5.0, 'how late a measurement may come', unit='s', low=0.1, high=120.0)
    time_jump: float = setting(
        60.0,
        'a stamp this far ahead needs others like it to be believed',
        unit='s',
        low=1.0,
        high=1e6,
    )
    start_yaw_std: float = setting(
        0.3,
        'deviation of the heading from which a start without known heading is made',
        unit='rad',
        low=0.01,
        high=1.0,
        live=True,
    )
    recovery_pictures: int = setting(
        5, 'pictures that must agree to overrule the filter', low=2, high=100, live=True
    )
    recovery_distance: float = setting(
        2.0,
        'way over which they must agree when they tell no heading, or differ little',
        unit='m',
        low=0.0,
        high=1e3,
        live=True,
    )
    recovery_jump: float = setting(
        1.5, 'difference that counts as little', unit='m', low=0.0, high=1e3, live=True
    )
    confirm_pictures: int = setting(
        3, 'pictures that must agree after an outage', low=1, high=100, live=True
    )
    confirm_distance: float = setting(
        2.0, 'way over which they must agree', unit='m', low=0.0, high=1e3, live=True
    )
    degraded_std: float = setting(
        0.5, 'position deviation from which on DEGRADED', unit='m', low=1e-3, high=1e6, live=True
    )
    lost_std: float = setting(
        2.0, 'position deviation from which on LOST', unit='m', low=1e-3, high=1e6, live=True
    )
    lost_yaw_std: float = setting(
        0.8, 'heading deviation from which on LOST', unit='rad', low=0.01, high=10.0, live=True
    )
    picture_timeout: float = setting(
        3.0,
        'time without a usable picture that is worth a warning',
        unit='s',
        low=0.1,
        high=3600.0,
        live=True,
    )
    largest_std: float = setting(
        100.0, 'position deviation that is never exceeded', unit='m', low=1.0, high=1e7
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.degraded_std > self.lost_std:
            raise ConfigError('FilterConfig: degraded_std must not exceed lost_std')
        if self.lost_std > self.largest_std:
            raise ConfigError('FilterConfig: lost_std must not exceed largest_std')
        if self.odometry_timeout > self.coast_time:
            raise ConfigError('FilterConfig: odometry_timeout must not exceed coast_time')


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


@dataclass(frozen=True, slots=True)
class DemoConfig(Settings):
    """The demonstration: which garden and drives, and how long its nodes may stay silent."""

    world: int = setting(1, 'garden', low=0, high=2**63 - 1)
    seed: int = setting(1, 'drives and sensor errors', low=0, high=2**63 - 1)
    rate: float = setting(1.0, 'speed of the replay', unit='x real time', low=0.1, high=20.0)
    start_timeout: float = setting(
        60.0, 'longest time that a node may take to start', unit='s', low=1.0, high=600.0
    )
    silence_timeout: float = setting(
        15.0, 'longest silence of a node during the replay', unit='s', low=1.0, high=600.0
    )
    settle_time: float = setting(
        2.0, 'silence that ends the recording after the replay', unit='s', low=0.1, high=60.0
    )
    stop_timeout: float = setting(
        10.0, 'longest time that a process may take to stop', unit='s', low=0.1, high=60.0
    )


@dataclass(frozen=True, slots=True)
class PlayConfig(Settings):
    """How a bag is replayed."""

    rate: float = setting(1.0, 'speed of the replay', unit='x', low=1e-3, high=1e6)
    start_offset: float = setting(0.0, 'begin this far into the bag', unit='s', low=0.0, high=1e9)
    clock_rate: float = setting(40.0, 'messages on /clock', unit='Hz', low=0.1, high=1e4)
    wait: float = setting(
        20.0,
        'time given to subscribers of images and odometry to appear before it starts',
        unit='s',
        low=0.0,
        high=3600.0,
    )


@dataclass(frozen=True, slots=True)
class InspectionConfig(Settings):
    """What a drive needs to be enough to train on."""

    min_pictures: int = setting(300, 'pictures with odometry', low=1)
    max_spacing: float = setting(
        0.5, 'way between pictures (90th percentile)', unit='m', low=0.01, high=100.0
    )
    reach: float = setting(
        1.0, 'ground this near to a picture is covered', unit='m', low=0.01, high=100.0
    )
    min_covered: float = setting(0.65, 'share of the area that is covered', low=0.0, high=1.0)
    min_directions: int = setting(3, 'line directions, of six, driven along', low=1, high=6)
    max_lost: float = setting(0.1, 'share of pictures that cannot be used', low=0.0, high=1.0)
    max_gap: float = setting(
        2.0, 'pause of a topic that is worth telling', unit='s', low=0.0, high=1e6
    )
    samples: int = setting(16, 'pictures on the contact sheet', low=1, high=400)


@dataclass(frozen=True, slots=True)
class HeadingConfig(Settings):
    """The visual compass, learnt with the map."""

    learn_heading: bool = setting(True, 'learn the heading from the pictures too')
    heading_layers: tuple[int, ...] = setting(
        (1, 2), 'layers whose maps tell the heading', low=1, high=20
    )
    heading_features: int = setting(8, 'slow features that tell it the place', low=0, high=1000)
    heading_folds: int = setting(
        6, 'parts of the segments left out in turn for its accuracy', low=2, high=100
    )
    heading_inducing_points: int = setting(
        800, 'pictures that span the compass', low=20, high=20000
    )


@dataclass(frozen=True, slots=True)
class NetworkConfig(Settings):
    """The hierarchical SFA network and its training."""

    engine: str = setting(
        'rotation',
        'exact sums over the rotation, or the same from MDP on really turned pictures '
        '(hundreds of times slower; needs the extra mdp)',
        choices=('rotation', 'mdp'),
    )
    layers: str = setting(
        'auto',
        'sizes of the layers: by the size of the panorama, a standard set, or the arrays below',
        choices=('auto', '600x60', '300x30', '320x40', 'custom'),
    )
    normalization: str = setting(
        'panorama',
        'what is taken out of each picture: mean and scale of each channel, of all together, '
        'gains (log), nothing, or color (grey)',
        choices=('panorama', 'brightness', 'log', 'none', 'grey'),
    )
    relative_cut: float = setting(
        1e-3,
        'signals of less variance than this part of the largest are dropped',
        low=0.0,
        high=1.0,
    )
    difference: str = setting(
        'picture',
        'slowness per picture, per metre driven, or per second',
        choices=('picture', 'distance', 'time'),
    )
    break_time: float = setting(
        5.0, 'pictures farther apart are no neighbors', unit='s', low=0.01, high=1e4
    )
    break_distance: float = setting(
        2.0, 'pictures farther apart are no neighbors', unit='m', low=0.01, high=1e4
    )
    photometric_std: float = setting(
        0.3, 'random light of each training picture, logarithmic', low=0.0, high=2.0
    )
    photometric_seed: int = setting(0, 'seed of the random light', low=0)
    binning: int = setting(2, 'custom: pixels averaged per side', low=1, high=64)
    field_rows: tuple[int, ...] = setting((10, 3, 4), 'custom: rows of a field', low=1)
    field_columns: tuple[int, ...] = setting((10, 5, 20), 'custom: columns of a field', low=1)
    stride_rows: tuple[int, ...] = setting((4, 1, 1), 'custom: rows between fields', low=1)
    stride_columns: tuple[int, ...] = setting((5, 1, 1), 'custom: columns between fields', low=1)
    linear_dimensions: tuple[int, ...] = setting(
        (32, 32, 48), 'custom: dimensions that are expanded', low=1
    )
    output_dimensions: tuple[int, ...] = setting(
        (32, 32, 32), 'custom: slow features that leave a layer', low=1
    )
    clip: float = setting(4.0, 'custom: limit of a slow feature', low=0.1, high=1e6)


@dataclass(frozen=True, slots=True)
class TuneConfig(Settings):
    """How the filter's noise parameters are sought."""

    method: str = setting(
        'likelihood',
        'likelihood (needs no ground truth), or grid (the search of the paper, which does)',
        choices=('likelihood', 'grid'),
    )
    trials: int = setting(120, 'settings to try by likelihood', low=10, high=100_000)
