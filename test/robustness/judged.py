# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a drive: errors, seconds LOCALISED and wrong, and time to recover."""

import math
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import wrap_angle
from sfa_localization.evaluation import WRONG_M

WRONG_DEG = 15.0
RELIEF_S = 0.5
"""Recovered is what stays LOCALISED and right for so long."""
WITHIN_95 = math.sqrt(-2 * math.log(0.05)), 1.96
"""Standard deviations that hold 95 % of the errors: of two coordinates, and of one."""


class Output(NamedTuple):
    """What the filter said at one odometry message: `level` by name, and the pose.

    `second` of the drive, errors `error_m` and `yaw_deg`, and the standard deviations claimed.
    """

    second: float
    level: str
    error_m: float
    yaw_deg: float
    std_m: float
    yaw_std_deg: float

    @property
    def wrong(self):
        return self.error_m > WRONG_M or self.yaw_deg > WRONG_DEG


def output(second, status, pose, covariance, true, transform):
    """Compare a pose (3,) in the map, with covariance (3, 3), with the truth (3,), to which a
    transform leads.
    """
    x, y = transform.apply(np.array(pose[:2])[None])[0]
    yaw = float(transform.apply_yaw(np.array(pose[2])))
    return Output(
        second,
        status.level.name,
        math.hypot(x - true[0], y - true[1]),
        math.degrees(abs(wrap_angle(yaw - true[2]))),
        math.sqrt(max(covariance[0, 0], covariance[1, 1])),
        math.degrees(math.sqrt(covariance[2, 2])),
    )


class Verdict(NamedTuple):
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
    seconds = np.array([said.second for said in outputs])
    lasted = np.diff(seconds, prepend=seconds[:1])
    sure = np.array([said.level == 'LOCALISED' for said in outputs])
    wrong = np.array([said.wrong for said in outputs])
    errors = np.array([said.error_m for said in outputs])
    times = lasted[sure & wrong].sum(), lasted[sure].sum()
    made = float(errors.max()), float(errors.mean()), *map(float, times)
    return Verdict(*made, recovery_s(seconds, sure & ~wrong, ends_s))


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


def row(name, verdict, width):
    """A verdict as text."""
    far, mean, again = (in_words(*v) for v in ((verdict.max_m, 'm'), (verdict.mean_m, 'm'),
                                            (verdict.recovered_s, 's')))  # fmt: skip
    return (
        f'{name:{width}s}  {far:>9s}  {mean:>10s}  {verdict.false_s:13.1f} s'
        f'  {verdict.localised_s:7.1f} s  {again:>11s}'
    )


def in_words(value, unit):
    """Meters or seconds in words."""
    if not math.isfinite(value):
        return '-' if math.isnan(value) else 'never'
    return f'{value:.{2 if unit == "m" else 1}f} {unit}'


def summary(outputs):
    """A line for each state: its seconds, its errors, and the share that its claims hold."""
    rows = [f'{"state":10s}   share  95 % of errors below  wrong  within 95 % (position, heading)']
    for level in ('LOCALISED', 'DEGRADED', 'LOST'):
        mine = [said for said in outputs if said.level == level]
        if not mine:
            continue
        error, std, yaw, yaw_std, wrong = np.transpose(
            [
                (said.error_m, said.std_m, said.yaw_deg, said.yaw_std_deg, said.wrong)
                for said in mine
            ]
        )
        within = np.mean(error <= WITHIN_95[0] * std), np.mean(yaw <= WITHIN_95[1] * yaw_std)
        rows.append(
            f'{level:10s}  {len(mine) / len(outputs):6.1%}  {np.percentile(error, 95):18.2f} m'
            f'  {np.mean(wrong):5.1%}  {within[0]:6.1%}, {within[1]:6.1%}'
        )
    return '\n'.join(rows)
