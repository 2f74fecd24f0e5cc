# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of the pose filter's state: constant turn rate and velocity (CTRV), driven by odometry.

The state is [x m, y m, yaw rad, v m/s, omega rad/s, yaw-rate bias rad/s, wheel scale - 1,
e_x, e_y, e_yaw]. The last three are what pictures of one place get wrong alike, in standard
deviations of the measurement: they fade over the distance driven, so that a robot that stands
still learns from its thousandth picture no more than from the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.fusion.settings import FilterConfig

X, Y, YAW, V, OMEGA, BIAS, SCALE, ERROR = range(8)
SIZE = 10
_HELD_VARIANCE = 1e-8
# A pose that moves or turns by more than its twist explains and this was reset.
_JUMP_M, _JUMP_RAD = 0.3, 0.5
_DIAGONAL = np.arange(SIZE)


@dataclass(frozen=True, slots=True)
class State:
    """Estimate at one stamp: `mean` (10,), `covariance` (10, 10), in the order told above."""

    stamp_ns: int
    mean: Array
    covariance: Array

    @property
    def pose(self) -> Array:
        """x m, y m, yaw rad in the map (3,)."""
        return self.mean[:3].copy()

    @property
    def pose_covariance(self) -> Array:
        """Covariance (3, 3) of `pose`."""
        return self.covariance[:3, :3].copy()

    @property
    def twist(self) -> Array:
        """Speed m/s and turn rate rad/s, corrected by scale and bias (2,)."""
        return self.mean[V : OMEGA + 1].copy()

    @property
    def twist_covariance(self) -> Array:
        """Covariance (2, 2) of `twist`."""
        return self.covariance[V : OMEGA + 1, V : OMEGA + 1].copy()

    @property
    def yaw_rate_bias(self) -> float:
        """What the odometry's turn rate reads too much, rad/s."""
        return float(self.mean[BIAS])

    @property
    def wheel_scale(self) -> float:
        """True speed over odometry's speed."""
        return 1.0 + float(self.mean[SCALE])

    @property
    def position_std(self) -> float:
        """Standard deviation along the worst direction, m."""
        a, b, c = self.covariance[0, 0], self.covariance[1, 1], self.covariance[0, 1]
        largest = (a + b) / 2 + math.hypot((a - b) / 2, c)
        return math.sqrt(max(float(largest), 0.0))

    @property
    def yaw_std(self) -> float:
        return math.sqrt(max(float(self.covariance[YAW, YAW]), 0.0))


class Step(NamedTuple):
    """A prediction: the new mean (10,), its Jacobian (10, 10), the noise it adds (10, 10)."""

    mean: Array
    jacobian: Array
    noise: Array


class Twist(NamedTuple):
    """An odometry reading, with variances: v m/s, omega rad/s."""

    v: float
    omega: float
    v_variance: float
    omega_variance: float

    def stands(self, config: FilterConfig) -> bool:
        return abs(self.v) < config.standstill_speed and abs(self.omega) < config.standstill_rate


def driven_twist(
    before: tuple[float, float, float],
    after: tuple[float, float, float],
    seconds: float,
    twist: Twist,
) -> Twist:
    """The reading with the mean twist by which odometry's own pose has moved since the last one.

    Publishers differ in what their twist is the mean of; their pose says what it was. The twist
    stays where the pose does not go with it: it was reset, or is not kept at all.
    """
    dx, dy = after[0] - before[0], after[1] - before[1]
    turn, way = wrap(after[2] - before[2]), math.hypot(dx, dy)
    expected, turned = abs(twist.v) * seconds, abs(twist.omega) * seconds
    reset = way > expected + _JUMP_M or abs(turn) > turned + _JUMP_RAD
    if seconds <= 0 or reset or (way == 0.0 and turn == 0.0):
        return twist
    forward = dx * math.cos(before[2] + turn / 2) + dy * math.sin(before[2] + turn / 2)
    half = turn / 2
    arc = forward * (half / math.sin(half) if abs(half) > 1e-6 else 1.0)
    return twist._replace(v=arc / seconds, omega=turn / seconds)


