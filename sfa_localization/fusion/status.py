# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far an estimate can be trusted, in words."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from sfa_localization.fusion.belief import Belief
from sfa_localization.fusion.camera_clock import CameraClock
from sfa_localization.fusion.consistency import LOST_M, LOST_RAD, doubts
from sfa_localization.fusion.evidence import ENOUGH_IMAGES, FEW_IMAGES
from sfa_localization.fusion.motion import State
from sfa_localization.fusion.predict import ODOMETRY_TIMEOUT_S
from sfa_localization.fusion.recover import DOUBT_STDS, IMAGE_TIMEOUT_S
from sfa_localization.fusion.settings import FilterConfig

FEW_PERIODS, LEAST_SILENCE_S, SILENT_M = 2.5, 1.5, 3.0
"""Images that stay away for so many of their usual periods are missed, but not before 1.5 s, in
which a robot goes about as many meters, or a fast one 3 m: meanwhile the robot may be towed, held
or carried away, and nothing shows it."""
MOST_SILENCE_S, ONE_PERIOD = 2.0, 1.25
"""They are missed after 2 s at the latest, those of a slow camera after a period and a quarter, and
after IMAGE_TIMEOUT_S in any case."""
NOTICED_S = 1.0
"""Images that contradict for so long are no outliers, however few: a jump is noticed by then."""
DEGRADED_YAW_RAD = 0.2
"""A heading with a larger standard deviation leads the robot a meter astray within a few."""
LOST_EXCESS, LOST_DISTANCE_M = 4.0, 0.5
"""ENOUGH_IMAGES in a row that contradict mean LOST where they lie outside the gate by this factor
on d2, or the robot has moved so far: standing, it may see one place where the map is wrong."""


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


def status_of(
    belief: Belief, clock: CameraClock, config: FilterConfig, delay_limit_ns: int
) -> Status:
    """The status of a belief; a camera whose delay is beyond the limit makes it DEGRADED."""
    state, memory = belief.state, belief.memory
    if state is None:
        return Status(Level.UNINITIALISED, (_missing(belief),))
    lost = uncertainty(state, config) + _contradictions(belief)
    degraded = _weakness(state, config) + _rejections(belief)
    # Only images confirm: what was driven since the last one, or before it came late, does not.
    degraded += doubts(memory.trust, memory.accepted_m, memory.pull)
    if belief.mounting is not None and belief.mounting.suspected:
        degraded.append(belief.mounting.problem)
    if belief.mounting is not None and belief.mounting.untested:
        degraded.append('the robot was moved, or the camera on it: turn, to show which')
    if belief.lateness is not None and belief.lateness.untested:
        degraded.append('nothing shows whether images are late: turn, or stop and start')
    degraded += _silences(belief, config)
    if abs(clock.delay_ns) > delay_limit_ns:
        late = 'late' if clock.delay_s > 0 else 'early'
        degraded.append(
            f'images are stamped {abs(clock.delay_s):.1f} s {late}: synchronize the clocks'
        )
    level = Level.LOST if lost else Level.DEGRADED if degraded else Level.LOCALISED
    return Status(level, (*lost, *degraded))


def _few(belief: Belief) -> int:
    """How many rejected images in a row are no outliers; of slow cameras the first counts."""
    memory = belief.memory
    lately = _silent_s(belief, memory.accepted_ns) < NOTICED_S
    return FEW_IMAGES if memory.support >= FEW_IMAGES and lately else 1


def uncertainty(state: State, config: FilterConfig) -> list[str]:
    """Why a state is LOST by its standard deviations alone."""
    reasons = []
    if state.position_std > config.lost_std:
        reasons.append(f'position known to {state.position_std:.1f} m only')
    if state.yaw_std > config.lost_yaw_std:
        reasons.append(_heading(state))
    return reasons


def _heading(state: State) -> str:
    return f'heading known to {math.degrees(state.yaw_std):.0f} deg only'


