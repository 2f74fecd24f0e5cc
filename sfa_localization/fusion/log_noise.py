# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of a log of odometry and positions, learned from the log itself, without truth.

The innovations of a filter with the right noise are as large as it expects, and white: its
likelihood is greatest. A filter smaller than `pose_filter` steps from position to position, many
trial settings at once, and Newton's method finds the most probable one. Each position comes with a
small probability from anywhere in the place (mixture of a Gaussian and a uniform density, updated
as in probabilistic data association, Bar-Shalom 1975), so that no outlier matters much, however
far it lies.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from sfa_localization.data.geometry import SPOT_RADIUS_M, Array
from sfa_localization.data.run import Stamps, integrate
from sfa_localization.fusion.motion import (
    BIAS_WALK,
    LOSS_WALK,
    ODOMETRY_CORRELATION_S,
    SCALE_WALK,
    STANDSTILL_RATE,
    STANDSTILL_SPEED,
    TURN_RADIUS_M,
    UNKNOWN_RATE,
    UNKNOWN_SPEED,
    YAW_PER_METER,
)
from sfa_localization.fusion.predict import ODOMETRY_TIMEOUT_S
from sfa_localization.fusion.recover import BIAS_STD, LOSS_STD, SCALE_STD
from sfa_localization.fusion.settings import FilterConfig

MOST_POSITIONS = 2000
"""Of more, so many are taken, evenly: they determine the noise well enough."""
LAGS_S = np.linspace(-1.0, 1.0, 21)
"""Delays of the motion behind the odometry's stamps for which it is tabulated, s."""
_OUTLIERS = 0.02
"""Probability that a position is wrong by any distance."""
_INNER = (5.0, 95.0)
"""Percentiles between which positions show the size of the place: outliers do not stretch it."""
_CLOUD = (16.0, 50.0, 84.0)
"""Percentiles of a normal distribution at its mean and one standard deviation from it."""
_HEADS = np.linspace(-np.pi, np.pi, 8, endpoint=False)
"""Headings that are tried at the start, rad."""
_SETTLE = 10
"""Positions after which the start's heading, and so the likelihood, is settled."""
_FORWARD_GAIN = 1.0
"""By so much in log-likelihood, holding readings forward has to be better than backward."""
_X, _Y, _YAW, _BIAS, _SCALE, _LOSS, _ERROR = range(7)
_SIZE = 8


class Noise(NamedTuple):
    """What a log suffers from; numbers, or arrays (C,) of trials.

    `turn`, `speed` and `slip` are factors on the standard deviations of the odometry, `position`
    that on those of the positions. Of their variance, `share` is common to positions close
    together, and fades over `distance_m`; it is 0 where the errors are white. The motion is `lag_s`
    behind the odometry's stamps.
    """

    turn: Array
    speed: Array
    slip: Array
    position: Array
    share: Array
    distance_m: Array
    lag_s: Array


class _Scale(NamedTuple):
    """On which scale a number is sought, and how far from the start it may be: 1 sigma."""

    to: Callable[[Array], Array]
    back: Callable[[Array], Array]
    std: float


EXPECTED = Noise(*map(np.array, (1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0)))
"""The noise that the parameters suppose, with white errors of positions."""
# Odometry may be several times better or worse than the parameters suppose; stated variances of
# positions are mostly right; real wheels lag behind their readings by up to half a second.
_SCALES = {
    'turn': _Scale(np.log, np.exp, 1.5),
    'speed': _Scale(np.log, np.exp, 1.5),
    'slip': _Scale(np.log, np.exp, 1.0),
    'position': _Scale(np.log, np.exp, 0.5),
    'share': _Scale(logit, expit, 1.5),
    'distance_m': _Scale(np.log, np.exp, 1.0),
    'lag_s': _Scale(np.asarray, np.asarray, 0.25),
}
_NAMES = Noise._fields
_STDS = np.array([scale.std for scale in _SCALES.values()])
# Errors are white, or else neighbors share some of them: usually half of the variance, over 1 m.
_CORRELATED = frozenset(['share', 'distance_m'])
_SHARED = {'share': np.array(0.5), 'distance_m': np.array(1.0)}
# Shares and distances (m) from which shared errors are sought.
_SHARED_STARTS = [(share, distance) for share in (0.1, 0.4, 0.8) for distance in (0.3, 1.0)]
# Odometry noisier than expected by more than this factor is no odometry: then it is rather the
# positions that are worthless.
_LARGEST = 10.0
_STEP = 0.15  # of difference quotients, in sigmas of _SCALES
_LARGEST_STEP = 1.5  # of Newton's method, in sigmas
_ROUNDS = 6
_LENGTHS = np.array([1.0, 0.5, 0.25, 0.1, 0.03])  # fractions of a step that are tried
_ENOUGH = 0.02  # gain in log-likelihood below which the search ends
# Where the search starts, in sigmas of the turns' and the positions' noise: one start is enough
# for noise near the expected, but the likelihood of noise far from it is flat.
_GRID = [(turn, position) for turn in (-1.0, 0.0, 1.0, 2.0) for position in (-1.0, 0.0, 1.0)]


