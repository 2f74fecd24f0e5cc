# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Recover: find the pose at the start, and again where images contradict the estimate."""

from __future__ import annotations

import math

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array
from sfa_localization.fusion.belief import (
    Belief,
    Evidence,
    MeasurementEvent,
    Memory,
    PoseEvent,
    Trust,
    Update,
    capped,
)
from sfa_localization.fusion.consistency import begun, moved
from sfa_localization.fusion.evidence import (
    AGREEING_DISTANCE_M,
    ENOUGH_IMAGES,
    FEW_IMAGES,
    MANY_IMAGES,
    Relocation,
    relocate,
    remember,
)
from sfa_localization.fusion.motion import (
    ERROR,
    SIZE,
    YAW,
    Twist,
    V,
    largest_std,
    wrap,
)
from sfa_localization.fusion.settings import FilterConfig

IMAGE_TIMEOUT_S = 3.0
"""Time without an accepted image that counts as an outage: many times any camera's period."""
ALIKE_SHARE = 0.2
"""Where neighbors share less of their errors, positions are those of a sensor with white errors."""
BIAS_STD, SCALE_STD, LOSS_STD = 0.01, 0.03, 0.05
"""Standard deviations of turn-rate bias (rad/s), wheel scale and way lost in turns (m/rad) before
any is learned: data sheets of cheap gyroscopes, the tolerance of a tire's diameter, and a third of
the half track of a small robot."""
START_YAW_STD = 0.3
"""rad: what positions alone must determine the heading to; up to there the EKF is linear enough."""
AGREEING_SHARE = 0.6
"""Share of all remembered images that must agree to start from positions: most, with a margin."""
AGREEING_PER_ACCEPTED = 3
"""With fewer agreeing images per accepted one on the same path, the estimate is rather right."""
OBVIOUS_STDS, OBVIOUS_JUMP_M, OBVIOUS_TURN_RAD = 8.0, 1.5, 0.5
"""A displacement larger than both 8 standard deviations of an image and this (m, rad) has no
other explanation than that the robot was moved; a smaller one may be the map's own error."""
FEW_DISTANCE = 1.25
"""Fewer than ENOUGH_IMAGES must agree over a distance by this factor longer."""
OUTAGE_DISTANCE = 1.4
"""Images right after an outage must agree over a distance by this factor longer: outages end
with bursts of wrong images, as when somebody wipes the lens."""
WIDENING = 1.3
"""In doubt, the pose's variance grows by this factor per new place that contradicts it: the
standard deviation doubles within five, while one or two wrong images do little."""
WIDENING_STANDING = 0.1
"""Share of that growth where the robot has not moved: the same image is hardly new evidence."""
DOUBT_STDS = 2.0
"""While lost, the difference from the images is taken as an error of so many sigma (95 %)."""


class Recovery:
    """Starts beliefs, and weighs rejected measurements against the estimate."""

    def __init__(self, config: FilterConfig, correlation: ErrorCorrelation) -> None:
        self._config = config
        self._correlation = correlation
        self.alike, self.decorrelation_m = correlation.share >= ALIKE_SHARE, correlation.distance_m

    def blank(self, stamp_ns: int) -> Belief:
        """The belief before the first message, without a pose."""
        speed_std, rate_std = self._config.speed_std, self._config.rate_std
        stds = [1, 1, 1, speed_std, rate_std, BIAS_STD, SCALE_STD, LOSS_STD, 1, 1, 1]
        return Belief(
            stamp_ns,
            np.zeros(SIZE),
            np.diag(np.square(stds)),
            located=False,
            dead_reckoned=(0.0, 0.0, 0.0),
            traveled_m=0.0,
            twist=Twist(0.0, 0.0, speed_std**2, rate_std**2),
            odometry_ns=None,
            memory=Memory(),
        )

    def with_accepted(self, memory: Memory, belief: Belief, event: MeasurementEvent) -> Memory:
        """The memory with an image that was accepted.

        Many weak ones together do not show the place well: what makes them weak is the same for
        all.
        """
        weak = self.alike and largest_std(event.covariance) > self._config.degraded_std
        return memory._replace(
            accepted_ns=event.stamp_ns,
            accepted_m=belief.traveled_m,
            precise_ns=belief.memory.precise_ns if weak else event.stamp_ns,
        )

    def placed(self, belief: Belief, event: PoseEvent) -> Belief:
        """The pose was set from outside: earlier images do not count any more."""
        memory = Memory(accepted_m=belief.traveled_m)
        placed = _at_pose(belief, event.pose, event.covariance, 0.0)
        late = belief.lateness and belief.lateness._replace(broken=True)
        return placed._replace(memory=memory, lateness=late)

    def started(
        self, belief: Belief, event: MeasurementEvent, evidence: tuple[Evidence, ...]
    ) -> Belief | None:
        """Start from one image with heading, or from the path along which several lie; None yet."""
        if event.value.size == 3:
            x, y, yaw = event.covariance.diagonal().tolist()
            config = self._config
            lost = max(x, y) > config.lost_std**2 or yaw > config.lost_yaw_std**2
            return None if lost else self._restarted(belief, event, event, 'started')
        found = relocate(evidence, self._correlation.distance_m)
        if found is None or not shows_heading(found, len(evidence)):
            return None
        return self._restarted(belief, event, found, 'started')

    def weighed(self, belief: Belief, event: MeasurementEvent, update: Update) -> Belief:
        """After a rejected image: restarted where those rejected outweigh the estimate."""
        evidence = remember(belief, event, accepted=False)
        if len(evidence) > 1:
            found = relocate(evidence, self._correlation.distance_m)
            if found is not None and outweighs(found, belief):
                return self._restarted(belief, event, found, 'restarted elsewhere')
        outside = update.d2 > update.threshold
        memory = belief.memory._replace(
            rejected=belief.memory.rejected + int(outside),
            gate_excess=update.d2 / update.threshold,
            outage=_follows_outage(belief.memory, event.stamp_ns),
            evidence=evidence,
            update=update,
        )
        if memory.rejected >= ENOUGH_IMAGES and update.innovation is not None:
            memory = memory._replace(doubt=_doubt(update.innovation))
        belief = belief._replace(memory=memory)
        return self._widened(belief) if outside and memory.rejected >= FEW_IMAGES else belief

    def _restarted(
        self,
        belief: Belief,
        event: MeasurementEvent,
        found: MeasurementEvent | Relocation,
        reason: str,
    ) -> Belief:
        pose = found.pose if isinstance(found, Relocation) else found.value
        memory = Memory(
            support=1,
            update=Update(event.stamp_ns, True, math.nan, math.nan, reason),
            trust=_trust(belief, pose, relocated=isinstance(found, Relocation)),
            scatter=belief.memory.scatter,
            period_s=belief.memory.period_s,
        )
        placed = _at_pose(belief, pose, found.covariance, self._correlation.share)
        return placed._replace(memory=self.with_accepted(memory, belief, event))

    def _widened(self, belief: Belief) -> Belief:
        """In doubt, the pose becomes less certain with every new place that contradicts it."""
        evidence = belief.memory.evidence
        moved_m = belief.traveled_m - evidence[-2].traveled_m if len(evidence) > 1 else 0.0
        fresh = 1 - math.exp(-moved_m / self._correlation.distance_m)
        factor = np.ones(SIZE)
        factor[:3] = math.sqrt(1 + (WIDENING - 1) * max(fresh, WIDENING_STANDING))
        return belief._replace(covariance=capped(belief.covariance * np.outer(factor, factor)))


