# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: small training images with known poses, matched by correlation over all rotations.

Slow features are regressed to a pose, and a regression always has an answer. A correlation with
the training images says whether the place was seen at all: local contrast survives another light
and season, and what matches nothing is unknown. The match is a pose of its own: the correlation
with the neighbors of the best keyframe is a surface over the ground whose top is the position,
and the shift of the columns is the heading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Image
from sfa_localization.features.agreement import needed_factor

Texture = NDArray[np.float32]
Spectra = NDArray[np.complex64]

_COLUMNS, _ROWS = 100, 20
# Standard deviation of the blur that takes light and its slow changes out, of the columns: 10 deg.
_BLUR = 1 / 37.5
# Keeps the noise of dark and of plain surfaces small beside texture: of the brightness (8 bit),
# and of its logarithm.
_DARKEST, _FLATTEST = 8.0, 0.1
# Textures are stored with one byte a pixel.
_LARGEST, _STEPS = 4.0, 127 / 4.0
_MOST = 2000
_NEIGHBORS = 24
_REACH_SHARE = 0.6
# Correlations that unknown places do not reach (foreign and mirrored gardens: 0.40), and the same
# as a share of what keyframes of other stretches of driving reach.
_KNOWN, _KNOWN_SHARE = 0.42, 0.5
_TEMPERATURES = np.geomspace(0.003, 0.1, 12)
_FLOORS_M = np.geomspace(0.03, 1.0, 15)
_ROWS_AT_ONCE = 64
_TRIALS = 400
_COARSE, _CANDIDATES = 15, 64
_FAR_M = 3.0
_HEAVY_TAIL = 4.0
# Temperature, floor m, yaw's standard deviation rad, factor and lowest correlation where nothing
# can be learnt.
_ASSUMED = (0.02, 0.3, 0.03, 1.0, _KNOWN)


@dataclass(frozen=True, slots=True)
class Match:
    """What the keyframes say of an image.

    `pose` (3,) [x m, y m, yaw rad] in the map, `covariance` (3, 3); `score` is the correlation
    with the best keyframe, 1 for the same image; `known` whether that is enough for a place that
    was seen in training.
    """

    pose: Array
    covariance: Array
    score: float
    known: bool


def texture(panorama: Image) -> Texture:
    """Local contrast of a panorama (H, W, 3) uint8, small: (rows, columns), zero mean, unit norm.

    The logarithm of the brightness minus its surroundings, over their standard deviation: what is
    left of an image after its light.
    """
    height, width = min(panorama.shape[0], _ROWS), min(panorama.shape[1], _COLUMNS)
    grey = cv2.cvtColor(panorama, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    margin = max(width // 6, 1)
    light = np.log(np.pad(small, ((0, 0), (margin, margin)), 'wrap') + np.float32(_DARKEST))
    detail = light - cv2.GaussianBlur(light, (0, 0), width * _BLUR)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), width * _BLUR))
    return _normalized((detail / (contrast + np.float32(_FLATTEST)))[:, margin:-margin])


def _normalized(image: Texture) -> Texture:
    centered = image - image.mean()
    return np.asarray(centered / max(float(np.linalg.norm(centered)), 1e-6), np.float32)


def _spectrum(textures: Texture) -> Spectra:
    """Fourier coefficients of the columns, (..., rows, F)."""
    return np.asarray(np.fft.rfft(textures, axis=-1), np.complex64)


