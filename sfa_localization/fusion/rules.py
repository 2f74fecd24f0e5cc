# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The rules of the filter, in three parts: predict, update, recover.

Each is a pure function of a belief and an event, so that late events can be placed where they
belong: see `history`.
"""

from __future__ import annotations

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.fusion.belief import Belief, Event, OdometryEvent, PoseEvent
from sfa_localization.fusion.kalman import Kalman
from sfa_localization.fusion.motion import MotionNoise
from sfa_localization.fusion.predict import Prediction
from sfa_localization.fusion.recover import Recovery
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.update import Correction


class Rules:
    """How a belief follows from the one before and an event, under some settings."""

    def __init__(
        self, config: FilterConfig, correlation: ErrorCorrelation, kalman: Kalman | None = None
    ) -> None:
        noise = MotionNoise(config.slip_per_metre, config.yaw_per_radian, correlation.distance_m)
        kalman = kalman or Kalman()
        self.prediction = Prediction(noise, kalman)
        self.recovery = Recovery(config, correlation)
        self.correction = Correction(config.lost_yaw_std, kalman, self.recovery)

    def step(self, belief: Belief, event: Event) -> Belief:
        """The belief after an event no earlier than it."""
        if isinstance(event, OdometryEvent):
            return self.prediction.drive(belief, event)
        belief = self.prediction.coast(belief, event.stamp_ns)
        if isinstance(event, PoseEvent):
            return self.recovery.placed(belief, event)
        return self.correction.fuse(belief, event)