def shows_heading(found: Relocation, remembered: int) -> bool:
    """Whether positions that agree determine the heading, and most of those remembered agree."""
    certain = found.covariance[YAW, YAW] < START_YAW_STD**2
    enough = found.images >= max(FEW_IMAGES, AGREEING_SHARE * remembered)
    return bool(certain and enough)


def outweighs(found: Relocation, belief: Belief) -> bool:
    """Whether agreeing images outweigh the estimate that they contradict."""
    memory, images = belief.memory, found.images
    if images < AGREEING_PER_ACCEPTED * found.contradicting:
        return False
    if found.covariance[YAW, YAW] > START_YAW_STD**2 or found.dissenting >= images:
        return False
    # A young estimate is overruled by one image more than it rests on.
    enough = images >= min(ENOUGH_IMAGES, max(2, memory.support + 1))
    distance_m = max(AGREEING_DISTANCE_M, OBVIOUS_STDS * found.position_std)
    distance_m *= OUTAGE_DISTANCE if memory.outage else 1.0
    far = found.distance_m >= distance_m
    established = memory.support >= ENOUGH_IMAGES
    if found.has_yaw and (not established or displaced(found, belief.mean)):
        return enough and (far or images >= MANY_IMAGES or not memory.outage)
    few = images >= FEW_IMAGES and found.distance_m >= FEW_DISTANCE * distance_m
    return far and (enough or few)


def displaced(found: Relocation, mean: Array) -> bool:
    """The robot is elsewhere, or turned, by so much that no error of images explains it."""
    jump_m = math.hypot(*(found.pose[:2] - mean[:2]))
    turn = abs(wrap(float(found.pose[YAW] - mean[YAW])))
    elsewhere = jump_m >= max(OBVIOUS_JUMP_M, OBVIOUS_STDS * found.position_std)
    return elsewhere or turn >= max(OBVIOUS_TURN_RAD, OBVIOUS_STDS * found.yaw_std)


def _trust(belief: Belief, pose: Array, *, relocated: bool) -> Trust:
    """The trust in a pose (3,) of an image alone, or where agreeing ones `relocated` the robot."""
    trust = belief.memory.trust
    if belief.located or trust.moves > 0:
        jump_m = math.hypot(*(pose[:2] - belief.mean[:2])) if belief.located else 0.0
        return moved(trust, belief.traveled_m, jump_m, belief.memory.accepted_m)
    return Trust() if relocated else begun(belief.traveled_m)


def _at_pose(belief: Belief, pose: Array, covariance: Array, share: float) -> Belief:
    """The belief at another pose (3,), with what is known of twist, bias, scale and loss.

    `share` of the pose's variance is the error that the next images will repeat.
    """
    mean = belief.mean.copy()
    mean[:3], mean[ERROR:] = pose, 0.0
    mean[YAW] = wrap(float(mean[YAW]))
    full, kept = np.eye(SIZE), slice(V, ERROR)
    full[:3, :3], full[kept, kept] = covariance, belief.covariance[kept, kept]
    shared = -math.sqrt(share) * np.linalg.cholesky(covariance)
    full[:3, ERROR:], full[ERROR:, :3] = shared, shared.T
    return belief._replace(mean=mean, covariance=full, located=True)


def _follows_outage(memory: Memory, stamp_ns: int) -> bool:
    """Whether the images that are rejected now are the first for a long time."""
    if memory.accepted_ns is None or memory.rejected or memory.outage:
        return memory.outage
    return stamp_ns - memory.accepted_ns > IMAGE_TIMEOUT_S * 1e9


def _doubt(innovation: Array) -> tuple[float, float, float]:
    """Lost: the pose may be wrong by as much as the images (2,) or (3,) differ from it."""
    position = float(innovation[0] ** 2 + innovation[1] ** 2) / DOUBT_STDS**2
    yaw = float(innovation[2] ** 2) / DOUBT_STDS**2 if len(innovation) == 3 else 0.0
    return position, position, yaw
