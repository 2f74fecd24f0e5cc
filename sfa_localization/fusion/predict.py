# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Predict: from a belief to that at a later stamp, with new odometry or without."""

from __future__ import annotations

import math

from sfa_localization.fusion import motion
from sfa_localization.fusion.belief import Belief, OdometryEvent, capped
from sfa_localization.fusion.driven_path import extended
from sfa_localization.fusion.kalman import Kalman
from sfa_localization.fusion.motion import SIZE, MotionNoise, Step, Twist

ODOMETRY_TIMEOUT_S = 0.5
"""Odometry silent for longer is a gap: many times the period of any odometry."""
COAST_S = 2.0
"""Silence for which the last speed is assumed to go on: about how long robots keep a speed."""
_BRIDGED_S = 10.0
"""A longer silence is not bridged by the twist after it: most of it was spent somehow else."""
_STALL_S = 0.5
"""Motion that odometry's poses show between messages stamped almost together, as after a stall of
the network, took about so long at most."""
_SUDDEN_V, _SUDDEN_OMEGA = 0.3, 0.3
"""A mean twist between two poses that differs from the reading by more than the reading itself and
this, m/s and rad/s, was faster or slower only by its stamps."""


class Prediction:
    """Moves beliefs on in time by the CTRV model of `motion`."""

    def __init__(self, noise: MotionNoise, kalman: Kalman) -> None:
        self._noise = noise
        self._kalman = kalman

    def drive(self, belief: Belief, event: OdometryEvent) -> Belief:
        """The belief after an odometry reading, which held since the one before it."""
        if belief.odometry_ns is None and belief.stamp_ns == 0:
            return belief._replace(
                stamp_ns=event.stamp_ns,
                twist=event.twist,
                odometry_ns=event.stamp_ns,
                odometry_pose=event.pose,
            )
        silence_s = (event.stamp_ns - (belief.odometry_ns or belief.stamp_ns)) * 1e-9
        if silence_s > _BRIDGED_S:
            belief = self.coast(belief, event.stamp_ns)
        gap = belief.odometry_ns is not None and silence_s > ODOMETRY_TIMEOUT_S
        dt = (event.stamp_ns - belief.stamp_ns) * 1e-9
        whole, shown, now = event.twist, False, None
        if gap:
            twist, shown = _bridged(belief, event, silence_s)
        else:
            whole = _shown(belief, event, silence_s, event.twist) or event.twist
            twist = _remaining(belief, event, whole, dt)
            now = _lately(belief, whole, event.twist, silence_s)
            event = event._replace(twist=now)
        factor, noise = belief.turn_factor, self._noise
        if factor != 1.0:
            twist = twist._replace(omega_variance=twist.omega_variance * factor**2)
            noise = noise._replace(yaw_per_radian=noise.yaw_per_radian * factor)
        step = motion.drive(belief.mean, twist, dt, noise, now)
        if silence_s > COAST_S and not shown:
            motion.add_unknown_motion(step.noise, twist, min(dt, silence_s - COAST_S))
        driven = self._moved(belief, event.stamp_ns, step, event, whole.omega)
        if silence_s > ODOMETRY_TIMEOUT_S:
            # What the robot did meanwhile is unknown: its path begins anew.
            late, trail = driven.lateness, ((event.stamp_ns, *driven.dead_reckoned),)
            late = late and late._replace(broken=True)
            driven = driven._replace(trail=trail, lateness=late)
        return driven

    def coast(self, belief: Belief, stamp_ns: int) -> Belief:
        """The belief at a later stamp without new odometry: at the last speed, then unknown."""
        if belief.stamp_ns == 0:
            return belief._replace(stamp_ns=stamp_ns)
        coasted_ns = belief.stamp_ns
        if belief.odometry_ns is not None:
            coasted_ns = max(coasted_ns, belief.odometry_ns + round(COAST_S * 1e9))
        end_ns = min(stamp_ns, coasted_ns)
        if end_ns > belief.stamp_ns:
            dt = (end_ns - belief.stamp_ns) * 1e-9
            step = motion.coast(belief.mean, belief.twist, dt, self._noise)
            belief = self._moved(belief, end_ns, step)
        if stamp_ns > belief.stamp_ns:
            dt = (stamp_ns - belief.stamp_ns) * 1e-9
            step = motion.halt(belief.mean, belief.twist, dt, self._noise)
            belief = self._moved(belief, stamp_ns, step)
            belief = belief._replace(covariance=capped(belief.covariance))
        return belief

    def _moved(
        self,
        belief: Belief,
        stamp_ns: int,
        step: Step,
        event: OdometryEvent | None = None,
        omega: float = 0.0,
    ) -> Belief:
        """Apply a prediction to mean, covariance, dead reckoning and the distance traveled."""
        before_x, before_y, before_yaw = belief.mean[:3].tolist()
        after_x, after_y, after_yaw = step.mean[:3].tolist()
        dx, dy = after_x - before_x, after_y - before_y
        x, y, yaw = belief.dead_reckoned
        c, s = math.cos(yaw - before_yaw), math.sin(yaw - before_yaw)
        turned = motion.wrap(yaw + after_yaw - before_yaw)
        reckoned = (x + c * dx - s * dy, y + s * dx + c * dy, turned)
        located = belief.located
        # Positional, and not _replace, which would cost half as much as the arithmetic above.
        return Belief(
            stamp_ns,
            step.mean,
            self._kalman.predicted(belief, step) if located else belief.covariance,
            located,
            reckoned,
            belief.traveled_m + math.hypot(dx, dy),
            event.twist if event else belief.twist,
            event.stamp_ns if event else belief.odometry_ns,
            belief.memory,
            event.pose if event else belief.odometry_pose,
            self._added(belief, step),
            belief.turns,
            belief.turn_factor,
            extended(belief.trail, (stamp_ns, *reckoned)),
            belief.lateness,
            belief.mounting,
            omega if event else belief.omega,
        )

    @staticmethod
    def _added(belief: Belief, step: Step) -> tuple[float, float]:
        """Without the motion that a turn of the heading adds to the position: it is small."""
        yaw, variance = belief.added
        noise = step.noise
        x, y, turned = noise.item(0), noise.item(SIZE + 1), noise.item(2 * SIZE + 2)
        return yaw + turned / belief.turn_factor**2, variance + (x + y) / 2


