# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the simulated garden and drive."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class SimulationConfig(Settings):
    """The simulated garden, the robot in it, and the errors of its sensors."""

    trajectory: str = setting(
        'coverage',
        'coverage (criss-crossing straight legs), lines (straight lines, no images between), '
        'mower (a grid of lanes), test (one smooth closed curve)',
        choices=('coverage', 'lines', 'mower', 'test'),
    )
    seed: int = setting(1, 'drive, sensor errors and light', low=0, high=2**63 - 1)
    world: int = setting(1, 'garden', low=0, high=2**63 - 1)
    light: str = setting(
        'day',
        'day (fixed exposure), morning, overcast, evening (automatic exposure, white balance)',
        choices=('day', 'morning', 'overcast', 'evening'),
    )
    season: str = setting(
        'summer', 'color and leaves of the plants', choices=('summer', 'autumn', 'winter')
    )
    area: tuple[float, ...] = setting(
        (16.0, 18.0), 'driven area along x and y', unit='m', low=6.0, high=100.0
    )
    length: float = setting(
        0.0, 'length of coverage and test; 0: by the area', unit='m', low=0.0, high=1e5
    )
    images: str = setting(
        'raw', 'image of the mirror, or the panorama itself', choices=('raw', 'panorama')
    )
    cameras: int = setting(
        0, 'cameras around the robot, each with its topics, instead of one image', low=0, high=8
    )
    camera_fov: float = setting(
        100.0,
        'view of each camera across its columns; above 120 degrees it is a fisheye',
        unit='deg',
        low=20.0,
        high=220.0,
    )
    camera_radius: float = setting(
        0.2, 'distance of the cameras from the center of the robot', unit='m', low=0.0, high=2.0
    )
    camera_size: tuple[float, ...] = setting(
        (400.0, 240.0), 'columns and rows of their images', unit='px', low=16.0, high=4096.0
    )
    camera_exposures: tuple[float, ...] = setting(
        (), 'brightness of the images of each camera; empty: equal', low=0.05, high=20.0
    )
    camera_skew: tuple[float, ...] = setting(
        (),
        'how much later than the others each camera takes its images; empty: not at all',
        unit='ms',
        low=-400.0,
        high=400.0,
    )
    camera_yaws: tuple[float, ...] = setting(
        (),
        'how much further left each camera looks than /tf_static says; empty: as it says',
        unit='deg',
        low=-180.0,
        high=180.0,
    )
    images_every: float = setting(0.2, 'distance between images', unit='m', low=0.02, high=10.0)
    images_every_turn: float = setting(
        30.0, 'turn on the spot between images', unit='deg', low=1.0, high=360.0
    )
    compression: str = setting(
        'none', 'of the images, published below /compressed', choices=('none', 'jpeg', 'png')
    )
    storage: str = setting('mcap', 'storage of the bag', choices=('mcap', 'sqlite3'))
    image_noise: float = setting(
        1.5, 'standard deviation of the pixel noise', unit='gray levels', low=0.0, high=50.0
    )
    illumination: float = setting(
        0.1, 'change of light: 0 none, 1 clouds and exposure at their worst', low=0.0, high=1.0
    )
    terrain: float = setting(
        0.0, 'standard deviation of the slope along each axis', unit='deg', low=0.0, high=10.0
    )
    speed: float = setting(1.0, 'driving speed', unit='m/s', low=0.05, high=3.0)
    odometry_rate: float = setting(
        50.0, 'rate of odometry, gyroscope and ground truth', unit='Hz', low=5.0, high=500.0
    )
    test_drift: float = setting(
        0.31, 'mean odometry error of a test drive; 0: as drawn', unit='m', low=0.0, high=10.0
    )
    scale_error: float = setting(
        0.005, 'standard deviation of the scales of wheels and gyroscope', low=0.0, high=0.2
    )
    slip: float = setting(
        0.02, 'standard deviation of wheel slip, correlated over about 2 s', low=0.0, high=0.5
    )
    speed_noise: float = setting(0.01, 'white noise of the speed', unit='m/s', low=0.0, high=1.0)
    gyro_bias: float = setting(
        0.0016, 'standard deviation of the gyroscope bias', unit='rad/s', low=0.0, high=0.1
    )
    gyro_noise: float = setting(
        0.005, 'white noise of the yaw rate', unit='rad/s', low=0.0, high=1.0
    )