class _Arc(NamedTuple):
    """A motion over dt at constant v and omega, and its derivatives."""

    dx: float
    dy: float
    dyaw: float
    dx_dv: float
    dy_dv: float
    dx_domega: float
    dy_domega: float


def _arc(yaw: float, v: float, omega: float, dt: float) -> _Arc:
    half = omega * dt / 2
    if abs(half) < 1e-4:  # the straight-line limit, exact to rounding here
        sinc, slope = 1 - half * half / 6, -half / 3
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / half
    c, s = math.cos(yaw + half), math.sin(yaw + half)
    reach, bend, chord = dt * sinc, v * dt * slope * dt / 2, v * dt * sinc
    return _Arc(
        dx=chord * c,
        dy=chord * s,
        dyaw=omega * dt,
        dx_dv=reach * c,
        dy_dv=reach * s,
        dx_domega=bend * c - chord * s * dt / 2,
        dy_domega=bend * s + chord * c * dt / 2,
    )


def drive(mean: Array, twist: Twist, dt: float, config: FilterConfig) -> Step:
    """Move by odometry: `twist` held over the last `dt` seconds becomes the state's v and omega.

    v = scale * v_odometry and omega = omega_odometry - bias, each with the noise of its reading.
    """
    if twist.stands(config):
        return _stand(mean)
    x, y, yaw, _, _, bias, scale, *errors = mean.tolist()
    v, omega = (1.0 + scale) * twist.v, twist.omega - bias
    arc = _arc(yaw, v, omega, dt)
    moved = abs(v) * dt + config.turn_radius * abs(omega) * dt
    fade = math.exp(-moved / config.decorrelation)
    after = np.array(
        [x + arc.dx, y + arc.dy, wrap(yaw + arc.dyaw), v, omega, bias, scale]
        + [fade * error for error in errors]
    )
    jacobian = _arc_jacobian(arc, dt, fade)
    # Columns of the old v and omega vanish: odometry replaces them, through scale and bias.
    gain = np.zeros((SIZE, 2))
    gain[[X, Y, V], 0] = arc.dx_dv, arc.dy_dv, 1.0
    gain[[X, Y, YAW, OMEGA], 1] = arc.dx_domega, arc.dy_domega, dt, 1.0
    jacobian[:, V] = jacobian[:, OMEGA] = 0.0
    jacobian[:, SCALE] += twist.v * gain[:, 0]
    jacobian[:, BIAS] -= gain[:, 1]
    variances = np.array([twist.v_variance, twist.omega_variance])
    noise = (gain * variances).dot(gain.T)
    _add_lasting_noise(noise, gain, variances, dt, config)
    _add_drift(noise, abs(v) * dt, abs(omega) * dt, dt, fade, config)
    return Step(after, jacobian, noise)


def coast(mean: Array, twist: Twist, dt: float, config: FilterConfig) -> Step:
    """Move on without new odometry: v and omega stay, and become less sure (CTRV).

    `twist` is the last reading, whose noise still counts.
    """
    x, y, yaw, v, omega, bias, scale, *errors = mean.tolist()
    if v == 0.0 and omega == 0.0:
        step = _stand(mean)
    else:
        arc = _arc(yaw, v, omega, dt)
        moved = abs(v) * dt + config.turn_radius * abs(omega) * dt
        fade = math.exp(-moved / config.decorrelation)
        after = np.array(
            [x + arc.dx, y + arc.dy, wrap(yaw + arc.dyaw), v, omega, bias, scale]
            + [fade * error for error in errors]
        )
        jacobian = _arc_jacobian(arc, dt, fade)
        noise = np.zeros((SIZE, SIZE))
        gain = jacobian[:, V : OMEGA + 1]
        variances = np.array([twist.v_variance, twist.omega_variance])
        _add_lasting_noise(noise, gain, variances, dt, config)
        _add_drift(noise, abs(v) * dt, abs(omega) * dt, dt, fade, config)
        step = Step(after, jacobian, noise)
    step.noise[V, V] += config.acceleration**2 * dt
    step.noise[OMEGA, OMEGA] += config.angular_acceleration**2 * dt
    return step


