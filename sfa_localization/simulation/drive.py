# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A robot drives through a simulated garden and records its sensors.

The seeds of the garden and of the drive decide all that is random: same seeds, same bytes.
"""

from __future__ import annotations

import heapq
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.data.geometry import Array
from sfa_localization.data.progress import progress_over
from sfa_localization.data.run import Image, Odometry, Stamps, Trajectory, YawRate, integrate
from sfa_localization.data.transforms import BASE
from sfa_localization.simulation.cameras import SimulatedCamera, simulated_cameras
from sfa_localization.simulation.garden import Garden, rounded
from sfa_localization.simulation.rendering import Light, View, panorama_view, raw_view
from sfa_localization.simulation.routes import ROUTES, Lawn, Motion, Route
from sfa_localization.simulation.settings import SimulationConfig

START_NS = 1_700_000_000 * 10**9
REST_S = 0.5  # at the start and the end of each drive
ACCELERATION = 1.0  # m/s^2
TURN_RATE = 0.6  # rad/s, on the spot
TURN_ACCELERATION = 2.0  # rad/s^2
SLIP_TIME_S = 2.0  # correlation time of the wheels' slip: some meters of grass
GYRO_BIAS_TIME_S = 40.0  # correlation time of the gyroscope's wandering bias
LIGHT_TIME_S = 30.0  # correlation time of sun, exposure and tone: a cloud passes

# The errors that are scaled until the odometry drifts as much as `test_drift` asks.
_DRIFT_ERRORS = ('scale_error', 'slip', 'gyro_bias')
_DRIFT_ITERATIONS = 3  # a few suffice, since the drift is almost linear in the errors
_DRIFT_FACTOR_MAX = 5.0  # in each iteration
_NO_DRIFT_M = 0.01  # a smaller drift cannot be scaled
ROUTE_STREAM, SENSOR_STREAM, LIGHT_STREAM, PIXEL_STREAM, FRAME_STREAM, GROUND_STREAM = range(6)
_FRAME_REACH_M = 50.0  # largest distance from the odometry frame to the start of the recording
WAVES = 12
WAVES_M = (1.5, 6.0)
"""Number of waves that make up uneven ground, and their lengths: a robot bridges shorter ones."""
SWAY = 0.25
"""Random tilt of each image as a share of the slope."""
RENDERED_AT_ONCE = 16
Entries = Iterator[tuple[int, Callable[[], None]]]
"""Stamps of messages in order, and functions that write them."""


@dataclass(frozen=True, slots=True)
class SimulatedDrive:
    """A drive: the truth in frame `world`, the measurements, and the stamps of the images.

    `yaw_rate` is None without a gyroscope.
    """

    truth: Trajectory
    odometry: Odometry
    yaw_rate: YawRate | None
    image_stamps_ns: Stamps

    @property
    def image_poses(self) -> Array:
        """True poses (M, 3) of the images."""
        return self.truth.at(self.image_stamps_ns)


def random_stream(config: SimulationConfig, stream: int, item: int = 0) -> np.random.Generator:
    """The random generator of a drive for one of the purposes *_STREAM."""
    drive_index = list(ROUTES).index(config.trajectory)
    return np.random.default_rng([config.seed, config.world, drive_index, stream, item])


def drive(garden: Garden, config: SimulationConfig) -> SimulatedDrive:
    """Plan and drive the route of `config` from the dock, and measure; images are not rendered."""
    lawn = Lawn(garden.half, garden.obstacles)
    plan = ROUTES[config.trajectory]
    route = plan(lawn, garden.dock, random_stream(config, ROUTE_STREAM), config.length)
    stamps, twists, imaging = _motion(route, config)
    truth = Trajectory(stamps, integrate(stamps, twists, garden.dock))
    if config.trajectory == 'test' and config.test_drift > 0:
        config = _drifting(truth, twists, config)
    measured, variances = _measured(twists, config, random_stream(config, SENSOR_STREAM))
    rng = random_stream(config, FRAME_STREAM)
    start = [*rng.uniform(-_FRAME_REACH_M, _FRAME_REACH_M, 2), rng.uniform(-np.pi, np.pi)]
    poses = integrate(stamps, measured, np.array(start))
    odometry = Odometry(stamps, poses, measured, variances)
    gyro = YawRate(stamps, measured[:, 1], variances[:, 1])
    return SimulatedDrive(truth, odometry, gyro, _image_stamps(stamps, twists, imaging, config))


def _motion(route: Route, config: SimulationConfig) -> tuple[Stamps, Array, Array]:
    """Stamps (N,), true twists (N, 2) since the last stamp, and 1 where images are taken (N,)."""
    dt_ns = round(1e9 / config.odometry_rate)
    rest = Motion(np.zeros((1, 2)), images=False)
    motions = [rest, *route, rest]
    parts = [_increments(motion, config, dt_ns * 1e-9) for motion in motions]
    increments = np.concatenate([np.zeros((1, 2)), *parts])
    lengths = [1, *map(len, parts)]
    imaging = np.repeat([0.0, *(motion.images for motion in motions)], lengths)
    stamps = START_NS + np.arange(len(increments), dtype=np.int64) * dt_ns
    return stamps, increments / (dt_ns * 1e-9), imaging


def _increments(motion: Motion, config: SimulationConfig, dt: float) -> Array:
    """Distance and turn (N, 2) in each time step of a motion, from rest to rest."""
    distance = np.concatenate([[0], np.cumsum(motion.steps[:, 0])])
    turn = np.concatenate([[0], np.cumsum(motion.steps[:, 1])])
    if distance[-1] > 0:
        done = _profile(distance[-1], config.speed, ACCELERATION, dt)
        return np.diff(np.stack([done, np.interp(done, distance, turn)], -1), axis=0)
    if turn[-1] == 0:
        return np.zeros((round(REST_S / dt), 2))
    done = np.sign(turn[-1]) * _profile(abs(turn[-1]), TURN_RATE, TURN_ACCELERATION, dt)
    return np.diff(np.stack([0 * done, done], -1), axis=0)


def _profile(distance: float, speed: float, acceleration: float, dt: float) -> Array:
    """Distance covered (N + 1,) after every time step: speeding up, steady, slowing down."""
    speed = min(speed, float(np.sqrt(distance * acceleration)))
    ramp = speed / acceleration
    total = distance / speed + ramp
    count = max(1, int(np.ceil(total / dt)))
    t = np.linspace(0, total, count + 1)
    rising = np.minimum(t, ramp)
    falling = np.maximum(t - (total - ramp), 0)
    steady = np.clip(t - ramp, 0, total - 2 * ramp)
    covered = acceleration * rising**2 / 2 + speed * steady + speed * falling
    return np.asarray(covered - acceleration * falling**2 / 2)


def _drifting(truth: Trajectory, twists: Array, config: SimulationConfig) -> SimulationConfig:
    """The config with errors of wheels and gyroscope scaled to a mean drift of `test_drift`.

    Otherwise some test drives have almost no drift, and drives are hard to compare.
    """
    for _ in range(_DRIFT_ITERATIONS):
        measured, _ = _measured(twists, config, random_stream(config, SENSOR_STREAM))
        path = integrate(truth.stamps_ns, measured, truth.poses[0])
        drift = float(np.hypot(*(path - truth.poses)[:, :2].T).mean())
        if drift < _NO_DRIFT_M:
            break
        factor = min(config.test_drift / drift, _DRIFT_FACTOR_MAX)
        errors = {name: factor * getattr(config, name) for name in _DRIFT_ERRORS}
        config = replace(config, **errors)
    return config


def _measured(
    twists: Array, config: SimulationConfig, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Measured twists (N, 2) and the variances (N, 2) of their errors.

    Errors of the wheels' scale and slip are proportional to the speed. The yaw rate has the scale
    error, the wandering bias and the white noise of a gyroscope. A variance is that of the error of
    a single message; the slow errors are correlated between messages.
    """
    dt = 1 / config.odometry_rate
    count = len(twists)
    wheel, gyro = 1 + config.scale_error * rng.standard_normal(2)
    slip = config.slip * wandering(count, dt, SLIP_TIME_S, rng)
    bias = config.gyro_bias * wandering(count, dt, GYRO_BIAS_TIME_S, rng)
    noise = rng.standard_normal((count, 2)) * [config.speed_noise, config.gyro_noise]
    v, omega = twists.T
    measured_v = v * (wheel + slip) + noise[:, 0] * (v != 0)
    measured = np.stack([measured_v, omega * gyro + bias + noise[:, 1]], -1)
    relative = config.scale_error**2 + config.slip**2
    variance_v = config.speed_noise**2 + relative * v**2
    variance_omega = config.gyro_noise**2 + config.gyro_bias**2 + (config.scale_error * omega) ** 2
    return measured, np.stack([variance_v, variance_omega], -1)


