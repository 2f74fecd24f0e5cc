# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether measurements agree under the odometry's motion, and where they put the robot.

A measurement that the filter rejects may be wrong, or the filter may be. What decides is whether
the rejected ones agree among themselves: laid along the odometry's path, which is turned and
shifted as one piece, they must match over a number of images and a distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.belief import Belief, Evidence, MeasurementEvent

FEW_IMAGES = 3
"""Agreement that is no coincidence: two images always agree on some motion, the third checks."""
ENOUGH_IMAGES = 5
"""Images that overrule an established estimate: half a second to a second of any camera."""
MANY_IMAGES = 4 * ENOUGH_IMAGES
"""So many agree even where the robot has not moved: a passing fault has ended by then."""
AGREEING_DISTANCE_M = 2.0
"""Distance over which images must agree: beyond it the errors that neighbors share differ."""
CAPACITY = 60
"""Measurements remembered at most; beyond, every other one of the older half is dropped."""
REMEMBERED_M, REMEMBERED_STDS = 3 * AGREEING_DISTANCE_M, 30.0
"""Distance (m, and in standard deviations of a measurement) after which one is forgotten: about
twice what any decision of `recover` asks for, so that agreement may begin late."""
AGREEING_VARIANCES = 9.0
"""Squared standard deviations within which two measurements agree: 3 sigma."""
ODOMETRY_DRIFT = 0.05
"""Error of odometry that agreement allows for, per meter: m, and rad; a poor robot's 5 %."""
BASELINE_STDS = 3.0
"""Two positions show a heading where they lie farther apart than 3 sigma of their difference."""
_NEWTON_STEPS = 3  # of a fit that starts within its linear range


class Relocation(NamedTuple):
    """Where agreeing measurements put the robot now: pose (3,), covariance (3, 3).

    Over the same distance, `contradicting` counts what the filter accepted, `dissenting` what it
    rejected but does not agree either. `position_std` and `yaw_std` are the mean claimed ones.
    """

    pose: Array
    covariance: Array
    images: int
    distance_m: float
    position_std: float
    yaw_std: float
    contradicting: int
    dissenting: int

    @property
    def has_yaw(self) -> bool:
        return math.isfinite(self.yaw_std)