def _coarse(spectra: Spectra) -> Spectra:
    """Low frequencies of spectra (T, rows, F), in pairs of rows, of unit norm."""
    low = spectra[:, : spectra.shape[1] // 2 * 2, 1 : _COARSE + 1]
    low = low[:, ::2] + low[:, 1::2] if low.shape[1] else spectra[:, :, 1 : _COARSE + 1]
    low = np.concatenate([np.zeros_like(low[:, :, :1]), low], axis=2)
    return np.asarray(low / np.maximum(np.linalg.norm(low, axis=(1, 2), keepdims=True), 1e-9))


@dataclass(frozen=True, slots=True)
class Keyframes:
    """`textures` (K, rows, columns) int8 and `poses` (K, 3) [x m, y m, yaw rad] in the map.

    `temperature` is the difference of correlation that matters, `floor_m` the standard deviation
    of a position at best, `yaw_std` that of a heading, `factor` what the variances of positions
    lack, `lowest` the correlation of a known place; all learnt from keyframes left out.
    """

    textures: NDArray[np.int8]
    poses: Array
    temperature: float
    floor_m: float
    yaw_std: float
    factor: float
    lowest: float
    clockwise: bool
    spectra: Spectra
    coarse: Spectra
    tree: cKDTree

    @classmethod
    def of(
        cls,
        textures: NDArray[np.int8],
        poses: Array,
        numbers: tuple[float, float, float, float, float],
        clockwise: bool,
    ) -> Keyframes:
        """Keyframes ready to be matched."""
        whole = np.stack([_normalized(t.astype(np.float32)) for t in textures])
        spectra = _spectrum(whole)
        coarse = np.ascontiguousarray(_coarse(spectra).transpose(2, 0, 1))
        return cls(textures, poses, *numbers, clockwise, spectra, coarse, cKDTree(poses[:, :2]))

    @classmethod
    def fit(
        cls, textures: Texture, poses: Array, path_m: Array, clockwise: bool = True
    ) -> Keyframes:
        """From textures (N, rows, columns) of training images, their poses (N, 3) in the map, and
        the distance (N,) m driven until each, which must jump between drives.

        Raises DataError for too few images.
        """
        if len(textures) < _NEIGHBORS:
            raise DataError(f'{len(textures)} images are too few for keyframes')
        kept = _spread(poses)
        deviation = np.maximum(np.std(textures[kept], axis=(1, 2), keepdims=True), 1e-6)
        small = np.clip(np.rint(textures[kept] * (_STEPS / deviation)), -127, 127).astype(np.int8)
        poses = np.asarray(poses[kept], float)
        raw = cls.of(small, poses, _ASSUMED, clockwise)
        return cls.of(small, poses, raw._calibrated(path_m[kept]), clockwise)

    def match(self, panorama: Image) -> Match:
        """Find a panorama (H, W, 3) uint8 BGR among the keyframes: the likeliest by a coarse
        correlation, these and the neighbors of the best of them by the full one.
        """
        spectrum = _spectrum(texture(panorama))[None]
        scores = np.full(len(self.poses), -np.inf, np.float32)
        shifts = np.zeros(len(self.poses), np.float32)
        for _ in range(2):
            if np.isfinite(scores).any():
                wanted = self._neighbors(int(scores.argmax()))
            else:
                wanted = self._candidates(spectrum)
            wanted = wanted[np.isneginf(scores[wanted])]
            if len(wanted):
                scores[wanted], shifts[wanted] = (
                    part[0] for part in self._correlated(spectrum, self.spectra[wanted])
                )
        return self._located(scores, shifts)

    def _candidates(self, spectrum: Spectra) -> NDArray[np.int64]:
        """The keyframes that are likeliest by the coarse structure of the image."""
        products = self.coarse @ np.conj(_coarse(spectrum)).transpose(2, 1, 0)
        curves = np.fft.irfft(products[:, :, 0].T, 2 * len(self.coarse), axis=1)
        scores = curves.max(1)
        number = min(_CANDIDATES, len(scores))
        return np.sort(np.argpartition(-scores, number - 1)[:number])

    def _neighbors(self, best: int) -> NDArray[np.int64]:
        """The keyframes nearest to one, itself first."""
        number = min(_NEIGHBORS, len(self.poses))
        return np.asarray(self.tree.query(self.poses[best, :2], number)[1], np.int64)

    def _correlated(
        self, spectra: Spectra, keyframes: Spectra
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Largest correlation of T spectra (T, rows, F) with each of K, (T, K), and the shift of
        columns, to a part of a column, at which it is reached.
        """
        columns = self.textures.shape[2]
        products = keyframes.transpose(2, 0, 1) @ np.conj(spectra).transpose(2, 1, 0)
        curves = np.fft.irfft(products.transpose(2, 1, 0), columns, axis=2).astype(np.float32)
        top = curves.argmax(2)
        t, k = np.ogrid[: len(spectra), : len(keyframes)]
        left, middle, right = (curves[t, k, (top + step) % columns] for step in (-1, 0, 1))
        bend = left - 2 * middle + right
        part = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1), 0)
        return middle, np.asarray(top + part, np.float32)

    def _located(self, scores: NDArray[np.float32], shifts: NDArray[np.float32]) -> Match:
        best = int(scores.argmax())
        place = self._top_of_surface(scores, best)
        sign = -1.0 if self.clockwise else 1.0
        yaw = self.poses[best, 2] + sign * shifts[best] * 2 * np.pi / self.textures.shape[2]
        scatter, weight = self._scatter(scores, place, self.temperature)
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = self.factor * (scatter + self.floor_m**2 * np.eye(2))
        yaws = self.poses[:, 2] + sign * shifts * 2 * np.pi / self.textures.shape[2]
        covariance[2, 2] = self.yaw_std**2 + float(weight @ wrap_angle(yaws - yaw) ** 2)
        pose = np.array([*place, wrap_angle(yaw)])
        score = float(scores[best])
        return Match(pose, covariance, score, score >= self.lowest)

    def _top_of_surface(self, scores: NDArray[np.float32], best: int) -> Array:
        """Top of the paraboloid through the correlations with the neighbors of the best."""
        center = self.poses[best, :2]
        near = self._neighbors(best)
        near = near[np.isfinite(scores[near])]
        offset = self.poses[near, :2] - center
        square = (offset**2).sum(1)
        reach = max(_REACH_SHARE * float(np.sqrt(square.max())), 1e-6)
        weight = np.exp(-square / (2 * reach**2))
        terms = np.column_stack([np.ones(len(near)), offset, -0.5 * square]) * weight[:, None]
        solution = np.linalg.lstsq(terms, scores[near] * weight, rcond=None)[0]
        if solution[3] <= 0:
            return np.array(center)
        step = solution[1:3] / solution[3]
        return np.asarray(center + step * min(1.0, reach / max(float(np.hypot(*step)), 1e-9)))

    def _scatter(
        self, scores: NDArray[np.float32], place: Array, temperature: float
    ) -> tuple[Array, Array]:
        """Covariance (2, 2) about a place of the keyframes by how likely each is, and that (K,)."""
        weight = np.exp((scores - scores.max()) / temperature, dtype=np.float64)
        weight /= weight.sum()
        offset = self.poses[:, :2] - place
        return (offset * weight[:, None]).T @ offset, weight

    def _calibrated(self, path_m: Array) -> tuple[float, float, float, float, float]:
        """Temperature, floor and yaw's standard deviation that suit keyframes left out best.

        A keyframe is matched with all but those from the same stretch of driving.
        """
        errors, yaws, scatters, correlations = [], [], [], []
        sample = np.unique(np.linspace(0, len(self.poses) - 1, _TRIALS).round().astype(np.int64))
        for start in range(0, len(sample), _ROWS_AT_ONCE):
            rows = sample[start : start + _ROWS_AT_ONCE]
            scores, shifts = self._correlated(self.spectra[rows], self.spectra)
            for row, score, shift in zip(rows.tolist(), scores, shifts, strict=True):
                score[np.abs(path_m - path_m[row]) < _FAR_M] = -np.inf
                match = self._located(score, shift) if np.isfinite(score).any() else None
                if match is None or match.score < _KNOWN:
                    continue
                correlations.append(match.score)
                place = match.pose[:2]
                errors.append(float(((place - self.poses[row, :2]) ** 2).sum()))
                yaws.append(abs(float(wrap_angle(match.pose[2] - self.poses[row, 2]))))
                scatters.append(
                    [np.trace(self._scatter(score, place, t)[0]) / 2 for t in _TEMPERATURES]
                )
        if len(errors) < _NEIGHBORS:
            return _ASSUMED
        squared, variances = np.array(errors), np.array(scatters)
        at, floor = _likeliest(squared, variances)
        ratio = squared / (variances[:, at] + floor**2)
        factor = max(needed_factor(ratio, 2, np.ones(len(ratio))), 1.0)
        yaw_std = max(1.4826 * float(np.median(yaws)), 1e-3)
        lowest = max(_KNOWN, _KNOWN_SHARE * float(np.median(correlations)))
        return float(_TEMPERATURES[at]), floor, yaw_std, factor, lowest

    def to_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Arrays to save, without pickle."""
        learnt = self.temperature, self.floor_m, self.yaw_std, self.factor, self.lowest
        numbers = [*learnt, float(self.clockwise)]
        return {'textures': self.textures, 'poses': self.poses, 'numbers': np.array(numbers)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> Keyframes:
        """Read what `to_arrays` gave."""
        *numbers, clockwise = (float(n) for n in np.asarray(arrays['numbers'], float))
        textures, poses = (
            np.asarray(arrays['textures'], np.int8),
            np.asarray(arrays['poses'], float),
        )
        temperature, floor_m, yaw_std, factor, lowest = numbers
        learnt = (temperature, floor_m, yaw_std, factor, lowest)
        return cls.of(textures, poses, learnt, bool(clockwise))


def _spread(poses: Array) -> NDArray[np.int64]:
    """At most _MOST images, spread over the ground: of each cell of a grid the first ones."""
    if len(poses) <= _MOST:
        return np.arange(len(poses))
    extent = np.ptp(poses[:, :2], axis=0)
    cell = float(np.sqrt(extent[0] * extent[1] / _MOST)) / 4
    places = np.floor(poses[:, :2] / max(cell, 1e-6)).astype(np.int64)
    rank = np.zeros(len(poses), np.int64)
    seen: dict[tuple[int, int], int] = {}
    for i, (x, y) in enumerate(places.tolist()):
        rank[i] = seen[x, y] = seen.get((x, y), -1) + 1
    return np.sort(np.argsort(rank, kind='stable')[:_MOST])


def _likeliest(squared_errors: Array, scatters: Array) -> tuple[int, float]:
    """Number of the temperature, and floor m, under which errors (M,) are likeliest."""
    best, found = np.inf, (0, float(_FLOORS_M[0]))
    for column in range(len(_TEMPERATURES)):
        for floor in _FLOORS_M:
            variance = scatters[:, column] + floor**2
            tails = (_HEAVY_TAIL + 2) / 2 * np.log1p(squared_errors / (variance * _HEAVY_TAIL))
            surprise = float(np.mean(tails + np.log(variance)))
            if surprise < best:
                best, found = surprise, (column, float(floor))
    return found