def wandering(count: int, dt: float, time_s: float, rng: np.random.Generator) -> Array:
    """A stationary random process (count,) of unit variance, correlated over `time_s`."""
    keep = np.exp(-dt / time_s)
    pushes = rng.standard_normal(count) * np.sqrt(1 - keep**2)
    process, _ = lfilter([1.0], [1.0, -keep], pushes, zi=keep * rng.standard_normal(1))
    return np.asarray(process, float)


def _image_stamps(
    stamps: Stamps, twists: Array, imaging: Array, config: SimulationConfig
) -> Stamps:
    """Stamps (M,) of the images: one at every `images_every` m, or degrees of a turn in place."""
    turning = (twists[:, 0] == 0) / np.radians(config.images_every_turn)
    rate = np.abs(twists[:, 0]) / config.images_every + np.abs(twists[:, 1]) * turning
    dt = np.diff(stamps) * 1e-9
    progress = np.concatenate([[0], np.cumsum((rate * imaging)[1:] * dt)])
    marks = np.arange(0.5, progress[-1])
    after = np.searchsorted(progress, marks)
    part = (marks - progress[after - 1]) / (progress[after] - progress[after - 1])
    span = stamps[after] - stamps[after - 1]
    return np.asarray(stamps[after - 1] + np.rint(part * span).astype(np.int64))


