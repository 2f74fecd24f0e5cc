# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Smooth a recorded drive: every estimate rests on the images before and after it.

The equations are those of Rauch, Tung and Striebel (1965). A belief (x, P) was predicted with
Jacobian F to (x-, P-), and what followed smoothed that to (x*, P*). Then

    C = P F' (P-)^-1    x <- x + C (x* - x-)    P <- P + C (P* - P-) C'

from the last belief back to the first. Smoothing does not pass a start or a relocation of the
filter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.belief import (
    Belief,
    Event,
    MeasurementEvent,
    OdometryEvent,
    PoseEvent,
    symmetric,
)
from sfa_localization.fusion.ekf import STARTS, Ekf, Kalman
from sfa_localization.fusion.history import History
from sfa_localization.fusion.motion import YAW, State, Step
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.timeline import HISTORY_NS

_RIDGE = 1e-12  # keeps the inverse of a covariance of unit diagonal finite


class _Prediction(NamedTuple):
    """The state before a prediction, its Jacobian, and the predicted state."""

    before: Belief
    jacobian: Array
    mean: Array
    covariance: Array


class _Stage(NamedTuple):
    """The belief after an event, by `predictions` from the stage before; none at the same stamp."""

    event: Event
    belief: Belief
    predictions: list[_Prediction]

    @property
    def follows(self) -> bool:
        """Whether the belief rests on the one before the event, which did not set the pose."""
        if isinstance(self.event, MeasurementEvent):
            update = self.belief.memory.update
            return update is None or update.reason not in STARTS
        return not isinstance(self.event, PoseEvent)


class _Recording(Kalman):
    """Notes every prediction."""

    def __init__(self) -> None:
        super().__init__()
        self.predictions: list[_Prediction] = []

    def predicted(self, belief: Belief, step: Step) -> Array:
        covariance = super().predicted(belief, step)
        self.predictions.append(_Prediction(belief, step.jacobian, step.mean, covariance))
        return covariance


class Smoother(PoseFilter):
    """A pose filter that keeps all messages, so that the whole drive can be smoothed in the end.

    It needs 2 kB of memory a message.
    """

    def __init__(
        self, config: FilterConfig | None = None, correlation: ErrorCorrelation | None = None
    ) -> None:
        self._pieces: list[tuple[Belief, History[Event, Belief]]] = []
        super().__init__(config, correlation)

    def _fresh(self, start: Belief, start_ns: int | None = None) -> History[Event, Belief]:
        history = History(HISTORY_NS, start, self._ekf.step, start_ns, keep=True)
        self._pieces.append((start, history))
        return history

    def smoothed(self) -> list[State]:
        """The smoothed estimates at the stamps of odometry, from the first start on."""
        states = list[State]()
        kalman = _Recording()
        ekf = Ekf(self.config, self.correlation, self._rig, kalman)
        for belief, history in self._pieces:
            stages = list[_Stage]()
            for event in history.events:  # once more, all in their places
                kalman.predictions = []
                belief = ekf.step(belief, event)
                stages.append(_Stage(event, belief, kalman.predictions))
            states += _smoothed(stages)
        return states


def _smoothed(stages: list[_Stage]) -> list[State]:
    """Backward through the stages of one drive."""
    states: list[State] = []
    mean = np.zeros(0)
    covariance = np.zeros((0, 0))
    following = False
    for stage in reversed(stages):
        belief = stage.belief
        if not belief.located:
            break
        if not following:
            mean = belief.mean
            covariance = belief.covariance
        if isinstance(stage.event, OdometryEvent):
            states.append(State(stage.event.stamp_ns, mean, symmetric(covariance)))
        following = stage.follows
        for prediction in reversed(stage.predictions if following else ()):
            mean, covariance = _back(prediction, mean, covariance)
    return states[::-1]


def _back(prediction: _Prediction, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """The smoothed estimate before a prediction, from that after it."""
    before = prediction.before
    predicted = prediction.covariance
    std = np.sqrt(np.maximum(np.diag(predicted), _RIDGE))
    correlation = predicted / np.outer(std, std) + _RIDGE * np.eye(len(std))
    forward = prediction.jacobian @ before.covariance
    gain = np.linalg.solve(correlation, forward / std[:, None]).T / std
    change = mean - prediction.mean
    change[YAW] = wrap_angle(change[YAW])
    smoothed = before.mean + gain @ change
    smoothed[YAW] = wrap_angle(smoothed[YAW])
    return smoothed, before.covariance + gain @ (covariance - predicted) @ gain.T
