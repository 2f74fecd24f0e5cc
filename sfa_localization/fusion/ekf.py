# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How the belief follows from the one before and an event: predict, update, or start anew.

Each is a pure function, so that late events can be placed where they belong: see `history`. The
equations of prediction and update are filterpy's.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.fusion import motion
from sfa_localization.fusion.belief import (
    Belief,
    DelayEvent,
    Event,
    Jump,
    MeasurementEvent,
    Memory,
    Odometer,
    OdometryEvent,
    PoseEvent,
    Update,
)
from sfa_localization.fusion.camera_clock import SIGNIFICANT_STDS
from sfa_localization.fusion.inputs import root
from sfa_localization.fusion.motion import (
    DELAY,
    ERROR,
    LOSS,
    SIZE,
    YAW,
    MotionNoise,
    Step,
    Twist,
    V,
    wrap,
)
from sfa_localization.fusion.odometry import COAST_S, Interval, interval, jump, received, repeats
from sfa_localization.fusion.relocation import Relocation, relocate
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import DEGRADED_YAW_RAD
from sfa_localization.fusion.track import Image, Track, remembered

STARTED, ELSEWHERE = STARTS = 'started', 'restarted elsewhere'
"""Reasons of updates that take a pose from measurements alone."""
ALIKE_SHARE = 0.2
"""Where neighbors share less of their errors, positions are those of a sensor with white errors."""
_LEARNING = 0.1
"""Relative change per image of the usual distance and period: learned over about twenty."""
_LEAST_SCATTER = 0.05
GATE = {2: 13.815510557964274, 3: 16.26623619623813}
OUTLYING = {2: 3.2188758248682006, 3: 4.641627676087445}
MEDIAN = {2: 1.3862943611198906, 3: 2.3659738843753377}
"""Of squared distances of right measurements, by dimensions (chi-square): one in a thousand is
rejected. Errors of images have heavy tails, so the outlying fifth loses weight."""
_OBSERVED = np.eye(3, SIZE)


def measurement_event(
    stamp_ns: int, value: Array, covariance: Array, share: float, late: Quantity
) -> MeasurementEvent:
    """A position (2,) or pose (3,), its covariance split into what neighboring images share.

    z = value + sqrt(share) L ERROR + white, with L L^T the covariance and (1 - share) of it white.
    Raises DataError for a covariance that is not positive.
    """
    jacobian, shared = _OBSERVED[: len(value)].copy(), math.sqrt(share)
    for i, row in enumerate(root(covariance.tolist())):
        for j, entry in enumerate(row, ERROR):
            jacobian[i, j] = shared * entry
    return MeasurementEvent(stamp_ns, value, covariance, jacobian, (1 - share) * covariance, late)