class Steps(NamedTuple):
    """The odometry between positions, for each of LAGS_S: arrays (M, L), the first row zero.

    `forward` and `left` m and `turn` rad of the motion, how much less both are for each meter lost
    per radian (`lost_forward`, `lost_left`), the `meters` and `radians` driven, the seconds
    `moving`, and the variances that readings as good as they claim add to the heading,
    `turn_variance`, and along the way, `way_variance`.
    """

    forward: Array
    left: Array
    lost_forward: Array
    lost_left: Array
    turn: Array
    meters: Array
    radians: Array
    moving: Array
    turn_variance: Array
    way_variance: Array


class Log(NamedTuple):
    """Odometry (N,) and positions (M,) of a drive, positions within the time of the odometry.

    `twists` (N, 2) v m/s, omega rad/s, held since the row before; `variances` (N, 2) with which
    the filter takes them; `places` (M, 2) m with variances `spreads` (M, 2) m^2.
    """

    stamps_ns: Stamps
    twists: Array
    variances: Array
    at_ns: Stamps
    places: Array
    spreads: Array

    @property
    def log_background(self) -> float:
        """Logarithm of the density of outliers: uniform over the place."""
        low, high = np.percentile(self.places, _INNER, axis=0)
        return -float(np.log(high - low + np.sqrt(self.spreads).mean(0)).sum())

    def held_forward(self) -> Log:
        """The log with readings that hold until the next one, as commanded speeds do."""
        return self._replace(
            twists=np.vstack([self.twists[:1], self.twists[:-1]]),
            variances=np.vstack([self.variances[:1], self.variances[:-1]]),
        )

    def thinned(self) -> Log:
        """The log with MOST_POSITIONS at most."""
        if len(self.at_ns) <= MOST_POSITIONS:
            return self
        kept = np.linspace(0, len(self.at_ns) - 1, MOST_POSITIONS).astype(int)
        return self._replace(
            at_ns=self.at_ns[kept], places=self.places[kept], spreads=self.spreads[kept]
        )


class Learned(NamedTuple):
    """The noise of a log, and whether its readings hold `forward`, until the next one.

    `cost` is the negative log-likelihood, prior included. `fits` is False where the positions are
    as likely without the odometry, although it has driven far: one of the two is worthless.
    """

    noise: Noise
    forward: bool
    cost: float
    fits: bool


def learn(log: Log, config: FilterConfig, start: Noise, held: frozenset[str]) -> Learned:
    """The most probable noise near `start` (numbers), of which those named in `held` stay.

    Factors are those of the mean variance, not of the likeliest: where the log determines them
    poorly, too little noise does more harm than too much. A lag within its uncertainty is none.
    Errors of positions are white, or shared by neighbors, whichever the log makes likelier.
    """
    log = log.thinned()
    drive = _Drive(log, config)
    white = held | _CORRELATED
    found = _Search(drive, start, white).best()
    after = _Drive(log.held_forward(), config)
    prompt = found._replace(noise=found.noise._replace(lag_s=np.array(0.0)))
    other = min(_likelihood_cost(one, after) for one in (found, prompt))
    if other < _likelihood_cost(found, drive) - _FORWARD_GAIN:
        drive, found = after, _Search(after, start, white).best()
    forward = drive is after
    shared = _Search(drive, start._replace(**_SHARED), held, found.heads).best(found.noise)
    found = min(found, shared, key=lambda one: one.improbability)
    return Learned(found.settled(), forward, found.cost, drive.fits(_likelihood_cost(found, drive)))


