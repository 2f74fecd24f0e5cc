# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How much noisier the odometry's turns are than expected, found while driving.

Wheels slip in turns by what no data sheet says, and a filter that expects too little follows a
wrong heading with confidence. A few small filters, which expect FACTORS times the noise, run from
measurement to measurement on the dead reckoning; each is as probable as its innovations are likely
(multiple-model estimation: Magill 1965). The factor in use is their mean, on a logarithmic scale.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.motion import ERROR, YAW, X, Y

FACTORS = np.array([1.0, 2.0, 4.0, 8.0])
"""On the standard deviation; real wheels were found to need 3 to 5."""
_PRIOR = np.array([0.0, -3.0, -4.0, -6.0])
"""Logarithms of the probabilities before: what is expected holds until the drive shows otherwise,
as clearly as any test at 2 % asks."""
SPACING_NS = 400_000_000
"""Measurements closer in time than this show no turn of their own: they are left out."""
_FORGETTING = 0.999
"""Share of the log likelihoods left after each measurement: floors change within minutes."""
_OUTLIER_D2 = 12.0
"""A d2 beyond this counts as this, and moves no filter: it is an outlier."""
_STATE = (X, Y, YAW, ERROR, ERROR + 1, ERROR + 2)


class Driven(NamedTuple):
    """Dead reckoning until a stamp: the pose, the fade of shared errors as the exponent `faded`,
    and the variances that it has added to the heading and to the position along each axis.
    """

    stamp_ns: int
    pose: tuple[float, float, float]
    faded: float
    yaw_variance: float
    variance: float


class TurnNoise(NamedTuple):
    """The filters (K, 6), (K, 6, 6) at the last measurement, and their log likelihoods (K,).

    `factor` on the standard deviation of turns is the root of the mean variance.
    """

    driven: Driven
    mean: Array
    covariance: Array
    likelihood: Array
    factor: float


def restarted(
    driven: Driven, mean: Array, covariance: Array, before: TurnNoise | None
) -> TurnNoise:
    """All filters at the state of the large one, mean (11,) and covariance (11, 11), with the
    log likelihoods from `before`.
    """
    count = len(FACTORS)
    likelihood = np.zeros(count) if before is None else before.likelihood
    return TurnNoise(
        driven,
        np.tile(mean[list(_STATE)], (count, 1)),
        np.tile(covariance[np.ix_(_STATE, _STATE)], (count, 1, 1)),
        likelihood,
        _factor(likelihood),
    )


def _factor(likelihood: Array) -> float:
    score = likelihood + _PRIOR
    weight = np.exp(score - score.max())
    return math.sqrt(float(weight @ FACTORS**2) / float(weight.sum()))


def updated(
    noise: TurnNoise, driven: Driven, value: Array, jacobian: Array, white: Array
) -> TurnNoise:
    """The filters after a measurement (2,) or (3,), with the `jacobian` (11 columns) and `white`
    noise of its event.
    """
    mean, covariance = _predicted(noise, driven)
    h = jacobian[:, list(_STATE)]
    cross = covariance @ h.T
    innovation = h @ cross + white
    inverse = np.linalg.inv(innovation)
    miss = value - mean @ h.T
    if len(value) == 3:
        miss[:, 2] = wrap_angle(miss[:, 2])
    d2 = np.einsum('ki,kij,kj->k', miss, inverse, miss)
    likelihood = -(np.minimum(d2, _OUTLIER_D2) + np.linalg.slogdet(innovation)[1]) / 2
    gain = cross @ inverse * (d2 <= _OUTLIER_D2)[:, None, None]
    mean = mean + (gain @ miss[:, :, None])[:, :, 0]
    covariance = covariance - gain @ cross.transpose(0, 2, 1)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    likelihood = _FORGETTING * noise.likelihood + likelihood - likelihood[0]
    return TurnNoise(driven, mean, covariance, likelihood, _factor(likelihood))


def _predicted(noise: TurnNoise, driven: Driven) -> tuple[Array, Array]:
    """The filters moved on by the dead reckoning since their last measurement, in one step."""
    before, mean = noise.driven, noise.mean.copy()
    turn = mean[:, 2] - before.pose[2]
    c, s = np.cos(turn), np.sin(turn)
    x, y = driven.pose[0] - before.pose[0], driven.pose[1] - before.pose[1]
    dx, dy = c * x - s * y, s * x + c * y
    # Another model's errors fade over another distance: what has faded stays so.
    fade = math.exp(min(before.faded - driven.faded, 0.0))
    mean[:, 0] += dx
    mean[:, 1] += dy
    mean[:, 2] += float(wrap_angle(driven.pose[2] - before.pose[2]))
    mean[:, 3:] *= fade
    jacobian = np.tile(np.diag([1.0, 1.0, 1.0, fade, fade, fade]), (len(mean), 1, 1))
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -dy, dx
    covariance = jacobian @ noise.covariance @ jacobian.transpose(0, 2, 1)
    yaw = FACTORS**2 * (driven.yaw_variance - before.yaw_variance)
    # A random walk of the heading moves the end of the way by half its sum.
    lever = np.stack([-dy / 2, dx / 2, np.ones_like(dx)], 1)
    covariance[:, :3, :3] += yaw[:, None, None] * lever[:, :, None] * lever[:, None, :]
    added = driven.variance - before.variance
    covariance += np.diag([added, added, 0.0, *[1 - fade**2] * 3])
    return mean, covariance
