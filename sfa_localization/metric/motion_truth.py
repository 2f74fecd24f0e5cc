# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The ground truth as one more source of motion, compared with the odometry.

In window w, over which the odometry o, psi hardly drifts, a marker at the lever arm l on the robot
that is stamped tau late is at

    p(t) = u_w [s_w o(t - tau) + exp(i psi(t - tau)) l] + c_w

or at its conjugate where the axes of the truth are mirrored. Rotation u_w, scale s_w and place c_w
of each window, l, tau, the scale of the drive and the wheels' loss in turns are found by
Gauss-Newton, with weights of Student's distribution. Estimates that are judged take no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from sfa_localization.data.errors import DataError
from sfa_localization.data.events import CLOCK_RANGE_S
from sfa_localization.data.geometry import Array, Complex, Indices, Mask, wrap_angle
from sfa_localization.data.run import Trajectory
from sfa_localization.data.statistics import LENGTH_TO_STD, evenly, outlier_factor, surprise
from sfa_localization.metric.dead_reckoning import TURN_SLIDE, OdometryTrack, summed
from sfa_localization.metric.motion_samples import fault_sentence, faulty
from sfa_localization.metric.motion_sources import ALIKE, EQUAL, LATE_S, late

TRUTH = 'ground truth'
WINDOW_M, WINDOWS_MIN, NOISE_M = 3.0, 4, 0.01
"""Length of a window, in which wheels deviate by the last value. Fewer windows show nothing."""
UNSTEADY = 0.15
"""Mean of 1 - cos of the rotations from window to window: at most 0.09 for real robots with their
own truth, 0.2 and more with that of another drive or with mirrored axes."""
CERTAIN = 9.0
"""Twice the least gain of log-likelihood by a lever arm or a delay: chance reaches it in 3 of 1,000
drives; 6 was the most of drives of real robots, 12 for a truth 0.1 s late over 28 m."""
LEVER_MIN_M, WAY_MIN_M = 1.6 * TURN_SLIDE, 0.04
"""Smaller lever arms, and ways during a delay, stay: wheels that slide in turns look like a lever
arm of TURN_SLIDE."""
FAULT_M = 0.1
"""A smaller jump of the truth harms nothing."""
ASIDE = np.deg2rad(10.0)
"""A smaller offset of the headings may be that of either source."""
WHEELS_STD = 0.05
"""Of the scale of a window, by the drives of the simulator."""
_PRIOR = np.array([1.0, 1.0, 1.0, 0.1, TURN_SLIDE])
_SHIFTS_S, _ROUNDS, _SAMPLES, _STEP_S = (0.0, -1.0, 1.0, -2.0, 2.0), 12, 4000, 0.05
_LEVER, _DELAY = [0, 1], [2]  # of theta
_CLOSE = 1e-4  # m and s
_UNITS = {1.0: '', 100.0: 'centimeters', 1000.0: 'millimeters'}
V = TypeVar('V', np.float64, np.complex128)


@dataclass(frozen=True, slots=True)
class TruePoses:
    """Poses of base_link by a ground truth, and `sentences` on what was corrected.

    Without `headings` the truth has none, and those of the odometry take their place.
    """

    poses: Trajectory
    headings: bool = True
    sentences: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Fit:
    """Values of `theta` (5,): lever arm ahead and to the left, m, delay, s, logarithm of the scale,
    loss, m per rad, of which `free` ones were fitted. Of the samples `rows` (M,) that the odometry
    covers: `residual` (M,) m with its robust `std`, and heading `yaw` (M,) rad of base_link in the
    frame of the truth by the odometry.
    """

    mirrored: bool
    free: Mask
    theta: Array
    std: float
    rows: Indices
    residual: Complex
    yaw: Array
    turns: Complex
    """(W,) rotations of the windows in which the robot drove."""

    @property
    def lever(self) -> complex:
        return complex(*self.theta[:2])

    @property
    def delay_s(self) -> float:
        return float(self.theta[2])

    def cost(self, std: float) -> float:
        """Negative log-likelihood of a place, for residuals of a standard deviation in m."""
        return float(surprise(np.abs(self.residual / std) ** 2, 2).mean())

    @property
    def unsteady(self) -> float:
        return 1.0 - float((self.turns[1:] * self.turns[:-1].conj()).real.mean())


