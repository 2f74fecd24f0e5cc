# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the pose filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.settings import Settings, setting


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


def resolved(config: FilterConfig, known: ErrorCorrelation | None = None) -> FilterConfig:
    """The settings with what they leave open filled in: the user's value, else what is known."""
    known = known or ErrorCorrelation()
    return replace(
        config,
        correlated_share=known.share if config.correlated_share < 0 else config.correlated_share,
        decorrelation=config.decorrelation or known.distance_m,
    )
