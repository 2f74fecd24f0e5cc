# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of metric learning: segments of odometry, the map, the compass."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


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
