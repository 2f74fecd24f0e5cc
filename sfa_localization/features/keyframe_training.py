# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Choose keyframes among the training images, and learn how well they are found."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import LENGTH_TO_STD, MEDIAN_TO_STD, quantile, surprise
from sfa_localization.features.image_features import evenly
from sfa_localization.features.keyframes import NEIGHBORS, Keyframes
from sfa_localization.features.observation import LOWEST, Match, MatchNoise
from sfa_localization.features.rotation_spread import needed_factor

Correlations = tuple[int, NDArray[np.float32], NDArray[np.float32]]

LEAST, DENSITY = 2000, 2
"""Keyframes of a model, 3 kB each: so many, or more where there are so many to a square meter: with
a third of them, 16 m x 18 m are known as well; smaller places show nearer things."""
# Keyframes that are left out in turn: enough for quantiles of 5 %.
_TRIALS = 400
# A keyframe is matched without those of the same stretch of driving: they are too alike.
_STRETCH_M = 3.0
_AT_ONCE = 8  # bounds the memory
# A place is unknown below this share of what keyframes of other stretches of driving reach.
_LOWEST_SHARE = 0.5
_TEMPERATURES = np.geomspace(0.003, 0.1, 12)
_FLOORS_M = np.geomspace(0.01, 1.0, 15)
_SLOPES_M = np.geomspace(0.03, 3.0, 13)
_USUAL_SHARE = 0.05
# Images between keyframes on both sides are more alike than most that are left out.
_ALIKE_SHARE = 0.25
_LEAST_BY_VARIATION = 1e-3
_LEAST_YAW_STD = 1e-3
# Keyframes that are matched as if they were so far outside, m: about as far as any are known.
_BEYOND_TRIALS, _BEYOND_M = 200, (0.2, 3.0)
_LEAST_UNLIKE = 1e-3
# Keyframes of a drive that are compared with those of others, and the least number; and the part of
# images, by squares, that is alike everywhere and that no place explains, from which lights differ:
# 0.03 to 0.1 between day, morning and overcast, 0.005 at most in one light.
_COMPARED, _FEWEST, _OF_LIGHT = 60, 20, 0.01
# Keeps novelty's scale finite where all images look alike.
_LEAST_RANGE = 0.05


def fit_keyframes(
    textures: NDArray[np.int8],
    poses: Array,
    path_m: Array,
    sphere: Sphere,
    drives: NDArray[np.int32] | None = None,
) -> Keyframes:
    """From textures (N, rows, columns) of training images, their poses (N, 3) in the map, the
    distance (N,) m driven until each, which must jump between drives, and the numbers (N,) of
    these; one drive by default. Drives in one light become one.

    Raises DataError for too few images.
    """
    kept = spread(poses)
    own = None if drives is None else drives[kept]
    keyframes = Keyframes.of(
        textures[kept], np.asarray(poses[kept], float), MatchNoise(), sphere, own
    )
    keyframes = _by_light(keyframes)
    return dataclasses.replace(keyframes, noise=_noise(keyframes, path_m[kept]))


def _by_light(keyframes: Keyframes) -> Keyframes:
    """With one number for all drives in one light: together they are nearer to any place."""
    lights, known = np.full(len(keyframes.drives), -1, np.int32), 0
    for drive in np.unique(keyframes.drives).tolist():
        own = keyframes.drives == drive
        seen = dataclasses.replace(keyframes, drives=lights)
        apart = [_of_light(seen, np.flatnonzero(own), light) for light in range(known)]
        same = [light for light in range(known) if apart[light] < _OF_LIGHT]
        lights[own] = min(same, key=apart.__getitem__, default=known)
        known = int(lights.max()) + 1
    return dataclasses.replace(keyframes, drives=lights, trained=known)


