# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The ground truth as one more source of motion, compared with the odometry.

In window w, over which the odometry o, psi hardly drifts, a marker at the lever arm l on the robot
that is stamped tau late is at

    p(t) = u_w [o(t - tau) + exp(i psi(t - tau)) l] + c_w

or at its conjugate where the axes of the truth are mirrored. Rotation and scale u_w and place c_w
of each window follow from l and tau, which are found by least squares with weights of Student's
distribution. Models free more and more of l, tau and the mirror; likelihood chooses, and a sentence
names each that is not the default. Estimates that are judged take no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize
from scipy.sparse import csr_array

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Points, Stamps, Trajectory
from sfa_localization.data.statistics import (
    LENGTH_TO_STD,
    evenly,
    outlier_factor,
    quantile,
    surprise,
)
from sfa_localization.motion.dead_reckoning import TURN_SLIDE, OdometryTrack
from sfa_localization.motion.samples import OUTLIER, fault_sentence, faulty
from sfa_localization.motion.sources import ALIKE, EQUAL, LATE_S, late

TRUTH = 'ground truth'
POINTS = 'points_topic'
NO_OFFSET = 0.0, 0.0, 0.0
"""m ahead and to the left of base_link, and delay, s."""
WINDOW_M = 3.0
WINDOWS_MIN = 4
NOISE_M = 0.01
"""Length of a window, in which wheels deviate by the last value. Fewer windows show nothing."""
UNSTEADY = 0.15
"""Mean of 1 - cos of the rotations from window to window: at most 0.09 for real robots with their
own truth, 0.2 and more with that of another drive or with mirrored axes."""
CERTAIN = 12.0
"""Twice the least gain of log-likelihood by one more parameter: right truths reach 11, and one that
is 0.1 s late over 28 m 13. Axes and a delay are one parameter, a lever arm is two."""
LEVER_MIN_M = 1.6 * TURN_SLIDE
"""Smaller lever arms stay: wheels that slide in turns look like one of TURN_SLIDE."""
FAULT_M = 0.1
"""A smaller jump of the truth harms nothing."""
ASIDE = np.deg2rad(10.0)
"""A smaller offset of the headings may be that of either source."""
WHEELS_STD = 0.05
"""Of the scale of a window, by the drives of the simulator."""
_SAMPLES = 4000
_STEP_S = 0.2
_PRIOR_STD = 1.0
"""Of the lever arm ahead and to the left, m, and of the delay, s, about that of the velocities."""
_STEP = 0.025
"""m and s, for slopes: in shorter intervals the speed of wheels is noise, in which the search for a
delay stops."""
_ROUNDS = 3
_FIXED: Mask = np.zeros(3, bool)
_UNITS = {1.0: '', 100.0: 'centimeters', 1000.0: 'millimeters'}


@dataclass(frozen=True, slots=True)
class TruePoses:
    """Poses of base_link by a ground truth, and `sentences` on what was corrected.

    Without `headings` the truth has none, and those of the odometry take their place. `offset` (3,)
    was subtracted: m ahead and to the left of base_link, and the delay, s.
    """

    poses: Trajectory
    headings: bool = True
    sentences: tuple[str, ...] = ()
    offset: tuple[float, ...] = NO_OFFSET


@dataclass(frozen=True, slots=True)
class _Fit:
    """The likeliest `offset` (3,), m ahead and to the left of base_link, and delay, s.

    Of the samples `rows` (M,) that the odometry covers: `residual` (M,) m with its robust `std`,
    and exp(i heading) (M,) of base_link in the frame of the truth by the odometry, or 0 where it
    hardly drives; `turns` of the other windows.
    """

    mirrored: bool
    offset: Array
    std: float
    rows: Indices
    residual: Complex
    facing: Complex
    turns: Complex

    @property
    def matters(self) -> bool:
        """Whether neither the lever arm nor the delay is too small to be certain."""
        ahead, left, late_s = np.abs(self.offset)
        return not (0 < np.hypot(ahead, left) < LEVER_MIN_M or 0 < late_s < LATE_S)

    @property
    def unsteady(self) -> float:
        """Mean of 1 - cos of the rotations from window to window."""
        return 1.0 - float((self.turns[1:] * self.turns[:-1].conj()).real.mean())

    def cost(self, std: float, windows: float) -> float:
        """Twice the negative log-likelihood; the samples of a window err alike."""
        return 2 * windows * float(surprise(np.abs(self.residual / std) ** 2, 2).mean())


