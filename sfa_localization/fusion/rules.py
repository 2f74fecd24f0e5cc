# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What one message changes in what the filter believes: pure functions of belief and event.

Prediction and correction are filterpy's extended Kalman filter; the gate, the start without a
known pose and the recovery of a displaced robot stand around it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.stats import chi2

from sfa_localization.data.geometry import Array
from sfa_localization.fusion import motion
from sfa_localization.fusion.evidence import Evidence, Fit, consistent, relocate, remember
from sfa_localization.fusion.inputs import lower_root, symmetric
from sfa_localization.fusion.motion import ERROR, SCALE, SIZE, YAW, State, Step, V, X, Y
from sfa_localization.fusion.settings import FilterConfig

DISTRUST_AFTER = 3
"""Pictures refused in a row from which on the estimate is in doubt."""
_DISTRUST = 1.3
_ESTABLISHED = 100
_DOMINATED = 4.0
_CERTAIN = 1e-7
_LASTING = 4
_AFTER_OUTAGE = 1.4
_PLAIN = 8.0
_PLAIN_TURN = 0.5
_BRIDGED_S = 10.0
_NO_DOUBT = (0.0, 0.0, 0.0)
_OBSERVE = np.eye(3, SIZE)
_PLACE = (X, Y, ERROR, ERROR + 1, ERROR + 2)
_REST = tuple(sorted({*range(SIZE)} - {*_PLACE}))
"""A position alone tells of these, and not of those, while the heading is lost."""


class Update(NamedTuple):
    """What became of one measurement.

    `d2` is the squared Mahalanobis distance of the whole innovation, with `threshold` its gate;
    both NaN where there was nothing to compare with. `innovation` (2,) or (3,) with its covariance.
    """

    stamp_ns: int
    accepted: bool
    d2: float
    threshold: float
    reason: str
    innovation: Array | None = None
    covariance: Array | None = None

    @property
    def log_likelihood(self) -> float:
        """Of the innovation under its covariance; NaN where there was nothing to compare with."""
        if self.covariance is None:
            return math.nan
        return -0.5 * (self.d2 + float(np.linalg.slogdet(2 * np.pi * self.covariance)[1]))


class OdometryEvent(NamedTuple):
    """An odometry reading at its stamp; `pose` is the message's own, in the odometry frame."""

    stamp_ns: int
    twist: motion.Twist
    pose: tuple[float, float, float] | None = None


class PoseEvent(NamedTuple):
    """A pose (3,) set from outside, with its covariance (3, 3)."""

    stamp_ns: int
    pose: Array
    covariance: Array


class MeasurementEvent(NamedTuple):
    """`jacobian` (2 or 3, 10) of the measurement and its `white` noise follow from covariance."""

    stamp_ns: int
    value: Array
    covariance: Array
    jacobian: Array
    white: Array


Event = OdometryEvent | PoseEvent | MeasurementEvent


class Memory(NamedTuple):
    """What the gate remembers: accepted pictures, refused ones in a row, and what they said."""

    support: int = 0
    refused: int = 0
    excess: float = 0.0
    accepted_ns: int | None = None
    accepted_m: float = 0.0
    outage: bool = False
    doubt: tuple[float, float, float] = _NO_DOUBT
    evidence: tuple[Evidence, ...] = ()
    update: Update | None = None


class Belief(NamedTuple):
    """Everything that the next event changes. `located` is False before the first pose."""

    stamp_ns: int
    mean: Array
    covariance: Array
    located: bool
    reckoned: tuple[float, float, float]
    travelled_m: float
    twist: motion.Twist
    odometry_ns: int | None
    memory: Memory
    odometry_pose: tuple[float, float, float] | None = None

    @property
    def state(self) -> State | None:
        """The estimate, if there is any.

        Doubt widens what is told, not what the gate goes by: wrong pictures must not open it.
        """
        if not self.located:
            return None
        doubt = self.memory.doubt
        if doubt is _NO_DOUBT:
            return State(self.stamp_ns, self.mean, symmetric(self.covariance))
        told = symmetric(self.covariance)
        for i, variance in enumerate(doubt):
            told[i, i] += variance
        return State(self.stamp_ns, self.mean, told)


