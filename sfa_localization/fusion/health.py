# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the estimate can be trusted: one posterior over what may be the matter with images.

The last images i lie beside the path d that the odometry drove, with headings h. If all is well,
one rigid transform T lays the path on the images; or something else explains them better:

    as it is    z_i = T d(t_i) + noise
    carried     the same, with another T from some image on, where the filter was placed anew
    late        z_i = T d(t_i - tau): images show the robot of tau seconds ago, or of later
    lever       z_i = T (d(t_i) + R(h_i) l): the camera sits l beside its place on the robot
    turned      headings of images are off by one angle
    scale       images move s times as far as the odometry
    unrelated   images lie anywhere

The noise is that of the images and of the odometry's drift; a share of outliers lies anywhere.
Neighboring images err alike: all together count as about one a meter. T is eliminated in closed
form (weighted: Umeyama 1991) and by Laplace's method, tau by a sum over a grid. Nothing of this
reaches the filter's state: it is a function of what the filter remembers of the drive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, Complex
from sfa_localization.fusion.relocation import AGREEING_M, ODOMETRY_DRIFT
from sfa_localization.fusion.track import LONGEST_DELAY_S, Track

LIKELY = 0.9
"""Probability of nothing harmful from which the estimate is trusted."""
PRIOR = {'carried': 3e-3, 'late': 1e-2, 'lever': 5e-3, 'turned': 5e-3, 'scale': 5e-3,
         'unrelated': 5e-3}  # fmt: skip
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
DELAYS: Array = np.r_[-1.5:-0.5:0.3, 0.6 : LONGEST_DELAY_S + 0.1 : 0.4]
"""Delays s that are told apart: the camera's clock compensates shorter ones."""
LONGEST_M = 14.0
"""An estimate that was placed anew again and again is confirmed over this distance at most."""
_ANYWHERE = 1 / (100.0 * 2 * math.pi)
"""Density of poses anywhere in 100 m^2, 1/(m^2 rad)."""
_NEVER_ALL = 1e-9  # of an image's weight is left, so that some path fits best
_STEPS = 2  # of reweighting, from where the fit hardly changes
_AHEAD_S = 0.3  # of the path: odometry may be a little behind
_BEFORE = 8  # images before it was placed anew, from which on the robot may have been elsewhere


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


def health_of(track: Track) -> Health:
    """What the images of a track show."""
    confirmed_m, needed_m = _confirmed(track)
    if len(track.images) <= 3:  # so few always lie on some path
        return Health(1.0, '', 0j, (0.0, 0.0, 0.0), confirmed_m, needed_m)
    window = _Window(track)
    table = window.hypotheses()
    harmful = (table.off_m > HARMLESS_M) | (table.off_rad > HARMLESS_RAD)
    odds = np.exp(table.log_odds - table.log_odds.max())
    odds = np.where(harmful, odds, 0.0) / odds.sum()
    worst = int(np.argmax(odds))
    place, turned = float(odds @ table.off_m**2) / 2, float(odds @ table.off_rad**2)
    return Health(
        1.0 - float(odds.sum()),
        table.names[worst],
        complex(table.sizes[worst]),
        (place, place, turned),
        min(confirmed_m, window.unbroken_m),
        needed_m,
    )


def _confirmed(track: Track) -> tuple[float, float]:
    """Meters driven from where the filter was placed to the newest image, and those needed: twice
    as many each time that it was placed anew, by images that agreed over as many as the first time
    needs.
    """
    times, traveled_m = len(track.placings), track.images[-1].traveled_m if track.images else 0.0
    if times == 0:
        return max(traveled_m - track.since_m, 0.0), AGREEING_M
    driven_m = AGREEING_M + traveled_m - track.placings[-1].traveled_m
    return driven_m, min(AGREEING_M * 2.0 ** (times - 1), AGREEING_M + LONGEST_M)


class _Table(NamedTuple):
    """What may be the matter (H,), with log odds up to a constant, its size, and how far from the
    truth, m and rad, it lets images put the robot now.

    Sizes are seconds, m ahead + i m to the left, rad, or a factor.
    """

    names: list[str]
    log_odds: Array
    sizes: Complex
    off_m: Array
    off_rad: Array