class Kalman(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's equations as pure functions; only the last innovation is kept between calls."""

    def __init__(self) -> None:
        super().__init__(SIZE, 3)
        self._next_mean: Array = np.zeros(SIZE)

    def predicted(self, belief: Belief, step: Step) -> Array:
        """Covariance (12, 12) after a prediction: F P F^T + Q."""
        self.x, self.P, self._next_mean = belief.mean, belief.covariance, step.mean
        self.F, self.Q = step.jacobian, step.noise
        self.predict()
        return np.asarray(self.P)

    def predict_x(self, u: object = 0) -> None:
        """filterpy's hook: the motion model is nonlinear."""
        self.x = self._next_mean

    def corrected(self, belief: Belief, event: MeasurementEvent) -> tuple[Array, Array, float]:
        """Mean (12,), covariance (Joseph form) and squared Mahalanobis distance of the innovation,
        which stays in `y`, its covariance in `S`.
        """
        self.x, self.P = belief.mean, belief.covariance
        h = event.jacobian
        self.update(event.value, lambda _: h, lambda x: h @ x, event.white, residual=_residual)
        self.x[YAW] = wrap(float(self.x[YAW]))
        return self.x, self.P, float(self.y @ self.SI @ self.y)


def _residual(z: Array, predicted: Array) -> Array:
    """Innovation, its angle wrapped."""
    difference = z - predicted
    if len(difference) == 3:
        difference[YAW] = wrap(float(difference[YAW]))
    return difference


class Ekf:
    """The filter's step under some settings."""

    def __init__(
        self,
        config: FilterConfig,
        correlation: ErrorCorrelation,
        rig: Rig | None = None,
        kalman: Kalman | None = None,
    ) -> None:
        self._config, self._correlation, self._rig = config, correlation, rig or Rig()
        self._noise = MotionNoise(
            config.slip_per_meter, config.yaw_per_radian, correlation.distance_m
        )
        self._kalman = kalman or Kalman()
        self._alike = correlation.share >= ALIKE_SHARE

    def blank(self, stamp_ns: int) -> Belief:
        """The belief before the first message, without a pose: the robot is that of the rig. Its
        scale and delay have been applied to what comes in."""
        speed_std, rate_std, rig = self._config.speed_std, self._config.rate_std, self._rig
        known = rig.wheel_scale.std / rig.wheel_scale.value, rig.turn_loss.std, rig.camera_delay.std
        stds = [1, 1, 1, speed_std, rate_std, motion.BIAS_STD, *known, 1, 1, 1]
        mean, covariance = np.zeros(SIZE), np.diag(np.square(stds))
        mean[LOSS] = rig.turn_loss.value
        twist = Twist(0.0, 0.0, speed_std**2, rate_std**2)
        nowhere = (0.0, 0.0, 0.0)
        return Belief(stamp_ns, mean, covariance, False, nowhere, 0.0, twist, Odometer(), Memory())

    def step(self, belief: Belief, event: Event) -> Belief:
        """The belief after an event no earlier than it."""
        if isinstance(event, OdometryEvent):
            return self._driven(belief, event)
        belief = self.coast(belief, event.stamp_ns)
        if isinstance(event, PoseEvent):
            placed = _at_pose(belief, event.pose, event.covariance, 0.0)
            trusted = Track(belief.track.knots, since_m=-math.inf)
            return placed._replace(memory=Memory(), track=trusted)
        belief = _overruled(belief, event.late)
        if isinstance(event, DelayEvent):  # which is why images in a row contradicted the estimate
            return belief._replace(memory=belief.memory._replace(rejected=0))
        return self._measured(belief, event)

    # Predict.

    def _driven(self, belief: Belief, event: OdometryEvent) -> Belief:
        """The belief after an odometry reading, which held since the one before it."""
        last = belief.odometry
        if last.stamp_ns is None and belief.stamp_ns == 0:
            return belief._replace(
                stamp_ns=event.stamp_ns, twist=event.twist, odometry=received(belief, event)
            )
        if repeats(belief, event):
            return belief
        if made := jump(belief, event):
            if last.suspect is None:
                return belief._replace(odometry=last._replace(suspect=event))
            return self._broken(belief, event, made)
        held, reading = interval(belief, event), event.twist
        if held is None:
            belief = self.coast(belief, event.stamp_ns)
            held = Interval(reading, reading, reading.omega)
        dt = (event.stamp_ns - belief.stamp_ns) * 1e-9
        step = motion.drive(belief.mean, held.twist, dt, self._noise, held.now)
        return self._moved(belief, event.stamp_ns, step, event, held)

    def _broken(self, belief: Belief, event: OdometryEvent, made: Jump) -> Belief:
        """The belief after a break: nothing tells a slip of the wheels' counts from a robot that
        was moved, so the pose is expected where its speed leads, and is known no better than one
        that is DEGRADED, until an image places it.
        """
        belief, std_m = self.coast(belief, event.stamp_ns), self._config.degraded_std
        noise = np.zeros((SIZE, SIZE))
        noise[:3, :3] = np.diag(np.square([std_m, std_m, DEGRADED_YAW_RAD]))
        moved = self._moved(belief, event.stamp_ns, Step(belief.mean, np.eye(SIZE), noise), event)
        twist = event.twist if moved.odometry.fills_twist else belief.twist
        return moved._replace(twist=twist, odometry=moved.odometry._replace(jump=made))

    def coast(self, belief: Belief, stamp_ns: int) -> Belief:
        """The belief at a later stamp without new odometry: at the last speed, then unknown."""
        if belief.stamp_ns == 0:
            return belief._replace(stamp_ns=stamp_ns)
        coasted_ns = belief.stamp_ns
        if belief.odometry.stamp_ns is not None:
            coasted_ns = max(coasted_ns, belief.odometry.stamp_ns + round(COAST_S * 1e9))
        for end_ns, move in ((min(stamp_ns, coasted_ns), motion.coast), (stamp_ns, motion.halt)):
            if end_ns > belief.stamp_ns:
                dt = (end_ns - belief.stamp_ns) * 1e-9
                step = move(belief.mean, belief.twist, dt, self._noise)
                belief = self._moved(belief, end_ns, step)
        return belief

    def _moved(
        self,
        belief: Belief,
        stamp_ns: int,
        step: Step,
        event: OdometryEvent | None = None,
        held: Interval | None = None,
    ) -> Belief:
        """Apply a prediction to mean, covariance, dead reckoning and the distance traveled."""
        before_x, before_y, before_yaw = belief.mean[:3].tolist()
        after_x, after_y, after_yaw = step.mean[:3].tolist()
        dx, dy = after_x - before_x, after_y - before_y
        x, y, yaw = belief.dead_reckoned
        c, s = math.cos(yaw - before_yaw), math.sin(yaw - before_yaw)
        turned = wrap(yaw + after_yaw - before_yaw)
        reckoned = (x + c * dx - s * dy, y + s * dx + c * dy, turned)
        located, images = belief.located, belief.memory.images
        oldest_ns = images[0].stamp_ns if images else stamp_ns
        # Positional, and not _replace, which would cost half as much as the arithmetic above.
        return Belief(
            stamp_ns,
            step.mean,
            self._kalman.predicted(belief, step) if located else belief.covariance,
            located,
            reckoned,
            belief.traveled_m + math.hypot(dx, dy),
            held.now if held else belief.twist,
            received(belief, event) if event else belief.odometry,
            belief.memory,
            belief.track.driven(stamp_ns, reckoned, oldest_ns),
            held.omega if held else belief.omega,
        )

    # Update.

    def _measured(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """The belief, predicted to the event's stamp before, after a measurement."""
        lost = belief.covariance[YAW, YAW] > self._config.lost_yaw_std**2
        if belief.located and (event.value.size == 3 or not lost):
            return self._gated(belief, event)
        return self._found(belief, event)

    def _found(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """Start from one image with heading, or from the path along which several lie."""
        images, config = _images(belief, event, False), self._config
        if event.value.size == 3:
            x, y, yaw = event.covariance.diagonal().tolist()
            if max(x, y) <= config.lost_std**2 and yaw <= config.lost_yaw_std**2:
                return self._restarted(belief, event, None, STARTED)
            reason = 'too uncertain to start from'
        else:
            found = relocate(images, self._correlation.distance_m)
            if found is not None and found.shows_heading(len(images)):
                return self._restarted(belief, event, found, STARTED)
            reason = 'heading unknown yet'
        update = Update(event.stamp_ns, False, math.nan, math.nan, reason)
        return belief._replace(memory=belief.memory._replace(images=images, update=update))

    def _gated(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """Accept what lies inside the gate; what is outlying within loses weight."""
        kalman, memory, size = self._kalman, belief.memory, event.value.size
        delayed = _delayed(belief, event)
        mean, covariance, d2 = kalman.corrected(belief, delayed)
        inside = d2 <= GATE[size]
        reason = 'accepted' if inside else 'outside the gate'
        update = Update(event.stamp_ns, inside, d2, GATE[size], reason, kalman.y, kalman.S)
        period_s = _period_s(memory, event.stamp_ns)
        if not inside:
            memory = memory._replace(update=update, period_s=period_s)
            return self._rejected(belief._replace(memory=memory), event)
        outlying = d2 / (memory.scatter * OUTLYING[size])
        if outlying > 1 and self._alike:
            lighter = delayed._replace(white=event.white * outlying**2)
            mean, covariance, _ = kalman.corrected(belief, lighter)
        # At most 1: an image that claims too little is not believed more than it claims.
        scatter = min(max(_nearer(memory.scatter, d2 / MEDIAN[size]), _LEAST_SCATTER), 1.0)
        images = _images(belief, event, True)
        memory = Memory(memory.support + 1, 0, event.stamp_ns, images, update, scatter, period_s)
        return Belief(belief.stamp_ns, mean, covariance, *belief[3:8], memory, *belief[9:])

    # Start, and start anew.

    def _rejected(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """After a rejected image: restarted where those rejected outweigh the estimate."""
        memory = belief.memory
        images = _images(belief, event, False)
        found = relocate(images, self._correlation.distance_m) if len(images) > 1 else None
        if found is not None and found.outweighs(belief):
            return self._restarted(belief, event, found, ELSEWHERE)
        return belief._replace(memory=memory._replace(rejected=memory.rejected + 1, images=images))

    def _restarted(
        self, belief: Belief, event: MeasurementEvent, found: Relocation | None, reason: str
    ) -> Belief:
        """At the pose that several images show, or at the event's own."""
        pose, covariance = found[:2] if found else event[1:3]
        since_m = belief.traveled_m - (found.distance_m if found else 0.0)
        track = belief.track
        track = track.placed(since_m) if reason == ELSEWHERE else track._replace(since_m=since_m)
        memory = Memory(
            support=1,
            accepted_ns=event.stamp_ns,
            update=Update(event.stamp_ns, True, math.nan, math.nan, reason),
            scatter=belief.memory.scatter,
            period_s=belief.memory.period_s,
        )
        placed = _at_pose(belief, pose, covariance, self._correlation.share)
        # The pose is that of the delay before.
        variance, by_delay = placed.covariance[DELAY, DELAY], np.zeros(SIZE)
        by_delay[:3], by_delay[DELAY] = motion.velocity(placed.mean), 1.0
        placed.mean[:3] += by_delay[:3] * (placed.mean[DELAY] - event.late.value)
        placed.covariance[DELAY] = placed.covariance[:, DELAY] = 0.0
        placed.covariance[:] += variance * np.outer(by_delay, by_delay)
        return placed._replace(memory=memory, track=track)


def _overruled(belief: Belief, late: Quantity) -> Belief:
    """The delay that turns of the images contradict gives way to theirs. What the filter learned
    with it follows by its regression on the delay (Jeffrey's rule for one Gaussian marginal).
    """
    variance = max(float(belief.covariance[DELAY, DELAY]), motion.DELAY_WALK**2)
    change = late.value - float(belief.mean[DELAY])
    if abs(change) <= SIGNIFICANT_STDS * math.hypot(late.std, math.sqrt(variance)):
        return belief
    by_delay = belief.covariance[DELAY] / variance
    by_delay[DELAY] = 1.0
    mean = belief.mean + by_delay * change
    mean[YAW] = wrap(float(mean[YAW]))
    covariance = belief.covariance + (late.std**2 - variance) * np.outer(by_delay, by_delay)
    return belief._replace(mean=mean, covariance=covariance)


def _delayed(belief: Belief, event: MeasurementEvent) -> MeasurementEvent:
    """As a measurement linear in the state: z = x - velocity (DELAY - late) + errors."""
    moving = motion.velocity(belief.mean)[: len(event.value)]
    jacobian = event.jacobian.copy()
    jacobian[:, DELAY] = -moving
    return event._replace(value=event.value - event.late.value * moving, jacobian=jacobian)


def _images(belief: Belief, event: MeasurementEvent, accepted: bool) -> tuple[Image, ...]:
    """The images remembered, with a measurement beside the pose by dead reckoning."""
    late = motion.velocity(belief.mean)[: len(event.value)] ** 2 * belief.covariance[DELAY, DELAY]
    variances, (x, y, *yaw) = (event.covariance.diagonal() + late).tolist(), event.value.tolist()
    newest = Image(
        event.stamp_ns,
        complex(x, y),
        yaw[0] if yaw else math.nan,
        (variances[0] + variances[1]) / 2,
        variances[2] if yaw else math.inf,
        belief.dead_reckoned,
        belief.traveled_m,
        accepted,
    )
    return remembered(belief.memory.images, newest)


def _nearer(usual: float, now: float) -> float:
    """The running median of a positive number."""
    return usual * math.exp(_LEARNING if now > usual else -_LEARNING)


def _period_s(memory: Memory, stamp_ns: int) -> float:
    """The usual time between images, accepted or not."""
    if memory.update is None:
        return memory.period_s
    return _nearer(memory.period_s, (stamp_ns - memory.update.stamp_ns) * 1e-9)


def _at_pose(belief: Belief, pose: Array, covariance: Array, share: float) -> Belief:
    """The belief at another pose (3,), with what is known of twist, bias, scale and loss.

    `share` of the pose's variance is the error that the next images will repeat.
    """
    mean = belief.mean.copy()
    mean[:3], mean[ERROR:] = pose, 0.0
    mean[YAW] = wrap(float(mean[YAW]))
    full, kept = np.eye(SIZE), slice(V, ERROR)
    full[:3, :3], full[kept, kept] = covariance, belief.covariance[kept, kept]
    for i, row in enumerate(root(covariance.tolist())):
        for j, entry in enumerate(row, ERROR):
            full[i, j] = full[j, i] = -math.sqrt(share) * entry
    return belief._replace(mean=mean, covariance=full, located=True)
