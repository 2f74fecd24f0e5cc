# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far an estimate can be trusted, in words: the one place that decides the level."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfa_localization.data.rig import UNKNOWN_YAW_STD
from sfa_localization.fusion.belief import ENOUGH_IMAGES, Belief
from sfa_localization.fusion.health import Health
from sfa_localization.fusion.motion import State
from sfa_localization.fusion.odometry import ODOMETRY_TIMEOUT_S
from sfa_localization.fusion.relocation import FEW_IMAGES
from sfa_localization.fusion.settings import FilterConfig

LEAST_SILENCE_S = 1.4
MOST_SILENCE_S = 3.0
PERIODS = 1.25
"""Images are reported missing after 1.25 usual periods, within these limits: without images nothing
shows that the robot is carried away."""
DEGRADED_YAW_RAD = 0.2
"""A heading with a larger standard deviation leads the robot a meter astray within a few."""


class Level(enum.Enum):
    """How far the estimate can be trusted."""

    UNINITIALISED = 0
    LOCALISED = 1
    DEGRADED = 2
    LOST = 3


@dataclass(frozen=True, slots=True)
class Status:
    """The level and why it is not better."""

    level: Level
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        """As on ekf/state."""
        reasons = '; '.join(self.reasons)
        return f'{self.level.name}: {reasons}' if reasons else self.level.name

    def with_reasons(self, lost: Sequence[str], degraded: Sequence[str]) -> Status:
        """Add reasons and lower the level; UNINITIALISED stays."""
        level = Level.LOST if lost else Level.DEGRADED if degraded else Level.LOCALISED
        if self.level is Level.UNINITIALISED or self.level.value > level.value:
            level = self.level
        return Status(level, (*lost, *self.reasons, *degraded))

    def because(self, reason: str) -> Status:
        """With this reason first, and DEGRADED at best."""
        return Status(self.with_reasons([], [reason]).level, (reason, *self.reasons))


def status_of(belief: Belief, state: State | None, health: Health, config: FilterConfig) -> Status:
    """The status of a belief with this state and health."""
    memory = belief.memory
    if state is None:
        no_odometry = belief.odometry.stamp_ns is None
        missing = 'no odometry and no images yet' if no_odometry else 'no usable image yet'
        moving = 'images show no heading yet: drive on'
        return Status(Level.UNINITIALISED, (moving if memory.images else missing,))
    lost = uncertainty(state, config)
    uncertain = _larger_stds(state, config.degraded_std, DEGRADED_YAW_RAD)
    degraded = [reason for reason in uncertain if reason not in lost] + health.problems
    # An estimate that rests on one or two images is doubted by the first that contradicts it.
    if memory.rejected >= ENOUGH_IMAGES:
        lost.append(f'{memory.rejected} images in a row contradict the estimate')
    elif memory.rejected >= (FEW_IMAGES if memory.support >= FEW_IMAGES else 1):
        degraded.append(f'{memory.rejected} images in a row did not match')
    return Status(Level.LOCALISED).with_reasons(lost, degraded + _silences(belief))


def uncertainty(state: State, config: FilterConfig) -> list[str]:
    """Why a state is LOST by its standard deviations alone."""
    return _larger_stds(state, config.lost_std, config.lost_yaw_std)


def _larger_stds(state: State, std_m: float, std_rad: float) -> list[str]:
    reasons = []
    if state.position_std > std_m:
        reasons.append(f'position known to {state.position_std:.1f} m only')
    if state.yaw_std >= max(std_rad, UNKNOWN_YAW_STD):
        reasons.append('heading unknown')
    elif state.yaw_std > std_rad:
        reasons.append(f'heading known to {math.degrees(state.yaw_std):.0f} deg only')
    return reasons


def _silences(belief: Belief) -> list[str]:
    reasons = []
    memory = belief.memory
    odometry = belief.odometry
    jump = odometry.jump
    if jump and jump.stamp_ns > (memory.accepted_ns or 0):
        size = f'{jump.way_m:.1f} m and {math.degrees(jump.turn_rad):.0f} deg'
        reasons.append(f'odometry jumped by {size}: no image has confirmed the pose since')
    if memory.accepted_ns is None:
        reasons.append('no image has confirmed the start yet')
    else:
        images_s = (belief.stamp_ns - memory.accepted_ns) * 1e-9
        if images_s > silence_limit_s([fix.stamp_ns for fix in memory.images]):
            fits = 'fitting' if memory.rejected else 'usable'
            reasons.append(f'no {fits} image for {images_s:.0f} s')
    if odometry.stamp_ns is None:
        reasons.append('no odometry')
    else:
        odometry_s = (belief.stamp_ns - odometry.stamp_ns) * 1e-9
        if odometry_s > ODOMETRY_TIMEOUT_S:
            reasons.append(f'no odometry for {odometry_s:.1f} s')
    return reasons


def silence_limit_s(stamps_ns: Sequence[int]) -> float:
    """Time without an accepted image after which it is missed, by the stamps of the images."""
    period_s = float(np.median(np.diff(stamps_ns[-6:]))) * 1e-9 if len(stamps_ns) > 1 else 0.0
    return min(max(PERIODS * period_s, LEAST_SILENCE_S), MOST_SILENCE_S)
