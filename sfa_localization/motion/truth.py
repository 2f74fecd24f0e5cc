# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The ground truth as one more source of motion, compared with the odometry.

In window w, over which the odometry o, psi hardly drifts, a marker at the lever arm l on the robot
that is stamped tau late is at

    p(t) = u_w [o(t - tau) + exp(i psi(t - tau)) l] + c_w

or at its conjugate where the axes of the truth are mirrored. Rotation and scale u_w and place c_w
of each window follow from l and tau, which are found by Gauss-Newton with weights of Student's
distribution. Estimates that are judged take no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.sparse import csr_array

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Points, Stamps, Trajectory
from sfa_localization.data.statistics import LENGTH_TO_STD, evenly, outlier_factor, surprise
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
"""Twice the least gain of log-likelihood by a lever arm or a delay: right truths reach 11,
and one that is 0.1 s late over 28 m 13."""
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
_PRIOR_STD = np.array([1.0, 1.0, 1.0, 0.1])
"""Of theta: lever arm ahead and to the left, m, delay, s, and logarithm of the scale."""
_SCALE: Mask = np.array([False, False, False, True])
# of theta
_STEP = 0.05
_ROUNDS = 12
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
    """Values of `theta` (4,). Of the samples `rows` (M,) that the odometry covers: `residual` (M,)
    m with its robust `std`, and exp(i heading) (M,) of base_link in the frame of the truth by the
    odometry, or 0 where it hardly drives; `turns` of the other windows.
    """

    mirrored: bool
    theta: Array
    std: float
    rows: Indices
    residual: Complex
    facing: Complex
    turns: Complex

    @property
    def unsteady(self) -> float:
        return 1.0 - float((self.turns[1:] * self.turns[:-1].conj()).real.mean())

    def rank(self) -> tuple[bool, float]:
        """Sorts fits: straight ways match at any delay, but with rotations of their own."""
        return self.unsteady > UNSTEADY, self.std

    def cost(self, std: float) -> float:
        """Twice the negative log-likelihood; the samples of a window err alike."""
        squares = np.abs(self.residual / std) ** 2
        return 2 * len(self.turns) * float(surprise(squares, 2).mean())


def _runs(*keys: NDArray[Any]) -> Indices:
    """The number (M,) of the run of neighbors with equal keys (M,) to which each belongs."""
    changes = np.any([np.diff(key) != 0 for key in keys], axis=0)
    return np.append(0, np.cumsum(changes))


class _Samples(NamedTuple):
    """M samples that the odometry covers: `places` (M,) m of the truth at `seconds` (M,), in
    `windows` (W, M), and which are `used` (M,).
    """

    odometry: _Comparison
    places: Complex
    seconds: Array
    windows: csr_array
    used: Mask

    def settled(
        self, theta: Array, free: Mask, about_s: float
    ) -> tuple[Array, float, Complex, Complex, Array]:
        """Theta (4,) with the likeliest `free` values, the robust standard deviation of residuals,
        and what is `matched` then.
        """
        each = len(self.places) / self.windows.shape[0]
        used = self.used.astype(float) + 1e-6
        weight = used
        std = NOISE_M
        for _ in range(_ROUNDS):
            found = self.matched(theta, weight, each * std**2)
            size = np.abs(found[0])
            std = max(LENGTH_TO_STD * float(np.median(size[self.used])), NOISE_M)
            weight = used / outlier_factor((size / std) ** 2, 2)
            variance = each * std**2
            slopes = self._slopes(theta, free, weight, variance)
            weighted = slopes.conj().T * (weight / variance)
            information = (weighted @ slopes).real + np.diag(1 / _PRIOR_STD**2)
            pulled = (theta - [0, 0, about_s, 0]) / _PRIOR_STD**2
            step = np.linalg.solve(information, -(weighted @ found[0]).real - pulled)
            theta = theta + np.clip(step, -0.5, 0.5) * free
        return theta, std, *found

    def _slopes(self, theta: Array, free: Mask, weight: Array, variance: float) -> Complex:
        """Derivatives (M, 4) of the residuals by theta."""
        sides = (theta + by * np.diag(_STEP * free) for by in (0.5, -0.5))
        ahead, back = ([self.matched(near, weight, variance)[0] for near in side] for side in sides)
        return np.asarray(np.subtract(ahead, back).T / _STEP)

    def matched(
        self, theta: Array, weight: Array, variance: float
    ) -> tuple[Complex, Complex, Array]:
        """Residuals (M,) m of places after the best motion of each window of the odometry, the
        products of both (W,), and the mean squares of the latter (W,), m^2. Windows with a weight
        of 1 have the `variance`, m^2.
        """
        windows = self.windows
        total = windows @ weight
        paths = self.places, self.odometry.marker(theta, self.seconds)
        true, here = (path - windows.T @ (windows @ (weight * path) / total) for path in paths)
        match = windows @ (weight * here.conj() * true)
        power = windows @ (weight * np.abs(here) ** 2)
        size = np.abs(match) + 1e-12
        sure = variance / WHEELS_STD**2
        motion = match / size * (size + sure) / (power + sure)
        return true - (windows.T @ motion) * here, match, np.where(total > 1, power / total, 0.0)