def lights(stamps_ns: Stamps, config: SimulationConfig) -> list[Light]:
    """The light at each stamp; sun, exposure and tone wander over time."""
    if not len(stamps_ns):
        return []
    rng = random_stream(config, LIGHT_STREAM)
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    grid = np.arange(0, seconds[-1] + 2)
    waves = [
        np.interp(seconds, grid, wandering(len(grid), 1.0, LIGHT_TIME_S, rng)) for _ in range(3)
    ]
    strength = config.illumination
    sun = np.clip(1 - strength * (0.4 + 0.5 * waves[0]), 0.05, 1.2)
    exposure = np.exp(0.4 * strength * waves[1])
    warmth = 0.08 * strength * waves[2]
    return list(map(Light, sun.tolist(), exposure.tolist(), warmth.tolist()))


def render_images(
    garden: Garden,
    drive: SimulatedDrive,
    config: SimulationConfig,
    view: View,
    place: complex = 0j,
    stream: int = 0,
) -> Iterator[Image]:
    """The noisy images of a drive in order, rendered by a thread per core, from a `place` on the
    robot, ahead + i left, m; the noise of another `stream` is independent.
    """
    poses = drive.image_poses
    light = lights(drive.image_stamps_ns, config)

    def take(index: int) -> Image:
        pose = poses[index]
        if config.terrain:
            pose = np.append(pose, roll_and_pitch(pose, config, index))
        shift = place * np.exp(1j * pose[2])
        pose[:2] += shift.real, shift.imag
        image = garden.image(pose, view, light[index])
        rng = random_stream(config, PIXEL_STREAM, index + stream * len(poses))
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        return rounded(image + np.float32(config.image_noise) * noise)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for start in range(0, len(poses), RENDERED_AT_ONCE):
            yield from pool.map(take, range(len(poses))[start : start + RENDERED_AT_ONCE])


def roll_and_pitch(pose: Array, config: SimulationConfig, index: int) -> Array:
    """Roll and pitch (2,) rad at a pose (3,): the slope of the garden's ground, and sway."""
    rng = np.random.default_rng([config.world, GROUND_STREAM])
    toward, phase = rng.uniform(0, 2 * np.pi, (2, WAVES))
    along = np.cos(toward) * pose[0] + np.sin(toward) * pose[1]
    slope = np.cos(2 * np.pi * along / rng.uniform(*WAVES_M, WAVES) + phase) * 2 / np.sqrt(WAVES)
    uphill = (slope * np.exp(1j * (toward - pose[2]))).sum()  # ahead + j left
    sway = SWAY * random_stream(config, GROUND_STREAM, index).standard_normal(2)
    return np.asarray(np.radians(config.terrain) * (sway + np.array([uphill.imag, -uphill.real])))


def simulate(
    config: SimulationConfig,
    out: Path,
    panorama: PanoramaConfig | None = None,
    progress: bool = False,
) -> SimulatedDrive:
    """Drive through the garden of `config`, and record the drive to the bag `out`; see `record`."""
    garden = Garden(config.world, config)
    driven = drive(garden, config)
    record(driven, garden, config, out, panorama, progress)
    return driven