def _likelihood_cost(found: _Found, drive: _Drive) -> float:
    """The negative log-likelihood of a found noise by a reading of the log."""
    trial = Noise(*(np.atleast_1d(value) for value in found.noise))
    return float(drive.costs(trial, found.heads)[0, 0])


class _Found(NamedTuple):
    """A most probable noise (numbers), its cost, its standard deviations on _SCALES by name, and
    the start heading (1,).

    `improbability` is the negative logarithm of the evidence for its kind of noise, by Laplace's
    method: a kind with more free numbers has to explain so much more.
    """

    noise: Noise
    cost: float
    improbability: float
    stds: dict[str, float]
    heads: Array

    def settled(self) -> Noise:
        """The noise to use: see `learn`."""
        # The mean of a variance whose logarithm is normal.
        more = {
            name: min(getattr(self.noise, name) * math.exp(self.stds[name] ** 2), _LARGEST)
            for name in ('turn', 'speed')
            if name in self.stds
        }
        sure = abs(float(self.noise.lag_s)) > self.stds.get('lag_s', 0.0)
        return self.noise._replace(**more, lag_s=self.noise.lag_s if sure else np.array(0.0))


class _Search:
    """Newton's method for the most probable noise of a drive; numbers in sigmas from the start."""

    def __init__(
        self, drive: _Drive, start: Noise, held: frozenset[str] | set[str], heads: Array = _HEADS
    ) -> None:
        self._drive, self._heads = drive, heads
        self._free = [i for i, name in enumerate(_NAMES) if name not in held]
        self._sigma = _STDS[self._free]
        pairs = zip(_SCALES.values(), start, strict=True)
        self._origin = np.array([float(scale.to(np.asarray(v, float))) for scale, v in pairs])

    def noises(self, units: Array) -> Noise:
        """The noises of trials (C, F)."""
        moved = np.tile(self._origin, (len(units), 1))
        moved[:, self._free] += units * self._sigma
        moved[:, -1] = np.clip(moved[:, -1], LAGS_S[0], LAGS_S[-1])
        moved[:, :3] = np.clip(moved[:, :3], -math.log(_LARGEST), math.log(_LARGEST))
        return Noise(*(s.back(moved[:, i]) for i, s in enumerate(_SCALES.values())))

    def costs(self, units: Array) -> Array:
        """Negative logarithms of the probabilities (C, H) of trials, by start heading."""
        likelihood = self._drive.costs(self.noises(units), self._heads)
        return np.asarray(likelihood + (units**2).sum(1)[:, None] / 2)

    def best(self, near: Noise | None = None) -> _Found:
        """Search from the best of a few starts, with the likeliest heading.

        `near`: a noise with white errors, to which shared ones are added.
        """
        trials = self._starts() if near is None else self._shared_starts(near)
        table = self.costs(trials)
        first, head = np.unravel_index(int(np.argmin(table)), table.shape)
        unit, self._heads = trials[first], self._heads[head : head + 1]
        for _ in range(_ROUNDS):
            value, gradient, hessian = self._derivatives(unit)
            curvature, axes = np.linalg.eigh(hessian)
            curvature = np.maximum(curvature, 1.0)  # what the prior alone has
            step = -axes @ ((axes.T @ gradient) / curvature)
            step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-9))
            along = unit + _LENGTHS[:, None] * step
            costs = self.costs(along)[:, 0]
            if costs.min() > value - _ENOUGH:
                break
            unit, value = along[int(np.argmin(costs))], float(costs.min())
        improbability = value + float(np.log(curvature).sum()) / 2
        stds = self._sigma * np.sqrt((axes**2 / curvature).sum(1))
        noise = Noise(*(np.asarray(values[0]) for values in self.noises(unit[None])))
        names = [_NAMES[i] for i in self._free]
        known = dict(zip(names, stds.tolist(), strict=True))
        return _Found(noise, value, improbability, known, self._heads)

    def _starts(self) -> Array:
        """Trials (C, F) over _GRID, as far as its numbers are free."""
        trials = np.zeros((len(_GRID), len(self._free)))
        for k, name in enumerate(('turn', 'position')):
            if _NAMES.index(name) in self._free:
                trials[:, self._free.index(_NAMES.index(name))] = np.array(_GRID)[:, k]
        return np.unique(trials, axis=0)

    def _shared_starts(self, near: Noise) -> Array:
        """Trials (C, F) beside a noise, over _SHARED_STARTS."""
        noises = [near._replace(share=np.array(share), distance_m=np.array(distance))
                  for share, distance in _SHARED_STARTS]  # fmt: skip
        pairs = zip(_SCALES.values(), zip(*noises, strict=True), strict=True)
        moved = np.column_stack([scale.to(np.array(values, float)) for scale, values in pairs])
        return np.asarray(((moved - self._origin) / _STDS)[:, self._free])

    def _derivatives(self, at: Array) -> tuple[float, Array, Array]:
        """Value, gradient (F,) and Hessian (F, F) by differences, all trials in one pass."""
        count = len(at)
        steps = _STEP * np.eye(count)
        i, j = np.tril_indices(count, -1)
        moves = np.concatenate([np.zeros((1, count)), steps, -steps, steps[i] + steps[j]])
        costs = self.costs(at + moves)[:, 0]
        value, up, down = costs[0], costs[1 : count + 1], costs[count + 1 : 2 * count + 1]
        hessian = np.diag(up + down - 2 * value)
        hessian[i, j] = hessian[j, i] = costs[2 * count + 1 :] - up[i] - up[j] + value
        return float(value), (up - down) / (2 * _STEP), hessian / _STEP**2