def _shown(belief: Belief, event: OdometryEvent, seconds: float, fastest: Twist) -> Twist | None:
    """The mean twist since the last reading by the odometry's own poses, where it is possible."""
    before, after = belief.odometry_pose, event.pose
    if before is None or after is None:
        return None
    if seconds <= ODOMETRY_TIMEOUT_S and motion.is_askew(before, after, seconds, event.twist):
        return None
    return motion.twist_from_poses(before, after, seconds, fastest)


def _remaining(belief: Belief, event: OdometryEvent, whole: Twist, dt: float) -> Twist:
    """The mean twist by the odometry's poses over the last `dt` s of an interval, of which images
    have claimed the begin: they were fused where the last twist led.
    """
    if whole is event.twist or belief.odometry_pose is None or event.pose is None:
        return whole
    coasted_s = (belief.stamp_ns - (belief.odometry_ns or belief.stamp_ns)) * 1e-9
    if coasted_s <= 0 or dt <= 0:
        return whole
    reached = motion.moved_on(belief.odometry_pose, belief.twist, coasted_s)
    return motion.twist_between(reached, event.pose, dt, whole)


def _lately(belief: Belief, whole: Twist, reading: Twist, seconds: float) -> Twist:
    """The twist to go on with after an interval: messages stamped almost together, or long after
    each other, show no speed, but their readings do, unless they are not filled.
    """
    sudden_v = abs(whole.v - reading.v) > abs(reading.v) + _SUDDEN_V
    sudden_omega = abs(whole.omega - reading.omega) > abs(reading.omega) + _SUDDEN_OMEGA
    if not (sudden_v or sudden_omega):
        return whole
    if reading.v or reading.omega:
        return reading
    before, new = belief.twist, -math.expm1(-seconds / _STALL_S)
    return whole._replace(
        v=before.v + new * (whole.v - before.v),
        omega=before.omega + new * (whole.omega - before.omega),
    )


def _bridged(belief: Belief, event: OdometryEvent, seconds: float) -> tuple[Twist, bool]:
    """The mean motion over a gap, and whether the odometry's own poses show it.

    Else nothing but both ends of it is known. The variance of a uniform distribution between them
    is their difference squared over 12; that of the mean of the random walk that joins them,
    CTRV's, is a twelfth of the walk's.
    """
    a, b = belief.twist, event.twist
    variances = max(a.v_variance, b.v_variance), max(a.omega_variance, b.omega_variance)
    mean = Twist((a.v + b.v) / 2, (a.omega + b.omega) / 2, *variances)
    v = max(abs(a.v), abs(b.v), motion.UNKNOWN_SPEED)
    omega = max(abs(a.omega), abs(b.omega), motion.UNKNOWN_RATE)
    shown = _shown(belief, event, seconds, Twist(v, omega, *variances))
    if shown is not None:
        # What the readings do not expect may be a reset of the pose.
        surprise = (shown.v - mean.v) / 2, (shown.omega - mean.omega) / 2
        return _wider(shown, surprise[0] ** 2, surprise[1] ** 2), True
    v_variance = (a.v - b.v) ** 2 + motion.ACCELERATION**2 * seconds
    omega_variance = (a.omega - b.omega) ** 2 + motion.ANGULAR_ACCELERATION**2 * seconds
    return _wider(mean, v_variance / 12, omega_variance / 12), False


def _wider(twist: Twist, v_variance: float, omega_variance: float) -> Twist:
    return twist._replace(v_variance=twist.v_variance + v_variance,
                          omega_variance=twist.omega_variance + omega_variance)  # fmt: skip
