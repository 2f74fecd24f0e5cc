# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of the filter's state: constant turn rate and velocity (CTRV), driven by odometry.

Section 5 of the paper names the model (CTRV, its reference [17]) and prints no equation of it, so
the formulas stand here. With h = omega dt / 2 and the chord c = v dt sin(h) / h, a motion at
constant v and omega leads from (x, y, yaw) to (`arc`)

    x' = x + c cos(yaw + h)    y' = y + c sin(yaw + h)    yaw' = yaw + omega dt

and its derivatives fill the Jacobian (`_advance`). The state has nine components more than a pose:

- V, OMEGA: speed m/s and turn rate rad/s of the robot, as in CTRV. Odometry replaces them:
  v = (1 + scale) v_odometry - loss |omega_odometry|, omega = omega_odometry - bias (`drive`).
- BIAS: what the odometry's turn rate reads too much, rad/s; a random walk in time.
- SCALE: true speed over wheel speed, minus 1; a random walk over the distance. Both calibrate the
  odometry while driving (augmented Kalman filter: Larsen et al., ICRA 1998).
- LOSS: way that is lost in a turn, m per radian; a random walk over the angle. Wheels of real
  robots push less where they turn, and controllers slow down: four small ones lost 0.07 to 0.1.
- DELAY: by how much images are stamped later than expected, s; a random walk in time. An image
  shows the robot of so long ago (`velocity`), which turns tell from an error of the pose.
- ERROR (3): the error that images of one place share, in standard deviations of the measurement.
  Images of neighboring places err alike, because the map is wrong there: e' = f e + sqrt(1 - f^2) n
  with f = exp(-distance / decorrelation) and n white of unit variance (Gauss-Markov process as
  added state: Gelb, Applied Optimal Estimation, 1974). So a robot that stands still learns from
  its thousandth image no more than from the first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import SPOT_RADIUS_M, Array

X, Y, YAW, V, OMEGA, BIAS, SCALE, LOSS, DELAY, ERROR = range(10)
SIZE = 12
TURN_RADIUS_M = 0.25
"""Distance that one radian of turning counts as: about half the track of a small robot."""
YAW_PER_METER = 0.005
"""Heading error that grows with the distance, rad per sqrt(m): turns the wheels do not show."""
ODOMETRY_CORRELATION_S = 0.1
"""Time for which odometry readings err alike: about the time constant of a wheel controller."""
BIAS_WALK, SCALE_WALK, LOSS_WALK, DELAY_WALK = 1e-4, 1e-3, 1e-3, 1e-3
"""Random walks: of the turn-rate bias, rad/s per sqrt(s), that of a cheap warm gyroscope; of the
wheel scale, 1/sqrt(m), a percent over 100 m, as load and ground change; of the way lost in turns,
m/rad per sqrt(rad); of the camera's delay, s per sqrt(s): clocks 50 ppm apart in 1000 s."""
ACCELERATION = 1.0
"""Change of speed (m/s) and turn rate (rad/s) per sqrt(s) without new odometry."""
UNKNOWN_SPEED, UNKNOWN_RATE = 0.5, 0.5
"""Speed (m/s) and turning (rad per sqrt(s)) of a robot whose odometry is silent for long."""
STANDSTILL_SPEED, STANDSTILL_RATE = 1e-3, 2e-3
"""A robot slower (m/s) and turning slower (rad/s) than this stands: encoders and gyros flicker."""
BIAS_STD = 0.01
"""Standard deviation of the turn-rate bias, rad/s, before any is learned: data sheets of cheap
gyroscopes. What is known of wheels and of the camera's clock is a matter of `Rig`."""
_HELD_VARIANCE = 1e-8  # of v and omega at a standstill: positive, to keep the covariance so
_STRAIGHT_RAD = 1e-4  # half turns below this are summed as series, exact to rounding
_DIAGONAL = slice(0, None, SIZE + 1)  # of flat matrices


class State(NamedTuple):
    """Estimate at one stamp: `mean` (12,) and `covariance` (12, 12), in the order of X to ERROR."""

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
    def turn_loss(self) -> float:
        """Way that is lost in a turn, m per radian."""
        return float(self.mean[LOSS])

    @property
    def position_std(self) -> float:
        """Standard deviation along the worst direction, m."""
        return largest_std(self.covariance)

    @property
    def yaw_std(self) -> float:
        return math.sqrt(max(float(self.covariance[YAW, YAW]), 0.0))


def largest_std(covariance: Array) -> float:
    """Standard deviation along the worst direction of x and y, the first rows of a covariance."""
    a, b, c = covariance[0, 0], covariance[1, 1], covariance[0, 1]
    return math.sqrt(max(float((a + b) / 2 + math.hypot((a - b) / 2, c)), 0.0))


