# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of the filter's state: constant turn rate and velocity (CTRV), driven by odometry.

Section 5 of the paper names the model (its reference [17]) and prints no equation. With
h = omega dt / 2 and the chord c = v dt sin(h) / h, constant v and omega lead from (x, y, yaw) to

    x' = x + c cos(yaw + h)    y' = y + c sin(yaw + h)    yaw' = yaw + omega dt

The state has eleven components more than a pose:

- V, OMEGA: speed m/s and turn rate rad/s of the robot. Odometry replaces them (`drive`):
  v = (1 + scale) v_odometry - loss |omega_odometry| + offset,
  omega = (1 + turn) omega_odometry - bias.
- BIAS: what the odometry's turn rate reads too much, rad/s; a random walk in time.
- SCALE: true speed over wheel speed, minus 1; a random walk over the distance (augmented Kalman
  filter: Larsen et al., ICRA 1998).
- LOSS: way that wheels lose in a turn, m per radian; a random walk over the angle. Four small
  robots lost 0.07 to 0.1.
- TURN: true turns over those of the odometry, minus 1; a random walk over the angle. Eleven real
  logs had -0.09 to 0, tracks that skid -0.3.
- OFFSET: what the wheels' speed reads too little, m/s; a random walk in time.
- DELAY: by how much images are stamped later than expected, s; a random walk in time. An image
  shows the robot as it was that long ago; turns distinguish this from an error of the pose.
- ERROR (3): the error that images of one place share, in standard deviations of the measurement:
  e' = f e + sqrt(1 - f^2) n with f = exp(-distance / decorrelation) and white n of unit variance
  (Gauss-Markov process: Gelb, Applied Optimal Estimation, 1974). A robot that stands still thus
  learns no more from its thousandth image than from its first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import SPOT_RADIUS_M, Array, wrap_angle

X, Y, YAW, V, OMEGA, BIAS, SCALE, LOSS, TURN, OFFSET, DELAY, ERROR = range(12)
SIZE = 14
TURN_RADIUS_M = 0.25  # one radian of turning counts as this way: half the track of a small robot
YAW_PER_METER = 0.005  # rad per sqrt(m): turns that wheels do not show
ODOMETRY_CORRELATION_S = 0.1  # readings err alike for the time constant of a wheel controller
WALKS: Array = np.square([1e-4, 1e-3, 1e-3, 1e-3, 1e-4, 1e-3])
"""Squares of the random walks of BIAS to DELAY: turn-rate bias of a cheap gyroscope, rad/s per
sqrt(s); wheel scale, 1/sqrt(m), a percent over 100 m; loss in turns, m/rad per sqrt(rad); turn
factor, 1/sqrt(rad); offset of the speed, m/s per sqrt(s); delay of the camera, s per sqrt(s)."""
PRIOR_CHANGE = 1.0
CHANGES = 100
"""Square of the change of speed (m/s) and turn rate (rad/s) in a second before any is observed,
that of a hasty robot: it counts as one of the last CHANGES seconds of driving. Seven robots changed
their turn rates by 0.02 to 0.09."""
STANDSTILL_SPEED = 1e-3
STANDSTILL_RATE = 2e-3
"""A robot slower (m/s) and turning slower (rad/s) than this stands: encoders and gyros flicker."""
BIAS_STD = 0.01  # rad/s, of the turn-rate bias before any is learned: cheap gyroscopes
_HELD_VARIANCE = 1e-8  # of v and omega at a standstill: keeps the covariance positive
_STRAIGHT_RAD = 1e-4  # half turns below this are summed as series, exact to rounding


