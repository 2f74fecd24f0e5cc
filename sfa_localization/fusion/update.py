# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Update: fuse a measurement that lies inside the gate; hand the others to `recover`."""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import chi2

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.belief import (
    Belief,
    Evidence,
    MeasurementEvent,
    Memory,
    Pull,
    Update,
)
from sfa_localization.fusion.consistency import hesitant, lies_far, pulled, watched
from sfa_localization.fusion.evidence import (
    AGREEING_DISTANCE_M,
    FEW_IMAGES,
    MANY_IMAGES,
    consistent,
    evidence_of,
    remember,
)
from sfa_localization.fusion.inputs import lower_root
from sfa_localization.fusion.kalman import Kalman
from sfa_localization.fusion.lateness import Lateness, followed, unrelated
from sfa_localization.fusion.motion import BIAS, ERROR, SIZE, YAW, X, Y
from sfa_localization.fusion.mounting import Mounting, elsewhere, mounted
from sfa_localization.fusion.predict import ODOMETRY_TIMEOUT_S
from sfa_localization.fusion.recover import Recovery
from sfa_localization.fusion.turn_noise import SPACING_NS, Driven, TurnNoise, begun, weighed

ELSEWHERE = 'restarted elsewhere'
STARTS = ('started', ELSEWHERE)
"""Reasons of updates that take a pose from measurements alone."""
GATE_PROBABILITY = 0.999
"""Share of correct measurements that the gate accepts: one in a thousand is rejected."""
_GATES = {size: float(chi2.ppf(GATE_PROBABILITY, size)) for size in (2, 3)}
_MEDIANS = {size: float(chi2.ppf(0.5, size)) for size in (2, 3)}
OUTLYING_SHARE = 0.8
"""Images farther off than this share of the usual ones lose weight, with the fourth power of their
distance: errors of images have heavy tails, and those of neighbors are alike. Of images that err as
they claim, the fifth that loses weight loses little."""
SCATTER_STEP = 0.05
"""Relative change of the usual distance per image: it is learned over about twenty images."""
LEAST_SCATTER = 0.05
PERIOD_STEP = 0.1
"""Relative change of the usual time between images per image: learned over about twenty."""
WIDE_GATE = 4.0
"""A prior of so many times a measurement's variance would follow it anywhere (gain above 0.8)."""
_OUTLYING = {size: float(chi2.ppf(OUTLYING_SHARE, size)) for size in (2, 3)}
_UNLIKELY = {size: float(chi2.ppf(0.9, size)) for size in (1, 2)}
"""A pose from outside is taken at its word where its first image lies within this."""
_OBSERVED = np.eye(3, SIZE)
_SEEN_BY_POSITION = (X, Y, ERROR, ERROR + 1, ERROR + 2)
_NOT_SEEN_BY_POSITION = tuple(sorted({*range(SIZE)} - {*_SEEN_BY_POSITION}))


def measurement_event(
    stamp_ns: int, value: Array, covariance: Array, share: float, apart: bool = False
) -> MeasurementEvent:
    """A position (2,) or pose (3,), its covariance split into what neighboring images share.

    z = value + sqrt(share) L ERROR + white, with L L^T the covariance and (1 - share) of it white.
    """
    size = len(value)
    jacobian = _OBSERVED[:size].copy()
    jacobian[:, ERROR : ERROR + size] = lower_root(covariance, math.sqrt(share))
    return MeasurementEvent(stamp_ns, value, covariance, jacobian, (1 - share) * covariance, apart)