def _weakness(state: State, config: FilterConfig) -> list[str]:
    """Why a state is DEGRADED by its standard deviations alone."""
    reasons = []
    if config.degraded_std < state.position_std <= config.lost_std:
        reasons.append(f'position known to {state.position_std:.1f} m only')
    if DEGRADED_YAW_RAD < state.yaw_std <= config.lost_yaw_std:
        reasons.append(_heading(state))
    return reasons


def _rejections(belief: Belief) -> list[str]:
    """What the last images say, where they contradict the estimate or were not fused."""
    reasons, images, update = [], _unmatched(belief), belief.memory.update
    # An estimate that rests on one or two images is doubted by the first that contradicts it.
    if (update is not None and update.far) or images >= _few(belief):
        one = 'an image did not match'
        reasons.append(one if images <= 1 else f'{images} images in a row did not match')
    if update is not None and not update.accepted and update.d2 <= update.threshold:
        reasons.append('images lie far from the estimate: others must confirm them')
    return reasons


def _unmatched(belief: Belief) -> int:
    """How many images in a row did not match: lately or, where they were enough to overrule the
    estimate, until as many in a row match again.
    """
    rejected = belief.memory.rejected
    newest_first = groupby(item.accepted for item in reversed(belief.memory.evidence))
    runs = ((fits, len([*images])) for fits, images in newest_first)
    matching = next((count for fits, count in runs if fits), 0)
    _, before = next(runs, (False, 0))
    return max(rejected, before) if matching < ENOUGH_IMAGES <= before else rejected


def _missing(belief: Belief) -> str:
    if belief.memory.evidence:
        return 'images show no heading yet: drive on'
    return 'no odometry and no images yet' if belief.odometry_ns is None else 'no usable image yet'


def _contradictions(belief: Belief) -> list[str]:
    memory = belief.memory
    moved_m = belief.traveled_m - memory.accepted_m
    serious = memory.gate_excess > LOST_EXCESS or moved_m > LOST_DISTANCE_M
    off_m, _, off_rad = np.sqrt(memory.doubt) * DOUBT_STDS
    near = off_m <= LOST_M and off_rad <= LOST_RAD
    if memory.rejected < ENOUGH_IMAGES or near or not serious:
        return []
    return [f'{memory.rejected} images in a row contradict the estimate']


def silence_limit_s(period_s: float, moved_m: float) -> float:
    """Time without an accepted image after which it is missed, by the usual time between them and
    the distance traveled since the last one.
    """
    few_s = FEW_PERIODS * period_s
    patient_s = few_s if moved_m > SILENT_M else max(few_s, LEAST_SILENCE_S)
    return min(max(min(patient_s, MOST_SILENCE_S), ONE_PERIOD * period_s), IMAGE_TIMEOUT_S)


def _silent_s(belief: Belief, last_ns: int | None) -> float:
    """Time since the last of something; infinite where there was none."""
    return math.inf if last_ns is None else (belief.stamp_ns - last_ns) * 1e-9


def _silences(belief: Belief, config: FilterConfig) -> list[str]:
    reasons, memory = [], belief.memory
    moved_m = belief.traveled_m - memory.accepted_m
    limit_s, least_m = silence_limit_s(memory.period_s, moved_m), config.degraded_std
    images_s, odometry_s = (
        _silent_s(belief, last_ns) for last_ns in (memory.accepted_ns, belief.odometry_ns)
    )
    if memory.accepted_ns is None:
        reasons.append('no image has confirmed the start yet')
    elif images_s > limit_s:
        reasons.append(f'no usable image for {images_s:.0f} s')
    elif _silent_s(belief, memory.precise_ns) > limit_s:
        reasons.append(f'single images show the position to no better than {least_m:g} m')
    if belief.odometry_ns is None:
        reasons.append('no odometry')
    elif odometry_s > ODOMETRY_TIMEOUT_S:
        reasons.append(f'no odometry for {odometry_s:.1f} s')
    return reasons
