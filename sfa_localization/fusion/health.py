# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the estimate can be trusted: the posterior probabilities of what may be wrong.

The last images i lie at z_i beside the path d that the odometry drove, with headings h. If all is
well, one rigid transform T lays the path on the images; or another hypothesis explains them better:

    as it is    z_i = T d(t_i) + noise
    late        z_i = T d(t_i - tau): images show the robot of tau seconds ago, or of later
    wheels      z_i = T d_f(t_i): the robot turned f times as far as the odometry
    lever       z_i = T (d(t_i) + R(h_i) l): the camera sits l beside its place on the robot
    turned      headings of images are off by one angle
    scale       images move s times as far as the odometry
    unrelated   images lie anywhere

The noise is that of the images and of the odometry's drift; a share of outliers lies anywhere.
Neighboring images err alike: all together count as about one a meter. T is eliminated in closed
form (weighted: Umeyama 1991) and by Laplace's method, tau and f by sums over grids. The filter's
state does not depend on any of this.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.fusion.belief import LONGEST_DELAY_S, Columns, DrivenPath, PositionFix
from sfa_localization.fusion.relocation import AGREEING_M

LIKELY = 0.9
"""Least probability of no harmful fault with which the estimate is trusted."""
LATE_PRIOR = 2e-2
PRIOR = 5e-3
"""Prior probability of all delays together, and of each other fault, in any window: once in some
hundred meters."""
LEVER_STD_M = 1.0
TURNED_STD_RAD = 0.6
SCALE_STD = 0.5
"""Prior standard deviations: cameras move by a meter and half a right angle, wheels slip by half.
"""
HARMLESS_M = 0.4
HARMLESS_RAD = 0.17
"""Errors of the pose below these are no fault: maps and odometry err by as much in places."""
OUTLIERS = 0.05
"""Share of images that lie anywhere."""
CAUTION = 4.0
FLOOR_M = 0.05
FLOOR_RAD = 0.02
YAW_DRIFT = 0.02
"""Factor on the variances of images and their least standard deviations, for errors that images of
one place share; heading error of the odometry, rad per m."""
DELAYS: Array = np.r_[-1.5:-0.2:0.3, 0.3, 0.6 : LONGEST_DELAY_S + 0.1 : 0.4]
"""Grid of delays, s, in addition to the compensated one."""
FACTORS: Array = np.exp(np.delete(np.arange(-10, 11), 10) * 0.05)
"""Grid of turn factors, in addition to the learned one: tracks skid. A twentieth of the turns in a
window is about the heading error that images allow."""
LONGEST_M = 16.0
"""An estimate that was placed anew again and again is confirmed over this distance at most."""
_ANYWHERE = 1 / (100.0 * 2 * math.pi)
"""Density of poses anywhere in 100 m^2, 1/(m^2 rad)."""
_TINY = 1e-9  # least weight of an image, so that some path fits best
_STEPS = 2  # of reweighting, from where the fit hardly changes
# rows that have these nuisances
_LEVER = -3
_TURNED = -2
_SCALE = -1
_AHEAD_S = 0.3  # of the path: odometry may be a little behind


class Health(NamedTuple):
    """The probability that all is `well`, and the likeliest fault with its size.

    `confirmed_m` of `needed_m` were driven since the estimate was placed.
    """

    well: float
    fault: str
    size: complex
    confirmed_m: float
    needed_m: float

    @property
    def problems(self) -> list[str]:
        """Why the estimate is not trusted, in words."""
        problems = [] if self.well >= LIKELY else [_sentence(self.fault, self.size)]
        if self.confirmed_m < self.needed_m:
            so_far = f'{self.confirmed_m:.1f} of {self.needed_m:.0f} m'
            problems.append(f'placed, confirmed over {so_far}: driving on confirms it')
        return problems


def _sentence(fault: str, size: complex) -> str:
    """A fault in words, with what to do."""
    if fault == 'late':
        late = 'late' if size.real > 0 else 'early'
        return f'images are stamped {abs(size):.1f} s {late}, or delayed: synchronize the clocks'
    if fault == 'lever':
        ahead = f'{abs(size.real):.1f} m {"ahead" if size.real > 0 else "behind"}'
        aside = f'{abs(size.imag):.1f} m {"left" if size.imag > 0 else "right"}'
        return f'images show places {ahead} and {aside} of the robot: was the camera moved?'
    if fault == 'turned':
        degrees = math.degrees(size.real)
        return f'images look {degrees:.0f} degrees off the motion: was the camera turned?'
    if fault == 'wheels':
        return f'images turn {size.real:.1f} times as far as the odometry: do the wheels skid?'
    if fault == 'scale':
        return f'images move {size.real:.1f} times as far as the odometry'
    return 'images and odometry show different motions'


