# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What a drive with a fault gave: how wrong, how long wrong and sure, how soon right again."""

import dataclasses
import math

import numpy as np

from robustness.recorded import to_truth
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.evaluation import WRONG_M

WRONG_DEG = 15.0
RELIEF_S = 0.5
"""Recovered is what stays LOCALISED and right for so long."""


@dataclasses.dataclass(frozen=True, slots=True)
class Output:
    """What the filter said at one odometry message: `level` by name, and the pose.

    `second` of the drive, errors `error_m` and `yaw_deg`, and the standard deviations claimed.
    """

    second: float
    level: str
    error_m: float
    yaw_deg: float
    std_m: float
    yaw_std_deg: float
    reasons: tuple = ()

    @property
    def wrong(self):
        return self.error_m > WRONG_M or self.yaw_deg > WRONG_DEG


def output(second, status, pose, covariance, true, transform=None):
    """Compare a pose (3,) in the map, with covariance (3, 3), with the truth (3,), to which a
    transform leads: that of the recorded drives by default.
    """
    transform = transform or to_truth()
    x, y = transform.apply(np.array(pose[:2])[None])[0]
    yaw = float(transform.apply_yaw(np.array(pose[2])))
    return Output(
        second,
        status.level.name,
        math.hypot(x - true[0], y - true[1]),
        math.degrees(abs(wrap_angle(yaw - true[2]))),
        math.sqrt(max(covariance[0, 0], covariance[1, 1])),
        math.degrees(math.sqrt(covariance[2, 2])),
        status.reasons,
    )


@dataclasses.dataclass(frozen=True, slots=True)
class Verdict:
    """A row of the table: errors in meters, times in seconds; NaN where there is none."""

    max_m: float
    mean_m: float
    false_s: float
    localised_s: float
    recovered_s: float


def judge(outputs, ends_s):
    """The row of a fault that ends after so many seconds of the drive."""
    if not outputs:
        return Verdict(math.nan, math.nan, 0.0, 0.0, recovery_s((), (), ends_s))
    seconds = np.array([one.second for one in outputs])
    lasted = np.diff(seconds, prepend=seconds[:1])
    sure = np.array([one.level == 'LOCALISED' for one in outputs])
    wrong = np.array([one.wrong for one in outputs])
    errors = np.array([one.error_m for one in outputs])
    return Verdict(
        float(errors.max()),
        float(errors.mean()),
        float(lasted[sure & wrong].sum()),
        float(lasted[sure].sum()),
        recovery_s(seconds, sure & ~wrong, ends_s),
    )


def recovery_s(seconds, right, ends_s):
    """Seconds from the end of the fault until all is right for RELIEF_S; NaN if it never ends."""
    if math.isinf(ends_s):
        return math.nan
    since = None
    for second, good in zip(seconds, right, strict=True):
        if second < ends_s or not good:
            since = None
            continue
        since = second if since is None else since
        if second - since >= RELIEF_S:
            return float(since - ends_s)
    return math.inf


def head(width):
    """The line above the rows, for names of a width."""
    return f'{"fault":{width}s}  max error  mean error  false LOCALISED  LOCALISED  right again'


def row(name, one, width):
    """A verdict as text."""
    return (
        f'{name:{width}s}  {meters(one.max_m):>9s}  {meters(one.mean_m):>10s}'
        f'  {one.false_s:13.1f} s  {one.localised_s:7.1f} s  {shown(one.recovered_s):>11s}'
    )


def meters(error):
    """An error in words."""
    return '-' if math.isnan(error) else f'{error:.2f} m'


def shown(seconds):
    """Seconds of recovery in words."""
    if math.isnan(seconds):
        return '-'
    return 'never' if math.isinf(seconds) else f'{seconds:.1f} s'
