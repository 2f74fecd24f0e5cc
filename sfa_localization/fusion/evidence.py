# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether measurements agree under the odometry's motion, and where they put the robot.

A measurement that the filter refuses may be wrong, or the filter may be. What decides is whether
the refused ones agree among themselves: laid along the odometry's path, turned and shifted as a
whole, they must fit over a number of pictures and a stretch of way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.settings import FilterConfig

CAPACITY = 60
"""Measurements remembered at most; beyond, every other one of the older half is dropped."""
_REACH = 9.0
"""Squared standard deviations within which two measurements agree."""
_DRIFT = 0.05
"""Odometry's error per metre that agreement allows for; and per metre, radians."""
_EFFORT = 3


class Evidence(NamedTuple):
    """A measurement beside the dead-reckoned pose at its stamp; yaw is NaN where unknown."""

    reckoned: tuple[float, float, float]
    travelled_m: float
    position: tuple[float, float]
    yaw: float
    variance: float
    yaw_variance: float
    agreed: bool


class Fit(NamedTuple):
    """Where agreeing measurements put the robot now: pose (3,), covariance (3, 3).

    Over the same stretch of way, `contradicting` counts what the filter accepted, `dissenting`
    what it refused but does not agree either. `std_m` and `yaw_std` are those told by pictures.
    """

    pose: Array
    covariance: Array
    pictures: int
    span_m: float
    std_m: float
    yaw_std: float
    contradicting: int
    dissenting: int
    has_yaw: bool