def health_of(path: DrivenPath, fixes: Sequence[PositionFix]) -> Health:
    """The health of an estimate from images along a path."""
    confirmed_m = max((fixes[-1].traveled_m if fixes else 0.0) - path.placed_m[-1], 0.0)
    # Each time that images which agree over as many meters place it anew doubles them.
    needed_m = min(AGREEING_M * 2.0 ** max(len(path.placed_m) - 2, 0), LONGEST_M)
    new = [fix for fix in fixes if fix.is_new]
    if len(new) <= 3:  # so few always lie on some path
        return Health(1.0, '', 0j, confirmed_m, needed_m)
    hypotheses = _Window(path, new).hypotheses()
    largest = max(each.log_odds for each in hypotheses)
    odds = np.exp([each.log_odds - largest for each in hypotheses])
    odds = np.where([each.is_harmful for each in hypotheses], odds, 0.0) / odds.sum()
    worst = hypotheses[int(np.argmax(odds))]
    well = 1 - float(odds.sum())
    return Health(well, worst.name, complex(worst.size), confirmed_m, needed_m)


class _Hypothesis(NamedTuple):
    """What may be wrong, its size (seconds, m ahead + i m to the left, rad, or a factor), and
    whether it displaces the robot by more than is harmless.
    """

    name: str
    log_odds: float
    size: complex
    is_harmful: bool


