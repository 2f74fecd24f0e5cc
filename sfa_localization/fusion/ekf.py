# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How the belief follows from the one before and an event: predict, update, or start anew.

Each is a pure function, so that late events can be placed where they belong: see `history`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array, compose, relative, wrap_angle
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.fusion import motion
from sfa_localization.fusion.belief import (
    Belief,
    Event,
    Jump,
    MeasurementEvent,
    Memory,
    Odometer,
    OdometryEvent,
    PoseEvent,
    PositionFix,
    Update,
    remembered,
)
from sfa_localization.fusion.camera_clock import SIGNIFICANT_STDS
from sfa_localization.fusion.motion import DELAY, ERROR, SIZE, YAW, MotionNoise, Step, Twist, V
from sfa_localization.fusion.odometry import (
    COAST_S,
    ODOMETRY_TIMEOUT_S,
    interval,
    jump,
    received,
    repeats,
)
from sfa_localization.fusion.relocation import Relocation, relocate
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.status import DEGRADED_YAW_RAD

STARTED, ELSEWHERE = STARTS = 'started', 'restarted elsewhere'
"""Reasons of updates that take a pose from measurements alone."""
GATE = {2: 13.815510557964274, 3: 16.26623619623813}
OUTLYING = {2: 3.2188758248682006, 3: 4.641627676087445}
"""Squared distances, by dimensions, that one right measurement in a thousand, and in five, exceeds
(chi-square). Those beyond the first are rejected, those beyond the second lose weight."""
LEAST_STD = 1e-3
"""Of a delay, s, or a turn factor, before turns contradict it."""
FACTOR_STDS = 4.0
"""Standard deviations by which a factor of turns contradicts: images that are half hidden turn by
a fifth too much."""
ALIKE_SHARE = 0.2
"""Where neighbors share less of their errors, positions are those of a sensor without outliers."""


class Correction(NamedTuple):
    """A belief's `mean` (14,) and `covariance` (14, 14) after a measurement, and its `innovation`
    (M,) with covariance (M, M) and squared Mahalanobis distance `d2`.
    """

    mean: Array
    covariance: Array
    innovation: Array
    innovation_covariance: Array
    d2: float


class Kalman:
    """The equations of the extended Kalman filter as pure functions."""

    def predicted(self, belief: Belief, step: Step) -> Array:
        """Covariance (14, 14) after a prediction: F P F^T + Q."""
        return step.jacobian @ belief.covariance @ step.jacobian.T + step.noise

    def corrected(self, belief: Belief, z: Array, jacobian: Array, noise: Array) -> Correction:
        """The belief after a measurement z (M,), with the covariance in Joseph form."""
        innovation = z - jacobian @ belief.mean
        innovation[YAW:] = wrap_angle(innovation[YAW:])
        common = jacobian @ belief.covariance
        innovation_covariance = common @ jacobian.T + noise
        solved = np.linalg.solve(innovation_covariance, np.column_stack([common, innovation]))
        gain = solved[:, :SIZE].T
        mean = belief.mean + gain @ innovation
        mean[YAW] = wrap_angle(mean[YAW])
        rest = np.eye(SIZE) - gain @ jacobian
        covariance = rest @ belief.covariance @ rest.T + gain @ noise @ gain.T
        d2 = float(innovation @ solved[:, SIZE])
        return Correction(mean, covariance, innovation, innovation_covariance, d2)