def halt(mean: Array, twist: Twist, dt: float, config: FilterConfig) -> Step:
    """Odometry has been silent for too long: expect no motion, and any motion.

    What a robot may have done since is bounded by `unknown_speed` or its last reading, `twist`.
    """
    step = _stand(mean)
    speed = doubt(step.noise, twist, dt, config)
    fade = math.exp(-speed * dt / config.decorrelation)
    for i in range(ERROR, SIZE):
        step.mean[i] *= fade
        step.jacobian[i, i] = fade
        step.noise[i, i] += 1 - fade * fade
    step.noise[V, V] = speed**2
    step.noise[OMEGA, OMEGA] = config.unknown_rate**2
    return step


def doubt(noise: Array, twist: Twist, dt: float, config: FilterConfig) -> float:
    """Add to `noise` (10, 10) what a robot may have done unseen for `dt` s; returns its speed."""
    speed = max(config.unknown_speed, abs(twist.v))
    spread = 2 * speed**2 * dt
    noise[X, X] += spread
    noise[Y, Y] += spread
    noise[YAW, YAW] += config.unknown_rate**2 * dt
    return speed


def _stand(mean: Array) -> Step:
    """The wheels say that the robot stands: nothing moves, and nothing becomes less sure."""
    after = mean.copy()
    after[V] = after[OMEGA] = 0.0
    jacobian = np.eye(SIZE)
    jacobian[V, V] = jacobian[OMEGA, OMEGA] = 0.0
    noise = np.zeros((SIZE, SIZE))
    noise[V, V] = noise[OMEGA, OMEGA] = _HELD_VARIANCE
    return Step(after, jacobian, noise)


def _arc_jacobian(arc: _Arc, dt: float, fade: float) -> Array:
    jacobian = np.zeros((SIZE, SIZE))
    jacobian[_DIAGONAL, _DIAGONAL] = (1, 1, 1, 1, 1, 1, 1, fade, fade, fade)
    jacobian[X, YAW], jacobian[Y, YAW] = -arc.dy, arc.dx
    jacobian[X, V], jacobian[Y, V] = arc.dx_dv, arc.dy_dv
    jacobian[X, OMEGA], jacobian[Y, OMEGA] = arc.dx_domega, arc.dy_domega
    jacobian[YAW, OMEGA] = dt
    return jacobian


def _add_lasting_noise(
    noise: Array, gain: Array, variances: Array, dt: float, config: FilterConfig
) -> None:
    """Readings err alike for a while, so that their error does not average out with the rate.

    Over dt it moves the pose as a constant error of variance (variance * correlation / dt) would.
    """
    if dt <= 0:
        return
    part = gain[:3]
    noise[:3, :3] += (part * (variances * (config.odometry_correlation / dt))).dot(part.T)


def _add_drift(
    noise: Array, metres: float, radians: float, dt: float, fade: float, config: FilterConfig
) -> None:
    """Slip in proportion to the way, and the random walks of bias, scale and picture error."""
    slip = config.slip_per_metre**2 * metres
    noise[X, X] += slip
    noise[Y, Y] += slip
    noise[YAW, YAW] += config.yaw_per_metre**2 * metres + config.yaw_per_radian**2 * radians
    if config.estimate_bias:
        noise[BIAS, BIAS] += config.bias_walk**2 * dt
    if config.estimate_scale:
        noise[SCALE, SCALE] += config.scale_walk**2 * metres
    for i in range(ERROR, SIZE):
        noise[i, i] += 1 - fade * fade


def wrap(angle: float) -> float:
    """Wrap to [-pi, pi): the scalar form of geometry.wrap_angle, which costs too much here."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
