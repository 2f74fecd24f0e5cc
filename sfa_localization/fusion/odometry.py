# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What two odometry messages show of the motion between them.

Publishers differ in the time over which they average their twist, bundle messages, or fall silent;
the pose in the message is unambiguous, unless it was reset or is not filled.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sfa_localization.data.odometry_steps import beyond, tolerance
from sfa_localization.fusion import motion
from sfa_localization.fusion.belief import Belief, Jump, Odometer, OdometryEvent
from sfa_localization.fusion.motion import Twist
from sfa_localization.fusion.track import Pose

ODOMETRY_TIMEOUT_S = 0.5
"""Odometry silent for longer is a gap: many times the period of any odometry."""
COAST_S = 2.0
"""Silence for which the last speed is assumed to go on: about how long robots keep a speed."""
_LEARNING, _LEAST_NOISE = 0.1, 1e-3
"""Relative change per message of the usual noise of steps, learned over about twenty; m or rad."""
_LONGEST_S = math.pi / motion.UNKNOWN_RATE
"""After a longer silence a robot may be headed anywhere: no step is impossible, and none is shown.
"""
_ROUNDED_M = 2e-3
"""A pose moves less than this sideways by its rounding."""
_JUMP = 0.05
"""More motion than twice that of the speed, and this, m or rad, took longer than stamps say."""


class Interval(NamedTuple):
    """The mean `twist` since the belief, the twist to go on with, `now`, and the mean turn rate
    `omega` since the message before.
    """

    twist: Twist
    now: Twist
    omega: float


def repeats(belief: Belief, event: OdometryEvent) -> bool:
    """Whether a message of a robot that moves repeats the position or the heading of the pose
    before: it is sent more often than its pose is renewed, and the next renewal counts the motion.
    """
    last, after = belief.odometry, event.pose
    before = last.suspect.pose if last.suspect else last.pose
    if before is None or after is None:
        return False
    moves = _moves(belief, event)
    same = before[:2] == after[:2], before[2] == after[2]
    return any(
        moving and equal and 0 <= event.stamp_ns - renewed_ns < ODOMETRY_TIMEOUT_S * 1e9
        for moving, equal, renewed_ns in zip(moves, same, last.renewed_ns, strict=True)
    )


def _moves(belief: Belief, event: OdometryEvent) -> tuple[bool, bool]:
    """Whether a robot drives and turns, by the twist of a message, or that of the poses before
    where messages fill none.
    """
    filled = belief.odometry.fills_twist or event.twist.v or event.twist.omega
    twist = event.twist if filled else belief.twist
    return abs(twist.v) > motion.STANDSTILL_SPEED, abs(twist.omega) > motion.STANDSTILL_RATE


def received(belief: Belief, event: OdometryEvent) -> Odometer:
    """What is remembered of the odometry after a message that is used."""
    last, before, after = belief.odometry, belief.odometry.pose, event.pose
    if before is None or after is None:
        return last._replace(stamp_ns=event.stamp_ns, pose=after, suspect=None)
    changed = before[:2] != after[:2], before[2] != after[2]
    # A pose that was never renewed is not filled.
    position_ns, yaw_ns = (
        event.stamp_ns if new or (renewed_ns and not moving) else renewed_ns
        for new, moving, renewed_ns in zip(
            changed, _moves(belief, event), last.renewed_ns, strict=True
        )
    )
    filled = bool(event.twist.v or event.twist.omega)
    return Odometer(
        event.stamp_ns,
        after,
        (position_ns, yaw_ns),
        filled or (last.fills_twist and not any(changed)),
        _noise(belief, event),
        None,
        last.jump,
    )