class Ekf:
    """The filter's step under some settings."""

    def __init__(
        self,
        config: FilterConfig,
        correlation: ErrorCorrelation,
        rig: Rig | None = None,
        kalman: Kalman | None = None,
    ) -> None:
        self._config = config
        self._correlation = correlation
        self._rig = rig or Rig()
        self._noise = MotionNoise(
            config.slip_per_meter, config.yaw_per_radian, correlation.distance_m
        )
        self._kalman = kalman or Kalman()

    def blank(self, stamp_ns: int) -> Belief:
        """The belief before the first message, without a pose: the prior of the robot is the rig,
        whose scale and delay are applied to all inputs.
        """
        speed_std = self._config.speed_std
        rate_std = self._config.rate_std
        rig = self._rig
        scale_std = rig.wheel_scale.std / rig.wheel_scale.value
        of_wheels = scale_std, rig.turn_loss.std, rig.turn_factor.std, rig.speed_offset.std
        of_robot = motion.BIAS_STD, *of_wheels, rig.camera_delay.std
        covariance = np.diag(np.square([1, 1, 1, speed_std, rate_std, *of_robot, 1, 1, 1]))
        mean = np.zeros(SIZE)
        mean[motion.LOSS] = rig.turn_loss.value
        mean[motion.OFFSET] = rig.speed_offset.value
        mean[motion.TURN] = rig.turn_factor.value - 1.0
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
            path = belief.path._replace(placed_m=(-math.inf,))
            return placed._replace(memory=Memory(), path=path)
        belief = replaced(belief, motion.DELAY, event.late)
        factor = Quantity(event.turn_factor.value - 1.0, event.turn_factor.std)
        return self._measured(replaced(belief, motion.TURN, factor, FACTOR_STDS), event)

    # Predict.

    def _driven(self, belief: Belief, event: OdometryEvent) -> Belief:
        """The belief after an odometry reading, which held since the one before it."""
        last = belief.odometry
        if last.stamp_ns is None and belief.stamp_ns == 0:
            odometry = received(belief, event)
            return belief._replace(stamp_ns=event.stamp_ns, twist=event.twist, odometry=odometry)
        if repeats(belief, event):
            return belief
        if leap := jump(belief, event):
            if last.suspect is None:
                return belief._replace(odometry=last._replace(suspect=event))
            return self._broken(belief, event, leap)
        twists = interval(belief, event)
        if twists is None:
            belief = self.coast(belief, event.stamp_ns)
            twists = event.twist, event.twist
        dt = (event.stamp_ns - belief.stamp_ns) * 1e-9
        coasted_s = (belief.stamp_ns - (last.stamp_ns or belief.stamp_ns)) * 1e-9
        counted_rad = belief.counted_rad + twists[0].omega * dt
        counted_rad += belief.twist.omega * max(coasted_s, 0.0)
        step = motion.drive(belief.mean, twists[0], dt, self._noise, twists[1])
        odometry = received(belief, event)
        moved = self._moved(belief, event.stamp_ns, step)
        pace = belief.pace.after(event.stamp_ns, twists[1])
        moved = moved._replace(counted_rad=counted_rad)
        return moved._replace(twist=twists[1], odometry=odometry, pace=pace)

    def _broken(self, belief: Belief, event: OdometryEvent, leap: Jump) -> Belief:
        """The belief after a break of the odometry, by wrong wheel counts or a robot that was
        moved: the pose is predicted with the last speed, and has the uncertainty of DEGRADED until
        an image confirms it.
        """
        belief = self.coast(belief, event.stamp_ns)
        std_m = self._config.degraded_std
        noise = np.zeros((SIZE, SIZE))
        noise[:3, :3] = np.diag(np.square([std_m, std_m, DEGRADED_YAW_RAD]))
        odometry = received(belief, event)._replace(jump=leap)
        moved = self._moved(belief, event.stamp_ns, Step(belief.mean, np.eye(SIZE), noise))
        twist = event.twist if odometry.fills_twist else belief.twist
        return moved._replace(twist=twist, odometry=odometry)

    def coast(self, belief: Belief, stamp_ns: int) -> Belief:
        """The belief at a later stamp without new odometry: at the last speed, then unknown."""
        if belief.stamp_ns == 0:
            return belief._replace(stamp_ns=stamp_ns)
        coasted_ns = belief.stamp_ns
        if belief.odometry.stamp_ns is not None:
            coasted_ns = max(coasted_ns, belief.odometry.stamp_ns + round(COAST_S * 1e9))
        changes = belief.pace.changes
        for end_ns, move, squares in (
            (min(stamp_ns, coasted_ns), motion.coast, changes),
            (stamp_ns, motion.halt, changes * COAST_S),
        ):
            if end_ns > belief.stamp_ns:
                dt = (end_ns - belief.stamp_ns) * 1e-9
                step = move(belief.mean, belief.twist, dt, self._noise, squares)
                belief = self._moved(belief, end_ns, step)
        return belief

    def _moved(self, belief: Belief, stamp_ns: int, step: Step) -> Belief:
        """Apply a prediction to mean, covariance, dead reckoning and the distance traveled."""
        moved = relative(belief.mean[:3], step.mean[:3])
        x, y, yaw = compose(np.array(belief.dead_reckoned), moved).tolist()
        images = belief.memory.images
        oldest_ns = images[0].stamp_ns if images else stamp_ns
        predicted = self._kalman.predicted(belief, step) if belief.located else belief.covariance
        return belief._replace(
            stamp_ns=stamp_ns,
            mean=step.mean,
            covariance=predicted,
            dead_reckoned=(x, y, yaw),
            traveled_m=belief.traveled_m + math.hypot(*moved[:2]),
            path=belief.path.driven(stamp_ns, (x, y, yaw), oldest_ns),
        )

    # Update.

    def _measured(self, belief: Belief, event: MeasurementEvent) -> Belief:
        """The belief, predicted to the event's stamp before, after a measurement."""
        images = remembered(belief.memory.images, _fix(belief, event))
        lost = belief.covariance[YAW, YAW] > self._config.lost_yaw_std**2
        if belief.located and (event.value.size == 3 or not lost):
            return self._gated(belief, event, images)
        return self._started(belief, event, images)

    def _started(
        self, belief: Belief, event: MeasurementEvent, images: tuple[PositionFix, ...]
    ) -> Belief:
        """Start from one image with heading, or from several images that agree along the path."""
        config = self._config
        if event.value.size == 3:
            x, y, yaw = event.covariance.diagonal().tolist()
            if max(x, y) <= config.lost_std**2 and yaw <= config.lost_yaw_std**2:
                start = Relocation(event.value, event.covariance, 1, 0.0, True)
                return self._restarted(belief, event, STARTED, start)
            reason = 'too uncertain to start from'
        else:
            place = relocate(images, self._correlation.distance_m)
            if place is not None and place.shows_heading(len(images)):
                return self._restarted(belief, event, STARTED, place)
            reason = 'heading unknown yet'
        update = Update(event.stamp_ns, False, math.nan, math.nan, reason)
        return belief._replace(memory=belief.memory._replace(images=images, update=update))

    def _gated(
        self, belief: Belief, event: MeasurementEvent, images: tuple[PositionFix, ...]
    ) -> Belief:
        """Accept what lies inside the gate, with less weight where it is outlying; reject what lies
        outside, or restart where the rejected images outweigh the estimate.
        """
        memory = belief.memory
        size = event.value.size
        z, jacobian, white = self._linearized(belief, event)
        corrected = self._kalman.corrected(belief, z, jacobian, white)
        d2 = corrected.d2
        inside = d2 <= GATE[size]
        reason = 'accepted' if inside else 'outside the gate'
        innovation = corrected.innovation, corrected.innovation_covariance
        update = Update(event.stamp_ns, inside, d2, GATE[size], reason, *innovation)
        if not inside:
            place = relocate(images, self._correlation.distance_m) if len(images) > 1 else None
            if place is not None and place.outweighs(belief):
                return self._restarted(belief, event, ELSEWHERE, place)
            rejected = memory._replace(rejected=memory.rejected + 1, images=images, update=update)
            return belief._replace(memory=rejected)
        outlying = d2 / OUTLYING[size]
        if outlying > 1 and self._correlation.share >= ALIKE_SHARE:
            corrected = self._kalman.corrected(belief, z, jacobian, white * outlying**2)
        images = (*images[:-1], images[-1]._replace(accepted=True))
        memory = Memory(memory.support + 1, 0, event.stamp_ns, images, update)
        return belief._replace(mean=corrected.mean, covariance=corrected.covariance, memory=memory)

    def _linearized(self, belief: Belief, event: MeasurementEvent) -> tuple[Array, Array, Array]:
        """Value z, Jacobian and white noise of a measurement that is linear in the state. With the
        covariance L L^T, of which neighboring images have `share` in common,

        z = value - late velocity = x - DELAY velocity + sqrt(share) L ERROR + white
        """
        size = event.value.size
        share = self._correlation.share
        moving = motion.velocity(belief.mean)[:size]
        jacobian = np.eye(size, SIZE)
        jacobian[:, DELAY] = -moving
        common = math.sqrt(share) * np.linalg.cholesky(event.covariance)
        jacobian[:, ERROR : ERROR + size] = common
        return event.value - event.late.value * moving, jacobian, (1 - share) * event.covariance

    def _restarted(
        self, belief: Belief, event: MeasurementEvent, reason: str, place: Relocation
    ) -> Belief:
        """The belief at the place that images show."""
        since_m = belief.traveled_m - place.distance_m
        path = belief.path
        path = path.placed(since_m) if reason == ELSEWHERE else path._replace(placed_m=(since_m,))
        update = Update(event.stamp_ns, True, math.nan, math.nan, reason)
        memory = Memory(support=1, accepted_ns=event.stamp_ns, update=update)
        placed = _at_pose(belief, place.pose, place.covariance, self._correlation.share)
        # Images show where the robot was a delay ago.
        variance = placed.covariance[DELAY, DELAY]
        by_delay = np.zeros(SIZE)
        by_delay[:3] = motion.velocity(placed.mean)
        by_delay[DELAY] = 1.0
        placed.mean[:3] += by_delay[:3] * (placed.mean[DELAY] - event.late.value)
        placed.covariance[DELAY] = placed.covariance[:, DELAY] = 0.0
        placed.covariance[:] += variance * np.outer(by_delay, by_delay)
        return placed._replace(memory=memory, path=path)