class _Drive:
    """A log made ready: the motion between its positions."""

    def __init__(self, log: Log, config: FilterConfig) -> None:
        self.log = log
        self.slip = config.slip_per_metre
        seconds = np.diff(log.stamps_ns, prepend=log.stamps_ns[:1]) * 1e-9
        clock = (log.stamps_ns - log.stamps_ns[0]) * 1e-9
        self._when = (log.at_ns - log.stamps_ns[0]) * 1e-9
        silent = np.cumsum(np.where(seconds > ODOMETRY_TIMEOUT_S, seconds, 0.0))
        silent = np.interp(self._when, clock, silent)
        self.silent = np.diff(silent, prepend=silent[:1])
        self.steps = self._between(clock, self._sums(seconds, config))

    def _sums(self, seconds: Array, config: FilterConfig) -> Array:
        """Running sums (10, N) along the odometry: x, y, the same that turns take, and those of
        which Steps has parts.
        """
        twists = self.log.twists.copy()
        # As Prediction.drive does.
        gaps = np.flatnonzero(seconds > ODOMETRY_TIMEOUT_S)
        twists[gaps] = (self.log.twists[gaps - 1] + self.log.twists[gaps]) / 2
        path = integrate(self.log.stamps_ns, twists)
        # As motion.drive does.
        speed, rate = np.abs(twists).T
        slowed = np.where(speed > SPOT_RADIUS_M * rate, np.sign(twists[:, 0]) * rate, 0.0)
        lost = integrate(self.log.stamps_ns, np.column_stack([slowed, twists[:, 1]]))
        meters, radians = (np.abs(twists) * seconds[:, None]).T
        moves = (np.abs(twists) >= [STANDSTILL_SPEED, STANDSTILL_RATE]).any(1) * seconds
        added = self.log.variances * (moves * (seconds + ODOMETRY_CORRELATION_S))[:, None]
        turning = config.yaw_per_radian**2 * radians + YAW_PER_METER**2 * meters + added[:, 1]
        rates = [twists[:, 1] * seconds, meters, radians, moves, turning, added[:, 0]]
        return np.asarray([*path[:, :2].T, *lost[:, :2].T, *np.cumsum(rates, axis=1)])

    def _between(self, clock: Array, sums: Array) -> Steps:
        """Interpolated at the positions' stamps, for every lag."""
        table = np.array([[np.interp(self._when - lag, clock, one) for lag in LAGS_S]
                          for one in sums])  # fmt: skip
        x, y, lost_x, lost_y, *rest = np.diff(table, axis=2, prepend=table[:, :, :1])
        heading = np.concatenate([table[4, :, :1], table[4, :, :-1]], axis=1)
        c, s = np.cos(heading), np.sin(heading)
        moved = c * x + s * y, c * y - s * x
        lost = c * lost_x + s * lost_y, c * lost_y - s * lost_x
        return Steps(*(part.T for part in (*moved, *lost, *rest)))

    def lagging(self, lag_s: Array) -> list[Steps]:
        """The steps, arrays (C,), by lags (C,): interpolated between those of LAGS_S."""
        at = (lag_s - LAGS_S[0]) / (LAGS_S[1] - LAGS_S[0])
        low = np.clip(at.astype(int), 0, len(LAGS_S) - 2)
        part = at - low
        driven = [(1 - part) * one[:, low] + part * one[:, low + 1] for one in self.steps]
        return [Steps(*row) for row in zip(*driven, strict=True)]

    def fits(self, cost: float) -> bool:
        """Whether the negative log-likelihood is less than that of a cloud without motion.

        Where the robot has not left the cloud, there is nothing to compare.
        """
        places = self.log.places
        low, middle, high = np.percentile(places, _CLOUD, axis=0)
        stds = np.maximum((high - low) / 2, np.sqrt(self.log.spreads.mean(0)))
        driven = integrate(self.log.stamps_ns, self.log.twists)[:, :2].std(0)
        d2 = (((places - middle) / stds) ** 2).sum(1)
        density = (1 - _OUTLIERS) * np.exp(-d2 / 2) / (2 * math.pi * stds.prod())
        density += _OUTLIERS * math.exp(self.log.log_background)
        cloud = -np.log(density[_SETTLE + 1 :]).sum()
        return bool(cost < cloud - math.log(len(places)) or np.hypot(*driven) < np.hypot(*stds))

    def costs(self, trials: Noise, heads: Array) -> Array:
        """Negative log-likelihoods (C, H) of the positions, by trial and start heading (H,)."""
        spread = Noise(*(np.repeat(values, len(heads)) for values in trials))
        log = self.log
        bank = _Bank(spread, np.tile(heads, len(trials.turn)), log.places[0], log.spreads[0])
        log_bad = math.log(_OUTLIERS) + log.log_background
        total = np.zeros(len(spread.turn))
        for i, step in enumerate(self.lagging(spread.lag_s)[1:], 1):
            slip = (self.slip * spread.slip) ** 2 * step.meters
            bank.predict(step, slip, float(self.silent[i]))
            log_likelihood = bank.correct(log.places[i], log.spreads[i], log_bad)
            if i > _SETTLE:
                total -= log_likelihood
        return total.reshape(-1, len(heads))


