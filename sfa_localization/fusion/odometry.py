# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The motion between two odometry messages.

Publishers differ in the time over which they average their twist, bundle messages, or fall silent;
the pose in the message is unambiguous, unless it was reset or is not filled.
"""

from __future__ import annotations

import math

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.odometry_steps import beyond, learned, tolerance
from sfa_localization.fusion import motion
from sfa_localization.fusion.belief import Belief, Jump, Odometer, OdometryEvent, Pose
from sfa_localization.fusion.motion import Twist

ODOMETRY_TIMEOUT_S = 0.5
COAST_S = 2.0
"""Odometry silent for longer is a gap: many times the period of any odometry. The last speed is
assumed to go on for 2 s: about how long robots keep a speed."""
_LONGEST_S = 2 * math.pi  # of a silence: at half a radian a second any heading is possible
_JUMP = 0.05  # m or rad: motion beyond twice the speed by more took longer than stamps say
_ROUNDED_M = 2e-3  # a pose moves less sideways by its rounding


def repeats(belief: Belief, event: OdometryEvent) -> bool:
    """Whether a message of a moving robot repeats the pose before it: such odometry is sent more
    often than its pose is renewed, and the next renewal includes the motion.
    """
    last = belief.odometry
    before = last.suspect.pose if last.suspect else last.pose
    unchanged_s = (event.stamp_ns - last.renewed_ns) * 1e-9
    return (
        before is not None
        and before == event.pose
        and _moves(belief, event)
        and 0 <= unchanged_s < ODOMETRY_TIMEOUT_S
    )


def _moves(belief: Belief, event: OdometryEvent) -> bool:
    """Whether the robot moves by a message's twist, or by the poses before if none is filled."""
    filled = belief.odometry.fills_twist or event.twist.v or event.twist.omega
    return (event.twist if filled else belief.twist).moves


def received(belief: Belief, event: OdometryEvent) -> Odometer:
    """What is remembered of the odometry after a message that is used."""
    last = belief.odometry
    before = belief.odometry.pose
    after = event.pose
    if before is None or after is None:
        return last._replace(stamp_ns=event.stamp_ns, pose=after, suspect=None)
    changed = before != after
    renewed_ns = last.renewed_ns
    # A pose that never changed is not filled.
    if changed or (renewed_ns and not _moves(belief, event)):
        renewed_ns = event.stamp_ns
    filled = bool(event.twist.v or event.twist.omega) or (last.fills_twist and not changed)
    noise = learned(last.noise, max(_beyond(belief, event)))
    return Odometer(event.stamp_ns, after, renewed_ns, filled, noise, None, last.jump)


def silence_s(belief: Belief, event: OdometryEvent) -> float:
    """Seconds since the odometry's last message, or since the belief where there is none."""
    return (event.stamp_ns - (belief.odometry.stamp_ns or belief.stamp_ns)) * 1e-9


def jump(belief: Belief, event: OdometryEvent) -> Jump | None:
    """The step to a pose that no robot makes, given the speed before it and, where the message
    before was suspected of it, the speed after it: see data.odometry_steps.
    """
    last = belief.odometry
    seconds = silence_s(belief, event)
    if last.pose is None or event.pose is None or seconds > _LONGEST_S:
        return None
    beyond_m, beyond_rad = _beyond(belief, event)
    possible = max(beyond_m, beyond_rad) <= tolerance(seconds, last.noise)
    if possible or _is_sideways_or_first(belief, event):
        return None
    return Jump(event.stamp_ns, beyond_m, beyond_rad)


def interval(belief: Belief, event: OdometryEvent) -> tuple[Twist, Twist] | None:
    """Mean twist up to a message, and the twist from then on; None after silence without poses."""
    seconds = silence_s(belief, event)
    reading = event.twist
    mean = _mean_twist(belief, event, seconds)
    if belief.odometry.stamp_ns is not None and seconds > ODOMETRY_TIMEOUT_S:
        return mean and (mean, reading)
    if mean is None:
        return reading, reading
    if reading.v or reading.omega:
        return _remaining(belief, event, mean), reading
    # The twist is not filled. Messages stamped almost together show the way, but not the speed.
    before = belief.twist
    weight = -math.expm1(-seconds / ODOMETRY_TIMEOUT_S)
    v = before.v + weight * (mean.v - before.v)
    omega = before.omega + weight * (mean.omega - before.omega)
    return _remaining(belief, event, mean), mean._replace(v=v, omega=omega)