def remember(belief: Belief, event: MeasurementEvent, accepted: bool) -> tuple[Evidence, ...]:
    """The evidence with a measurement more, without what lies far behind; the rest thinned out."""
    newest = evidence_of(belief, event, accepted)
    evidence, std = belief.memory.evidence, math.sqrt(newest.variance)
    oldest_m = belief.traveled_m - max(REMEMBERED_M, REMEMBERED_STDS * std)
    start = 0
    while start < len(evidence) and evidence[start].traveled_m < oldest_m:
        start += 1
    kept = (*evidence[start:], newest)
    if len(kept) <= CAPACITY:
        return kept
    # The newer half stays complete: it is what the next decision counts.
    return kept[: CAPACITY // 2 : 2] + kept[CAPACITY // 2 :]


def evidence_of(belief: Belief, event: MeasurementEvent, accepted: bool) -> Evidence:
    """A measurement beside the pose by dead reckoning."""
    variances, (x, y, *yaw) = event.covariance.diagonal().tolist(), event.value.tolist()
    return Evidence(
        belief.dead_reckoned,
        belief.traveled_m,
        (x, y),
        yaw[0] if yaw else math.nan,
        (variances[0] + variances[1]) / 2,
        variances[2] if yaw else math.inf,
        accepted,
    )


def relocate(evidence: Sequence[Evidence], decorrelation_m: float) -> Relocation | None:
    """The pose at the newest measurement that most others agree with; None without agreement.

    Only measurements that the filter rejected count. Hypotheses come from the newest one's own
    heading and from its pairs with others. `decorrelation_m`: see ErrorCorrelation.distance_m.
    """
    table = _Table([item for item in evidence if not item.accepted])
    best: NDArray[np.bool_] | None = None
    turn = 0.0
    for turn_h, variance in table.hypotheses():
        agree = table.agreeing(turn_h, variance)
        if best is None or agree.sum() > best.sum():
            best, turn = agree, turn_h
    if best is None:
        return None
    found = table.relocation(best, turn, decorrelation_m)
    oldest = evidence[-1].traveled_m - found.distance_m
    recent = [item for item in evidence if item.traveled_m >= oldest]
    against = sum(item.accepted for item in recent)
    return found._replace(contradicting=against, dissenting=len(recent) - against - found.images)


def consistent(evidence: Sequence[Evidence], turn: float, turn_std: float) -> int:
    """How many of the newest measurements agree with the last one, without a break.

    `turn` turns dead reckoning into the map, known to `turn_std`.
    """
    agree = _Table(evidence).agreeing(turn, turn_std**2)
    return int(np.argmin(agree[::-1])) if not agree.all() else len(agree)


class _Table:
    """Evidence as arrays, the newest last; positions in the plane as complex numbers."""

    def __init__(self, evidence: Sequence[Evidence]) -> None:
        self.dead_reckoned = np.array([item.dead_reckoned for item in evidence])
        self.position = np.array([complex(*item.position) for item in evidence])
        self.yaw = np.array([item.yaw for item in evidence])
        self.has_yaw = np.isfinite(self.yaw)
        self.variance = np.array([item.variance for item in evidence])
        self.yaw_variance = np.array([item.yaw_variance for item in evidence])
        traveled = np.array([item.traveled_m for item in evidence])
        self.behind_m = traveled[-1] - traveled
        self.drift = (ODOMETRY_DRIFT * self.behind_m) ** 2
        step = self.dead_reckoned[:, :2] - self.dead_reckoned[-1, :2]
        self.path = step[:, 0] + 1j * step[:, 1]
        self.shift = self.position - self.position[-1]

    def hypotheses(self) -> list[tuple[float, float]]:
        """Turns from dead reckoning to the map, with their variances."""
        found = []
        if self.has_yaw[-1]:
            turn = float(wrap_angle(self.yaw[-1] - self.dead_reckoned[-1, 2]))
            found.append((turn, float(self.yaw_variance[-1])))
        both = self.variance + self.variance[-1]
        length = np.abs(self.path)
        for i in np.flatnonzero(length > BASELINE_STDS * np.sqrt(both)):
            turn = float(np.angle(self.shift[i] * np.conj(self.path[i])))
            found.append((turn, float(both[i] / length[i] ** 2)))
        return found

    def yaw_residual(self, turn: float) -> Array:
        """Measured headings minus those of dead reckoning after a turn; 0 where none is known."""
        difference = self.yaw - self.dead_reckoned[:, 2] - turn
        return np.asarray(wrap_angle(np.where(self.has_yaw, difference, 0.0)))

    def agreeing(self, turn: float, turn_variance: float) -> NDArray[np.bool_]:
        """Mask of the measurements that agree with the newest one under a turn."""
        residual = self.shift - np.exp(1j * turn) * self.path
        allowed = self.variance + self.variance[-1] + self.drift
        allowed = allowed + turn_variance * np.abs(self.path) ** 2
        agree = np.abs(residual) ** 2 <= AGREEING_VARIANCES * allowed
        allowed_yaw = self.yaw_variance + turn_variance + self.drift
        near = self.yaw_residual(turn) ** 2 <= AGREEING_VARIANCES * allowed_yaw
        return np.asarray(agree & (~self.has_yaw | near))

    def relocation(
        self, agree: NDArray[np.bool_], turn: float, decorrelation_m: float
    ) -> Relocation:
        """Least squares over the agreeing measurements: pose at the newest, and its covariance."""
        has_yaw = agree & self.has_yaw
        weight = agree / (self.variance + self.drift)
        yaw_weight = has_yaw / (self.yaw_variance + self.drift)
        place = self.position[-1]
        for _ in range(_NEWTON_STEPS):
            path = np.exp(1j * turn) * self.path
            normal, right = _normal_equations(weight, path, self.position - place - path)
            normal[2, 2] += yaw_weight.sum()
            right[2] += float(yaw_weight @ self.yaw_residual(turn))
            normal += 1e-12 * np.eye(3)  # regular even where a lone position shows no turn
            step = np.linalg.solve(normal, right)
            place, turn = place + complex(step[0], step[1]), turn + float(step[2])
        images, distance_m = int(agree.sum()), float(self.behind_m[agree].max())
        # Neighboring images err alike and count as fewer.
        dependence = max(1.0, images / (1 + distance_m / decorrelation_m))
        yaw_variance = self.yaw_variance[has_yaw].mean() if has_yaw.any() else math.inf
        return Relocation(
            pose=np.array([place.real, place.imag, wrap_angle(self.dead_reckoned[-1, 2] + turn)]),
            covariance=np.asarray(np.linalg.inv(normal) * dependence),
            images=images,
            distance_m=distance_m,
            position_std=math.sqrt(float(self.variance[agree].mean())),
            yaw_std=math.sqrt(float(yaw_variance)),
            contradicting=0,
            dissenting=0,
        )


def _normal_equations(weight: Array, path: Array, residual: Array) -> tuple[Array, Array]:
    """Of the shift (x, y) and the small turn that bring a path (N,) onto its `residual` (complex).

    A turn moves a point z of the path by i z: its column of the design matrix.
    """
    lever = 1j * path
    total = weight.sum()
    x, y = weight @ lever.real, weight @ lever.imag
    normal = np.array([[total, 0.0, x], [0.0, total, y], [x, y, weight @ np.abs(lever) ** 2]])
    turned = (np.conj(lever) * residual).real
    return normal, np.array([weight @ residual.real, weight @ residual.imag, weight @ turned])
