# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the estimate can be trusted: one posterior over what may be the matter with images.

The last images i lie beside the path d that the odometry drove, with headings h. If all is well,
one rigid transform T lays the path on the images; or something else explains them better:

    as it is    z_i = T d(t_i) + noise
    late        z_i = T d(t_i - tau): images show the robot of tau seconds ago, or of later
    lever       z_i = T (d(t_i) + R(h_i) l): the camera sits l beside its place on the robot
    turned      headings of images are off by one angle
    scale       images move s times as far as the odometry
    unrelated   images lie anywhere

The noise is that of the images and of the odometry's drift; a share of outliers lies anywhere.
Neighboring images err alike: all together count as about one a meter. T is eliminated in closed
form (weighted: Umeyama 1991) and by Laplace's method, tau by a sum over a grid. Nothing of this
reaches the filter's state: it is a function of what the filter remembers of the drive since images
last placed it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.fusion.relocation import AGREEING_M
from sfa_localization.fusion.track import LONGEST_DELAY_S, Columns, Image, Track

LIKELY = 0.9
"""Probability of nothing harmful from which the estimate is trusted."""
PRIOR = {'late': 2e-2, 'lever': 5e-3, 'turned': 5e-3, 'scale': 5e-3, 'unrelated': 5e-3}
"""Probabilities of what is the matter, in any window: once in some hundred meters."""
LEVER_STD_M, TURNED_STD_RAD, SCALE_STD = 1.0, 0.6, 0.5
"""How large nuisances are, if there are any: cameras move by a meter and half a right angle, wheels
slip or measure by half."""
HARMLESS_M, HARMLESS_RAD = 0.4, 0.17
"""What moves the robot by less is no fault: maps and odometry err by as much in places."""
OUTLIERS = 0.05
"""Share of images that lie anywhere."""
CAUTION, FLOOR_M, FLOOR_RAD, YAW_DRIFT = 4.0, 0.05, 0.02, 0.02
"""Factor on the variances of images, their least standard deviations, and the odometry's error of
the heading, rad per m: for what images of one place have in common."""
DELAYS: Array = np.r_[-1.5:-0.2:0.3, 0.3, 0.6 : LONGEST_DELAY_S + 0.1 : 0.4]
"""Delays s that are distinguished, beside those that the camera's clock compensates."""
LONGEST_M = 16.0
"""An estimate that was placed anew again and again is confirmed over this distance at most."""
_ANYWHERE = 1 / (100.0 * 2 * math.pi)
"""Density of poses anywhere in 100 m^2, 1/(m^2 rad)."""
_TINY = 1e-9  # part of an image's weight that is left, so that some path fits best
_STEPS = 2  # of reweighting, from where the fit hardly changes
_LEVER, _TURNED, _SCALE = -3, -2, -1  # rows that have these nuisances
_AHEAD_S = 0.3  # of the path: odometry may be a little behind


class Health(NamedTuple):
    """The probability that all is `well`, the likeliest fault with its size, and what faults may
    add to the variances of x, y and yaw.

    `confirmed_m` of `needed_m` were driven since the estimate was placed.
    """

    well: float
    fault: str
    size: complex
    variances: tuple[float, float, float]
    confirmed_m: float
    needed_m: float

    @property
    def problems(self) -> list[str]:
        """Why the estimate is not trusted, in words."""
        found = [] if self.well >= LIKELY else [_told(self.fault, self.size)]
        if self.confirmed_m < self.needed_m:
            so_far = f'{self.confirmed_m:.1f} of {self.needed_m:.0f} m'
            found.append(f'placed, confirmed over {so_far}: driving on confirms it')
        return found


def _told(fault: str, size: complex) -> str:
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
    if fault == 'scale':
        return f'images move {size.real:.1f} times as far as the odometry'
    return 'images and odometry show different motions'


