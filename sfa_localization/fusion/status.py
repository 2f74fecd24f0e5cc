# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far an estimate can be trusted, in words: the one place that decides the level."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass

from sfa_localization.fusion.belief import ENOUGH_IMAGES, Belief
from sfa_localization.fusion.health import Health
from sfa_localization.fusion.motion import State
from sfa_localization.fusion.odometry import ODOMETRY_TIMEOUT_S
from sfa_localization.fusion.relocation import FEW_IMAGES
from sfa_localization.fusion.settings import FilterConfig

LEAST_SILENCE_S, MOST_SILENCE_S, PERIODS = 1.4, 3.0, 1.25
"""Images that stay away for longer than a period and a quarter are missed, within these limits:
meanwhile the robot may be towed, held or carried away, and nothing shows it."""
DEGRADED_YAW_RAD = 0.2
"""A heading with a larger standard deviation leads the robot a meter astray within a few."""
_UNKNOWN_YAW_RAD = math.pi / math.sqrt(3)  # of an angle of which nothing is known


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

    @classmethod
    def of(cls, lost: Sequence[str], degraded: Sequence[str]) -> Status:
        """That of reasons to be LOST, and to be DEGRADED."""
        level = Level.LOST if lost else Level.DEGRADED if degraded else Level.LOCALISED
        return cls(level, (*lost, *degraded))

    def with_reasons(self, lost: Sequence[str], degraded: Sequence[str]) -> Status:
        """With more reasons; no reason makes a filter that has not begun worse."""
        reasons = (*lost, *self.reasons, *degraded)
        if self.level is Level.UNINITIALISED:
            return Status(self.level, reasons)
        level = Status.of(lost, degraded).level
        return Status(max(level, self.level, key=lambda one: one.value), reasons)


def status_of(belief: Belief, state: State | None, health: Health, config: FilterConfig) -> Status:
    """The status of a belief with this state and health."""
    memory = belief.memory
    if state is None:
        return Status(Level.UNINITIALISED, (_missing(belief),))
    lost = uncertainty(state, config)
    found = _known_to(state, config.degraded_std, DEGRADED_YAW_RAD)
    degraded = [reason for reason in found if reason not in lost] + health.problems
    # An estimate that rests on one or two images is doubted by the first that contradicts it.
    if memory.rejected >= ENOUGH_IMAGES:
        lost.append(f'{memory.rejected} images in a row contradict the estimate')
    elif memory.rejected >= (FEW_IMAGES if memory.support >= FEW_IMAGES else 1):
        degraded.append(f'{memory.rejected} images in a row did not match')
    return Status.of(lost, degraded + _silences(belief))


def uncertainty(state: State, config: FilterConfig) -> list[str]:
    """Why a state is LOST by its standard deviations alone."""
    return _known_to(state, config.lost_std, config.lost_yaw_std)


def _known_to(state: State, std_m: float, std_rad: float) -> list[str]:
    reasons = []
    if state.position_std > std_m:
        reasons.append(f'position known to {state.position_std:.1f} m only')
    if state.yaw_std > std_rad:
        known = f'heading known to {math.degrees(state.yaw_std):.0f} deg only'
        reasons.append(known if state.yaw_std < _UNKNOWN_YAW_RAD else 'heading unknown')
    return reasons


def _missing(belief: Belief) -> str:
    if belief.memory.images:
        return 'images show no heading yet: drive on'
    return (
        'no odometry and no images yet'
        if belief.odometry.stamp_ns is None
        else 'no usable image yet'
    )


def _silences(belief: Belief) -> list[str]:
    reasons, memory = [], belief.memory
    images_s, odometry_s = (
        math.inf if last_ns is None else (belief.stamp_ns - last_ns) * 1e-9
        for last_ns in (memory.accepted_ns, belief.odometry.stamp_ns)
    )
    jump = belief.odometry.jump
    if jump and jump.stamp_ns > (memory.accepted_ns or 0):
        far = f'{jump.way_m:.1f} m and {math.degrees(jump.turn_rad):.0f} deg'
        reasons.append(f'odometry jumped by {far}: no image has confirmed the pose since')
    if memory.accepted_ns is None:
        reasons.append('no image has confirmed the start yet')
    elif images_s > silence_limit_s(memory.period_s):
        fits = 'fitting' if memory.rejected else 'usable'
        reasons.append(f'no {fits} image for {images_s:.0f} s')
    if belief.odometry.stamp_ns is None:
        reasons.append('no odometry')
    elif odometry_s > ODOMETRY_TIMEOUT_S:
        reasons.append(f'no odometry for {odometry_s:.1f} s')
    return reasons


def silence_limit_s(period_s: float) -> float:
    """Time without an accepted image after which it is missed, by the usual time between them."""
    return min(max(PERIODS * period_s, LEAST_SILENCE_S), MOST_SILENCE_S)