def record(
    driven: SimulatedDrive,
    garden: Garden,
    config: SimulationConfig,
    out: Path,
    panorama: PanoramaConfig | None = None,
    progress: bool = False,
    lens: LensCalibration | None = None,
) -> None:
    """Record a drive to the bag `out`; `progress` shows a bar. Raw images are those of a `lens`, by
    default of the mirror; or of the `cameras` of `config`.

    Raises BagError when the bag exists or cannot be written, ConfigError for impossible settings.
    After an error or Ctrl-C nothing is left.
    """
    label = f'render the images of {out.name}'
    shown = partial(progress_over, desc=label, total=len(driven.image_stamps_ns), visible=progress)
    cameras = simulated_cameras(config)
    with BagWriter(out, config.storage) as bag:
        if cameras:
            images = _of_cameras(bag, driven, garden, config, cameras, shown)
        else:
            view = _view(config, panorama or PanoramaConfig(), lens or LensCalibration())
            topic = '/panorama' if config.images == 'panorama' else '/image_raw'
            frames = shown(render_images(garden, driven, config, view))
            images = [_images(bag, topic, 'camera', driven.image_stamps_ns, frames, config)]
        _write(bag, driven, images)


def _view(config: SimulationConfig, panorama: PanoramaConfig, lens: LensCalibration) -> View:
    """The kind of the images of one camera that sees all around."""
    if config.images == 'panorama':
        return panorama_view(panorama)
    size = lens.image_height, lens.image_width
    return raw_view(make_camera(lens, size, mount_rpy=lens.mount_rpy).unproject, size)


def _of_cameras(
    bag: BagWriter,
    drive: SimulatedDrive,
    garden: Garden,
    config: SimulationConfig,
    cameras: Sequence[SimulatedCamera],
    shown: Callable[[Iterable[Image]], Iterator[Image]],
) -> list[Entries]:
    """Transforms, calibrations and images of cameras; `shown` shows the progress of the first."""
    start_ns = int(drive.truth.stamps_ns[0])
    poses = {camera.frame: camera.mounted for camera in cameras}
    transforms = partial(bag.static_transforms, start_ns, BASE, poses)
    entries: list[Entries] = [iter([(start_ns, transforms)])]
    for number, camera in enumerate(cameras):
        skewed = replace(drive, image_stamps_ns=drive.image_stamps_ns + camera.skew_ns)
        stamps_ns = skewed.image_stamps_ns
        frames = render_images(garden, skewed, config, camera.view, camera.place, number)
        frames = frames if number else shown(frames)
        info = partial(bag.camera_info, lens=camera.mounted.lens, frame_id=camera.frame)
        entries.append(_entries(info, f'/{camera.mounted.name}/camera_info', stamps_ns))
        topic = f'/{camera.mounted.name}/image_raw'
        entries.append(_images(bag, topic, camera.frame, stamps_ns, frames, config))
    return entries


def _images(
    bag: BagWriter,
    topic: str,
    frame: str,
    stamps_ns: Stamps,
    frames: Iterable[Image],
    config: SimulationConfig,
) -> Entries:
    """The images of a camera, below /compressed where `config` compresses them."""
    compressed = None if config.compression == 'none' else config.compression
    topic += '/compressed' if compressed else ''
    image = partial(bag.image, frame_id=frame, compressed=compressed)
    return _entries(image, topic, stamps_ns, frames)


def _write(bag: BagWriter, drive: SimulatedDrive, images: Iterable[Entries]) -> None:
    """Write all messages in the order of their stamps."""
    odometry = drive.odometry
    gyro = drive.yaw_rate
    truth = drive.truth
    driven = odometry.poses, odometry.twists, odometry.variances
    entries = heapq.merge(
        _entries(bag.odometry, '/odom', odometry.stamps_ns, *driven),
        _entries(bag.imu, '/imu', gyro.stamps_ns, gyro.omega, gyro.variance) if gyro else (),
        _entries(bag.pose, '/ground_truth', truth.stamps_ns, truth.poses),
        *images,
        key=lambda entry: entry[0],
    )
    for _, write in entries:
        write()


def _entries(
    write: Callable[..., None], topic: str, stamps_ns: Stamps, *columns: Iterable[Any]
) -> Entries:
    """Stamp of each message of a topic, and a function that writes it."""
    for stamp, *values in zip(map(int, stamps_ns), *columns, strict=True):
        yield stamp, partial(write, topic, stamp, *values)