def _of_light(keyframes: Keyframes, rows: NDArray[np.int64], light: int) -> float:
    """The part of the keyframes `rows` that those in a light do not explain and that is alike
    everywhere: 0 in the same light, more in another; 1 where they do not meet.
    """
    others = np.flatnonzero(keyframes.drives == light)
    left, spectra = [], keyframes.spectra()
    for row in rows[np.linspace(0, len(rows) - 1, min(_COMPARED, len(rows))).astype(int)].tolist():
        match = keyframes.match_among(spectra[row], others)
        if match.score >= LOWEST and match.left is not None and not match.at_border:
            left.append(match.left)
    if len(left) < _FEWEST:
        return 1.0
    # Two halves, so that the errors of single images are not alike by being the same.
    one, other = np.mean(left[::2], axis=0), np.mean(left[1::2], axis=0)
    whole = np.square(np.abs(spectra[rows])).sum(axis=(1, 2)).mean()
    return float((one * other.conj()).sum().real / whole)


def left_out(keyframes: Keyframes, path_m: Array) -> Iterator[Correlations]:
    """Some keyframes, each correlated with those of other stretches: index, (K,) correlations,
    -inf for its own stretch, and (K,) yaws rad. `path_m` (K,) is the distance driven until each.
    """
    sample = evenly(len(keyframes.poses), _TRIALS)
    for start in range(0, len(sample), _AT_ONCE):
        rows = sample[start : start + _AT_ONCE]
        found = keyframes.correlated(keyframes.spectra(rows), np.arange(len(path_m)))
        for row, scores, yaws in zip(rows.tolist(), *found, strict=True):
            scores[np.abs(path_m - path_m[row]) < _STRETCH_M] = -np.inf
            if np.isfinite(scores).sum() >= NEIGHBORS and scores.max() >= LOWEST:
                yield row, scores, yaws


@dataclass(frozen=True, slots=True)
class _Trial:
    """The `match` of a keyframe that is left out: `squared_error` m^2, `turn` rad, the error of its
    yaw, the variance m^2 by keyframes elsewhere at each temperature, and whether another track was
    `crossed` there: else nothing is left of the place.
    """

    match: Match
    squared_error: float
    turn: float
    crossed: bool
    scatters: tuple[float, ...]

    @classmethod
    def of(
        cls,
        keyframes: Keyframes,
        row: int,
        scores: NDArray[np.float32],
        yaws: NDArray[np.float32],
    ) -> _Trial:
        match = keyframes.located(keyframes.spectra([row])[0], scores, yaws)
        error = match.pose - keyframes.poses[row]
        reach = keyframes.reach(int(scores.argmax()))
        squares = (keyframes.elsewhere(scores, match.pose[:2], reach) ** 2).sum(1)
        scatters = [
            float(keyframes.likelihood(scores, temperature) @ squares) / 2
            for temperature in _TEMPERATURES.tolist()
        ]
        squared, turn = float(error[:2] @ error[:2]), abs(float(wrap_angle(error[2])))
        others = keyframes.poses[np.isfinite(scores), :2] - keyframes.poses[row, :2]
        crossed = bool(np.hypot(*others.T).min() < _STRETCH_M / 2)
        return cls(match, squared, turn, crossed, tuple(scatters))


def _noise(keyframes: Keyframes, path_m: Array) -> MatchNoise:
    """What the errors of keyframes that are left out are like; the default for too few."""
    trials = [_Trial.of(keyframes, *left) for left in left_out(keyframes, path_m)]
    if len(trials) < NEIGHBORS:
        return MatchNoise()
    noise, variance = _likeliest(trials)
    squared = np.array([trial.squared_error for trial in trials])
    lowest = max(LOWEST, _LOWEST_SHARE * float(np.median([trial.match.score for trial in trials])))
    turns = [trial.turn / (1 + trial.match.unlike) for trial in trials]
    crossings = [trial for trial in trials if trial.crossed]
    return dataclasses.replace(
        _usual(crossings, noise, lowest) if crossings else noise,
        factor=max(needed_factor(squared / variance, 2), 1.0),
        yaw_std=max(MEDIAN_TO_STD * float(np.median(turns)), _LEAST_YAW_STD),
        lowest=lowest,
        away_m=_away(keyframes, lowest),
    )