def _runs(*keys: NDArray[Any]) -> Indices:
    """The number (M,) of the run of neighbors with equal keys (M,) to which each belongs."""
    changes = np.any([np.diff(key) != 0 for key in keys], axis=0)
    return np.append(0, np.cumsum(changes))


class _Samples(NamedTuple):
    """M samples that the odometry covers: `places` (M,) m of the truth at `seconds` (M,), in
    `windows` (W, M), and their weights `used` (M,).
    """

    odometry: _Comparison
    places: Complex
    seconds: Array
    windows: csr_array
    used: Array

    def settled(self, about: Array, free: Mask) -> tuple[Array, float, Complex, Complex]:
        """The offset (3,) with the likeliest `free` values and the others of `about`, the robust
        standard deviation of residuals, and what is `matched` then.
        """
        weight = self.used
        std = NOISE_M
        offset = about
        for _ in range(_ROUNDS):
            offset = self._likeliest(offset, about, free, weight, std) if free.any() else offset
            residual, match = self.matched(offset, weight, std)
            size = np.abs(residual)
            std = max(LENGTH_TO_STD * float(np.median(size[self.used > 0.5])), NOISE_M)
            weight = self.used / outlier_factor((size / std) ** 2, 2)
        return offset, std, residual, match

    def _likeliest(
        self, start: Array, about: Array, free: Mask, weight: Array, std: float
    ) -> Array:
        """The offset (3,) whose `free` values have the least weighted squares."""
        factor = np.sqrt(weight * self.windows.shape[0] / len(weight)) / std
        steps = np.diag(_STEP * free)[free]

        def scaled(values: Array) -> Array:
            offset = start.copy()
            offset[free] = values
            off = factor * self.matched(offset, weight, std)[0]
            return np.concatenate([off.real, off.imag, (offset - about) / _PRIOR_STD])

        def slopes(values: Array) -> Array:
            ahead = [scaled(values + step[free]) for step in steps]
            back = [scaled(values - step[free]) for step in steps]
            return np.asarray(np.subtract(ahead, back).T / (2 * _STEP))

        offset = start.copy()
        offset[free] = optimize.least_squares(scaled, start[free], slopes).x
        return offset

    def matched(self, offset: Array, weight: Array, std: float) -> tuple[Complex, Complex]:
        """Residuals (M,) m of places after the best motion of each window of the odometry, and the
        mean products of both (W,), m^2. A window with weights of 1 counts as one place that errs
        by `std`, m.
        """
        windows = self.windows
        total = windows @ weight
        paths = self.places, self.odometry.marker(offset, self.seconds)
        true, here = (path - windows.T @ (windows @ (weight * path) / total) for path in paths)
        match = windows @ (weight * here.conj() * true)
        power = windows @ (weight * np.abs(here) ** 2)
        size = np.abs(match) + 1e-12
        sure = len(weight) / windows.shape[0] * (std / WHEELS_STD) ** 2
        motion = match / size * (size + sure) / (power + sure)
        return true - (windows.T @ motion) * here, match / total


