# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Steps of the odometry that no robot can make: one rule for training and for the live filter.

A step is a break where no speed before or after it explains it: it ends farther than `tolerance`
from where each of them leads (`beyond`). Causes are wheel ticks that jump, a driver that restarts
and a robot that was carried; the motion between the two poses is then unknown. Where a later step
leads back, the messages between are beside the path (`Paths`): a driver failed for a moment, or
there is a second publisher.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.geometry import Array, Mask

JUMP = 0.05
"""m or rad by which quantized and rounded poses may miss any speed."""
ACCELERATION = 5.0
RAMP_S = 0.2
"""Change of speed (m/s^2, rad/s^2) that wheels on the ground reach, and the time for which it may
act within a step: longer ramps appear in the speeds before and after."""
NOISE = 6.0
"""Standard deviations of the odometry's noise that a break exceeds as well."""
NOISE_START = 0.01
_NOISE_LEAST = 1e-3
_LEARNING = 0.1
"""m or rad: this noise before any message, and the least; relative change of it per message."""
RETURN_S = 0.5
"""Messages of a path pause for less: a driver that fails for longer breaks the path."""
_STALE_S = 0.2
"""Poses that are repeated, and messages that come in bundles, may be renewed as seldom as this."""
UNTURNED_RAD = 0.2
"""An orientation that is constant while the twist turns by this is not filled."""
FIRST_SPEED = 2.0
"""m/s at most of a robot that starts, where no twist says its speed."""
IN_TURN = 0.1
_MEMORY = 50
"""Share, among so many messages, of changes between two paths that move: 1 of two publishers that
alternate, 0.2 where one is nine times as fast, 0 of single faults, whose pose stands."""


def beyond(step: ArrayLike, seconds: ArrayLike, speeds: Sequence[ArrayLike]) -> Array:
    """The least distance (...) of steps (..., K) from where each of the speeds (..., K) leads.

    Steps are positions (K = 2, m) or headings (K = 1, rad, wrapped) in the frame of the robot
    before. `seconds` (...) is the longest time that a step may have taken: a robot may stop within
    it, and stamps may be late.
    """
    moved = np.asarray(step, float)
    longest_s = np.asarray(seconds, float)[..., None]
    distances = []
    for each in speeds:
        speed = np.asarray(each, float)
        square = np.maximum((speed**2).sum(-1, keepdims=True), 1e-12)
        time_s = np.clip((moved * speed).sum(-1, keepdims=True) / square, 0.0, longest_s)
        distances.append(np.linalg.norm(moved - speed * time_s, axis=-1))
    return np.asarray(np.min(distances, axis=0))


def tolerance(seconds: ArrayLike, noise: float) -> Array:
    """The largest distance (...) `beyond` any speed, m or rad, of possible steps of `seconds`.

    `noise` is the standard deviation of this odometry's steps, m or rad.
    """
    longest_s = np.asarray(seconds, float)
    return np.asarray(
        JUMP + ACCELERATION * np.minimum(longest_s, RAMP_S) * longest_s + NOISE * noise
    )


def learned(noise: float, distance: float) -> float:
    """The running 68 % quantile, `noise`, after another step at a distance `beyond` the speed."""
    return max(noise * math.exp(_LEARNING * (0.68 - (distance <= noise))), _NOISE_LEAST)


class _Message(NamedTuple):
    """A message: its number, and that of the first on its path; v m/s and omega rad/s. Its pose
    was `renewed_s` first; None before its path has moved."""

    path: int
    number: int
    seconds: float
    pose: Sequence[float]
    twist: tuple[float, float]
    renewed_s: float


class Paths:
    """Which path each message of odometry continues; single messages beside a path are faults.

    `noise` is the standard deviation of the steps, m or rad, which messages show by and by.
    """

    def __init__(self, noise: float = NOISE_START) -> None:
        self._ends: list[_Message] = []  # of the paths; that of the last message comes last
        self._fills_twist = False
        self._messages = 0
        self._returned = -1
        self.noise = noise
        self._share = 0.0
        self.aside = 0
        """Number of messages that the last one shows to be beside its path."""

    @property
    def in_turn(self) -> bool:
        """Whether messages lead along two paths in turn, as those of two publishers."""
        return self._share > IN_TURN

    def add(self, seconds: float, pose: Sequence[float], v: float, omega: float) -> int:
        """Take a message with a pose x m, y m, yaw rad; returns the number of its path."""
        ends = [end for end in self._ends if seconds - end.seconds < RETURN_S]
        self._fills_twist |= bool(v or omega)
        message = _Message(self._messages, self._messages, seconds, pose, (v, omega), seconds)
        self._messages = self._messages + 1
        self.aside = 0
        for end in reversed(ends):
            distance = _distance(end, message, self._fills_twist)
            if distance <= tolerance(seconds - end.seconds, self.noise):
                self.noise = learned(self.noise, distance)
                message = message._replace(path=end.path)
                if not self._fills_twist and end.pose == message.pose:
                    message = message._replace(renewed_s=end.renewed_s, twist=end.twist)
                elif not self._fills_twist:
                    message = message._replace(twist=_between(end, message))
                if end.pose != message.pose:
                    self._continued(end, message.number - end.number - 1)
                break
        self._ends = [*[end for end in ends if end.path != message.path][-2:], message]
        return message.path

    def _continued(self, end: _Message, others: int) -> None:
        """Take into account that a path goes on, after messages of others."""
        changed = others > 0 and self._returned != end.path
        self._share += (changed - self._share) / _MEMORY
        if others:
            self._returned = end.path
            self.aside = 0 if self.in_turn else others


