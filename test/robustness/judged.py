# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a drive: errors, seconds LOCALISED and wrong, and time to recover."""

import math
from typing import NamedTuple

import numpy as np
from page_tables import markdown

from sfa_localization.data.geometry import compose, wrap_angle
from sfa_localization.evaluation import WRONG_M

WRONG_DEG = 15.0
LARGE_M = 1.0
"""Faults that err by more have a row in test/README.md."""
RELIEF_S = 0.5
"""An estimate has recovered once it stays LOCALISED and right for this long."""
WITHIN_95 = math.sqrt(-2 * math.log(0.05)), 1.96
"""Standard deviations that contain 95 % of the errors of two coordinates, and of a single one."""


class Output(NamedTuple):
    """The filter's output at an odometry message: the name of its `level`, and the pose.

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
    x, y, yaw = compose(transform.pose, pose).tolist()
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
    seconds = np.array([each.second for each in outputs])
    lasted = np.diff(seconds, prepend=seconds[:1])
    sure = np.array([each.level == 'LOCALISED' for each in outputs])
    wrong = np.array([each.wrong for each in outputs])
    errors = np.array([each.error_m for each in outputs])
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
    far, mean, again = (with_unit(*v) for v in ((verdict.max_m, 'm'), (verdict.mean_m, 'm'),
                                            (verdict.recovered_s, 's')))  # fmt: skip
    return (
        f'{name:{width}s}  {far:>9s}  {mean:>10s}  {verdict.false_s:13.1f} s'
        f'  {verdict.localised_s:7.1f} s  {again:>11s}'
    )


def with_unit(value, unit):
    """Meters or seconds in words."""
    if not math.isfinite(value):
        return '-' if math.isnan(value) else 'never'
    return f'{value:.{2 if unit == "m" else 1}f} {unit}'


def errors_table(verdicts):
    """Return the table of the faults that do much, and a sentence on the others."""
    small = {
        name: verdict
        for name, verdict in verdicts.items()
        if not verdict.false_s and verdict.max_m <= LARGE_M
    }
    silent = [name for name, verdict in verdicts.items() if math.isnan(verdict.max_m)]
    rows = [
        [name, with_unit(verdict.max_m, 'm'), with_unit(verdict.mean_m, 'm'),
         f'{verdict.false_s:.1f} s', f'{verdict.localised_s:.1f} s',
         with_unit(verdict.recovered_s, 's')]
        for name, verdict in verdicts.items() if name not in [*small, *silent]
    ]  # fmt: skip
    worst_m = max(verdict.max_m for verdict in small.values())
    header = ['fault', 'max error:', 'mean error:', 'LOCALISED and wrong:', 'LOCALISED:',
              'right again after:']  # fmt: skip
    return markdown(header, rows) + (
        f'\nThe other {len(small)} faults err by at most {worst_m:.2f} m, and are never LOCALISED'
        f' and wrong. Faults without any estimate: {", ".join(silent) or "none"}.\n'
    )


def states(outputs):
    """Return for each state its share, the 95th percentile of its errors in m, and the shares of
    outputs that are wrong, and whose position and heading lie within 95 %.
    """
    rows = {}
    for level in ('LOCALISED', 'DEGRADED', 'LOST'):
        columns = [
            (each.error_m, each.std_m, each.yaw_deg, each.yaw_std_deg, each.wrong)
            for each in outputs
            if each.level == level
        ]
        if columns:
            error, std, yaw, yaw_std, wrong = np.transpose(columns)
            within = np.mean(error <= WITHIN_95[0] * std), np.mean(yaw <= WITHIN_95[1] * yaw_std)
            share = len(columns) / len(outputs)
            rows[level] = share, np.percentile(error, 95), np.mean(wrong), *within
    return rows


def states_table(outputs):
    """Return the states as a table."""
    header = ['state', 'share of the time:', '95 % of errors below:', 'wrong:',
              'position within 95 %:', 'heading within 95 %:']  # fmt: skip
    return markdown(header, [
        [level, f'{share:.1%}', f'{error_m:.2f} m', *(f'{part:.1%}' for part in parts)]
        for level, (share, error_m, *parts) in states(outputs).items()
    ])  # fmt: skip


def summary(outputs):
    """Return the states as text."""
    rows = [f'{"state":10s}   share  95 % of errors below  wrong  within 95 % (position, heading)']
    rows += [
        f'{level:10s}  {share:6.1%}  {error_m:18.2f} m  {wrong:5.1%}  {place:6.1%}, {yaw:6.1%}'
        for level, (share, error_m, wrong, place, yaw) in states(outputs).items()
    ]
    return '\n'.join(rows)