class _Kalman(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter as a workbench: values in, values out, nothing kept between calls."""

    def __init__(self) -> None:
        super().__init__(SIZE, 3)
        self._next: Array = np.zeros(SIZE)

    def move(self, mean: Array, covariance: Array, step: Step) -> Array:
        """Covariance after a prediction."""
        self.x, self.P, self._next = mean, covariance, step.mean
        self.F, self.Q = step.jacobian, step.noise
        self.predict()
        return np.asarray(self.P)

    def predict_x(self, u: object = 0) -> None:
        self.x = self._next

    def correct(
        self, mean: Array, covariance: Array, z: Array, jacobian: Array, noise: Array
    ) -> tuple[Array, Array, float]:
        """Mean, covariance (Joseph form) and squared Mahalanobis distance of the innovation."""
        self.x, self.P = mean, covariance
        # Array.dot throughout: on arrays this small, @ takes twice as long.
        self.update(z, lambda _: jacobian, jacobian.dot, noise, residual=_residual)
        self.x[YAW] = motion.wrap(float(self.x[YAW]))
        return self.x, symmetric(self.P), float(self.y.dot(self.SI).dot(self.y))


class Fusion:
    """The rules by which a belief follows from the one before and an event.

    `config` must say how picture errors correlate: see correlation.resolved.
    """

    def __init__(self, config: FilterConfig) -> None:
        self.config = config
        self._kalman = _Kalman()
        self._many = _LASTING * config.recovery_pictures
        self._root_share = math.sqrt(config.correlated_share)
        self._thresholds = {n: float(chi2.ppf(config.gate_probability, n)) for n in (2, 3)}

    def measurement(self, stamp_ns: int, value: Array, covariance: Array) -> MeasurementEvent:
        """Split the noise into what neighbouring pictures share and what is each one's own."""
        size, share = len(value), self.config.correlated_share
        jacobian = _OBSERVE[:size].copy()
        jacobian[:, ERROR : ERROR + size] = lower_root(covariance, self._root_share)
        return MeasurementEvent(stamp_ns, value, covariance, jacobian, (1 - share) * covariance)

    def blank(self, stamp_ns: int) -> Belief:
        """What is believed before anything is known."""
        covariance = self._prior_covariance(np.eye(3))
        still = motion.Twist(0.0, 0.0, self.config.speed_std**2, self.config.rate_std**2)
        return Belief(
            stamp_ns,
            np.zeros(SIZE),
            covariance,
            False,
            (0.0, 0.0, 0.0),
            0.0,
            still,
            None,
            Memory(),
        )

    # One event after another: pure functions of belief and event.

    def step(self, belief: Belief, event: Event) -> Belief:
        """The belief after an event no earlier than it."""
        if isinstance(event, OdometryEvent):
            return self._driven(belief, event)
        belief = self.coasted(belief, event.stamp_ns)
        if isinstance(event, PoseEvent):
            return self._placed(belief, event)
        return self._measured(belief, event)

    def _driven(self, belief: Belief, event: OdometryEvent) -> Belief:
        if belief.odometry_ns is None and belief.stamp_ns == 0:
            return belief._replace(
                stamp_ns=event.stamp_ns,
                twist=event.twist,
                odometry_ns=event.stamp_ns,
                odometry_pose=event.pose,
            )
        silence = (event.stamp_ns - (belief.odometry_ns or belief.stamp_ns)) * 1e-9
        if silence > _BRIDGED_S:
            belief = self.coasted(belief, event.stamp_ns)
        twist = event.twist
        if belief.odometry_ns is not None and silence > self.config.odometry_timeout:
            twist = _between(belief.twist, event.twist)
        elif belief.odometry_pose is not None and event.pose is not None:
            twist = motion.driven_twist(belief.odometry_pose, event.pose, silence, twist)
            event = event._replace(twist=twist)
        dt = (event.stamp_ns - belief.stamp_ns) * 1e-9
        step = motion.drive(belief.mean, twist, dt, self.config)
        if silence > self.config.coast_time:
            unknown = min(dt, silence - self.config.coast_time)
            motion.doubt(step.noise, twist, unknown, self.config)
        return self._moved(belief, event.stamp_ns, step, event)

    def coasted(self, belief: Belief, stamp_ns: int) -> Belief:
        """Go on to a stamp without new odometry."""
        if belief.stamp_ns == 0 or stamp_ns <= belief.stamp_ns:
            return belief._replace(stamp_ns=stamp_ns) if belief.stamp_ns == 0 else belief
        config = self.config
        last = belief.stamp_ns if belief.odometry_ns is None else belief.odometry_ns
        end = min(stamp_ns, max(belief.stamp_ns, last + round(config.coast_time * 1e9)))
        if belief.odometry_ns is None:
            end = belief.stamp_ns
        if end > belief.stamp_ns:
            dt = (end - belief.stamp_ns) * 1e-9
            step = motion.coast(belief.mean, belief.twist, dt, config)
            belief = self._moved(belief, end, step)
        if stamp_ns > end:
            rest = (stamp_ns - end) * 1e-9
            step = motion.halt(belief.mean, belief.twist, rest, config)
            belief = self._moved(belief, stamp_ns, step)
            belief = belief._replace(covariance=self._capped(belief.covariance))
        return belief

    def _moved(
        self, belief: Belief, stamp_ns: int, step: Step, event: OdometryEvent | None = None
    ) -> Belief:
        """Apply a prediction to mean, covariance and path; `event` is the odometry behind it."""
        before_x, before_y, before_yaw = belief.mean[:3].tolist()
        after_x, after_y, after_yaw = step.mean[:3].tolist()
        dx, dy = after_x - before_x, after_y - before_y
        x, y, yaw = belief.reckoned
        c, s = math.cos(yaw - before_yaw), math.sin(yaw - before_yaw)
        turned = motion.wrap(yaw + after_yaw - before_yaw)
        covariance = belief.covariance
        if belief.located:
            covariance = self._kalman.move(belief.mean, covariance, step)
        return Belief(
            stamp_ns,
            step.mean,
            covariance,
            belief.located,
            (x + c * dx - s * dy, y + s * dx + c * dy, turned),
            belief.travelled_m + math.hypot(dx, dy),
            event.twist if event else belief.twist,
            event.stamp_ns if event else belief.odometry_ns,
            belief.memory,
            event.pose if event else belief.odometry_pose,
        )

    def _placed(self, belief: Belief, event: PoseEvent) -> Belief:
        """The pose was set from outside: what pictures said before does not count any more."""
        covariance = self._with_pose(belief, event.covariance, 0.0)
        mean = belief.mean.copy()
        mean[:3], mean[ERROR:] = event.pose, 0.0
        mean[YAW] = motion.wrap(float(mean[YAW]))
        memory = Memory(accepted_m=belief.travelled_m)
        return belief._replace(mean=mean, covariance=covariance, located=True, memory=memory)

    def _with_pose(self, belief: Belief, pose: Array, share: float) -> Array:
        """Covariance with a new pose block; bias and scale keep what is known of them.

        `share` of the pose's variance is the picture error that the next pictures will repeat.
        """
        covariance = self._prior_covariance(pose)
        kept = slice(V, SCALE + 1)
        covariance[kept, kept] = belief.covariance[kept, kept]
        shared = -math.sqrt(share) * np.linalg.cholesky(pose)
        covariance[:3, ERROR:], covariance[ERROR:, :3] = shared, shared.T
        return covariance

    def _measured(self, belief: Belief, event: MeasurementEvent) -> Belief:
        covariance = event.covariance
        blind = event.value.size == 2 and belief.covariance[YAW, YAW] > self.config.lost_yaw_std**2
        if not belief.located or blind:
            return self._started(belief, event, covariance)
        return self._gated(belief, event, covariance)

    def _started(self, belief: Belief, event: MeasurementEvent, covariance: Array) -> Belief:
        """Start from one picture with heading, or from the way that several lie along."""
        evidence = self._remembered(belief, event, covariance, False)
        found = None
        if event.value.size == 3:
            if self._sure(covariance):
                found = event.value, covariance
        else:
            fit = relocate(evidence, self.config)
            if fit is not None and self._sure_of_heading(fit) and self._fair(fit, evidence):
                found = fit.pose, fit.covariance
        if found is None and belief.located:
            return self._followed(belief, event, evidence)
        if found is None:
            reason = 'heading unknown yet' if event.value.size == 2 else 'too unsure to start from'
            memory = belief.memory._replace(evidence=evidence, update=_refused(event, reason))
            return belief._replace(memory=memory)
        return self._restarted(belief, event, found, 'started')

    def _followed(
        self, belief: Belief, event: MeasurementEvent, evidence: tuple[Evidence, ...]
    ) -> Belief:
        """The heading is lost: follow positions, and draw no conclusion from them on the heading.

        What the heading has to do with the position is linear only for small errors.
        """
        apart = belief.covariance.copy()
        apart[np.ix_(_PLACE, _REST)] = apart[np.ix_(_REST, _PLACE)] = 0.0
        mean, posterior, d2 = self._kalman.correct(
            belief.mean, apart, event.value, event.jacobian, event.white
        )
        threshold = self._thresholds[2]
        near = d2 <= threshold
        reason = 'position only: heading unknown' if near else 'outside the gate'
        update = Update(event.stamp_ns, near, d2, threshold, reason)
        memory = belief.memory._replace(evidence=evidence, update=update)
        if not near:
            return belief._replace(memory=memory)
        memory = memory._replace(accepted_ns=event.stamp_ns, accepted_m=belief.travelled_m)
        return belief._replace(mean=mean, covariance=posterior, memory=memory)

    def _sure(self, covariance: Array) -> bool:
        """Whether one picture's pose is a place to start from: not one that would be LOST."""
        config = self.config
        x, y, yaw = covariance.diagonal().tolist()
        return bool(max(x, y) <= config.lost_std**2 and yaw <= config.lost_yaw_std**2)

    def _sure_of_heading(self, fit: Fit) -> bool:
        return bool(fit.covariance[2, 2] < self.config.start_yaw_std**2) and fit.pictures >= 3

    def _fair(self, fit: Fit, evidence: tuple[Evidence, ...]) -> bool:
        """Most of what was seen agrees."""
        return fit.pictures >= 0.6 * len(evidence)

    def _restarted(
        self, belief: Belief, event: MeasurementEvent, found: tuple[Array, Array], reason: str
    ) -> Belief:
        pose, spread = found
        mean = belief.mean.copy()
        mean[:3], mean[ERROR:] = pose, 0.0
        mean[YAW] = motion.wrap(float(mean[YAW]))
        covariance = self._with_pose(belief, spread, self.config.correlated_share)
        update = Update(event.stamp_ns, True, math.nan, math.nan, reason)
        memory = Memory(
            support=1,
            accepted_ns=event.stamp_ns,
            accepted_m=belief.travelled_m,
            update=update,
        )
        return belief._replace(mean=mean, covariance=covariance, located=True, memory=memory)

    def _gated(self, belief: Belief, event: MeasurementEvent, covariance: Array) -> Belief:
        """Accept what fits; weigh what does not against what else did not fit."""
        mean, posterior, d2 = self._kalman.correct(
            belief.mean, belief.covariance, event.value, event.jacobian, event.white
        )
        threshold = self._thresholds[len(event.value)]
        innovation, spread = self._kalman.y, self._kalman.S
        update = Update(event.stamp_ns, True, d2, threshold, 'accepted', innovation, spread)
        if d2 <= threshold and (
            not self._surprising(belief, event, covariance)
            or self._confirmed(belief, event, covariance)
        ):
            return self._accepted(belief, event, covariance, (mean, posterior), update)
        reason = 'outside the gate' if d2 > threshold else 'not confirmed after an outage yet'
        refused = update._replace(accepted=False, reason=reason)
        return self._doubted(belief, event, covariance, refused)

    def _accepted(
        self,
        belief: Belief,
        event: MeasurementEvent,
        covariance: Array,
        posterior: tuple[Array, Array],
        update: Update,
    ) -> Belief:
        memory = Memory(
            support=min(belief.memory.support + 1, _ESTABLISHED),
            accepted_ns=event.stamp_ns,
            accepted_m=belief.travelled_m,
            evidence=self._remembered(belief, event, covariance, True),
            update=update,
        )
        return Belief(
            belief.stamp_ns,
            posterior[0],
            posterior[1],
            True,
            belief.reckoned,
            belief.travelled_m,
            belief.twist,
            belief.odometry_ns,
            memory,
            belief.odometry_pose,
        )

    def _surprising(self, belief: Belief, event: MeasurementEvent, covariance: Array) -> bool:
        """The gate is wide because the estimate is poor, and the picture would move it far."""
        prior, own = belief.covariance, covariance
        if belief.memory.support == 0:  # a pose set from outside says itself how poor it is
            return False
        if max(prior[0, 0], prior[1, 1]) < _DOMINATED * max(own[0, 0], own[1, 1]):
            return False
        miss = event.value[:2] - belief.mean[:2]
        return bool(miss @ np.linalg.solve(own[:2, :2], miss) > self._thresholds[2])

    def _confirmed(self, belief: Belief, event: MeasurementEvent, covariance: Array) -> bool:
        """Enough pictures in a row agree with this one, along the way that odometry tells."""
        evidence = self._remembered(belief, event, covariance, False)
        offset = float(belief.mean[YAW]) - belief.reckoned[2]
        count = consistent(evidence, offset, math.sqrt(belief.covariance[YAW, YAW]))
        if count < self.config.confirm_pictures:
            return False
        span = belief.travelled_m - evidence[-count].travelled_m
        return span >= self.config.confirm_distance or count >= self._many

    def _doubted(
        self, belief: Belief, event: MeasurementEvent, covariance: Array, update: Update
    ) -> Belief:
        """Refuse a picture, unless those refused outweigh the estimate; then start anew there."""
        evidence = self._remembered(belief, event, covariance, False)
        fit = relocate(evidence, self.config) if len(evidence) > 1 else None
        if fit is not None and self._overruled(belief, fit):
            return self._restarted(belief, event, (fit.pose, fit.covariance), 're-initialised')
        outside = update.d2 > update.threshold
        refused = belief.memory.refused + int(outside)
        memory = belief.memory._replace(
            refused=refused,
            excess=update.d2 / update.threshold,
            outage=self._outage(belief, event),
            doubt=self._doubt(belief, update, refused),
            evidence=evidence,
            update=update,
        )
        widened = belief.covariance
        if outside and refused >= DISTRUST_AFTER:
            widened = self._widened(belief, evidence)
        return belief._replace(covariance=widened, memory=memory)

    def _doubt(self, belief: Belief, update: Update, refused: int) -> tuple[float, float, float]:
        """Lost: the pose told may be wrong by as much as pictures say that it is."""
        if refused < self.config.recovery_pictures or update.innovation is None:
            return belief.memory.doubt
        miss = update.innovation
        spread = float(miss[0] ** 2 + miss[1] ** 2) / 4
        return spread, spread, float(miss[2] ** 2) / 4 if len(miss) == 3 else 0.0

    def _outage(self, belief: Belief, event: MeasurementEvent) -> bool:
        """Whether the pictures that are refused now are the first for a long time."""
        memory = belief.memory
        if memory.accepted_ns is None or memory.refused or memory.outage:
            return memory.outage
        return event.stamp_ns - memory.accepted_ns > self.config.picture_timeout * 1e9

    def _overruled(self, belief: Belief, fit: Fit) -> bool:
        """Whether agreeing pictures outweigh the estimate that they contradict."""
        config, support = self.config, belief.memory.support
        needed = min(config.recovery_pictures, max(2, support + 1))
        if fit.contradicting * 3 > fit.pictures or fit.covariance[2, 2] > config.start_yaw_std**2:
            return False
        if fit.dissenting >= fit.pictures:
            return False
        little = support >= config.recovery_pictures and not self._plain(belief, fit)
        way = max(config.recovery_distance, 8 * fit.std_m)
        way *= _AFTER_OUTAGE if belief.memory.outage else 1.0
        if fit.has_yaw and not little:
            seen = fit.pictures >= needed
            # What follows an outage may be a burst of wrong pictures: let them last.
            lasting = fit.span_m >= way or fit.pictures >= self._many
            return seen and (lasting or not belief.memory.outage)
        enough = fit.pictures >= needed or (fit.pictures >= 3 and fit.span_m >= 1.25 * way)
        return enough and fit.span_m >= way

    def _plain(self, belief: Belief, fit: Fit) -> bool:
        """The robot is elsewhere, or turned, by so much that no error of pictures explains it."""
        jump = math.hypot(*(fit.pose[:2] - belief.mean[:2]))
        turn = abs(motion.wrap(float(fit.pose[YAW] - belief.mean[YAW])))
        elsewhere = jump >= max(self.config.recovery_jump, _PLAIN * fit.std_m)
        return elsewhere or turn >= max(_PLAIN_TURN, _PLAIN * fit.yaw_std)

    def _widened(self, belief: Belief, evidence: tuple[Evidence, ...]) -> Array:
        """In doubt, the pose becomes less sure with every new place that contradicts it."""
        moved = belief.travelled_m - evidence[-2].travelled_m if len(evidence) > 1 else 0.0
        fresh = 1 - math.exp(-moved / self.config.decorrelation)
        factor = np.ones(SIZE)
        factor[:3] = math.sqrt(1 + (_DISTRUST - 1) * max(fresh, 0.1))
        return self._capped(belief.covariance * np.outer(factor, factor))

    def _capped(self, covariance: Array) -> Array:
        """Keep the pose's deviations below what is possible at all."""
        limits = np.array([self.config.largest_std, self.config.largest_std, math.pi])
        stds = np.sqrt(np.diag(covariance)[:3])
        factor = np.ones(SIZE)
        factor[:3] = np.minimum(1.0, limits / stds)
        return np.asarray(covariance * np.outer(factor, factor))

    def _remembered(
        self, belief: Belief, event: MeasurementEvent, covariance: Array, agreed: bool
    ) -> tuple[Evidence, ...]:
        variances, (x, y, *yaw) = covariance.diagonal().tolist(), event.value.tolist()
        variance = (variances[0] + variances[1]) / 2
        item = Evidence(
            belief.reckoned,
            belief.travelled_m,
            (x, y),
            yaw[0] if yaw else math.nan,
            variance,
            variances[2] if yaw else math.inf,
            agreed,
        )
        reach = max(3 * self.config.recovery_distance, 30 * math.sqrt(variance))
        return remember(belief.memory.evidence, item, reach)

    def _prior_covariance(self, pose: Array) -> Array:
        config = self.config
        bias = config.bias_std if config.estimate_bias else _CERTAIN
        scale = config.scale_std if config.estimate_scale else _CERTAIN
        covariance = np.diag(
            np.square([1, 1, 1, config.speed_std, config.rate_std, bias, scale, 1, 1, 1])
        )
        covariance[:3, :3] = pose
        return covariance


def _refused(event: MeasurementEvent, reason: str) -> Update:
    return Update(event.stamp_ns, False, math.nan, math.nan, reason)


def _between(a: motion.Twist, b: motion.Twist) -> motion.Twist:
    """The mean motion over a gap, as unsure as its ends differ."""
    spread_v, spread_omega = (a.v - b.v) ** 2 / 12, (a.omega - b.omega) ** 2 / 12
    return motion.Twist(
        (a.v + b.v) / 2,
        (a.omega + b.omega) / 2,
        max(a.v_variance, b.v_variance) + spread_v,
        max(a.omega_variance, b.omega_variance) + spread_omega,
    )


def _residual(z: Array, predicted: Array) -> Array:
    """Innovation, its angle wrapped."""
    difference = z - predicted
    if len(difference) == 3:
        difference[2] = motion.wrap(float(difference[2]))
    return difference
