# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Steps of the odometry that no robot can make: one rule for training and for the live filter.

A step is a break where no speed before or after it explains it: it ends farther than `tolerance`
from where each of them leads (`beyond`). Causes are wheel ticks that jump, a driver that restarts
and a robot that was carried; the motion between the two poses is then unknown.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sfa_localization.data.geometry import Array

JUMP = 0.05
"""m or rad by which quantized and rounded poses may miss any speed."""
ACCELERATION, RAMP_S = 5.0, 0.2
"""Change of speed (m/s^2, rad/s^2) that wheels on the ground reach, and the time for which it may
act within a step: longer ramps appear in the speeds before and after."""
NOISE = 6.0
"""Standard deviations of the odometry's noise that a break exceeds as well."""


def beyond(step: ArrayLike, seconds: ArrayLike, speeds: Sequence[ArrayLike]) -> Array:
    """The least distance (...) of steps (..., K) from where each of the speeds (..., K) leads.

    Steps are positions (K = 2, m) or headings (K = 1, rad, wrapped) in the frame of the robot
    before. `seconds` (...) is the longest time that a step may have taken: a robot may stop within
    it, and stamps may be late.
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
    """The largest distance (...) `beyond` any speed, m or rad, of possible steps of `seconds`.

    `noise` is the standard deviation of this odometry's steps, m or rad.
    """
    longest_s = np.asarray(seconds, float)
    return np.asarray(
        JUMP + ACCELERATION * np.minimum(longest_s, RAMP_S) * longest_s + NOISE * noise
    )