class _Bank:
    """A filter for each trial (C,): x m, y m, yaw rad, turn-rate bias, scale, way lost in turns,
    and the error that positions share, in standard deviations (x, y); the motion is that of
    `motion`, in one step.
    """

    def __init__(self, noise: Noise, yaw: Array, place: Array, spread: Array) -> None:
        self._noise = noise
        self._mean = np.zeros((len(yaw), _SIZE))
        self._mean[:, :2], self._mean[:, _YAW] = place, yaw
        stds = np.array([0, 0, np.pi / len(_HEADS), BIAS_STD, SCALE_STD, LOSS_STD, 1, 1])
        self._covariance = np.tile(np.diag(stds**2), (len(yaw), 1, 1))
        variance = noise.position[:, None] ** 2 * spread
        for axis in (_X, _Y):
            shared, other = -np.sqrt(noise.share * variance[:, axis]), _ERROR + axis
            self._covariance[:, axis, axis] = variance[:, axis]
            self._covariance[:, axis, other] = self._covariance[:, other, axis] = shared

    def predict(self, step: Steps, slip: Array, silent: float) -> None:
        """Move on by a step, with slip variance (C,) m^2; s without odometry."""
        mean, noise = self._mean, self._noise
        # Along the chord, which a bias turns by half.
        yaw = mean[:, _YAW] - mean[:, _BIAS] * step.moving / 2
        gain, loss, c, s = 1 + mean[:, _SCALE], mean[:, _LOSS], np.cos(yaw), np.sin(yaw)
        by_scale = c * step.forward - s * step.left, s * step.forward + c * step.left
        less, left = step.lost_forward, step.lost_left
        by_loss = s * left - c * less, -s * less - c * left
        dx, dy = (gain * a + loss * b for a, b in zip(by_scale, by_loss, strict=True))
        fade = np.exp(-(step.meters + TURN_RADIUS_M * step.radians) / noise.distance_m)
        jacobian = np.tile(np.eye(_SIZE), (len(yaw), 1, 1))
        jacobian[:, _X, _YAW], jacobian[:, _Y, _YAW] = -dy, dx
        jacobian[:, _X, _BIAS], jacobian[:, _Y, _BIAS] = dy * step.moving / 2, -dx * step.moving / 2
        jacobian[:, _YAW, _BIAS] = -step.moving
        jacobian[:, _X, _SCALE], jacobian[:, _Y, _SCALE] = by_scale
        jacobian[:, _X, _LOSS], jacobian[:, _Y, _LOSS] = by_loss
        jacobian[:, _ERROR, _ERROR] = jacobian[:, _ERROR + 1, _ERROR + 1] = fade
        covariance = jacobian @ self._covariance @ jacobian.transpose(0, 2, 1)
        turning = noise.turn**2 * step.turn_variance + UNKNOWN_RATE**2 * silent
        _add_turning(covariance, turning, np.stack([-dy, dx], 1))
        along = np.stack([c, s], 1) * (noise.speed * np.sqrt(step.way_variance))[:, None]
        covariance[:, :2, :2] += along[:, :, None] * along[:, None, :]
        anywhere = slip + 2 * UNKNOWN_SPEED**2 * silent
        fresh = [anywhere, anywhere, BIAS_WALK**2 * step.moving, SCALE_WALK**2 * step.meters,
                 LOSS_WALK**2 * step.radians, 1 - fade**2, 1 - fade**2]  # fmt: skip
        rows = (_X, _Y, _BIAS, _SCALE, _LOSS, _ERROR, _ERROR + 1)
        for i, variance in zip(rows, fresh, strict=True):
            covariance[:, i, i] += variance
        mean[:, :3] += np.stack([dx, dy, step.turn - mean[:, _BIAS] * step.moving], 1)
        mean[:, _ERROR:] *= fade[:, None]
        self._covariance = covariance

    def correct(self, place: Array, spread: Array, log_bad: float) -> Array:
        """Fuse a position (2,) of variances (2,), as far as it is none of the outliers, of log
        density `log_bad`; its log-likelihoods (C,).
        """
        covariance, share = self._covariance, self._noise.share[:, None]
        variance = self._noise.position[:, None] ** 2 * spread
        root = np.sqrt(share * variance)
        cross = covariance[:, :, :2] + covariance[:, :, _ERROR:] * root[:, None, :]
        innovation = cross[:, :2] + root[:, :, None] * cross[:, _ERROR:]
        innovation[:, [0, 1], [0, 1]] += (1 - share) * variance
        inverse, determinant = _inverse(innovation)
        miss = place - self._mean[:, :2] - root * self._mean[:, _ERROR:]
        gain = cross @ inverse
        move = (gain @ miss[:, :, None])[:, :, 0]
        d2 = ((inverse @ miss[:, :, None])[:, :, 0] * miss).sum(1)
        log_good = math.log(1 - _OUTLIERS) - d2 / 2 - np.log(2 * math.pi * np.sqrt(determinant))
        total = np.logaddexp(log_good, log_bad)
        good = np.exp(log_good - total)
        self._mean = self._mean + good[:, None] * move
        less, doubt = gain @ cross.transpose(0, 2, 1), good * (1 - good)
        self._covariance = (
            covariance
            - good[:, None, None] * less
            + doubt[:, None, None] * move[:, :, None] * move[:, None, :]
        )
        return np.asarray(total)


def _add_turning(covariance: Array, variance: Array, lever: Array) -> None:
    """Add a random walk (C,) of the heading; `lever` (C, 2) is the motion turned to the left.

    The end of the way moves by half the walk's sum, and its variance is a third of that.
    """
    reach = variance[:, None] * lever
    covariance[:, :2, :2] += reach[:, :, None] * lever[:, None, :] / 3
    covariance[:, :2, _YAW] += reach / 2
    covariance[:, _YAW, :2] += reach / 2
    covariance[:, _YAW, _YAW] += variance


def _inverse(matrices: Array) -> tuple[Array, Array]:
    """Inverses (C, 2, 2) of symmetric matrices, and determinants (C,)."""
    a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    determinant = a * d - b * b
    rows = np.stack([d, -b, -b, a], 1).reshape(-1, 2, 2)
    return rows / determinant[:, None, None], determinant