class State(NamedTuple):
    """Estimate at one stamp: `mean` (14,) and `covariance` (14, 14), in the order of X to ERROR."""

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
        return self.mean[V:BIAS].copy()

    @property
    def twist_covariance(self) -> Array:
        """Covariance (2, 2) of `twist`."""
        return self.covariance[V:BIAS, V:BIAS].copy()

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
    def turn_factor(self) -> float:
        """True turns over those of the odometry."""
        return 1.0 + float(self.mean[TURN])

    @property
    def position_std(self) -> float:
        """Standard deviation along the worst direction, m."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance[:2, :2])[1]), 0.0))

    @property
    def yaw_std(self) -> float:
        return math.sqrt(max(float(self.covariance[YAW, YAW]), 0.0))


class Step(NamedTuple):
    """A prediction: the new mean (14,), its Jacobian (14, 14), the noise it adds (14, 14)."""

    mean: Array
    jacobian: Array
    noise: Array


class MotionNoise(NamedTuple):
    """The parameters of these names, and the distance over which the errors of images fade."""

    slip_per_meter: float
    yaw_per_radian: float
    decorrelation_m: float


class Twist(NamedTuple):
    """An odometry reading with its variances: v m/s, omega rad/s."""

    v: float
    omega: float
    v_variance: float
    omega_variance: float

    @property
    def moves(self) -> bool:
        """Whether a robot of this twist does not stand."""
        return abs(self.v) >= STANDSTILL_SPEED or abs(self.omega) >= STANDSTILL_RATE

    @property
    def variances(self) -> Array:
        """Of v and omega (2,)."""
        return np.array(self[2:])


class Pace(NamedTuple):
    """Mean squares `v` and `omega` of this robot's changes of speed and turn rate in a second, over
    `seconds` of driving; `last` is the twist from which the next change counts.
    """

    stamp_ns: int = 0
    last: Twist | None = None
    v: float = 0.0
    omega: float = 0.0
    seconds: int = 0

    def after(self, stamp_ns: int, twist: Twist) -> Pace:
        """After a reading at a stamp. A robot that stands on, or after a silence, shows nothing."""
        elapsed_s = (stamp_ns - self.stamp_ns) * 1e-9
        last = self.last
        if last is not None and 0 <= elapsed_s < 1:
            return self
        anew = self._replace(stamp_ns=stamp_ns, last=twist)
        if last is None or not 1 <= elapsed_s < 2 or not (last.moves or twist.moves):
            return anew
        seconds = min(self.seconds + 1, CHANGES)
        v = self.v + ((twist.v - last.v) ** 2 / elapsed_s - self.v) / seconds
        omega = self.omega + ((twist.omega - last.omega) ** 2 / elapsed_s - self.omega) / seconds
        return anew._replace(v=v, omega=omega, seconds=seconds)

    @property
    def changes(self) -> Array:
        """Variances of the changes of speed and turn rate in a second (2,), with the prior."""
        observed = self.seconds * np.array([self.v, self.omega])
        return np.asarray((observed + PRIOR_CHANGE) / (self.seconds + 1))


def arc(yaw: float, v: float, omega: float, dt: float) -> tuple[Array, Array]:
    """The motion (3,) over dt, and its derivatives (3, 2) by v and omega; with s = sin(h) / h

    dx/dv = dt s cos(yaw + h)
    dx/domega = (dt / 2) (v dt ds/dh cos(yaw + h) - c sin(yaw + h)),    ds/dh = (cos(h) - s) / h

    and the same for y with sin for cos and cos for -sin.
    """
    half = omega * dt / 2
    if abs(half) < _STRAIGHT_RAD:
        sinc = 1 - half * half / 6
        slope = -half / 3
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / half
    ahead = np.array([math.cos(yaw + half), math.sin(yaw + half)])
    across = np.array([-ahead[1], ahead[0]])
    by_twist = np.zeros((3, 2))
    by_twist[:2, 0] = dt * sinc * ahead
    by_twist[:2, 1] = v * dt * dt / 2 * (slope * ahead + sinc * across)
    by_twist[2, 1] = dt
    return np.array([*(v * dt * sinc * ahead), omega * dt]), by_twist


def drive(
    mean: Array, twist: Twist, dt: float, noise: MotionNoise, now: Twist | None = None
) -> Step:
    """Move by odometry: `twist`, held over the last `dt` seconds. It becomes the state's v and
    omega, or the twist of `now` does.

    The columns of the old v and omega in the Jacobian vanish; those of the odometry's errors follow
    by the chain rule from v' and omega'. Each reading adds noise of its variance in the same way.
    """
    if not twist.moves:
        return _stand(mean)
    by_errors = _by_errors(mean, twist)
    v, omega = (twist[:2] + by_errors @ mean[BIAS:DELAY]).tolist()
    step = _advance(mean, v, omega, twist, dt, noise)
    by_twist = step.jacobian[:BIAS, V:BIAS].copy()
    step.jacobian[:BIAS, V:BIAS] = 0.0
    step.jacobian[:BIAS, BIAS:DELAY] = by_twist @ by_errors
    step.noise[:BIAS, :BIAS] += by_twist * twist.variances @ by_twist.T
    if now is not None:
        by_errors = _by_errors(mean, now)
        step.mean[V:BIAS] = now[:2] + by_errors @ mean[BIAS:DELAY]
        step.jacobian[V:BIAS, BIAS:DELAY] = by_errors
    return step


def _by_errors(mean: Array, twist: Twist) -> Array:
    """Derivatives (2, 5) of speed and turn rate by BIAS to OFFSET, in which they are linear."""
    by_loss = offset = 0.0
    # A loss slows a robot down, but turns no motion around; what turns on the spot does not drive.
    # test_a_loss_in_turns_slows_the_robot_and_never_turns_it_around
    if abs(twist.v) > max(SPOT_RADIUS_M, 2 * abs(float(mean[LOSS]))) * abs(twist.omega):
        by_loss = -math.copysign(abs(twist.omega), twist.v)
        offset = 1.0
    rows = [0.0, twist.v, by_loss, 0.0, offset], [-1.0, 0.0, 0.0, twist.omega, 0.0]
    return np.array(rows)


def coast(mean: Array, twist: Twist, dt: float, noise: MotionNoise, changes: Array) -> Step:
    """Move on without new odometry: v and omega stay, and become less certain (CTRV). The pose
    gets a third of the variance of their random walk, and half of it in common with them.

    `twist` is the last reading, whose noise still counts; `changes` are those of `Pace`.
    """
    v = float(mean[V])
    omega = float(mean[OMEGA])
    standing = v == 0.0 and omega == 0.0
    step = _stand(mean) if standing else _advance(mean, v, omega, twist, dt, noise)
    by_twist = step.jacobian[:3, V:BIAS]
    walk = np.diag(changes * dt)
    step.noise[:3, :3] += by_twist @ walk @ by_twist.T / 3
    step.noise[:3, V:BIAS] += by_twist @ walk / 2
    step.noise[V:BIAS, :3] += walk @ by_twist.T / 2
    step.noise[V:BIAS, V:BIAS] += walk
    return step


def halt(mean: Array, twist: Twist, dt: float, noise: MotionNoise, changes: Array) -> Step:
    """Expect no motion, but allow for the last `twist`, or for what `changes` (2,) have led to."""
    step = _stand(mean)
    speed, rate = np.maximum(np.square(twist[:2]), changes).tolist()
    step.noise[[X, Y, V], [X, Y, V]] += speed * np.array([2 * dt, 2 * dt, 1.0])
    step.noise[[YAW, OMEGA], [YAW, OMEGA]] += rate * np.array([dt, 1.0])
    return step


def _stand(mean: Array) -> Step:
    """The wheels stand: nothing moves, and nothing becomes less certain."""
    after = mean.copy()
    jacobian = np.eye(SIZE)
    noise = np.zeros((SIZE, SIZE))
    after[V:BIAS] = 0.0
    jacobian[V:BIAS, V:BIAS] = 0.0
    noise[V:BIAS, V:BIAS] = _HELD_VARIANCE * np.eye(2)
    return Step(after, jacobian, noise)


def _advance(
    mean: Array, v: float, omega: float, twist: Twist, dt: float, noise: MotionNoise
) -> Step:
    """CTRV at v and omega over dt: mean, full Jacobian, and the noise of driving itself: slip, the
    random walks of BIAS to ERROR, and errors of readings.
    """
    moved, by_twist = arc(mean[YAW], v, omega, dt)
    meters = abs(v) * dt
    radians = abs(omega) * dt
    fade = math.exp(-(meters + TURN_RADIUS_M * radians) / noise.decorrelation_m)
    kept = np.ones(SIZE)
    kept[ERROR:] = fade
    after = kept * mean
    after[:3] += moved
    after[YAW] = wrap_angle(after[YAW])
    after[V:BIAS] = v, omega
    jacobian = np.diag(kept)
    jacobian[:2, YAW] = -moved[1], moved[0]
    jacobian[:3, V:BIAS] = by_twist
    slip = noise.slip_per_meter**2 * meters
    yaw = YAW_PER_METER**2 * meters + noise.yaw_per_radian**2 * radians
    walks = WALKS * [dt, meters, radians, radians, dt, dt]
    added = np.diag([slip, slip, yaw, 0, 0, *walks, *[1 - fade * fade] * 3])
    # Readings err alike for a while, which does not average out with the rate of the messages: over
    # dt it moves the pose as a constant error of variance (variance * time / dt) would.
    # test_errors_of_readings_do_not_average_out_with_the_rate_of_messages
    if dt > 0:
        lasting = ODOMETRY_CORRELATION_S / dt * twist.variances
        added[:3, :3] += by_twist * lasting @ by_twist.T
    return Step(after, jacobian, added)


def velocity(mean: Array) -> Array:
    """Of x m/s, y m/s and yaw rad/s (3,)."""
    yaw, v, omega = mean[YAW:BIAS].tolist()
    return np.array([v * math.cos(yaw), v * math.sin(yaw), omega])