@dataclass(frozen=True, slots=True)
class _Windows:
    """The first sample of each window (W,), and the window of each sample (M,)."""

    first: Indices
    number: Indices

    @classmethod
    def of(cls, keys: NDArray[np.float64]) -> _Windows:
        """Of neighbors with equal keys (M, K)."""
        begins = np.append(True, np.diff(keys, axis=0).any(1))
        return cls(np.flatnonzero(begins), np.cumsum(begins) - 1)

    def sums(self, values: NDArray[V]) -> NDArray[V]:
        """(W, ...) of values (M, ...)."""
        return np.asarray(np.add.reduceat(values, self.first, axis=0))

    def centered(self, values: Complex, weight: Array) -> Complex:
        """Values (M, K) without the means of windows."""
        means = self.sums(weight[:, None] * values) / self.sums(weight)[:, None]
        return np.asarray(values - means[self.number])

    def without(self, values: Complex, direction: Complex, weight: Array, known: float) -> Complex:
        """Values (M, K) without their parts along a direction (M,), which differs in each window by
        a real factor with the precision `known`.
        """
        shares = self.sums(weight[:, None] * (direction.conj()[:, None] * values).real)
        shares /= (self.sums(weight * np.abs(direction) ** 2) + known)[:, None]
        return np.asarray(values - direction[:, None] * shares[self.number])


@dataclass(frozen=True, slots=True)
class _Linear:
    """Residuals (M,) m of samples, their derivatives `slopes` (M, 5) by -theta, and rotations (W,)
    of the windows, with a mask of those in which the robot drove.
    """

    residual: Complex
    slopes: Complex
    turns: Complex
    drove: Mask

    def step(
        self,
        theta: Array,
        expected: Array,
        free: Mask,
        weight: Array,
        variance: float,
    ) -> Array:
        """The step (5,) of Gauss and Newton; windows of weight 1 have the `variance`, m^2."""
        score = (weight[:, None] * (self.residual[:, None] * self.slopes.conj()).real).sum(0)
        normal = ((weight[:, None] * self.slopes).conj().T @ self.slopes).real
        prior, both, step = variance / _PRIOR**2, np.ix_(free, free), np.zeros(5)
        score -= prior * (theta - expected)
        step[free] = np.linalg.solve((normal + np.diag(prior))[both], score[free])
        return np.clip(step, -0.5, 0.5)