class Step(NamedTuple):
    """A prediction: the new mean (12,), its Jacobian (12, 12), the noise it adds (12, 12)."""

    mean: Array
    jacobian: Array
    noise: Array


class MotionNoise(NamedTuple):
    """How driving makes the state uncertain; see the parameters of these names.

    `decorrelation_m` is the distance over which the error that images share fades.
    """

    slip_per_meter: float
    yaw_per_radian: float
    decorrelation_m: float


class Twist(NamedTuple):
    """An odometry reading with its variances: v m/s, omega rad/s."""

    v: float
    omega: float
    v_variance: float
    omega_variance: float


class Arc(NamedTuple):
    """A motion over dt at constant v and omega, and its derivatives."""

    dx: float
    dy: float
    dyaw: float
    dx_dv: float
    dy_dv: float
    dx_domega: float
    dy_domega: float


def arc(yaw: float, v: float, omega: float, dt: float) -> Arc:
    """The motion of the module's formulas; with s = sin(h) / h its derivatives are

    dx/dv = dt s cos(yaw + h)
    dx/domega = (dt / 2) (v dt ds/dh cos(yaw + h) - c sin(yaw + h)),    ds/dh = (cos(h) - s) / h

    and the same for y with sin for cos and cos for -sin.
    """
    half = omega * dt / 2
    if abs(half) < _STRAIGHT_RAD:
        sinc, slope = 1 - half * half / 6, -half / 3
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / half
    c, s = math.cos(yaw + half), math.sin(yaw + half)
    reach, bend, chord = dt * sinc, v * dt * slope * dt / 2, v * dt * sinc
    return Arc(
        dx=chord * c,
        dy=chord * s,
        dyaw=omega * dt,
        dx_dv=reach * c,
        dy_dv=reach * s,
        dx_domega=bend * c - chord * s * dt / 2,
        dy_domega=bend * s + chord * c * dt / 2,
    )


def drive(
    mean: Array, twist: Twist, dt: float, noise: MotionNoise, now: Twist | None = None
) -> Step:
    """Move by odometry: `twist`, held over the last `dt` seconds. It becomes the state's v and
    omega, or the twist of `now` does.

    v' = (1 + scale) v_odometry - loss |omega_odometry| (with the sign of v; none on the spot) and
    omega' = omega_odometry - bias: the columns of the old v and omega in the Jacobian vanish; those
    of scale, loss and bias are v_odometry, -|omega_odometry| and -1 times those of v' and omega'.
    Each reading adds noise of its own variance through the same columns.
    """
    if abs(twist.v) < STANDSTILL_SPEED and abs(twist.omega) < STANDSTILL_RATE:
        return _stand(mean)
    v, omega, by_loss = _corrected(mean, twist)
    step = _advance(mean, v, omega, twist, dt, noise)
    moved, twists = slice(X, OMEGA + 1), slice(V, OMEGA + 1)
    gain = step.jacobian[moved, twists].copy()
    step.jacobian[moved, twists] = 0.0
    step.jacobian[moved, BIAS:DELAY] = gain.dot(((0.0, twist.v, by_loss), (-1.0, 0.0, 0.0)))
    step.noise[moved, moved] += (gain * twist[2:]).dot(gain.T)
    if now is not None and now is not twist:
        step.mean[V], step.mean[OMEGA], slowed = _corrected(mean, now)
        step.jacobian[V, SCALE] += now.v - twist.v
        step.jacobian[V, LOSS] += slowed - by_loss
    return step


def _corrected(mean: Array, twist: Twist) -> tuple[float, float, float]:
    """Speed and turn rate by a reading, and the derivative of the speed by the loss."""
    loss, by_loss = float(mean[LOSS]), 0.0
    # A loss slows a robot down, but turns no motion around.
    if abs(twist.v) > max(SPOT_RADIUS_M, 2 * abs(loss)) * abs(twist.omega):
        by_loss = -math.copysign(abs(twist.omega), twist.v)
    v = (1.0 + float(mean[SCALE])) * twist.v + by_loss * loss
    return v, twist.omega - float(mean[BIAS]), by_loss