class _Comparison:
    """Places of a truth, m, at N times in s, and the odometry of the drive."""

    def __init__(self, truth: Trajectory, track: OdometryTrack) -> None:
        self.track = track
        self.track_s = track.seconds
        self.way = track.length
        self.wheels = track.poses[:, 0] + 1j * track.poses[:, 1]
        self.seconds = (truth.stamps_ns - track.stamps_ns[0]) * 1e-9
        self.places = truth.poses[:, 0] + 1j * truth.poses[:, 1]
        self.yaw = truth.poses[:, 2]
        self.used = np.ones(len(truth), bool)

    def scale(self) -> float:
        """Of the truth, by the distances between samples about a window apart."""
        apart = max(int(WINDOW_M * len(self.places) / max(self.way[-1], 1e-9)), 1)
        by_wheels = np.interp(self.seconds, self.track_s, self.wheels)
        true, driven = (np.abs(p[apart:] - p[:-apart]) for p in (self.places, by_wheels))
        return quantile(true / np.maximum(driven, 1e-9), 0.5, driven)

    def lag_s(self, mirrored: bool) -> float:
        """The delay by which the velocities of both are most alike, of any size."""
        by_wheels, true = (
            np.diff(np.interp(np.arange(at[0], at[-1], _STEP_S), at, places))
            for at, places in ((self.track_s, self.wheels), (self.seconds, self.places))
        )
        true = true.conj() if mirrored else true
        from scipy import signal  # takes long to import

        behind = int(np.argmax(np.abs(signal.correlate(true, by_wheels)))) - len(by_wheels) + 1
        return float(self.seconds[0] - self.track_s[0]) + _STEP_S * behind

    def fitted(
        self, mirrored: bool, about: Array, free: Mask, rows: Indices | None = None
    ) -> _Fit | None:
        """Change the `free` values of the offset `about` (3,), in windows for about this delay;
        None without enough motion.
        """
        rows = evenly(len(self.seconds), _SAMPLES) if rows is None else rows
        at = self.seconds[rows] - about[2]
        inside = (at >= self.track_s[0]) & (at <= self.track_s[-1])
        rows = rows[inside]
        used = self.used[rows]
        if used.sum() < 3 * WINDOWS_MIN:
            return None
        seconds = self.seconds[rows]
        places = self.places[rows].conj() if mirrored else self.places[rows]
        samples = _Samples(self, places, seconds, self._windows(at[inside]), used + 1e-6)
        offset, std, residual, match = samples.settled(about, free)
        drove = np.abs(match) > (WINDOW_M / 10) ** 2
        if drove.sum() < WINDOWS_MIN:
            return None
        turns = np.where(drove, np.exp(1j * np.angle(match)), 0)
        facing = self._facing(seconds - offset[2]) * (samples.windows.T @ turns)
        return _Fit(mirrored, offset, std, rows, residual, facing, turns[drove])

    def _windows(self, at: Array) -> csr_array:
        """The windows (W, M) of sorted times (M,) s."""
        way = np.interp(at, self.track_s, self.way)
        part = self.track.part[np.searchsorted(self.track_s, at, 'right') - 1]
        number = _runs(way // WINDOW_M, part)
        return csr_array((np.ones(len(at)), (number, np.arange(len(at)))))

    def _facing(self, at: Array) -> Complex:
        """exp(i psi) (M,) at times (M,) s."""
        return np.asarray(np.exp(1j * np.interp(at, self.track_s, self.track.yaw)))

    def marker(self, offset: Array, seconds: Array) -> Complex:
        """Places (M,) m by the odometry of a marker that is stamped at these times, s."""
        at = seconds - offset[2]
        driven = np.interp(at, self.track_s, self.wheels)
        return np.asarray(driven + complex(*offset[:2]) * self._facing(at))

    def best(self, open_loop: bool, usual: Sequence[float]) -> _Fit | None:
        """The likeliest fit: each parameter that is neither the default nor `usual` has to gain
        CERTAIN. None without enough motion.
        """
        prices = []
        for mirrored in (False, True):
            lag_s = self.lag_s(mirrored)
            for offset in (NO_OFFSET, usual):
                fit = self.fitted(mirrored, np.array(offset), _FIXED)
                prices.append((fit, CERTAIN * mirrored))
            for lever, delay in [(True, False), (False, not open_loop), (True, not open_loop)]:
                about = np.array([0.0, 0.0, lag_s * delay])
                fit = self.fitted(mirrored, about, np.array([lever, lever, delay]))
                prices.append((fit, CERTAIN * (mirrored + 2 * lever + delay)))
        fits = [(fit, price) for fit, price in prices if fit and fit.matters]
        std = min((fit.std for fit, _ in fits), default=NOISE_M)
        windows = self.way[-1] / WINDOW_M
        return min(fits, key=lambda it: it[0].cost(std, windows) + it[1], default=(None, 0.0))[0]

    def agreed(self, open_loop: bool, usual: Sequence[float] = NO_OFFSET) -> _Fit | None:
        """The best fit, of all samples; faulty ones are no longer `used`. `open_loop` odometry
        shows no delay. None without enough motion. One of another motion is unsteady.
        """
        for _ in range(2):
            fit = self.best(open_loop, usual)
            if fit is None or fit.unsteady > UNSTEADY:
                break
            rows = np.arange(len(self.seconds))
            fit = self.fitted(fit.mirrored, fit.offset, _FIXED, rows) or fit
            before = self.used
            self.used = ~(self.held(fit) | self.elsewhere(fit))
            if (before == self.used).all():
                break
        return fit

    def held(self, fit: _Fit) -> Mask:
        """Samples (N,) that repeat a pose while the robot drives on, as others do not."""
        run = _runs(self.places)
        way = self.ways(fit, self.seconds)
        last = np.searchsorted(run, run, 'right') - 1
        driven = way[:, last] - way[:, np.searchsorted(run, run)]
        return faulty(driven.min(0), FAULT_M)

    def elsewhere(self, fit: _Fit) -> Mask:
        """Samples (N,) which a jump takes away from where the odometry puts them."""
        part = np.append(0, np.cumsum(self.jump(fit, self.seconds, self.places)))
        off = np.zeros(len(part))
        off[fit.rows] = np.abs(fit.residual)
        return faulty(ndimage.median(off, part, np.arange(part[-1] + 1))[part], FAULT_M)

    def ways(self, fit: _Fit, seconds: Array) -> Array:
        """What the marker has moved, m, at seconds (M,), up to a second before or after: (S, M)."""
        way = self.way + abs(complex(*fit.offset[:2])) * self.track.turned
        shifted_s = seconds - fit.offset[2] + np.linspace(-1.0, 1.0, 11)[:, None]
        return np.asarray(np.interp(shifted_s, self.track_s, way))

    def jump(self, fit: _Fit, seconds: Array, places: Complex) -> Mask:
        """Steps (M - 1,) of places at seconds (M,) that are farther than the robot drives in as
        much time, up to a second before or after.
        """
        way = np.diff(self.ways(fit, seconds)).max(0)
        noise = np.hypot(np.sqrt(2) * fit.std, WHEELS_STD * way)  # of two samples
        return np.asarray(np.abs(np.diff(places)) - way > np.maximum(OUTLIER * noise, FAULT_M))

    def restarts(self, fit: _Fit) -> str:
        """Where the used samples jump, in words; '' if they do not."""
        seconds = self.seconds[self.used]
        places = self.places[self.used]
        rows = np.flatnonzero(self.jump(fit, seconds, places))
        if not len(rows):
            return ''
        often = f'{len(rows)} times, first' if len(rows) > 1 else 'once'
        at_s = seconds[rows[0] + 1] - self.seconds[0]
        far = abs(places[rows[0] + 1] - places[rows[0]])
        return f'jumps {often} by {far:.2f} m after {at_s:.1f} s: was it started anew?'

    def headings(self, fit: _Fit) -> tuple[Array, str, bool]:
        """Headings (N,) rad of base_link, with a sentence on what was corrected of those of the
        truth, and whether it has any.
        """
        moved = fit.facing != 0
        rows = fit.rows[moved]
        facing = fit.facing[moved]
        usual = -1.0 if fit.mirrored else 1.0
        means = {
            sign: (np.exp(1j * sign * self.yaw[rows]) * facing.conj())[self.used[rows]].mean()
            for sign in (usual, -usual)
        }
        sign = -usual if abs(means[usual]) < ALIKE < abs(means[-usual]) else usual
        if not abs(means[sign]) > ALIKE:
            by_wheels = np.interp(self.seconds, self.seconds[rows], np.unwrap(np.angle(facing)))
            return by_wheels, 'has no headings of base_link; they are not judged', False
        turned = '' if sign == usual else 'clockwise '
        aside = float(np.angle(means[sign]))
        if abs(aside) < ASIDE:
            text = f'has {turned}headings; turned around' if turned else ''
            return sign * self.yaw, text, True
        text = f'has {turned}headings {np.rad2deg(aside):+.0f} degrees beside those of base_link; '
        return sign * self.yaw - aside, text + 'taken into account', True


def true_poses(
    truth: Trajectory,
    track: OdometryTrack,
    trusted: bool = True,
    open_loop: bool = False,
    usual: Sequence[float] = NO_OFFSET,
) -> TruePoses:
    """The poses of base_link by a ground truth, which is compared with the odometry of the drive.

    Only odometry that is `trusted` refutes a truth. `open_loop` odometry repeats commands, which
    the robot follows later: it shows no delay. The `usual` offset (3,) is that of other drives:
    see TruePoses. Raises DataError for the truth of another drive.
    """
    comparison = _Comparison(truth, track)
    factor = comparison.scale()
    if factor < 1e-9 and trusted:
        raise DataError(f'{TRUTH} does not move with the robot: is its topic the right one?')
    factor = max(factor, 1e-9)
    unit = min(_UNITS, key=lambda unit: abs(np.log(factor / unit)))
    comparison.places /= unit
    fit = comparison.agreed(open_loop, usual)
    if fit is None or (fit.unsteady > UNSTEADY and not trusted):
        return TruePoses(truth)
    if fit.unsteady > UNSTEADY:
        raise DataError(
            f'{TRUTH} moves independently of odometry: is it of this drive, and of this robot?'
        )
    if not 1 / EQUAL < factor / unit < EQUAL:
        raise DataError(f'{TRUTH} drives {factor:.3g} times as far as odometry: publish meters')
    return _corrected(truth, comparison, fit, unit)


def _differences(fit: _Fit) -> list[str]:
    """How what is fitted differs from base_link in time and place, in sentences."""
    x, y, late_s = fit.offset.tolist()
    ahead = f'{abs(x):.2f} m {"ahead of" if x > 0 else "behind"}'
    side = f'{abs(y):.2f} m to the {"left" if y > 0 else "right"} of base_link'
    texts = [f'is stamped {late(late_s)}; taken into account'] if late_s else []
    return [*texts, f'lies {ahead} and {side}; taken into account'] if x or y else texts


def _sentences(
    source: str, texts: Sequence[str], comparison: _Comparison, stamps_ns: Stamps
) -> list[str]:
    """Sentences on a source, from the words after its name, and on the samples not used."""
    faults = fault_sentence(source, ~comparison.used, stamps_ns, 'odometry')
    return [*(f'{source} {text}' for text in texts), *filter(None, [faults])]


def _corrected(truth: Trajectory, comparison: _Comparison, fit: _Fit, unit: float) -> TruePoses:
    """The truth after all corrections; itself if there are none."""
    yaw, text, headings = comparison.headings(fit)
    texts = [f'is in {_UNITS[unit]}; converted'] if unit != 1.0 else []
    if fit.mirrored:
        texts.append('is mirrored (y to the right, or x and y swapped); turned around')
    texts += [*_differences(fit), *filter(None, (text, comparison.restarts(fit)))]
    sentences = _sentences(TRUTH, texts, comparison, truth.stamps_ns)
    if not sentences:
        return TruePoses(truth)
    places = comparison.places.conj() if fit.mirrored else comparison.places
    places = places - complex(*fit.offset[:2]) * np.exp(1j * yaw)
    poses = np.column_stack([places.real, places.imag, wrap_angle(yaw)])
    stamps_ns = truth.stamps_ns - round(fit.offset[2] * 1e9)
    kept = Trajectory(stamps_ns[comparison.used], poses[comparison.used])
    return TruePoses(kept, headings, tuple(sentences), tuple(fit.offset.tolist()))


def timed_points(
    points: Points, track: OdometryTrack, open_loop: bool = False
) -> tuple[Points, list[str]]:
    """Points of a topic by the clock of the odometry and with the lever arm of their antenna,
    without those that contradict the odometry; and sentences on it.

    Points that have not the shape and size of the drive are not changed: see `settle`.
    """
    places = np.column_stack([points.places.real, points.places.imag, np.zeros(len(points))])
    comparison = _Comparison(Trajectory(points.stamps_ns, places), track)
    fit = comparison.agreed(open_loop)
    alike = fit and not fit.mirrored and fit.unsteady <= UNSTEADY
    if not fit or not alike or not 1 / EQUAL < comparison.scale() < EQUAL:
        return points, []
    rows = np.flatnonzero(comparison.used)
    lever = complex(*fit.offset[:2])
    late_ns = round(fit.offset[2] * 1e9)
    timed = [
        (name, stamp_ns - late_ns, place, std, lever or known)
        for name, stamp_ns, place, std, known in points.rows()
    ]
    texts = _sentences(POINTS, _differences(fit), comparison, points.stamps_ns)
    return Points.of([timed[row] for row in rows]), texts