class _Comparison:
    """Places of a truth, m, at N times in s, and the odometry of the drive."""

    def __init__(self, truth: Trajectory, track: OdometryTrack) -> None:
        self.track, self.track_s, self.way = track, track.seconds, track.length
        self.wheels = track.poses[:, 0] + 1j * track.poses[:, 1]
        self.lost = summed(track.way_per_loss())
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
        velocities = []
        for at, places in (self.track_s, self.wheels), (self.seconds, self.places):
            step = np.diff(np.interp(np.arange(at[0], at[-1], 4 * _STEP_S), at, places))
            most = 3 * np.quantile(np.abs(step), 0.5)
            velocities.append(np.where(np.abs(step) < most, step, 0))
        by_wheels, true = velocities
        true = true.conj() if mirrored else true
        product = np.abs(signal.correlate(true, by_wheels))
        behind = int(np.argmax(product)) - len(by_wheels) + 1
        return float(self.seconds[0] - self.track_s[0]) + 4 * _STEP_S * behind

    def fitted(
        self, mirrored: bool, theta: Array, free: Mask, rows: Indices, about_s: float
    ) -> _Fit | None:
        """Start at theta (5,), and change its `free` values, in windows for a delay of about so
        much; None without enough motion.
        """
        at = self.seconds[rows] - about_s
        inside = (at >= self.track_s[0]) & (at <= self.track_s[-1])
        rows, at = rows[inside], at[inside]
        if self.used[rows].sum() < 3 * WINDOWS_MIN:
            return None
        way = np.interp(at, self.track_s, self.way)
        after = np.searchsorted(self.track_s, at, 'right')
        windows = _Windows.of(np.column_stack([way // self.window_m, self.track.part[after - 1]]))
        used, each = self.used[rows], len(rows) / len(windows.first)
        weight, std = used + 1e-6, NOISE_M
        expected = np.where(np.abs(theta) > CLOCK_RANGE_S, theta, 0.0)  # a clock of its own
        for _ in range(_ROUNDS):
            linear = self._linear(mirrored, theta, rows, windows, weight, each * std**2)
            size = np.abs(linear.residual)
            std = max(LENGTH_TO_STD * float(np.median(size[used])), NOISE_M)
            weight = (used + 1e-6) / outlier_factor((size / std) ** 2, 2)
            step = linear.step(theta, expected, free, weight, each * std**2)
            theta = theta + step
            if np.abs(step).max() < _CLOSE:
                break
        if linear.drove.sum() < WINDOWS_MIN:
            return None
        middle = windows.sums(weight * way) / windows.sums(weight)
        turns = linear.turns[linear.drove]
        turned = np.interp(way, middle[linear.drove], np.unwrap(np.angle(turns)))
        yaw = np.interp(self.seconds[rows] - theta[2], self.track_s, self.track.yaw) + turned
        return _Fit(mirrored, free, theta, std, rows, linear.residual, yaw, turns)

    def _linear(
        self,
        mirrored: bool,
        theta: Array,
        rows: Indices,
        windows: _Windows,
        weight: Array,
        variance: float,
    ) -> _Linear:
        """The model near theta (5,); `variance` (m^2) is that of a window with a weight of 1."""
        at, places = self.seconds[rows] - theta[2], self.places[rows]
        now, later, before = (self._marker(theta, at + by) for by in (0.0, _STEP_S, -_STEP_S))
        velocity = (later[0] - before[0]) / (2 * _STEP_S)
        columns = [places.conj() if mirrored else places, velocity, *now]
        centered = windows.centered(np.stack(columns, -1), weight).T
        true, velocity, here, facing, driven, lost = centered
        match = windows.sums(weight * here.conj() * true)
        turns = match / np.maximum(np.abs(match), 1e-12)
        u = turns[windows.number]
        slopes = facing, 1j * facing, -velocity, driven, -lost
        both = np.stack([true - u * here, *(u * slope for slope in slopes)], -1)
        both = windows.without(both, 1j * u * here, weight, 1e-9)
        both = windows.without(both, u * driven, weight, variance / WHEELS_STD**2)
        square, total = windows.sums(weight * np.abs(here) ** 2), windows.sums(weight)
        drove = (total > 1.0) & (square > total * (self.window_m / 10) ** 2)
        return _Linear(both[:, 0], both[:, 1:], turns, drove)

    def _marker(self, theta: Array, at: Array) -> tuple[Complex, Complex, Complex, Complex]:
        """By the odometry, at times (M,) s: place of the marker, exp(i psi), the place of base_link
        and what a loss of 1 m per radian takes from it.
        """
        facing = np.exp(1j * np.interp(at, self.track_s, self.track.yaw))
        lost = np.interp(at, self.track_s, self.lost)
        driven = np.exp(theta[3]) * (np.interp(at, self.track_s, self.wheels) - theta[4] * lost)
        return driven + complex(*theta[:2]) * facing, facing, driven, lost

    def best(self, shifts_s: Sequence[float], free: Mask) -> _Fit | None:
        """The best of some delays to start with, and of plain and mirrored axes."""
        rows, chosen = evenly(len(self.seconds), _SAMPLES), []
        for mirrored in (False, True):
            starts = [np.array([0.0, 0.0, s, 0.0, 0.0]) for s in shifts_s]
            fits = [self.fitted(mirrored, start, free, rows, start[2]) for start in starts]
            chosen.append(
                min((fit for fit in fits if fit), key=lambda fit: fit.cost(FAULT_M), default=None)
            )
        plain, mirror = chosen
        if plain is None or mirror is None:
            return plain
        return mirror if max(UNSTEADY / 4, 4 * mirror.unsteady) < plain.unsteady else plain

    def settled(self, fit: _Fit, free: Mask) -> _Fit:
        """The fit with a delay and a lever arm only where they are certain, and matter."""
        steps = np.diff(self.way)
        speed = float((steps**2 / np.diff(self.track_s)).sum() / max(steps.sum(), 1e-9))
        least_s = max(LATE_S, WAY_MIN_M / speed)
        rows, about_s = np.arange(len(self.seconds)), float(fit.theta[2])

        def refitted(free: Mask) -> _Fit:
            theta = np.where(free, fit.theta, 0.0)
            fitted = self.fitted(fit.mirrored, theta, free, rows, about_s)
            return fitted or replace(fit, free=free, theta=theta)

        fit = refitted(free)
        for _ in range(2):
            fewer = []
            for chosen, least in (_LEVER, LEVER_MIN_M), (_DELAY, least_s):
                if not fit.free[chosen].all():
                    continue
                without = refitted(fit.free & ~np.isin(np.arange(5), chosen))
                gain = 2 * len(fit.turns) * (self.cost(without, fit.std) - self.cost(fit, fit.std))
                if gain < CERTAIN or np.linalg.norm(fit.theta[chosen]) < least:
                    fewer.append(without)
            if not fewer:
                break
            fit = min(fewer, key=lambda fit: self.cost(fit, FAULT_M))
        return fit

    def faults(self, fit: _Fit | None) -> Mask:
        """Samples (N,) that repeat the last pose while the robot drives on, or which a jump takes
        away from where the odometry puts them.
        """
        theta = np.zeros(5) if fit is None else fit.theta
        marker, *_ = self._marker(theta, self.seconds - theta[2])
        step, way = np.abs(np.diff(self.places)), np.abs(np.diff(marker))
        jump = np.append(False, faulty(step - way, FAULT_M) & (step > way))
        held = np.append(False, step == 0)
        runs = _Windows.of(np.column_stack([np.cumsum(jump), held]))
        before_jump = np.append(jump, False)[np.append(runs.first[1:], len(held))]
        lost = held[runs.first] & before_jump & (runs.sums(np.append(0.0, way)) > FAULT_M)
        mask = lost[runs.number]
        if fit is not None:
            off, parts = np.zeros(len(held)), _Windows.of(np.cumsum(jump)[:, None])
            off[fit.rows] = np.abs(fit.residual)
            mask |= faulty((parts.sums(off) / np.bincount(parts.number))[parts.number], FAULT_M)
        _, value = np.unique(self.places, return_inverse=True)
        return np.asarray(mask | (np.bincount(value, mask) > np.bincount(value) / 2)[value])

    def facing(self, fit: _Fit) -> tuple[float, complex]:
        """The sign of the truth's headings, and the mean of exp(i deviation) from the odometry's,
        which is small for headings that are not those of base_link.
        """
        rows = np.flatnonzero(self.used[fit.rows])
        usual = -1.0 if fit.mirrored else 1.0
        both = [
            (sign, complex(np.exp(1j * (sign * self.yaw[fit.rows] - fit.yaw))[rows].mean()))
            for sign in (usual, -usual)
        ]
        return both[1] if abs(both[0][1]) < ALIKE < abs(both[1][1]) else both[0]

    def cost(self, fit: _Fit, std: float) -> float:
        """Negative log-likelihood of a sample, with its heading if the truth has any."""
        alike = abs(self.facing(fit)[1])
        return fit.cost(std) + ((1 - alike) / ASIDE**2 if alike > ALIKE else 0.0)

    def headings(self, fit: _Fit) -> tuple[Array, str, bool]:
        """Headings (N,) rad of base_link, with a sentence on what was corrected of those of the
        truth, and whether it has any.
        """
        sign, mean = self.facing(fit)
        if not abs(mean) > ALIKE:
            by_wheels = np.interp(self.seconds, self.seconds[fit.rows], fit.yaw)
            return by_wheels, 'has no headings of base_link; they are not judged', False
        turned = '' if (sign < 0) == fit.mirrored else 'clockwise '
        aside = float(np.angle(mean))
        if abs(aside) < ASIDE:
            text = f'has {turned}headings; turned around' if turned else ''
            return sign * self.yaw, text, True
        text = f'has {turned}headings {np.rad2deg(aside):+.0f} degrees beside those of base_link; '
        return sign * self.yaw - aside, text + 'taken into account', True


def true_poses(
    truth: Trajectory, track: OdometryTrack, trusted: bool = True, open_loop: bool = False
) -> TruePoses:
    """The poses of base_link by a ground truth, which is compared with the odometry of the drive.

    Only odometry that is `trusted` refutes a truth. `open_loop` odometry repeats commands, which
    the robot follows later: it shows no delay. Raises DataError for the truth of another drive.
    """
    comparison, free = _Comparison(truth, track), np.array([True, True, not open_loop, True, True])
    factor = comparison.scale()
    if factor < 1e-9 and trusted:
        raise DataError(f'{TRUTH} does not move with the robot: is its topic the right one?')
    factor = max(factor, 1e-9)
    unit = min(_UNITS, key=lambda unit: abs(np.log(factor / unit)))
    comparison.places /= unit
    comparison.used = ~comparison.faults(None)
    fit = comparison.best(_SHIFTS_S, free)
    if fit is None or fit.unsteady > UNSTEADY:
        lags_s = [comparison.lag_s(mirrored) for mirrored in (False, True)]
        fit = comparison.best([*lags_s, 0.0], free)
    if fit is None or (fit.unsteady > UNSTEADY and not trusted):
        return TruePoses(truth)
    if fit.unsteady > UNSTEADY:
        raise DataError(
            f'{TRUTH} moves independently of odometry: is it of this drive, and of this robot?'
        )
    if not 1 / EQUAL < factor / unit < EQUAL:
        raise DataError(f'{TRUTH} drives {factor:.3g} times as far as odometry: publish meters')
    for _ in range(3):
        fit = comparison.settled(fit, free)
        before, comparison.used = comparison.used, ~comparison.faults(fit)
        if (before == comparison.used).all():
            break
    return _corrected(truth, comparison, fit, unit)


def _corrected(truth: Trajectory, comparison: _Comparison, fit: _Fit, unit: float) -> TruePoses:
    """The truth after all corrections; itself if there are none."""
    yaw, text, headings = comparison.headings(fit)
    lever, (x, y, late_s, *_) = fit.lever, fit.theta
    sides = f'{abs(x):.2f} m {"ahead of" if x > 0 else "behind"} and {abs(y):.2f} m to the '
    texts = {
        f'is in {_UNITS[unit]}; converted': unit != 1.0,
        'is mirrored (y to the right, or x and y swapped); turned around': fit.mirrored,
        f'is stamped {late(late_s)}; taken into account': late_s != 0,
        f'lies {sides}{"left" if y > 0 else "right"} of base_link; taken into account': (
            lever != 0
        ),
        text: bool(text),
    }
    faults = fault_sentence(TRUTH, ~comparison.used, truth.stamps_ns, 'odometry')
    sentences = [f'{TRUTH} {text}' for text, applies in texts.items() if applies]
    sentences += [faults] if faults else []
    if not sentences:
        return TruePoses(truth)
    places = comparison.places.conj() if fit.mirrored else comparison.places
    places = places - lever * np.exp(1j * yaw)
    poses = np.column_stack([places.real, places.imag, wrap_angle(yaw)])
    stamps_ns = truth.stamps_ns - round(late_s * 1e9)
    kept = Trajectory(stamps_ns[comparison.used], poses[comparison.used])
    return TruePoses(kept, headings, tuple(sentences))
