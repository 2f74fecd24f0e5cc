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
state does not depend on any of this. Where odometry is missing, d is a guess: no fault is named.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.data.rig import TURN_FACTOR_STD
from sfa_localization.fusion.belief import LONGEST_DELAY_S, Columns, DrivenPath, PositionFix
from sfa_localization.fusion.relocation import AGREEING_M, aligned, centered, summed

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
EXPECTED = 4 * TURN_FACTOR_STD
"""Nearer to the learned factor, the state of the filter follows by itself: real wheels are off by
up to a tenth, and turn on the spot."""
LONGEST_M = 16.0
"""An estimate that was placed anew again and again is confirmed over this distance at most."""
MISSING = 'odometry was missing while images came: is it lost, or this computer too busy?'
_ANYWHERE = 1 / (100.0 * 2 * math.pi)
"""Density of poses anywhere in 100 m^2, 1/(m^2 rad)."""
_TINY = 1e-9  # least weight of an image, so that some path fits best
_STEPS = 2  # of reweighting, from where the fit hardly changes
_AHEAD_S = 0.3  # of the path: odometry may be a little behind


class Health(NamedTuple):
    """The probability that all is `well`, and the likeliest fault with its size.

    `confirmed_m` of `needed_m` were driven since the estimate was placed. Where messages have
    `waited_s` for this program, they seem late, and no clock is to blame. The path `is_guess` where
    odometry was missing for some of the images.
    """

    well: float
    fault: str
    size: complex
    confirmed_m: float
    needed_m: float
    is_guess: bool = False
    waited_s: float = 0.0

    @property
    def is_busy(self) -> bool:
        """Whether images seem late, and messages had to wait."""
        return self.well < LIKELY and self.fault == 'late' and self.waited_s > 0

    @property
    def problems(self) -> list[str]:
        """Why the estimate is not trusted, in words."""
        problems = [] if self.well >= LIKELY else [_sentence(self.fault, self.size)]
        if problems and self.is_guess:
            problems = [MISSING]
        if self.is_busy:
            problems = [busy(self.waited_s)]
        if self.confirmed_m < self.needed_m:
            so_far = f'{self.confirmed_m:.1f} of {self.needed_m:.0f} m'
            problems.append(f'placed, confirmed over {so_far}: driving on confirms it')
        return problems