def _between(end: _Message, message: _Message) -> tuple[float, float]:
    """Speed m/s and turn rate rad/s from the end of a path to a message, by their poses."""
    seconds = max(message.seconds - end.renewed_s, 1e-3)
    dx, dy, turn = (b - a for a, b in zip(end.pose, message.pose, strict=True))
    ahead = dx * math.cos(end.pose[2]) + dy * math.sin(end.pose[2])
    return ahead / seconds, math.remainder(turn, math.tau) / seconds


def _distance(end: _Message, message: _Message, fills_twist: bool) -> float:
    """How far a message, m or rad, is `beyond` the speeds from the end of a path: those of twists,
    or without any that between its last poses."""
    longest_s = message.seconds - end.renewed_s + _STALE_S
    twists = (end.twist, message.twist)
    if fills_twist:
        longest_s = message.seconds - end.seconds + _STALE_S
    elif end.twist == (0.0, 0.0):
        dx, dy = (b - a for a, b in zip(end.pose[:2], message.pose[:2], strict=True))
        return max(math.hypot(dx, dy) - FIRST_SPEED * longest_s, 0.0)
    dx, dy, turn = (b - a for a, b in zip(end.pose, message.pose, strict=True))
    c = math.cos(end.pose[2])
    s = math.sin(end.pose[2])
    turn = math.remainder(turn, math.tau)

    def missed(step: float, speed: float) -> float:
        return step - sorted((0.0, step, speed * longest_s))[1]

    moved = min(math.hypot(missed(dx * c + dy * s, v), dy * c - dx * s) for v, _ in twists)
    return max(moved, min(abs(missed(turn, omega)) for _, omega in twists))


class Orientation:
    """Whether the orientation of messages is filled: drivers leave it constant while the twist
    turns."""

    def __init__(self) -> None:
        self._seconds = 0.0
        self._yaw = math.nan
        self._changes = 0
        self._turned = 0.0

    @property
    def is_filled(self) -> bool:
        """Until the twist shows otherwise."""
        return self._changes > 1 or self._turned < UNTURNED_RAD

    def add(self, seconds: float, yaw: float, omega: float) -> None:
        """Take the next message."""
        self._changes += yaw != self._yaw  # also the first one
        self._turned += abs(omega) * sorted((0.0, seconds - self._seconds, RETURN_S))[1]
        self._seconds = seconds
        self._yaw = yaw


def beside(seconds: Array, poses: Array, twists: Array) -> tuple[Mask, float]:
    """Mask (N,) of messages that are beside a longer path, which others continue before and after
    them; and the share of messages at which two paths are driven in turn.

    `seconds` (N,) increase; `poses` (N, 3) are x m, y m, yaw rad, `twists` (N, 2) m/s and rad/s.
    """
    aside = np.zeros(len(poses), bool)
    path = np.zeros(len(poses), np.int64)
    noise = NOISE_START
    if not len(poses):
        return aside, 0.0
    for _ in range(2):  # the first time shows the noise
        paths = Paths(noise)
        in_turn = 0
        messages = zip(seconds.tolist(), poses.tolist(), *twists.T.tolist(), strict=True)
        for k, message in enumerate(messages):
            path[k] = paths.add(*message)
            in_turn += paths.in_turn
        noise = paths.noise
    order = np.argsort(path, kind='stable')
    of_path = np.split(order, np.flatnonzero(np.diff(path[order])) + 1)
    lengths = [float(np.hypot(*np.diff(poses[rows, :2], axis=0).T).sum()) for rows in of_path]
    for _, rows in sorted(zip(lengths, of_path, strict=True), key=lambda each: -each[0]):
        if not aside[rows].any():
            between = slice(rows[0], rows[-1])
            aside[between] |= path[between] != path[rows[0]]
    return aside, in_turn / len(poses)