def _away(keyframes: Keyframes, lowest: float) -> float:
    """`MatchNoise.away_m`: what keyframes show that are matched with those alone that lie on one
    side of them, and not near, as if they had been taken outside.
    """
    rng = np.random.default_rng(0)
    places = keyframes.poses[:, :2]
    nearest, farthest = map(math.log, _BEYOND_M)
    far = np.exp(rng.uniform(nearest, farthest, _BEYOND_TRIALS))
    angle = rng.uniform(-np.pi, np.pi, _BEYOND_TRIALS)
    directions = np.column_stack([np.cos(angle), np.sin(angle)])
    sample = rng.integers(len(places), size=_BEYOND_TRIALS)
    shown = []
    for row, outward, distance in zip(sample.tolist(), directions, far, strict=True):
        rows = np.flatnonzero((places - places[row]) @ outward < -distance)
        if len(rows) < NEIGHBORS:
            continue
        match = keyframes.match_among(keyframes.spectra([row])[0], rows)
        if match.score >= lowest and match.at_border:
            unlike = max(math.log1p(match.unlike), _LEAST_UNLIKE)
            shown.append(math.dist(match.pose[:2], places[row]) / unlike)
    if len(shown) < NEIGHBORS:
        return keyframes.noise.away_m
    return LENGTH_TO_STD * float(np.median(shown))


def _usual(trials: Sequence[_Trial], noise: MatchNoise, lowest: float) -> MatchNoise:
    """The noise with what is usual at places that were left out where tracks cross."""
    variation = np.maximum([trial.match.variation for trial in trials], 1e-6)
    ratio = np.array([trial.match.unlike for trial in trials]) / variation**2
    usual = quantile(np.array([trial.match.score for trial in trials]), _USUAL_SHARE)
    return dataclasses.replace(
        noise,
        usual=max(usual, lowest + _LEAST_RANGE),
        by_variation=max(quantile(ratio, _ALIKE_SHARE), _LEAST_BY_VARIATION),
    )


def spread(poses: Array) -> NDArray[np.int64]:
    """Some of N images, by their poses (N, 3), spread over the ground: of each square meter as
    many, chosen at random, always the same.
    """
    cells, cell = np.unique(np.floor(poses[:, :2]), axis=0, return_inverse=True)
    number, cell = max(LEAST, DENSITY * len(cells)), cell.reshape(-1)
    order = np.random.default_rng(0).permutation(len(poses))
    order = order[np.argsort(cell[order], kind='stable')]
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.argsort(rank, kind='stable')[:number]])


def _likeliest(trials: Sequence[_Trial]) -> tuple[MatchNoise, Array]:
    """The noise under which the errors of M trials are likeliest, and the variances (M,) m^2 that
    it gives them.
    """
    squared = np.array([trial.squared_error for trial in trials])
    unlike = np.array([trial.match.unlike for trial in trials])
    nearby = np.array([np.trace(trial.match.noise) for trial in trials]) / 2
    scatters = np.array([trial.scatters for trial in trials]).T + nearby
    best, found = np.inf, (MatchNoise(), squared)
    # Of equals the largest temperature, which doubts most.
    for temperature, scatter in reversed([*zip(_TEMPERATURES.tolist(), scatters, strict=True)]):
        for floor, slope in itertools.product(_FLOORS_M.tolist(), _SLOPES_M.tolist()):
            variance = scatter + floor**2 + (slope * unlike) ** 2
            cost = float(np.mean(surprise(squared / variance, 2) + np.log(variance)))
            if cost < best:
                best, found = cost, (MatchNoise(temperature, floor, slope), variance)
    return found