class Correction:
    """Fuses measurements by filterpy's equations, inside a chi-square gate."""

    def __init__(self, lost_yaw_std: float, kalman: Kalman, recovery: Recovery) -> None:
        self._lost_yaw_variance = lost_yaw_std**2
        self._kalman = kalman
        self._recovery = recovery

    def fuse(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """The belief, predicted to the event's stamp before, after a measurement."""
        before = belief.mean
        belief = self._fused(self._weighed(belief, event), event)
        update = belief.memory.update
        mounting = _mounting(belief, event, update, before)
        belief = belief._replace(lateness=_late(belief, event, update), mounting=mounting)
        if belief.located and update is not None and update.reason in STARTS:
            return belief._replace(turns=self._begun(belief))
        return belief

    def _begun(self, belief: Belief) -> TurnNoise:
        """What is known about the noise of turns, from another pose on."""
        faded = belief.traveled_m / self._recovery.decorrelation_m
        driven = Driven(belief.stamp_ns, belief.dead_reckoned, faded, *belief.added)
        return begun(driven, belief.mean, belief.covariance, belief.turns)

    def _weighed(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """The belief with what a measurement shows about the noise of turns."""
        if not belief.located or belief.covariance[YAW, YAW] > self._lost_yaw_variance:
            return belief
        last = belief.turns
        if last is not None and belief.stamp_ns < last.driven.stamp_ns + SPACING_NS:
            return belief
        now = self._begun(belief)
        turns = weighed(last or now, now.driven, event.value, event.jacobian, event.white)
        return belief._replace(turns=turns, turn_factor=turns.factor)

    def _fused(self, belief: Belief, event: MeasurementEvent) -> Belief:
        trust = watched(belief.memory.trust, evidence_of(belief, event, accepted=False))
        apart = event.apart or (belief.lateness is not None and belief.lateness.suspected)
        rejected = belief.memory.rejected
        trust = hesitant(trust, belief.traveled_m, rejected, apart, belief.turn_factor)
        period_s = _period_s(belief.memory, event.stamp_ns)
        memory = belief.memory._replace(trust=trust, period_s=period_s)
        belief = belief._replace(memory=memory)
        heading_lost = belief.covariance[YAW, YAW] > self._lost_yaw_variance
        if belief.located and (event.value.size == 3 or not heading_lost):
            return self._gated(belief, event)
        evidence = remember(belief, event, accepted=False)
        started = self._recovery.started(belief, event, evidence)
        if started is not None:
            return started
        if belief.located:
            return self._followed(belief, event, evidence)
        reason = 'heading unknown yet' if event.value.size == 2 else 'too uncertain to start from'
        update = Update(event.stamp_ns, False, math.nan, math.nan, reason)
        return belief._replace(memory=belief.memory._replace(evidence=evidence, update=update))

    def _followed(
        self, belief: Belief, event: MeasurementEvent, evidence: tuple[Evidence, ...]
    ) -> Belief:
        """The heading is lost: follow positions, and conclude nothing from them on the heading.

        The correlation of heading and position is meaningful only for small heading errors.
        """
        apart = belief.covariance.copy()
        apart[np.ix_(_SEEN_BY_POSITION, _NOT_SEEN_BY_POSITION)] = 0.0
        apart[np.ix_(_NOT_SEEN_BY_POSITION, _SEEN_BY_POSITION)] = 0.0
        mean, covariance, d2 = self._kalman.corrected(belief, apart, event)
        near = d2 <= _GATES[2]
        reason = 'position only: heading unknown' if near else 'outside the gate'
        update = Update(event.stamp_ns, near, d2, _GATES[2], reason)
        memory = belief.memory._replace(evidence=evidence, update=update)
        if not near:
            return belief._replace(memory=memory)
        memory = self._recovery.with_accepted(memory, belief, event)
        return belief._replace(mean=mean, covariance=covariance, memory=memory)

    def _gated(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """Accept what lies inside the gate, after an outage only when others confirm it."""
        mean, covariance, d2 = self._kalman.corrected(belief, belief.covariance, event)
        threshold, kalman = _GATES[event.value.size], self._kalman
        far = _lies_far(belief, event)
        update = Update(event.stamp_ns, True, d2, threshold, 'accepted', kalman.y, kalman.S, far)
        if d2 > threshold:
            rejected = update._replace(accepted=False, reason='outside the gate')
            return self._recovery.weighed(belief, event, rejected)
        if _pulls_far(belief, event) and not _confirmed(belief, event):
            reason = 'not confirmed after an outage yet'
            rejected = update._replace(accepted=False, reason=reason)
            return self._recovery.weighed(belief, event, rejected)
        if belief.memory.support == 0:
            belief = belief._replace(covariance=_doubted(belief, event))
            mean, covariance, _ = kalman.corrected(belief, belief.covariance, event)
        memory = Memory(
            support=belief.memory.support + 1,
            evidence=remember(belief, event, accepted=True),
            update=update,
            trust=belief.memory.trust,
            scatter=_scatter(belief.memory.scatter, d2 / _MEDIANS[event.value.size]),
            period_s=belief.memory.period_s,
            pull=_pull(belief, event),
        )
        outlying = d2 / (belief.memory.scatter * _OUTLYING[event.value.size])
        if outlying > 1 and self._recovery.alike:
            lighter = event._replace(white=event.white * outlying**2)
            mean, covariance, _ = kalman.corrected(belief, belief.covariance, lighter)
        memory = self._recovery.with_accepted(memory, belief, event)
        return belief._replace(mean=mean, covariance=covariance, memory=memory)


def _lies_far(belief: Belief, event: MeasurementEvent) -> bool:
    last = belief.memory.update
    was_far = last is not None and last.far
    return lies_far(_offset(belief, event), _offset_covariance(belief, event), was_far)


def _offset(belief: Belief, event: MeasurementEvent) -> Array:
    """Of a measurement (2,) or (3,) from the estimate, whatever errors images may share."""
    offset = event.value - belief.mean[: event.value.size]
    offset[YAW:] = wrap_angle(offset[YAW:])
    return offset


def _offset_covariance(belief: Belief, event: MeasurementEvent) -> Array:
    """Covariance of that offset."""
    size = event.value.size
    return belief.covariance[:size, :size] + event.covariance


def _pull(belief: Belief, event: MeasurementEvent) -> Pull:
    """With an image that was accepted."""
    offset_m = complex(*_offset(belief, event)[:2].tolist())
    variance = float(np.trace(_offset_covariance(belief, event)[:2, :2])) / 2
    return pulled(belief.memory.pull, belief.traveled_m, offset_m, variance)


def _late(belief: Belief, event: MeasurementEvent, update: Update | None) -> Lateness | None:
    """What is known about the time of images after another one; positions alone show none."""
    if event.value.size == 2:
        return belief.lateness
    now, trail = (belief.stamp_ns, *belief.dead_reckoned), belief.trail
    if belief.odometry_ns is None:
        return followed(None, trail, now, event.value, event.covariance, False, 0.0)
    if belief.stamp_ns - belief.odometry_ns > ODOMETRY_TIMEOUT_S * 1e9:
        return unrelated(belief.lateness, trail, now, event.value, event.covariance)
    restarted = update is not None and update.reason == ELSEWHERE
    bias = float(belief.mean[BIAS])
    return followed(belief.lateness, trail, now, event.value, event.covariance, restarted, bias)


def _mounting(
    belief: Belief, event: MeasurementEvent, update: Update | None, before: Array
) -> Mounting | None:
    """Where images show the camera on the robot after another one, which found the estimate at a
    mean `before`; positions alone show nothing.
    """
    if event.value.size == 2:
        return belief.mounting
    image, driven_variance = evidence_of(belief, event, accepted=False), belief.added[1]
    if update is not None and update.reason == ELSEWHERE:
        jump_m = math.hypot(*(belief.mean[:2] - before[:2]))
        return elsewhere(belief.mounting, image, driven_variance, jump_m)
    return mounted(belief.mounting, image, driven_variance)


def _scatter(usual: float, distance: float) -> float:
    """The running median of the images' squared distances, each over the expected median.

    It is at most 1: an image that claims too little is not believed more than it claims.
    """
    step = math.exp(SCATTER_STEP if distance > usual else -SCATTER_STEP)
    return min(max(usual * step, LEAST_SCATTER), 1.0)


def _period_s(memory: Memory, stamp_ns: int) -> float:
    """The running median of the time between images, accepted or not."""
    if memory.update is None:
        return memory.period_s
    longer = (stamp_ns - memory.update.stamp_ns) * 1e-9 > memory.period_s
    return memory.period_s * math.exp(PERIOD_STEP if longer else -PERIOD_STEP)


def _pulls_far(belief: Belief, event: MeasurementEvent) -> bool:
    """The gate is wide because the estimate is poor, and the image would move it far."""
    prior, own = belief.covariance, event.covariance
    if belief.memory.support == 0:  # whoever sets a pose from outside knows how poor it is
        return False
    if max(prior[0, 0], prior[1, 1]) < WIDE_GATE * max(own[0, 0], own[1, 1]):
        return False
    offset = event.value[:2] - belief.mean[:2]
    return bool(offset @ np.linalg.solve(own[:2, :2], offset) > _GATES[2])


def _doubted(belief: Belief, event: MeasurementEvent) -> Array:
    """The covariance of a pose from outside, before its first image: one that lies unlikely far
    off claims too much, and is as uncertain as it is off.
    """
    covariance, offset = belief.covariance.copy(), _offset(belief, event)
    for part in (slice(X, YAW), slice(YAW, event.value.size)):
        off, size = offset[part], len(offset[part])
        both = covariance[part, part] + event.covariance[part, part]
        if size and off @ np.linalg.solve(both, off) > _UNLIKELY[size]:
            covariance[part, part] += float(off @ off) * np.eye(size)
    return covariance


def _confirmed(belief: Belief, event: MeasurementEvent) -> bool:
    """Enough images in a row agree with this one along the odometry's path."""
    evidence = remember(belief, event, accepted=False)
    turn = float(belief.mean[YAW]) - belief.dead_reckoned[2]
    count = consistent(evidence, turn, math.sqrt(belief.covariance[YAW, YAW]))
    if count < FEW_IMAGES:
        return False
    distance_m = belief.traveled_m - evidence[-count].traveled_m
    return distance_m >= AGREEING_DISTANCE_M or count >= MANY_IMAGES