class _Window:
    """The images (N,) of a track, and the path beside them. Rows (R, N) are paths that they may
    have followed; positions in the plane are complex numbers.
    """

    def __init__(self, track: Track) -> None:
        images = track.images
        stamps = np.array([image.stamp_ns for image in images])
        self._stamps, self._placings, newest_ns = stamps, track.placings, int(stamps[-1])
        self._seconds = (stamps - newest_ns) * 1e-9
        self._places = np.array([image.place for image in images])
        yaws = np.array([image.yaw for image in images])
        self._has_yaw = np.isfinite(yaws)
        self._yaws = np.where(self._has_yaw, yaws, 0.0)
        self._way_m = np.array([image.traveled_m for image in images])
        behind_m = self._way_m[-1] - self._way_m
        claimed = np.array([(image.variance, image.yaw_variance) for image in images]).T
        floors = np.array([[FLOOR_M], [FLOOR_RAD]]) ** 2
        drift = np.array([[ODOMETRY_DRIFT], [YAW_DRIFT]]) * behind_m
        self._variance, self._yaw_variance = CAUTION * claimed + floors + drift**2
        yaw_norm = np.sqrt(2 * np.pi * np.where(self._has_yaw, self._yaw_variance, 2 * np.pi))
        self._peak = (1 - OUTLIERS) / (2 * np.pi * self._variance * yaw_norm)
        knots = np.array([(knot[0] - newest_ns, *knot[1:]) for knot in track.knots])
        self._times, (x, y, yaw) = knots[:, 0] * 1e-9, knots[:, 1:].T
        self._path, self._path_yaw = x + 1j * y, np.unwrap(yaw)
        self._power = min(1.0, max(1 + behind_m[0], 3.0) / len(images))
        self.unbroken_m = math.inf

    def hypotheses(self) -> _Table:
        """All of them."""
        rows, yaws, delays = self._paths()
        logs, _ = self._fitted(rows, yaws)
        rest = 1 - sum(PRIOR.values())
        count = len(delays) - 1
        names = ['as it is', *['late'] * count]
        priors = [rest, *[PRIOR['late'] / len(DELAYS)] * count]
        sizes, off_m = list(delays), list(np.abs(rows[:, -1] - rows[0, -1]))
        off_rad, logs = list(np.abs(yaws[:, -1] - yaws[0, -1])), list(logs)
        for name in ('lever', 'turned', 'scale'):
            (log,), (size,) = self._fitted(rows[:1], yaws[:1], name)
            names.append(name)
            logs.append(log)
            sizes.append(size)
            off = abs(size - 1) * AGREEING_M if name == 'scale' else abs(size)
            off_m.append(0.0 if name == 'turned' else off)
            off_rad.append(off if name == 'turned' else 0.0)
        names.append('unrelated')
        logs.append(self._power * len(self._places) * math.log(_ANYWHERE))
        sizes.append(0.0)
        off_m.append(AGREEING_M)
        off_rad.append(0.0)
        carried = self._carried(rows[:1], yaws[:1])
        if carried is not None:
            names.append('carried')
            logs.append(carried)
            sizes.append(0.0)
            off_m.append(0.0)
            off_rad.append(0.0)
        priors += [PRIOR[name] for name in names[len(priors) :]]
        return _Table(
            names, np.log(priors) + logs, np.array(sizes), np.array(off_m), np.array(off_rad)
        )

    def _paths(self) -> tuple[Complex, Array, Array]:
        """Places and headings (R, N) on the path by the delays (R,) at which all are known."""
        delays = np.append(0.0, DELAYS)
        earliest, latest = self._seconds[0] - delays, self._seconds[-1] - delays
        known = (earliest >= self._times[0]) & (latest <= self._times[-1] + _AHEAD_S)
        delays = delays[known | (delays == 0.0)]
        at = self._seconds - delays[:, None]
        places, yaws = (np.interp(at, self._times, x) for x in (self._path, self._path_yaw))
        return places, yaws, delays

    def _carried(self, rows: Complex, yaws: Array) -> float | None:
        """Log evidence of another T from some image on, before the filter was placed anew."""
        if not self._placings or not self._stamps[0] < self._placings[-1].stamp_ns:
            return None
        at = int(np.searchsorted(self._stamps, self._placings[-1].stamp_ns))
        self.unbroken_m = 0.0
        breaks = np.arange(max(at - _BEFORE, 1), min(at, len(self._stamps) - 3) + 1)
        if not len(breaks):
            return None
        before = np.arange(len(self._stamps)) < breaks[:, None]
        rows, yaws = (np.broadcast_to(each, before.shape) for each in (rows, yaws))
        logs = self._fitted(rows, yaws, used=before)[0] + self._fitted(rows, yaws, used=~before)[0]
        best = int(np.argmax(logs))
        self.unbroken_m = float(self._way_m[-1] - self._way_m[breaks[best]])
        return float(logs[best])

    def _fitted(
        self, rows: Complex, yaws: Array, nuisance: str = '', used: NDArray[np.bool_] | None = None
    ) -> tuple[Array, Complex]:
        """Log evidence (R,) of paths, of the images `used` (R, N), and the nuisance's size (R,).

        With weights w and w', centered places z and path d, and v = exp(i (yaw - h)), the error
        sum w |z - u d|^2 + w' |v - u|^2 is least for the u along sum w conj(d) z + w' v.
        """
        look = np.exp(1j * (self._yaws - yaws))
        arm = np.exp(1j * yaws) if nuisance == 'lever' else np.zeros(1)
        likely = np.ones(rows.shape) if used is None else used.astype(float)
        used = likely
        lever, factor, bent = np.zeros(1), np.ones(1), np.ones(1)
        for step in range(_STEPS):
            w, w_yaw = likely / self._variance, likely / self._yaw_variance
            total, of_yaw = (each.sum(1, keepdims=True) for each in (w, w_yaw))
            d, g, z = (x - (w * x).sum(1, keepdims=True) / total for x in (rows, arm, self._places))
            seen = (w_yaw * look).sum(1, keepdims=True)
            path = factor * d + lever * g
            u = (w * np.conj(path) * z).sum(1, keepdims=True)
            if nuisance != 'turned' or step:
                u = u + seen * np.conj(bent)
            u = u / np.maximum(np.abs(u), 1e-12)
            if nuisance == 'lever':
                information = (w * np.abs(g) ** 2).sum(1, keepdims=True) + LEVER_STD_M**-2
                lever = (w * np.conj(g) * (z * np.conj(u) - d)).sum(1, keepdims=True) / information
            elif nuisance == 'scale':
                information = (w * np.abs(d) ** 2).sum(1, keepdims=True) + SCALE_STD**-2
                along = (w * (np.conj(u * d) * z).real).sum(1, keepdims=True)
                factor = (along + SCALE_STD**-2) / information
            elif nuisance == 'turned':
                information = of_yaw + TURNED_STD_RAD**-2
                angle = np.angle(seen * np.conj(u)) * of_yaw / information
                bent = np.exp(1j * angle)
            path = factor * d + lever * g
            apart = np.abs(z - u * path) ** 2 / self._variance
            apart += 2 * (1 - (look * np.conj(u * bent)).real) / self._yaw_variance
            fits = self._peak * np.exp(-0.5 * apart)
            anything = fits + OUTLIERS * _ANYWHERE
            likely = used * (fits / anything + _NEVER_ALL)
        square = (w * np.abs(path) ** 2).sum(1) + of_yaw[:, 0] + _NEVER_ALL
        log = (used * np.log(anything)).sum(1) + math.log(_ANYWHERE * (2 * math.pi) ** 1.5)
        log -= np.log(total[:, 0]) + 0.5 * np.log(square)
        if not nuisance:
            return self._power * log, np.zeros(len(rows))
        size, off, std, count = {
            'lever': (lever, lever, LEVER_STD_M, 2),
            'scale': (factor, factor - 1, SCALE_STD, 1),
            'turned': (np.angle(bent), np.angle(bent), TURNED_STD_RAD, 1),
        }[nuisance]
        log -= 0.5 * (np.abs(off) / std)[:, 0] ** 2
        log -= count / 2 * np.log(information[:, 0] * std**2)
        return self._power * log, size[:, 0]