def busy(waited_s: float) -> str:
    """That messages had to wait for this program, in words."""
    return f'messages have waited {waited_s:.1f} s: this computer is too busy'


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
    is_guess = not all(fix.is_reckoned for fix in fixes)
    return Health(well, worst.name, complex(worst.size), confirmed_m, needed_m, is_guess)


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
        places, yaws = self._driven(np.zeros(1))
        well = self._fitted(places, yaws, 1 - LATE_PRIOR - 5 * PRIOR)
        unrelated = self._power * len(self._places) * math.log(_ANYWHERE) + math.log(PRIOR)
        return [
            _Hypothesis('as it is', well.log[0], 0j, False),
            _Hypothesis('unrelated', unrelated, 0j, True),
            *self._delayed(places, yaws),
            *self._turned_by_factors(places, yaws),
            self._with_lever(places, yaws),
            self._with_turned_camera(places, yaws),
            self._with_scale(places, yaws),
        ]

    def _driven(self, delays: Array) -> tuple[Complex, Array]:
        """Places and headings (R, N) on the path by delays (R,)."""
        at = self._seconds - delays[:, None]
        return np.interp(at, self._times, self._path), np.interp(at, self._times, self._path_yaw)

    def _delayed(self, places: Complex, yaws: Array) -> Iterator[_Hypothesis]:
        """Of the delays for which the path is long enough."""
        earliest = self._seconds[0] - DELAYS
        latest = self._seconds[-1] - DELAYS
        covered = (earliest >= self._times[0]) & (latest <= self._times[-1] + _AHEAD_S)
        delays = DELAYS[covered]
        late_places, late_yaws = self._driven(delays)
        harmful = np.abs(late_places - places)[:, -1] > HARMLESS_M
        harmful |= np.abs(late_yaws - yaws)[:, -1] > HARMLESS_RAD
        fits = self._fitted(late_places, late_yaws, LATE_PRIOR / len(DELAYS))
        for each in zip(fits.log, delays, harmful, strict=True):
            yield _Hypothesis('late', *each)

    def _turned_by_factors(self, places: Complex, yaws: Array) -> Iterator[_Hypothesis]:
        """Of a path that turns FACTORS times as far."""
        beyond = (FACTORS[:, None] - 1.0) * (yaws - yaws[:, :1])
        between = np.exp(1j * (beyond[:, 1:] + beyond[:, :-1]) / 2)
        ways = np.cumsum(between * np.diff(places), axis=1)
        unexpected = np.abs(FACTORS - 1) > EXPECTED
        misturned = np.abs(FACTORS - 1) * np.ptp(yaws[0, self._is_recent]) > HARMLESS_RAD
        turned_places = np.insert(ways, 0, 0.0, axis=1)
        fits = self._fitted(turned_places, yaws + beyond, PRIOR / len(FACTORS))
        for each in zip(fits.log, FACTORS, unexpected & misturned, strict=True):
            yield _Hypothesis('wheels', *each)

    def _with_lever(self, places: Complex, yaws: Array) -> _Hypothesis:
        """Of a camera beside its place on the robot."""
        fit = self._fitted(places, yaws, PRIOR, LEVER_STD_M * np.exp(1j * yaws))
        lever = LEVER_STD_M * fit.shift.item()
        return _Hypothesis('lever', fit.log[0], lever, abs(lever) > HARMLESS_M)

    def _with_turned_camera(self, places: Complex, yaws: Array) -> _Hypothesis:
        """Of headings that are all off by one angle."""
        fit = self._fitted(places, yaws, PRIOR, angle_std=TURNED_STD_RAD)
        angle = TURNED_STD_RAD * fit.angle.item()
        return _Hypothesis('turned', fit.log[0], angle, abs(angle) > HARMLESS_RAD)

    def _with_scale(self, places: Complex, yaws: Array) -> _Hypothesis:
        """Of images that move farther than the odometry, or less far."""
        fit = self._fitted(places, yaws, PRIOR, SCALE_STD * places, axes=1)
        longer = SCALE_STD * fit.shift.item()
        is_harmful = abs(longer) * AGREEING_M > HARMLESS_M
        return _Hypothesis('scale', fit.log[0], 1 + longer, is_harmful)

    def _fitted(
        self,
        places: Complex,
        yaws: Array,
        prior: float,
        direction: Complex | float = 0.0,
        axes: int = 2,
        angle_std: float = 0.0,
    ) -> _Fits:
        """Paths of `places` and `yaws` (R, N), each of this prior probability, laid on the images
        by least squares, repeated with weights that fall with the residuals.

        One nuisance may be open: paths are displaced along a `direction` (R, N), or headings are
        off by an angle of this standard deviation.
        """
        looks = self._looks * np.exp(-1j * yaws)
        share = np.ones(places.shape)
        displaced = places
        turned = 0.0 * looks if angle_std else looks  # before the angle is estimated
        for _ in range(_STEPS):
            w = share / self._variance
            w_yaw = share / self._yaw_variance
            shown, u = aligned(displaced, self._places, turned, w, w_yaw)
            missed = np.conj(u) * shown - centered(places, w)
            off = np.angle(np.conj(u) * summed(w_yaw * looks))
            shift = _Nuisance.along(centered(direction, w), missed, w, axes)
            angle = _Nuisance.along(angle_std, off, summed(w_yaw), 1)
            displaced = places + shift.size * direction
            turned = looks * np.exp(-1j * angle_std * angle.size)
            density = self._density(shown - u * centered(displaced, w), turned * np.conj(u))
            share = 1 - OUTLIERS * _ANYWHERE / density + _TINY
        log = _log_evidence(density, displaced, w, w_yaw) - shift.surplus - angle.surplus
        log = self._power * log + math.log(prior)
        return _Fits(log[:, 0], shift.size, angle.size)

    def _density(self, missed: Complex, turned: Complex) -> Array:
        """Of images (R, N) that lie `missed` from their places, and whose headings are `turned`."""
        squares = np.abs(missed) ** 2 / self._variance
        squares += 2 * (1 - turned.real) / self._yaw_variance
        return np.asarray(self._peak * np.exp(-0.5 * squares) + OUTLIERS * _ANYWHERE)


def _log_evidence(density: Array, places: Complex, w: Array, w_yaw: Array) -> Array:
    """Of paths (R, 1), by Laplace's method over their shift and turn."""
    reach = summed(w * np.abs(centered(places, w)) ** 2 + w_yaw) + _TINY
    log = summed(np.log(density)) - np.log(summed(w)) - np.log(reach) / 2
    return np.asarray(log + math.log(_ANYWHERE * (2 * math.pi) ** 1.5))


class _Fits(NamedTuple):
    """Log odds (R,) of paths, and the sizes (R, 1) of their nuisances in units of the priors."""

    log: Array
    shift: NDArray[Any]
    angle: NDArray[Any]


class _Nuisance(NamedTuple):
    """Sizes (R, 1), whose prior has unit variance along each of the `axes`: a complex size, or with
    one axis a real one; and their precision by prior and images."""

    size: NDArray[Any]
    precision: Array
    axes: int

    @classmethod
    def along(
        cls, direction: Complex | float, missed: NDArray[Any], weight: Array, axes: int
    ) -> _Nuisance:
        """The likeliest that explains what is `missed` (R, N) by this `direction` (R, N)."""
        weighted = weight * np.conj(direction)
        precision = 1 + summed((weighted * direction).real)
        size = summed(weighted * missed) / precision
        return cls(size if axes == 2 else size.real, precision, axes)

    @property
    def surplus(self) -> Array:
        """Minus the log of the prior density times the posterior width (Laplace)."""
        return np.asarray(np.abs(self.size) ** 2 + self.axes * np.log(self.precision)) / 2
