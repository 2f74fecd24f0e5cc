# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Smooth a recorded drive: every estimate rests on the images before and after it.

The equations are those of Rauch, Tung and Striebel (1965). A belief (x, P) was predicted with
Jacobian F to (x-, P-), and what followed smoothed that to (x*, P*). Then

    C = P F' (P-)^-1    x <- x + C (x* - x-)    P <- P + C (P* - P-) C'

from the last belief back to the first. Where the filter started, or was placed anew, nothing of
later beliefs reaches earlier ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array
from sfa_localization.fusion.belief import Belief, Event, MeasurementEvent, OdometryEvent, PoseEvent
from sfa_localization.fusion.ekf import STARTS, Ekf, Kalman
from sfa_localization.fusion.history import History
from sfa_localization.fusion.inputs import symmetric
from sfa_localization.fusion.motion import YAW, State, Step, wrap
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.timeline import HISTORY_NS

# Keeps the inverse of a covariance of unit diagonal finite.
_RIDGE = 1e-12


class _Link(NamedTuple):
    """A prediction: what it started from, its Jacobian, and what it led to."""

    before: Belief
    jacobian: Array
    mean: Array
    covariance: Array


class _Stage(NamedTuple):
    """The belief after an event, by the predictions `links` since the stage before; none at the
    same stamp.

    `follows` is False where the event set the pose.
    """

    event: Event
    belief: Belief
    links: tuple[_Link, ...]
    follows: bool


class _Recording(Kalman):
    """Notes every prediction."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[_Link] = []

    def predicted(self, belief: Belief, step: Step) -> Array:
        covariance = super().predicted(belief, step)
        self.links.append(_Link(belief, step.jacobian, step.mean, covariance))
        return covariance


class Smoother(PoseFilter):
    """A pose filter that keeps all messages, so that the whole drive can be smoothed in the end.

    It needs 1 kB of memory a message.
    """

    def __init__(
        self, config: FilterConfig | None = None, correlation: ErrorCorrelation | None = None
    ) -> None:
        self._pieces: list[tuple[Belief, History[Event, Belief]]] = []
        super().__init__(config, correlation)

    def _fresh(self, start: Belief, start_ns: int | None = None) -> History[Event, Belief]:
        archive = list[Event]()
        history = History(HISTORY_NS, start, self._ekf.step, start_ns, archive)
        self._pieces.append((start, history))
        return history

    def smoothed(self) -> list[State]:
        """The smoothed estimates at the stamps of odometry, from the first start on."""
        states = []
        for start, history in self._pieces:
            states += _smoothed(self._replayed(start, history.events))
        return states

    def _replayed(self, belief: Belief, events: list[Event]) -> list[_Stage]:
        """The stages of a drive whose messages are all in their places."""
        kalman, stages = _Recording(), list[_Stage]()
        ekf = Ekf(self.config, self.correlation, self._rig, kalman)
        for event in events:
            kalman.links.clear()
            belief = ekf.step(belief, event)
            stages.append(_Stage(event, belief, tuple(kalman.links), _follows(event, belief)))
        return stages


def _follows(event: Event, belief: Belief) -> bool:
    """Whether the belief after an event rests on the one before it."""
    if isinstance(event, MeasurementEvent):
        update = belief.memory.update
        return update is None or update.reason not in STARTS
    return not isinstance(event, PoseEvent)


def _smoothed(stages: list[_Stage]) -> list[State]:
    """Backward through the stages of one drive."""
    states: list[State] = []
    mean, covariance = np.zeros(0), np.zeros((0, 0))
    following = False
    for stage in reversed(stages):
        belief = stage.belief
        if not belief.located:
            break
        if not following:
            mean, covariance = belief.mean, belief.covariance
        if isinstance(stage.event, OdometryEvent):
            states.append(State(stage.event.stamp_ns, mean, symmetric(covariance)))
        following = stage.follows
        for link in reversed(stage.links if following else ()):
            mean, covariance = _back(link, mean, covariance)
    return states[::-1]


def _back(link: _Link, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """The smoothed estimate before a prediction, from that after it."""
    before = link.before
    std = np.sqrt(np.maximum(np.diag(link.covariance), _RIDGE))
    correlation = link.covariance / np.outer(std, std) + _RIDGE * np.eye(len(std))
    gain = np.linalg.solve(correlation, (link.jacobian @ before.covariance) / std[:, None]).T / std
    change = mean - link.mean
    change[YAW] = wrap(float(change[YAW]))
    smoothed = before.mean + gain @ change
    smoothed[YAW] = wrap(float(smoothed[YAW]))
    return smoothed, before.covariance + gain @ (covariance - link.covariance) @ gain.T