def jump(belief: Belief, event: OdometryEvent) -> Jump | None:
    """The step to a pose that no robot makes, given the speed before it and, where the message
    before was suspected of it, that after it: see data.odometry_steps.
    """
    last, after = belief.odometry, event.pose
    if last.pose is None or after is None or _gives_way(belief, event):
        return None
    seconds = (event.stamp_ns - (last.stamp_ns or belief.stamp_ns)) * 1e-9
    if seconds > _LONGEST_S:
        return None
    beyond_m, beyond_rad = _beyond(belief, event)
    allowed = tolerance(seconds, last.noise)
    if max(beyond_m, beyond_rad) <= allowed:
        return None
    return Jump(event.stamp_ns, beyond_m, beyond_rad)


def interval(belief: Belief, event: OdometryEvent) -> Interval | None:
    """The motion that led to an odometry message; None after a silence, where nothing shows it."""
    reading, before = event.twist, belief.twist
    silence_s = (event.stamp_ns - (belief.odometry.stamp_ns or belief.stamp_ns)) * 1e-9
    shown = _shown(belief, event, silence_s)
    if belief.odometry.stamp_ns is None or silence_s <= ODOMETRY_TIMEOUT_S:
        whole = shown or reading
        now = _going_on(belief, whole, reading, silence_s)
        return Interval(_remaining(belief, event, whole), now, whole.omega)
    if shown is None and silence_s <= COAST_S:
        shown = _between(before, reading, silence_s)
    return shown and Interval(shown, reading, reading.omega)


def _between(a: Twist, b: Twist, seconds: float) -> Twist:
    """The mean twist over a silence of which nothing but both ends is known. The variance of a
    uniform distribution between them is their difference squared over 12; that of the mean of the
    random walk that joins them, CTRV's, is a twelfth of the walk's.
    """
    walk = motion.ACCELERATION**2 * seconds
    return Twist(
        (a.v + b.v) / 2,
        (a.omega + b.omega) / 2,
        max(a.v_variance, b.v_variance) + ((a.v - b.v) ** 2 + walk) / 12,
        max(a.omega_variance, b.omega_variance) + ((a.omega - b.omega) ** 2 + walk) / 12,
    )


def _shown(belief: Belief, event: OdometryEvent, seconds: float) -> Twist | None:
    """The mean twist since the last reading by the odometry's own poses, with the variances of the
    reading; None where they did not move, or more sideways than ahead: then position or heading are
    not filled.
    """
    before, after = belief.odometry.pose, event.pose
    if before is None or after is None or before == after or seconds <= 0:
        return None
    if seconds > _LONGEST_S or _gives_way(belief, event):
        return None
    turn, ahead, _ = _moved(before, after)
    return _twist(turn, ahead, seconds, event.twist)


def _gives_way(belief: Belief, event: OdometryEvent) -> bool:
    """Whether a pose gives way to the twist: it moves more sideways than ahead, which no robot on
    wheels does, or for the first time after twists that count already.
    """
    assert belief.odometry.pose is not None and event.pose is not None
    seconds = (event.stamp_ns - (belief.odometry.stamp_ns or belief.stamp_ns)) * 1e-9
    _, ahead, aside = _moved(belief.odometry.pose, event.pose)
    if not any(belief.odometry.renewed_ns) and (belief.twist.v or belief.twist.omega):
        return True
    drives = abs(event.twist.v) * seconds > abs(aside) / 2
    return seconds <= ODOMETRY_TIMEOUT_S and drives and abs(aside) > max(abs(ahead), _ROUNDED_M)


def _beyond(belief: Belief, event: OdometryEvent) -> tuple[float, float]:
    """How far, m and rad, the step to a message's pose lies beyond the speeds around it."""
    last, after = belief.odometry, event.pose
    assert last.pose is not None and after is not None
    seconds = max((event.stamp_ns - (last.stamp_ns or belief.stamp_ns)) * 1e-9, 0.0)
    turn, *way = _moved(last.pose, after)
    speeds, rates = [(belief.twist.v, 0.0)], [(belief.twist.omega,)]
    if last.suspect and last.suspect.pose and event.stamp_ns > last.suspect.stamp_ns:
        step_s = (event.stamp_ns - last.suspect.stamp_ns) * 1e-9
        after_turn, ahead, aside = _moved(last.suspect.pose, after)
        speeds.append((ahead / step_s, aside / step_s))
        rates.append((after_turn / step_s,))
    return float(beyond(way, seconds, speeds)), float(beyond([turn], seconds, rates))


