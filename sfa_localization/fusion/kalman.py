# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""filterpy's extended Kalman filter as pure functions: beliefs go in and come out."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from sfa_localization.data.geometry import Array
from sfa_localization.fusion.belief import Belief, MeasurementEvent
from sfa_localization.fusion.inputs import symmetric
from sfa_localization.fusion.motion import SIZE, YAW, Step, wrap


class Kalman(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's equations; nothing but the last innovation is kept between calls."""

    def __init__(self) -> None:
        super().__init__(SIZE, 3)
        self._next_mean: Array = np.zeros(SIZE)

    def predicted(self, belief: Belief, step: Step) -> Array:
        """Covariance (11, 11) after a prediction: F P F^T + Q."""
        self.x, self.P, self._next_mean = belief.mean, belief.covariance, step.mean
        self.F, self.Q = step.jacobian, step.noise
        self.predict()
        return np.asarray(self.P)

    def predict_x(self, u: object = 0) -> None:
        """filterpy's hook: the motion model is nonlinear."""
        self.x = self._next_mean

    def corrected(
        self, belief: Belief, covariance: Array, event: MeasurementEvent
    ) -> tuple[Array, Array, float]:
        """Mean (11,), covariance (Joseph form) and squared Mahalanobis distance of the innovation.

        `covariance` (11, 11) is the prior one. The innovation stays in `y`, its covariance in `S`.
        """
        self.x, self.P = belief.mean, covariance
        # Array.dot throughout: on arrays this small, @ takes twice as long.
        jacobian = event.jacobian
        self.update(event.value, lambda _: jacobian, jacobian.dot, event.white, residual=_residual)
        self.x[YAW] = wrap(float(self.x[YAW]))
        return self.x, symmetric(self.P), float(self.y.dot(self.SI).dot(self.y))


def _residual(z: Array, predicted: Array) -> Array:
    """Innovation, its angle wrapped."""
    difference = z - predicted
    if len(difference) == 3:
        difference[2] = wrap(float(difference[2]))
    return difference
