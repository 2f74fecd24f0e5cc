# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which steps between two poses of odometry no robot makes: the same rule in training and live.

A step is a break where none of the speeds around it explains it: it lies farther than `tolerance`
from where every one of them leads (`beyond`). Wheel ticks that jump, a driver that starts anew and
a robot that was carried look so; nothing is assumed of the motion between the two poses then.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.geometry import Array

JUMP = 0.05
"""m or rad that quantized and rounded poses may move beyond any speed."""
ACCELERATION, RAMP_S = 5.0, 0.2
"""Change of speed (m/s^2, rad/s^2) that wheels on the ground reach, and the time for which it may
act unseen, which changes the speed by 1 m/s: longer ramps appear in the speeds around."""
NOISE = 6.0
"""Standard deviations of the odometry's usual noise that a break exceeds, too."""


def beyond(step: ArrayLike, seconds: ArrayLike, speeds: Sequence[ArrayLike]) -> Array:
    """How far (...) steps (..., K) lie from where each of some speeds (..., K) leads, the least.

    Positions (K = 2, m) and headings (K = 1, rad, wrapped) are judged apart, in the frame of the
    robot before the step. `seconds` (...) is the longest time that a step may have taken: a robot
    may stop within it, and stamps may be late.
    """
    moved, longest_s = np.asarray(step, float), np.asarray(seconds, float)[..., None]
    distances = []
    for each in speeds:
        speed = np.asarray(each, float)
        square = np.maximum((speed**2).sum(-1, keepdims=True), 1e-12)
        time_s = np.clip((moved * speed).sum(-1, keepdims=True) / square, 0.0, longest_s)
        distances.append(np.linalg.norm(moved - speed * time_s, axis=-1))
    return np.asarray(np.min(distances, axis=0))


def tolerance(seconds: ArrayLike, noise: float) -> Array:
    """What steps of these `seconds` (...) may be `beyond` their speeds, m or rad (...).

    `noise` is the standard deviation, m or rad, by which this odometry's steps usually are.
    """
    longest_s = np.asarray(seconds, float)
    return np.asarray(
        JUMP + ACCELERATION * np.minimum(longest_s, RAMP_S) * longest_s + NOISE * noise
    )