def _noise(belief: Belief, event: OdometryEvent) -> float:
    """The running 68 % quantile of what steps are beyond the speed: their standard deviation."""
    noise = belief.odometry.noise
    below = max(_beyond(belief, event)) <= noise
    return max(noise * math.exp(_LEARNING * (0.68 - below)), _LEAST_NOISE)


def _going_on(belief: Belief, whole: Twist, reading: Twist, seconds: float) -> Twist:
    """The twist after an interval: the reading, or, where that is not filled, what the poses show:
    little of it in messages stamped almost together.
    """
    if whole is reading or reading.v or reading.omega:
        return reading
    before, new = belief.twist, -math.expm1(-seconds / ODOMETRY_TIMEOUT_S)
    v, omega = whole.v - before.v, whole.omega - before.omega
    return whole._replace(v=before.v + new * v, omega=before.omega + new * omega)


def _remaining(belief: Belief, event: OdometryEvent, whole: Twist) -> Twist:
    """The mean twist by the odometry's poses since the belief: images have claimed the begin of the
    interval, and were fused where the last twist led.
    """
    if whole is event.twist or belief.odometry.pose is None or event.pose is None:
        return whole
    coasted_s = (belief.stamp_ns - (belief.odometry.stamp_ns or belief.stamp_ns)) * 1e-9
    left_s = (event.stamp_ns - belief.stamp_ns) * 1e-9
    if coasted_s <= 0 or left_s <= 0:
        return whole
    x, y, yaw = belief.odometry.pose
    way = motion.arc(yaw, belief.twist.v, belief.twist.omega, coasted_s)
    turn, ahead, _ = _moved((x + way.dx, y + way.dy, yaw + way.dyaw), event.pose)
    return _twist(turn, ahead, left_s, whole)


def _moved(before: Pose, after: Pose) -> tuple[float, float, float]:
    """How far a pose turned, and lies ahead and to the left, by the mean of both headings."""
    turn = motion.wrap(after[2] - before[2])
    c, s = math.cos(before[2] + turn / 2), math.sin(before[2] + turn / 2)
    dx, dy = after[0] - before[0], after[1] - before[1]
    return turn, dx * c + dy * s, dy * c - dx * s


def _twist(turn: float, chord: float, seconds: float, reading: Twist) -> Twist:
    """The mean twist of a motion, with the variances of a reading."""
    half = turn / 2
    arc = chord * (half / math.sin(half) if half else 1.0)
    return reading._replace(v=arc / seconds, omega=turn / seconds)


def stalled(before: Belief, after: Belief, taken_ns: int, stamp_ns: int) -> bool:
    """Whether the odometry between two stamps shows far more motion than it takes, after a silence
    in which it shows far less, as where a network that stalled hands over all at once.
    """
    if after.odometry.stamp_ns is None or after.odometry.stamp_ns <= taken_ns:
        return False
    seconds, silent_s = (stamp_ns - taken_ns) * 1e-9, (taken_ns - before.stamp_ns) * 1e-9
    moved = math.dist(before.dead_reckoned[:2], after.dead_reckoned[:2])
    turned = abs(motion.wrap(after.dead_reckoned[2] - before.dead_reckoned[2]))
    pairs = (moved, before.twist.v, after.twist.v), (turned, before.omega, after.omega)
    return any(
        way > 2 * max(abs(a), abs(b)) * seconds + _JUMP or abs(a) * silent_s > way + _JUMP
        for way, a, b in pairs
    )