def health_of(track: Track, images: Sequence[Image]) -> Health:
    """What images beside a track show."""
    traveled_m = images[-1].traveled_m if images else 0.0
    # Each time that it is placed anew, by images that agree over as many meters, doubles them.
    placed_m = (track.since_m, *track.placed_m)
    needed_m = min(AGREEING_M * 2.0 ** max(len(placed_m) - 2, 0), LONGEST_M)
    confirmed_m = max(traveled_m - placed_m[-1], 0.0)
    new = [image for image in images if image.is_new]
    if len(new) <= 3:  # so few always lie on some path
        return Health(1.0, '', 0j, (0.0, 0.0, 0.0), confirmed_m, needed_m)
    found = _Window(track, new).hypotheses()
    largest = max(item.log_odds for item in found)
    odds = np.exp([item.log_odds - largest for item in found])
    odds = np.where([item.is_harmful for item in found], odds, 0.0) / odds.sum()
    worst = found[int(np.argmax(odds))]
    place, turned = (odds @ np.square([(item.off_m, item.off_rad) for item in found])).tolist()
    well = 1 - float(odds.sum())
    # What nothing shows, as a delay on a circle, makes nobody doubt.
    off = (0.0, 0.0, 0.0) if well >= LIKELY else (place / 2, place / 2, turned)
    return Health(well, worst.name, complex(worst.size), off, confirmed_m, needed_m)


class _Hypothesis(NamedTuple):
    """What may be the matter, its size (seconds, m ahead + i m to the left, rad, or a factor), and
    how far off it lets images put the robot now.
    """

    name: str
    log_odds: float
    size: complex = 0j
    off_m: float = 0.0
    off_rad: float = 0.0

    @property
    def is_harmful(self) -> bool:
        return self.off_m > HARMLESS_M or self.off_rad > HARMLESS_RAD