def _mean_twist(belief: Belief, event: OdometryEvent, seconds: float) -> Twist | None:
    """The mean twist since the last message by the poses; None where they do not show it."""
    before = belief.odometry.pose
    after = event.pose
    if before is None or after is None or before == after or not 0 < seconds <= _LONGEST_S:
        return None
    if _is_sideways_or_first(belief, event):
        return None
    return _twist_between(before, after, seconds, event.twist)


def _is_sideways_or_first(belief: Belief, event: OdometryEvent) -> bool:
    """Whether to trust the twist rather than the pose: the pose moves more sideways than ahead, or
    changes for the first time after twists were used.
    """
    assert belief.odometry.pose is not None and event.pose is not None
    # The first change: test_a_pose_that_is_repeated_adds_nothing[fresh-12]
    if not belief.odometry.renewed_ns and (belief.twist.v or belief.twist.omega):
        return True
    seconds = silence_s(belief, event)
    _, ahead, aside = _moved(belief.odometry.pose, event.pose)
    drives = abs(event.twist.v) * seconds > abs(aside) / 2
    return seconds <= ODOMETRY_TIMEOUT_S and drives and abs(aside) > max(abs(ahead), _ROUNDED_M)


def _beyond(belief: Belief, event: OdometryEvent) -> tuple[float, float]:
    """How far, m and rad, the step to a message's pose lies beyond the speeds around it."""
    last = belief.odometry
    after = event.pose
    assert last.pose is not None and after is not None
    seconds = max(silence_s(belief, event), 0.0)
    turn, *way = _moved(last.pose, after)
    speeds = [(belief.twist.v, 0.0)]
    rates = [(belief.twist.omega,)]
    if last.suspect and last.suspect.pose and event.stamp_ns > last.suspect.stamp_ns:
        step_s = (event.stamp_ns - last.suspect.stamp_ns) * 1e-9
        turn_after, ahead, aside = _moved(last.suspect.pose, after)
        speeds.append((ahead / step_s, aside / step_s))
        rates.append((turn_after / step_s,))
    return float(beyond(way, seconds, speeds)), float(beyond([turn], seconds, rates))


def _remaining(belief: Belief, event: OdometryEvent, mean: Twist) -> Twist:
    """The mean twist since the belief. An image within the interval was fused where the last twist
    led by then; the rest of the interval leads from there to the pose of the odometry.
    """
    # test_odometry_with_poses_may_be_stamped_irregularly[stalled]
    last = belief.odometry
    coasted_s = (belief.stamp_ns - (last.stamp_ns or belief.stamp_ns)) * 1e-9
    remaining_s = (event.stamp_ns - belief.stamp_ns) * 1e-9
    if coasted_s <= 0 or remaining_s <= 0 or last.pose is None or event.pose is None:
        return mean
    moved, _ = motion.arc(last.pose[2], belief.twist.v, belief.twist.omega, coasted_s)
    x, y, yaw = (moved + last.pose).tolist()
    return _twist_between((x, y, yaw), event.pose, remaining_s, mean)


def _moved(before: Pose, after: Pose) -> tuple[float, float, float]:
    """Turn and displacement (ahead, left) of a pose, in the frame of the mean of both headings."""
    turn = float(wrap_angle(after[2] - before[2]))
    c = math.cos(before[2] + turn / 2)
    s = math.sin(before[2] + turn / 2)
    dx = after[0] - before[0]
    dy = after[1] - before[1]
    return turn, dx * c + dy * s, dy * c - dx * s


def _twist_between(before: Pose, after: Pose, seconds: float, reading: Twist) -> Twist:
    """The mean twist of a motion, with the variances of a reading."""
    turn, chord, _ = _moved(before, after)
    half = turn / 2
    arc = chord * (half / math.sin(half) if half else 1.0)
    return reading._replace(v=arc / seconds, omega=turn / seconds)


def stalled(before: Belief, after: Belief, taken_ns: int, stamp_ns: int) -> bool:
    """Whether the odometry between two stamps shows far more motion than it takes, after a silence
    in which it shows far less: a network that stalled handed over all at once.
    """
    if after.odometry.stamp_ns is None or after.odometry.stamp_ns <= taken_ns:
        return False
    seconds = (stamp_ns - taken_ns) * 1e-9
    silent_s = (taken_ns - before.stamp_ns) * 1e-9
    turn, *way = _moved(before.dead_reckoned, after.dead_reckoned)
    driven = (math.hypot(*way), before.twist.v, after.twist.v)
    turned = (abs(turn), before.twist.omega, after.twist.omega)
    return any(
        moved > 2 * max(abs(a), abs(b)) * seconds + _JUMP or abs(a) * silent_s > moved + _JUMP
        for moved, a, b in (driven, turned)
    )