def remember(
    evidence: tuple[Evidence, ...], item: Evidence, reach_m: float
) -> tuple[Evidence, ...]:
    """Append, forgetting what lies more than `reach_m` of way behind, and thinning the rest."""
    oldest = item.travelled_m - reach_m
    start = 0
    while start < len(evidence) and evidence[start].travelled_m < oldest:
        start += 1
    kept = (*evidence[start:], item) if start else (*evidence, item)
    if len(kept) <= CAPACITY:
        return kept
    # What is recent stays whole: it is what the next decision counts.
    return kept[: CAPACITY // 2 : 2] + kept[CAPACITY // 2 :]


def relocate(evidence: Sequence[Evidence], config: FilterConfig) -> Fit | None:
    """The pose at the newest measurement that most others agree with; None without agreement.

    Only measurements that the filter refused have a say. Hypotheses come from the newest one's
    own heading and from its pairs with others.
    """
    table = _Table([item for item in evidence if not item.agreed])
    best: NDArray[np.bool_] | None = None
    turn = 0.0
    for turn_h, variance in table.hypotheses():
        agree = table.agreeing(turn_h, variance)
        if best is None or agree.sum() > best.sum():
            best, turn = agree, turn_h
    if best is None:
        return None
    fit = table.fit(best, turn, config)
    oldest = evidence[-1].travelled_m - fit.span_m
    recent = [item for item in evidence if item.travelled_m >= oldest]
    against = sum(item.agreed for item in recent)
    return fit._replace(contradicting=against, dissenting=len(recent) - against - fit.pictures)


def consistent(evidence: Sequence[Evidence], heading_offset: float, yaw_std: float) -> int:
    """How many of the newest measurements agree with the last one, without a break.

    `heading_offset` turns dead reckoning into the map, known to `yaw_std`.
    """
    agree = _Table(evidence).agreeing(heading_offset, yaw_std**2)
    return int(np.argmin(agree[::-1])) if not agree.all() else len(agree)


class _Table:
    """Evidence as arrays, the newest last."""

    def __init__(self, evidence: Sequence[Evidence]) -> None:
        self.reckoned = np.array([item.reckoned for item in evidence])
        self.travelled = np.array([item.travelled_m for item in evidence])
        self.position = np.array([item.position for item in evidence])
        self.yaw = np.array([item.yaw for item in evidence])
        self.variance = np.array([item.variance for item in evidence])
        self.yaw_variance = np.array([item.yaw_variance for item in evidence])
        self.back = self.travelled[-1] - self.travelled
        step = self.reckoned[:, :2] - self.reckoned[-1, :2]
        self.path = step[:, 0] + 1j * step[:, 1]
        shift = self.position - self.position[-1]
        self.shift = shift[:, 0] + 1j * shift[:, 1]

    def hypotheses(self) -> list[tuple[float, float]]:
        """Turns from dead reckoning to the map, with their variances."""
        found = []
        if math.isfinite(self.yaw[-1]):
            turn = float(wrap_angle(self.yaw[-1] - self.reckoned[-1, 2]))
            found.append((turn, float(self.yaw_variance[-1])))
        both = self.variance + self.variance[-1]
        length = np.abs(self.path)
        for i in np.flatnonzero(length > 3 * np.sqrt(both)):
            turn = float(np.angle(self.shift[i] * np.conj(self.path[i])))
            found.append((turn, float(both[i] / length[i] ** 2)))
        return found

    def agreeing(self, turn: float, turn_variance: float) -> NDArray[np.bool_]:
        """Mask of the measurements that agree with the newest one under a turn."""
        miss = self.shift - np.exp(1j * turn) * self.path
        allowed = self.variance + self.variance[-1] + (_DRIFT * self.back) ** 2
        allowed = allowed + turn_variance * np.abs(self.path) ** 2
        agree = np.abs(miss) ** 2 <= _REACH * allowed
        knows = np.isfinite(self.yaw)
        turned = wrap_angle(np.where(knows, self.yaw - self.reckoned[:, 2] - turn, 0.0))
        loose = self.yaw_variance + turn_variance + (_DRIFT * self.back) ** 2
        return np.asarray(agree & (~knows | (turned**2 <= _REACH * loose)))

    def fit(self, agree: NDArray[np.bool_], turn: float, config: FilterConfig) -> Fit:
        """Least squares over the agreeing measurements: pose at the newest, and its covariance."""
        knows = agree & np.isfinite(self.yaw)
        weight = agree / (self.variance + (_DRIFT * self.back) ** 2)
        yaw_weight = knows / (self.yaw_variance + (_DRIFT * self.back) ** 2)
        place = complex(*self.position[-1])
        where = self.position[:, 0] + 1j * self.position[:, 1]
        for _ in range(_EFFORT):
            laid = np.exp(1j * turn) * self.path
            miss = where - place - laid
            lean = wrap_angle(np.where(knows, self.yaw - self.reckoned[:, 2] - turn, 0.0))
            normal, right = _normal_equations(weight, laid, miss)
            normal[2, 2] += yaw_weight.sum()
            right[2] += float(yaw_weight @ lean)
            step = np.linalg.solve(normal + 1e-12 * np.eye(3), right)
            place, turn = place + complex(step[0], step[1]), turn + float(step[2])
        yaw = float(wrap_angle(self.reckoned[-1, 2] + turn))
        span = float(self.back[agree].max())
        dependence = _dependence(int(agree.sum()), span, config)
        return Fit(
            pose=np.array([place.real, place.imag, yaw]),
            covariance=np.asarray(np.linalg.inv(normal + 1e-12 * np.eye(3)) * dependence),
            pictures=int(agree.sum()),
            span_m=span,
            std_m=math.sqrt(float(self.variance[agree].mean())),
            yaw_std=math.sqrt(float(self.yaw_variance[knows].mean())) if knows.any() else math.inf,
            contradicting=0,
            dissenting=0,
            has_yaw=bool(knows.any()),
        )


def _normal_equations(weight: Array, laid: Array, miss: Array) -> tuple[Array, Array]:
    """Of shifts (x, y) and a small turn that bring `laid` to what it misses (complex, m)."""
    lever = 1j * laid
    total = weight.sum()
    normal = np.array(
        [
            [total, 0.0, weight @ lever.real],
            [0.0, total, weight @ lever.imag],
            [weight @ lever.real, weight @ lever.imag, weight @ np.abs(lever) ** 2],
        ]
    )
    right = np.array(
        [weight @ miss.real, weight @ miss.imag, weight @ (np.conj(lever) * miss).real]
    )
    return normal, right


def _dependence(pictures: int, span_m: float, config: FilterConfig) -> float:
    """Factor on the variance: neighbouring pictures err alike and count as fewer."""
    independent = 1 + span_m / config.decorrelation
    return max(1.0, pictures / independent)