def coast(mean: Array, twist: Twist, dt: float, noise: MotionNoise) -> Step:
    """Move on without new odometry: v and omega stay, and become less certain (CTRV); what a random
    walk of theirs moves the pose by has a third of its variance, and half in common with it.

    `twist` is the last reading, whose noise still counts.
    """
    v, omega = float(mean[V]), float(mean[OMEGA])
    standing = v == 0.0 and omega == 0.0
    step = _stand(mean) if standing else _advance(mean, v, omega, twist, dt, noise)
    twists, gain, walk = slice(V, OMEGA + 1), step.jacobian[:3, V : OMEGA + 1], ACCELERATION**2 * dt
    step.noise[:3, :3] += walk / 3 * gain.dot(gain.T)
    step.noise[:3, twists] += walk / 2 * gain
    step.noise[twists, :3] += walk / 2 * gain.T
    step.noise[[V, OMEGA], [V, OMEGA]] += walk
    return step


def halt(mean: Array, twist: Twist, dt: float, noise: MotionNoise) -> Step:
    """Odometry has been silent for too long: expect no motion, and allow for any.

    What a robot may have done since is bounded by UNKNOWN_SPEED or its last reading, `twist`.
    """
    step, speed = _stand(mean), max(UNKNOWN_SPEED, abs(twist.v))
    step.noise[[X, Y, V], [X, Y, V]] += speed**2 * np.array([2 * dt, 2 * dt, 1.0])
    step.noise[[YAW, OMEGA], [YAW, OMEGA]] += UNKNOWN_RATE**2 * np.array([dt, 1.0])
    return step


def _stand(mean: Array) -> Step:
    """The wheels stand: nothing moves, and nothing becomes less certain."""
    after = mean.copy()
    after[V] = after[OMEGA] = 0.0
    jacobian = np.eye(SIZE)
    jacobian[V, V] = jacobian[OMEGA, OMEGA] = 0.0
    noise = np.zeros((SIZE, SIZE))
    noise[V, V] = noise[OMEGA, OMEGA] = _HELD_VARIANCE
    return Step(after, jacobian, noise)


def _advance(
    mean: Array, v: float, omega: float, twist: Twist, dt: float, noise: MotionNoise
) -> Step:
    """CTRV at v and omega over dt: mean, full Jacobian, and the noise that driving itself adds."""
    x, y, yaw, _, _, bias, scale, loss, delay, *errors = mean.tolist()
    way = arc(yaw, v, omega, dt)
    fade = math.exp(-(abs(v) * dt + TURN_RADIUS_M * abs(omega) * dt) / noise.decorrelation_m)
    after = np.array(
        [x + way.dx, y + way.dy, wrap(yaw + way.dyaw), v, omega, bias, scale, loss, delay]
        + [fade * error for error in errors]
    )
    jacobian = np.zeros((SIZE, SIZE))
    jacobian.flat[_DIAGONAL] = (1, 1, 1, 1, 1, 1, 1, 1, 1, fade, fade, fade)
    jacobian[X, YAW], jacobian[Y, YAW] = -way.dy, way.dx
    jacobian[X, V], jacobian[Y, V] = way.dx_dv, way.dy_dv
    jacobian[X, OMEGA], jacobian[Y, OMEGA] = way.dx_domega, way.dy_domega
    jacobian[YAW, OMEGA] = dt
    added = _drift(abs(v) * dt, abs(omega) * dt, dt, fade, noise)
    if dt > 0:
        # Readings err alike for a while. This does not average out with the rate of the messages:
        # over dt it moves the pose as a constant error of variance (variance * time / dt) would.
        gain, share = jacobian[:3, V : OMEGA + 1], ODOMETRY_CORRELATION_S / dt
        added[:3, :3] += (gain * (twist[2] * share, twist[3] * share)).dot(gain.T)
    return Step(after, jacobian, added)


def _drift(meters: float, radians: float, dt: float, fade: float, noise: MotionNoise) -> Array:
    """Slip in proportion to the distance, and the random walks of BIAS to ERROR, (12, 12)."""
    slip, fresh = noise.slip_per_meter**2 * meters, 1 - fade * fade
    yaw = YAW_PER_METER**2 * meters + noise.yaw_per_radian**2 * radians
    walks = (
        BIAS_WALK**2 * dt, SCALE_WALK**2 * meters, LOSS_WALK**2 * radians, DELAY_WALK**2 * dt
    )  # fmt: skip
    covariance = np.zeros((SIZE, SIZE))
    covariance.flat[_DIAGONAL] = (slip, slip, yaw, 0, 0, *walks, fresh, fresh, fresh)
    return covariance


def velocity(mean: Array) -> Array:
    """Of x m/s, y m/s and yaw rad/s (3,)."""
    yaw, v, omega = mean[YAW : OMEGA + 1].tolist()
    return np.array([v * math.cos(yaw), v * math.sin(yaw), omega])


def wrap(angle: float) -> float:
    """Wrap to [-pi, pi): the scalar form of geometry.wrap_angle, which costs too much here."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