class _Window:
    """The images (N,) of a track, and the path beside them. Rows (R, N) are paths that they may
    have followed; positions in the plane are complex numbers.
    """

    def __init__(self, track: Track, images: Sequence[Image]) -> None:
        seen, newest_ns = Columns(images), images[-1].stamp_ns
        self._seconds, self._places = (seen.stamps_ns - newest_ns) * 1e-9, seen.place
        self._looks, yaw_drift = np.exp(1j * seen.yaw), (YAW_DRIFT * seen.behind_m) ** 2
        self._variance = CAUTION * seen.variance + FLOOR_M**2 + seen.drift
        self._yaw_variance = CAUTION * seen.yaw_variance + FLOOR_RAD**2 + yaw_drift
        yaw_width = np.sqrt(2 * np.pi * np.where(seen.has_yaw, self._yaw_variance, 2 * np.pi))
        self._peak = (1 - OUTLIERS) / (2 * np.pi * self._variance * yaw_width)
        stamps_ns, x, y, yaw = map(np.array, zip(*track.knots, strict=True))
        self._times = (stamps_ns - newest_ns) * 1e-9
        self._path, self._path_yaw = x + 1j * y, np.unwrap(yaw)
        self._power = min(1.0, max(1 + seen.behind_m[0], 3.0) / len(images))

    def hypotheses(self) -> list[_Hypothesis]:
        """All, with log odds up to a constant."""
        rows, yaws, delays = self._paths()
        rows, yaws = (np.concatenate([x, np.repeat(x[:1], 3, 0)]) for x in (rows, yaws))
        logs, (lever, turned, scale) = self._fitted(rows, yaws)
        off_m, off_rad = np.abs(rows[:-3, -1] - rows[0, -1]), np.abs(yaws[:-3, -1] - yaws[0, -1])
        of_delays = np.array([logs[:-3], delays, off_m, off_rad]).T.tolist()
        late = [_Hypothesis('late', *each) for each in of_delays]
        nothing = self._power * len(self._places) * math.log(_ANYWHERE)
        found = [
            late[0]._replace(name='as it is'),
            _Hypothesis('lever', logs[_LEVER], lever, abs(lever)),
            _Hypothesis('turned', logs[_TURNED], turned, 0.0, abs(turned)),
            _Hypothesis('scale', logs[_SCALE], scale, abs(scale - 1) * AGREEING_M),
            _Hypothesis('unrelated', nothing, 0j, AGREEING_M),
            *late[1:],
        ]
        shares = {**PRIOR, 'as it is': 1 - sum(PRIOR.values()), 'late': PRIOR['late'] / len(DELAYS)}
        return [
            item._replace(log_odds=item.log_odds + math.log(shares[item.name])) for item in found
        ]

    def _paths(self) -> tuple[Complex, Array, Array]:
        """Places and headings (R, N) on the path by the delays (R,) at which all are known."""
        delays = np.append(0.0, DELAYS)
        earliest, latest = self._seconds[0] - delays, self._seconds[-1] - delays
        known = (earliest >= self._times[0]) & (latest <= self._times[-1] + _AHEAD_S)
        delays = delays[known | (delays == 0.0)]
        at = self._seconds - delays[:, None]
        places, yaws = (np.interp(at, self._times, x) for x in (self._path, self._path_yaw))
        return places, yaws, delays

    def _fitted(self, rows: Complex, yaws: Array) -> tuple[Array, tuple[complex, float, float]]:
        """Log evidence (R,) of paths, and lever, angle and factor, which the last three have.

        With weights w and w', centered places z and path d, and v = exp(i (yaw - h)), the error
        sum w |z - u d|^2 + w' |v - u|^2 is least for the u along sum w conj(d) z + w' v.
        """
        arm, one = np.exp(1j * yaws), np.ones((len(rows), 1))
        look, weight = self._looks * np.conj(arm), np.ones(rows.shape)
        lever, angle, factor, by_yaw = 0j * one, 0.0 * one, 1.0 * one, 1.0 * one
        by_yaw[_TURNED] = 0.0  # before its angle is known
        for _ in range(_STEPS):
            w, w_yaw = weight / self._variance, weight / self._yaw_variance
            total, of_yaw = (each.sum(1, keepdims=True) for each in (w, w_yaw))
            d, g, z = (x - (w * x).sum(1, keepdims=True) / total for x in (rows, arm, self._places))
            seen, path = (w_yaw * look).sum(1, keepdims=True), factor * d + lever * g
            u = (w * np.conj(path) * z).sum(1, keepdims=True)
            u = u + seen * np.exp(-1j * angle) * by_yaw
            u, by_yaw = u / np.maximum(np.abs(u), _TINY), one
            arms, ways = w[_LEVER] * np.conj(g[_LEVER]), w[_SCALE] * np.conj(d[_SCALE])
            of_arm = float((arms @ g[_LEVER]).real) + LEVER_STD_M**-2
            of_path = float((ways @ d[_SCALE]).real) + SCALE_STD**-2
            of_angle = float(of_yaw[_TURNED, 0]) + TURNED_STD_RAD**-2
            lever[_LEVER] = arms @ (z[_LEVER] * np.conj(u[_LEVER]) - d[_LEVER]) / of_arm
            along = (np.conj(u[_SCALE]) * (ways @ z[_SCALE])).real
            factor[_SCALE] = (along + SCALE_STD**-2) / of_path
            turned = np.angle(seen[_TURNED] * np.conj(u[_TURNED]))
            angle[_TURNED] = turned * of_yaw[_TURNED] / of_angle
            path = factor * d + lever * g
            apart = np.abs(z - u * path) ** 2 / self._variance
            apart += 2 * (1 - (look * np.conj(u * np.exp(1j * angle))).real) / self._yaw_variance
            fits = self._peak * np.exp(-0.5 * apart)
            anything = fits + OUTLIERS * _ANYWHERE
            weight = fits / anything + _TINY
        square = (w * np.abs(path) ** 2).sum(1) + of_yaw[:, 0] + _TINY
        log = np.log(anything).sum(1) - np.log(total[:, 0]) - 0.5 * np.log(square)
        log += math.log(_ANYWHERE * (2 * math.pi) ** 1.5)
        sizes = complex(lever[_LEVER, 0]), float(angle[_TURNED, 0]), float(factor[_SCALE, 0])
        log[_LEVER:] -= _unexpected(sizes, (of_arm, of_angle, of_path))
        return self._power * log, sizes


def _unexpected(sizes: tuple[complex, float, float], known: tuple[float, ...]) -> list[float]:
    """Minus the log of what is expected of lever, angle and factor, over how exactly each is then
    `known` (Laplace).
    """
    lever, angle, factor = sizes
    stds, dimensions = (LEVER_STD_M, TURNED_STD_RAD, SCALE_STD), (2, 1, 1)
    each = zip((abs(lever), angle, factor - 1), stds, known, dimensions, strict=True)
    return [((x / std) ** 2 + n * math.log(of * std**2)) / 2 for x, std, of, n in each]