def replaced(
    belief: Belief, row: int, by_turns: Quantity, significant: float = SIGNIFICANT_STDS
) -> Belief:
    """What the turns of the images show replaces a row of the state where both contradict each
    other. The rest of the state follows by its regression on that row (Jeffrey's rule).
    """
    variance = max(float(belief.covariance[row, row]), LEAST_STD**2)
    change = by_turns.value - float(belief.mean[row])
    if abs(change) <= significant * math.hypot(by_turns.std, math.sqrt(variance)):
        return belief
    by_row = belief.covariance[row] / variance
    by_row[row] = 1.0
    mean = belief.mean + by_row * change
    mean[YAW] = wrap_angle(mean[YAW])
    covariance = belief.covariance + (by_turns.std**2 - variance) * np.outer(by_row, by_row)
    return belief._replace(mean=mean, covariance=covariance)


def _fix(belief: Belief, event: MeasurementEvent) -> PositionFix:
    """A measurement beside the pose by dead reckoning; the uncertain delay adds variance."""
    moving = motion.velocity(belief.mean)[: len(event.value)]
    variances = event.covariance.diagonal() + moving**2 * belief.covariance[DELAY, DELAY]
    x, y, *yaw = event.value.tolist()
    counted_ns = belief.odometry.stamp_ns
    limit_ns = round(ODOMETRY_TIMEOUT_S * 1e9)
    return PositionFix(
        event.stamp_ns,
        complex(x, y),
        yaw[0] if yaw else math.nan,
        float(variances[:2].mean()),
        float(variances[2]) if yaw else math.inf,
        belief.dead_reckoned,
        belief.traveled_m,
        is_reckoned=counted_ns is not None and event.stamp_ns - counted_ns <= limit_ns,
    )


def _at_pose(belief: Belief, pose: Array, covariance: Array, share: float) -> Belief:
    """The belief at another pose (3,); twist, bias, scale, loss and delay stay.

    `share` of the pose's variance is the error that the next images will repeat.
    """
    mean = np.array([*pose, *belief.mean[V:ERROR], 0.0, 0.0, 0.0])
    mean[YAW] = wrap_angle(mean[YAW])
    full = np.eye(SIZE)
    full[:3, :3] = covariance
    full[V:ERROR, V:ERROR] = belief.covariance[V:ERROR, V:ERROR]
    full[:3, ERROR:] = -math.sqrt(share) * np.linalg.cholesky(covariance)
    full[ERROR:, :3] = full[:3, ERROR:].T
    return belief._replace(mean=mean, covariance=full, located=True)