class _Window:
    """The images (N,) beside a path. Rows (R, N) are paths that they may have followed; positions
    in the plane are complex numbers.
    """

    def __init__(self, path: DrivenPath, fixes: Sequence[PositionFix]) -> None:
        images = Columns(fixes)
        newest_ns = fixes[-1].stamp_ns
        self._is_recent = images.behind_m <= AGREEING_M
        self._seconds = (images.stamps_ns - newest_ns) * 1e-9
        self._places = images.place
        self._looks = np.exp(1j * images.yaw)
        yaw_drift = (YAW_DRIFT * images.behind_m) ** 2
        self._variance = CAUTION * images.variance + FLOOR_M**2 + images.drift
        self._yaw_variance = CAUTION * images.yaw_variance + FLOOR_RAD**2 + yaw_drift
        yaw_width = np.sqrt(2 * np.pi * np.where(images.has_yaw, self._yaw_variance, 2 * np.pi))
        self._peak = (1 - OUTLIERS) / (2 * np.pi * self._variance * yaw_width)
        stamps_ns, x, y, yaw = map(np.array, zip(*path.knots, strict=True))
        self._times = (stamps_ns - newest_ns) * 1e-9
        self._path = x + 1j * y
        self._path_yaw = np.unwrap(yaw)
        self._power = min(1.0, max(1 + images.behind_m[0], 3.0) / len(fixes))

    def hypotheses(self) -> list[_Hypothesis]:
        """All, with log odds up to a constant."""
        rows, yaws, delays = self._paths()
        turned_rows, turned_yaws = self._turned_paths(rows[0], yaws[0])
        rows = np.concatenate([rows, turned_rows, np.repeat(rows[:1], 3, 0)])
        yaws = np.concatenate([yaws, turned_yaws, np.repeat(yaws[:1], 3, 0)])
        off = np.abs(rows[:, -1] - rows[0, -1]) > HARMLESS_M
        off |= np.abs(yaws[:, -1] - yaws[0, -1]) > HARMLESS_RAD
        logs, (lever, turned, scale) = self._fitted(rows, yaws)
        prior = math.log(PRIOR)
        late_prior = math.log(LATE_PRIOR / len(DELAYS))
        wheels_prior = math.log(PRIOR / len(FACTORS))
        as_it_is = math.log(1 - LATE_PRIOR - 5 * PRIOR)
        unrelated = self._power * len(self._places) * math.log(_ANYWHERE)
        of_scale = abs(scale - 1) * AGREEING_M > HARMLESS_M
        late = slice(1, len(delays))
        wheels = slice(len(delays), len(rows) - 3)
        of_delays = zip(logs[late] + late_prior, delays[late], off[late], strict=True)
        turned_lately = float(np.ptp(yaws[0, self._is_recent]))
        misturned = np.abs(FACTORS - 1) * turned_lately > HARMLESS_RAD
        of_factors = zip(logs[wheels] + wheels_prior, FACTORS, misturned, strict=True)
        return [
            _Hypothesis('as it is', logs[0] + as_it_is, 0j, False),
            _Hypothesis('lever', logs[_LEVER] + prior, lever, abs(lever) > HARMLESS_M),
            _Hypothesis('turned', logs[_TURNED] + prior, turned, abs(turned) > HARMLESS_RAD),
            _Hypothesis('scale', logs[_SCALE] + prior, scale, of_scale),
            _Hypothesis('unrelated', unrelated + prior, 0j, True),
            *(_Hypothesis('late', *each) for each in of_delays),
            *(_Hypothesis('wheels', *each) for each in of_factors),
        ]

    def _paths(self) -> tuple[Complex, Array, Array]:
        """Places and headings (R, N) on the path by the delays (R,) for which it is long enough."""
        delays = np.append(0.0, DELAYS)
        earliest = self._seconds[0] - delays
        latest = self._seconds[-1] - delays
        covered = (earliest >= self._times[0]) & (latest <= self._times[-1] + _AHEAD_S)
        delays = delays[covered | (delays == 0.0)]
        at = self._seconds - delays[:, None]
        places, yaws = (np.interp(at, self._times, x) for x in (self._path, self._path_yaw))
        return places, yaws, delays

    def _turned_paths(self, places: Complex, yaws: Array) -> tuple[Complex, Array]:
        """Places and headings (R, N) on the path that turns FACTORS (R,) times as far."""
        beyond = (FACTORS[:, None] - 1.0) * (yaws - yaws[0])
        between = np.exp(1j * (beyond[:, 1:] + beyond[:, :-1]) / 2)
        steps = np.cumsum(between * np.diff(places), axis=1)
        return places[0] + np.insert(steps, 0, 0.0, axis=1), yaws + beyond

    def _fitted(self, rows: Complex, yaws: Array) -> tuple[Array, tuple[complex, float, float]]:
        """Log evidence (R,) of paths, and lever, angle and factor, which the last three have.

        With weights w and w', centered places z and path d, and v = exp(i (yaw - h)), the error
        sum w |z - u d|^2 + w' |v - u|^2 is least for the u along sum w conj(d) z + w' v.
        """
        arm = np.exp(1j * yaws)
        ones = np.ones((len(rows), 1))
        look = self._looks * np.conj(arm)
        weight = np.ones(rows.shape)
        lever = 0j * ones
        angle = 0.0 * ones
        factor = 1.0 * ones
        by_yaw = 1.0 * ones
        by_yaw[_TURNED] = 0.0  # before its angle is estimated
        for _ in range(_STEPS):
            w = weight / self._variance
            w_yaw = weight / self._yaw_variance
            total, of_yaw = (each.sum(1, keepdims=True) for each in (w, w_yaw))
            d, g, z = (x - (w * x).sum(1, keepdims=True) / total for x in (rows, arm, self._places))
            looks = (w_yaw * look).sum(1, keepdims=True)
            path = factor * d + lever * g
            u = (w * np.conj(path) * z).sum(1, keepdims=True)
            u = u + looks * np.exp(-1j * angle) * by_yaw
            u = u / np.maximum(np.abs(u), _TINY)
            by_yaw = ones
            arms = w[_LEVER] * np.conj(g[_LEVER])
            ways = w[_SCALE] * np.conj(d[_SCALE])
            of_arm = float((arms @ g[_LEVER]).real) + LEVER_STD_M**-2
            of_path = float((ways @ d[_SCALE]).real) + SCALE_STD**-2
            of_angle = float(of_yaw[_TURNED, 0]) + TURNED_STD_RAD**-2
            lever[_LEVER] = arms @ (z[_LEVER] * np.conj(u[_LEVER]) - d[_LEVER]) / of_arm
            along = (np.conj(u[_SCALE]) * (ways @ z[_SCALE])).real
            factor[_SCALE] = (along + SCALE_STD**-2) / of_path
            turned = np.angle(looks[_TURNED] * np.conj(u[_TURNED]))
            angle[_TURNED] = turned * of_yaw[_TURNED] / of_angle
            path = factor * d + lever * g
            squares = np.abs(z - u * path) ** 2 / self._variance
            squares += 2 * (1 - (look * np.conj(u * np.exp(1j * angle))).real) / self._yaw_variance
            fits = self._peak * np.exp(-0.5 * squares)
            anything = fits + OUTLIERS * _ANYWHERE
            weight = fits / anything + _TINY
        square = (w * np.abs(path) ** 2).sum(1) + of_yaw[:, 0] + _TINY
        log = np.log(anything).sum(1) - np.log(total[:, 0]) - 0.5 * np.log(square)
        log += math.log(_ANYWHERE * (2 * math.pi) ** 1.5)
        sizes = complex(lever[_LEVER, 0]), float(angle[_TURNED, 0]), float(factor[_SCALE, 0])
        log[_LEVER:] -= _unlikely(sizes, (of_arm, of_angle, of_path))
        return self._power * log, sizes


def _unlikely(sizes: tuple[complex, float, float], precision: tuple[float, ...]) -> Array:
    """Minus the log of the prior density times the posterior width of each nuisance (Laplace)."""
    stds = np.array([LEVER_STD_M, TURNED_STD_RAD, SCALE_STD])
    squares = np.abs(np.subtract(sizes, (0, 0, 1)) / stds) ** 2
    return np.asarray(squares + np.log(precision * stds**2) * [2, 1, 1]) / 2