class _Comparison:
    """Places of a truth, m, at N times in s, and the odometry of the drive."""

    def __init__(
        self, truth: Trajectory, track: OdometryTrack, usual: Sequence[float] = NO_OFFSET
    ) -> None:
        self.usual = np.array([*usual, 0.0])
        self.track = track
        self.track_s = track.seconds
        self.way = track.length
        self.wheels = track.poses[:, 0] + 1j * track.poses[:, 1]
        self.seconds = (truth.stamps_ns - track.stamps_ns[0]) * 1e-9
        self.places = truth.poses[:, 0] + 1j * truth.poses[:, 1]
        self.yaw = truth.poses[:, 2]
        self.used = np.ones(len(truth), bool)
        self.window_m = max(WINDOW_M, 6 * self.way[-1] / len(truth))

    def scale(self) -> float:
        """Of the truth, by the distances between samples about a window apart."""
        apart = max(int(self.window_m * len(self.places) / max(self.way[-1], 1e-9)), 1)
        by_wheels = np.interp(self.seconds, self.track_s, self.wheels)
        true, driven = (np.abs(p[apart:] - p[:-apart]) for p in (self.places, by_wheels))
        far = driven > self.window_m / 4
        return float(np.median(true[far] / driven[far])) if far.any() else 1.0

    def lag_s(self, mirrored: bool) -> float:
        """The delay by which the velocities of both are most alike, of any size."""
        speeds = []
        for at, places in (self.track_s, self.wheels), (self.seconds, self.places):
            step = np.diff(np.interp(np.arange(at[0], at[-1], _STEP_S), at, places))
            speeds.append(np.where(np.abs(step) < 3 * np.median(np.abs(step)), step, 0))
        by_wheels = speeds[0]
        true = speeds[1].conj() if mirrored else speeds[1]
        behind = int(np.argmax(np.abs(signal.correlate(true, by_wheels)))) - len(by_wheels) + 1
        return float(self.seconds[0] - self.track_s[0]) + _STEP_S * behind

    def fitted(
        self, mirrored: bool, theta: Array, free: Mask, rows: Indices, about_s: float
    ) -> _Fit | None:
        """Change the `free` values of theta (4,), in windows for about this delay; None without
        enough motion.
        """
        at = self.seconds[rows] - about_s
        inside = (at >= self.track_s[0]) & (at <= self.track_s[-1])
        rows = rows[inside]
        used = self.used[rows]
        if used.sum() < 3 * WINDOWS_MIN:
            return None
        places = self.places[rows].conj() if mirrored else self.places[rows]
        samples = _Samples(self, places, self.seconds[rows], self._windows(at[inside]), used)
        theta, std, residual, match, spread = samples.settled(theta, free, about_s)
        drove = spread > (self.window_m / 10) ** 2
        if drove.sum() < WINDOWS_MIN:
            return None
        turns = np.where(drove, np.exp(1j * np.angle(match)), 0)
        facing = self._facing(self.seconds[rows] - theta[2]) * (samples.windows.T @ turns)
        return _Fit(mirrored, theta, std, rows, residual, facing, turns[drove])

    def _windows(self, at: Array) -> csr_array:
        """The windows (W, M) of sorted times (M,) s."""
        way = np.interp(at, self.track_s, self.way)
        part = self.track.part[np.searchsorted(self.track_s, at, 'right') - 1]
        number = _runs(way // self.window_m, part)
        return csr_array((np.ones(len(at)), (number, np.arange(len(at)))))

    def _facing(self, at: Array) -> Complex:
        """exp(i psi) (M,) at times (M,) s."""
        return np.asarray(np.exp(1j * np.interp(at, self.track_s, self.track.yaw)))

    def marker(self, theta: Array, seconds: Array) -> Complex:
        """Places (M,) m by the odometry of a marker that is stamped at these times, s."""
        driven = np.exp(theta[3]) * np.interp(seconds - theta[2], self.track_s, self.wheels)
        return np.asarray(driven + complex(*theta[:2]) * self._facing(seconds - theta[2]))

    def best(self, free: Mask) -> _Fit | None:
        """The better of no delay and that of the velocities to start with; for mirrored axes only
        where the windows then agree far better.
        """
        rows = evenly(len(self.seconds), _SAMPLES)
        chosen = []
        for mirrored in (False, True):
            fits = [
                self.fitted(mirrored, np.array([0.0, 0.0, about_s, 0.0]), free, rows, about_s)
                for about_s in (0.0, self.lag_s(mirrored) * free[2])
            ]
            chosen.append(min(filter(None, fits), key=_Fit.rank, default=None))
        plain, mirror = chosen
        if plain and mirror and max(UNSTEADY / 4, 4 * mirror.unsteady) < plain.unsteady:
            return mirror
        return plain

    def settled(self, fit: _Fit, free: Mask) -> _Fit:
        """The fit with a delay and a lever arm only where they matter, and each gains CERTAIN, or
        are the usual ones.
        """
        rows = np.arange(len(self.seconds))
        about_s = float(fit.theta[2])
        fits = []
        as_usual = self.fitted(fit.mirrored, self.usual, free & _SCALE, rows, self.usual[2])
        if as_usual and self.usual.any():
            fits.append((as_usual, 0.0))
        for lever, delay in product((True, False), repeat=2):
            chosen = free & [lever, lever, delay, True]
            other = self.fitted(fit.mirrored, fit.theta * chosen, chosen, rows, about_s)
            if other is None:
                continue
            x, y, late_s, _ = np.abs(other.theta)
            if np.hypot(x, y) >= LEVER_MIN_M * lever and late_s >= LATE_S * delay:
                fits.append((other, CERTAIN * (lever + delay)))
        std = min((other.std for other, _ in fits), default=NOISE_M)
        return min(fits, key=lambda item: item[0].cost(std) + item[1], default=(fit, 0.0))[0]

    def agreed(self, open_loop: bool) -> _Fit | None:
        """The best fit without faulty samples, which are no longer `used`, and without a delay for
        `open_loop` odometry; None without enough motion. One of another motion is unsteady.
        """
        free = np.array([True, True, not open_loop, True])
        self.used = ~self.faults(None)
        fit = self.best(free)
        if fit is None or fit.unsteady > UNSTEADY:
            return fit
        for _ in range(3):
            fit = self.settled(fit, free)
            before = self.used
            self.used = ~self.faults(fit)
            if (before == self.used).all():
                break
        return fit

    def faults(self, fit: _Fit | None) -> Mask:
        """Samples (N,) that repeat the last pose while the robot drives on, or which a jump takes
        away from where the odometry puts them.
        """
        marker = self.marker(np.zeros(4) if fit is None else fit.theta, self.seconds)
        step = np.abs(np.diff(self.places))
        way = np.abs(np.diff(marker))
        jump = np.append(False, faulty(step - way, FAULT_M) & (step > way))
        held = np.append(False, step == 0)
        part = np.cumsum(jump)
        run = _runs(part, held)
        driven = np.bincount(run, np.append(0, way))
        jumps = np.bincount(run, np.append(jump[1:], 0))
        mask = held & ((driven > FAULT_M) & (jumps > 0))[run]
        if fit is not None:
            off = np.zeros(len(held))
            off[fit.rows] = np.abs(fit.residual)
            mask |= faulty((np.bincount(part, off) / np.bincount(part))[part], FAULT_M)
        _, value = np.unique(self.places, return_inverse=True)
        return np.asarray(mask | (np.bincount(value, mask) > np.bincount(value) / 2)[value])

    def jumps(self, fit: _Fit) -> str:
        """Where the used samples jump farther than the robot drives in as much time, up to a second
        before or after, in words; '' if they do not.
        """
        seconds = self.seconds[self.used]
        places = self.places[self.used]
        shifted_s = seconds - fit.theta[2] + np.linspace(-1.0, 1.0, 11)[:, None]
        step = np.abs(np.diff(places))
        way = np.diff(np.interp(shifted_s, self.track_s, self.way))
        noise = np.hypot(np.sqrt(2) * fit.std, WHEELS_STD * way.max(0))  # of two samples
        far = step - way.max(0) > np.maximum(OUTLIER * noise, FAULT_M)
        if not far.any():
            return ''
        first = int(np.argmax(far))
        often = f'{far.sum()} times, first' if far.sum() > 1 else 'once'
        at_s = seconds[first + 1] - self.seconds[0]
        return f'jumps {often} by {step[first]:.2f} m after {at_s:.1f} s: was it started anew?'

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
    comparison = _Comparison(truth, track, usual)
    factor = comparison.scale()
    if factor < 1e-9 and trusted:
        raise DataError(f'{TRUTH} does not move with the robot: is its topic the right one?')
    factor = max(factor, 1e-9)
    unit = min(_UNITS, key=lambda unit: abs(np.log(factor / unit)))
    comparison.places /= unit
    fit = comparison.agreed(open_loop)
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
    x, y, late_s, _ = fit.theta.tolist()
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
    texts += [*_differences(fit), *filter(None, (text, comparison.jumps(fit)))]
    sentences = _sentences(TRUTH, texts, comparison, truth.stamps_ns)
    if not sentences:
        return TruePoses(truth)
    places = comparison.places.conj() if fit.mirrored else comparison.places
    places = places - complex(*fit.theta[:2]) * np.exp(1j * yaw)
    poses = np.column_stack([places.real, places.imag, wrap_angle(yaw)])
    stamps_ns = truth.stamps_ns - round(fit.theta[2] * 1e9)
    kept = Trajectory(stamps_ns[comparison.used], poses[comparison.used])
    return TruePoses(kept, headings, tuple(sentences), tuple(fit.theta[:3].tolist()))


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
    lever = complex(*fit.theta[:2])
    late_ns = round(fit.theta[2] * 1e9)
    timed = [
        (name, stamp_ns - late_ns, place, std, lever or known)
        for name, stamp_ns, place, std, known in points.rows()
    ]
    texts = _sentences(POINTS, _differences(fit), comparison, points.stamps_ns)
    return Points.of([timed[row] for row in rows]), texts
