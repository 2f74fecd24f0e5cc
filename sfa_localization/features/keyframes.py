# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: small training images with known poses, matched by correlation over all rotations.

Slow features are regressed to a pose, and a regression always has an answer. A correlation with
the training images says whether the place was seen at all: local contrast survives another light
and season, and what matches nothing is unknown. The match is a pose of its own: the keyframes
around the best one show how the image changes with the place, and the shift of the columns is the
heading. Brightness also shows the sunlit side of things, and seems to move them with the sun; their
colors stay.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.leveling import TILTED_RAD, leveled
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Image
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import parabola_peak
from sfa_localization.features.local_regression import Neighbors, averaged, columns_of, turned
from sfa_localization.features.observation import Leveled, Match, MatchNoise, Spectra, unlikeness
from sfa_localization.features.tilt import derivatives, find_tilt, visible

Texture = NDArray[np.float32]
Scores = tuple[NDArray[np.float32], NDArray[np.float32]]

_COLUMNS, _ROWS, _COLOR_ROWS = 80, 16, 8
# Standard deviation of the blur that takes light and its slow changes out, of the columns: 10 deg.
_BLUR = 1 / 37.5
# Keeps the noise of dark and of plain surfaces small beside texture: of the brightness (8 bit),
# and of its logarithm.
_DARKEST, _FLATTEST = 8.0, 0.1
# Textures and spectra have one byte a number: of a texture so many steps are a standard deviation.
_LARGEST, _LEAST_STEP = 127, 1e-9
_STEPS = _LARGEST / 4.0
NEIGHBORS = 24
"""Keyframes about a place that may be it."""
_FEWEST = 6  # a place, its slopes along both axes, and as many to spare
# Keyframes of each regression; it is repeated once around where it has put the image, where that
# is farther from the best keyframe than this part of its reach.
_REGRESSED, _REPEATED, _NEARER = 64, 2, 0.5
# Drives of the training, at most, that say where an image is.
_DRIVES = 3
# How far it may put the image from the best keyframe, of the distance to its farthest neighbor.
_REACH_SHARE = 0.6
# Frequencies of the coarse correlation, and how many keyframes it leaves for the full one.
_COARSE, _CANDIDATES = 12, 64
# The likest keyframes to which an image is leveled: with a tilt the first may be another place.
_LEVELED = 16
# Sets of neighbors that are kept, 0.8 MB each, of three drives; keyframes that are read at once.
_KEPT, _AT_ONCE = 6, 512
# Tilts that are tried for an image that is unlike all keyframes: beyond 8 degrees it is, even of a
# known place, and each of these makes it like them up to 6 degrees on.
_STEEP_RAD = math.radians(8.0) * np.array(
    [(math.cos(angle), math.sin(angle)) for angle in np.arange(8) * math.pi / 4]
)
# Keyframes near the place show headings that differ by no more than this because things are near.
_PARALLAX_RAD = 0.3


def texture(panorama: Image) -> Texture:
    """Local contrast of a panorama (H, W, 3) uint8, small: (rows, columns), zero mean, unit norm.

    The logarithm of the brightness minus its surroundings, over their standard deviation: what is
    left of an image after its light. Below it, in half as many rows, the same of red over green
    and of blue over both; a gray camera has none.
    """
    small = _small(panorama, _ROWS, _COLUMNS)
    few = _small(small, _COLOR_ROWS, _COLUMNS)
    light = _logarithm(np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.float32))
    blue, green, red = np.moveaxis(_logarithm(few), 2, 0)
    colors = np.dstack([red - green, blue - (red + green) / 2])
    return normalized(np.concatenate([*_contrast(light[:, :, None]), *_contrast(colors)]))


def _logarithm(image: Texture) -> Texture:
    return np.asarray(np.log(image + np.float32(_DARKEST)), np.float32)


def _contrast(values: Texture) -> Texture:
    """Of channels (rows, columns, C): their values minus the surroundings, over their standard
    deviation there, (C, rows, columns).
    """
    width = values.shape[1]
    margin = max(width // 6, 1)
    around = cv2.copyMakeBorder(values, 0, 0, margin, margin, cv2.BORDER_WRAP)
    detail = around - cv2.GaussianBlur(around, (0, 0), width * _BLUR)
    deviation = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), width * _BLUR))
    contrast = (detail / (deviation + np.float32(_FLATTEST)))[:, margin:-margin]
    return np.asarray(np.moveaxis(contrast.reshape(*values.shape), 2, 0), np.float32)


def _small(image: NDArray[Any], rows: int, columns: int) -> Texture:
    """An image (H, W) or (H, W, C) of at most so many rows and columns."""
    size = min(image.shape[1], columns), min(image.shape[0], rows)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def normalized(image: Texture) -> Texture:
    """An image of zero mean and unit norm."""
    centered = image - image.mean()
    return np.asarray(centered / max(float(np.linalg.norm(centered)), 1e-6), np.float32)


def spectrum(textures: Texture) -> Spectra:
    """Fourier coefficients of the columns, (..., rows, F)."""
    return np.asarray(np.fft.rfft(textures), np.complex64)


def channels(rows: int) -> tuple[slice, ...]:
    """Of a texture's rows those of brightness and of both color differences."""
    few = min(rows // 3, _COLOR_ROWS)
    light = rows - 2 * few
    return slice(0, light), slice(light, light + few), slice(light + few, rows)


def quantized(textures: Texture) -> NDArray[np.int8]:
    """Textures (N, rows, columns) with one byte a pixel."""
    deviation = np.maximum(np.std(textures, axis=(1, 2), keepdims=True), 1e-6)
    return np.asarray(np.clip(np.rint(textures * (_STEPS / deviation)), -127, 127), np.int8)


def spectra_of(textures: NDArray[np.int8]) -> Spectra:
    """Spectra (K, rows, F) of quantized textures (K, rows, columns), each of unit norm."""
    return spectrum(np.stack([normalized(t.astype(np.float32)) for t in textures]))


def correlate(spectra: Spectra, keyframes: Spectra, columns: int) -> Scores:
    """Largest correlation of T spectra (T, rows, F) with each of K (K, rows, F), (T, K), and the
    shift of columns, to a part of one of so many, at which it is reached.
    """
    return _peaks(keyframes.transpose(2, 0, 1) @ np.conj(spectra).transpose(2, 1, 0), columns)


def _peaks(products: Spectra, columns: int) -> Scores:
    """The same by products (F, K, T) over the rows."""
    # Half columns: between whole ones, the same image would seem to be another one.
    curves = columns_of(products, 2 * columns, axis=0)
    top = curves.argmax(0)
    around = (top + np.arange(-1, 2)[:, None, None]) % len(curves)
    left, middle, right = np.take_along_axis(curves, around, 0)
    part = parabola_peak(left, middle, right)
    return (2 * middle - (left - right) * part / 2).T, np.asarray((top + part) / 2, np.float32).T


def _least(values: NDArray[Any], number: int) -> NDArray[np.int64]:
    """Where so many values (K,) are least, in their order."""
    few = len(values) <= number
    found = np.arange(len(values)) if few else np.argpartition(values, number)[:number]
    return found[np.argsort(values[found])]


def coarse(spectra: Spectra) -> Texture:
    """Low frequencies of spectra (K, rows, F), the sums of four rows each, of unit norm: real parts
    and below them imaginary ones, (F', 2 rows', K).
    """
    low = _low(spectra).transpose(2, 1, 0)
    return np.ascontiguousarray(np.concatenate([low.real, low.imag], axis=1))


def coarse_scores(spectra: Spectra, keyframes: Texture) -> NDArray[np.float32]:
    """About the largest correlation (T, K) of spectra (T, rows, F) with keyframes' `coarse`."""
    low, (frequencies, rows, count) = _low(spectra).transpose(2, 0, 1), keyframes.shape
    parts = np.concatenate([low.real, low.imag, -low.imag, low.real], axis=2)
    images = parts.reshape(frequencies, -1, 2, rows).swapaxes(1, 2)
    products = images.reshape(frequencies, -1, rows) @ keyframes
    curves = _waves(frequencies) @ products.reshape(2 * frequencies, -1)
    return np.asarray(curves.max(0).reshape(len(spectra), count))


@cache
def _waves(frequencies: int) -> Texture:
    """What makes correlations (N,) at all headings of the parts (2 F,) of their coefficients."""
    angle = np.outer(np.arange(2 * frequencies + 2), np.arange(1, frequencies + 1))
    waves = np.exp(-1j * angle * np.pi / (frequencies + 1))
    return np.asarray(waves.astype(np.complex64).view(np.float32))


def _low(spectra: Spectra) -> Spectra:
    """Low frequencies of spectra (T, rows, F), the sums of four rows each, of unit norm."""
    low = np.add.reduceat(spectra[:, :, 1 : _COARSE + 1], range(0, spectra.shape[1], 4), axis=1)
    return np.asarray(low / np.maximum(np.linalg.norm(low, axis=(1, 2), keepdims=True), 1e-9))


@dataclass(frozen=True, slots=True)
class Keyframes:
    """K textures of so many `columns`, with their `poses` (K, 3) [x m, y m, yaw rad] in the map.

    They are held as the spectra of images with yaw 0: `values` (K, F, 2 rows) int8, real and
    imaginary parts in turn, in units of `step`; and as `coarse` ones. `drives` (K,) are the
    numbers of their drives, of which the first `trained` were those of the training; drives of the
    training in one light have one number.
    """

    values: NDArray[np.int8] | Texture
    step: float
    columns: int
    poses: Array
    noise: MatchNoise
    sphere: Sphere
    drives: NDArray[np.int32]
    trained: int
    coarse: Texture = field(init=False, repr=False)
    _last: dict[bytes, Neighbors] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        blocks = range(0, len(self.values), _AT_ONCE)
        rough = [coarse(self.aligned(slice(at, at + _AT_ONCE), _COARSE + 1)) for at in blocks]
        object.__setattr__(self, 'coarse', np.concatenate(rough, axis=2))
        object.__setattr__(self, '_last', {})

    @classmethod
    def of(
        cls,
        textures: NDArray[np.int8],
        poses: Array,
        noise: MatchNoise,
        sphere: Sphere,
        drives: NDArray[np.int32] | None = None,
        rounded: bool = True,
    ) -> Keyframes:
        """Of quantized textures (K, rows, columns), by default of one drive; all are of the
        training. Raises DataError for too few. Those that nobody saves need not be `rounded`.
        """
        if len(poses) < _FEWEST:
            raise DataError(f'{len(poses)} images are too few for keyframes')
        drives = np.zeros(len(poses), np.int32) if drives is None else drives
        parts = parts_of(textures, poses, sphere)
        values, step = encoded(parts) if rounded else (parts, 1.0)
        of_all = textures.shape[2], poses, noise, sphere, drives, int(drives.max()) + 1
        return cls(values, step, *of_all)

    def spectra(self, rows: Any = slice(None)) -> Spectra:
        """The spectra (M, rows, F) of the textures of some keyframes, by default of all."""
        return turned(self.aligned(rows), -self._sign * self.poses[rows, 2])

    def aligned(self, rows: Any, frequencies: int | None = None) -> Spectra:
        """The same with yaw 0, by default at all frequencies."""
        held = self.values[rows, :frequencies].astype(np.float32)
        held *= self.step
        return np.asarray(held.view(np.complex64).swapaxes(1, 2))

    @property
    def first(self) -> NDArray[np.bool_]:
        """Which keyframes are of the training (K,)."""
        return self.drives < self.trained

    def match(self, panorama: Image, pattern: Spectra | None = None) -> Match:
        """Find a panorama (H, W, 3) uint8 BGR without the `pattern` of its light, `OtherLight`."""
        return self.match_level(self.level(panorama), pattern)

    def level(self, panorama: Image) -> Leveled:
        """A panorama (H, W, 3) uint8 BGR without the roll and pitch of the robot that make it
        likest one of the keyframes that it is likest anyway, or would be with a large tilt.
        """
        known = self._upright(self._compared(panorama, np.zeros(2)))
        if known.score >= self.noise.lowest:
            return known
        steep = [self._compared(panorama, tilt) for tilt in _STEEP_RAD]
        likest = self._upright(max(steep, key=lambda one: one.score))
        return likest if likest.score > known.score else known

    def _seen(self, panorama: Image, tilt: Array) -> Leveled:
        """A panorama (H, W, 3) that a tilt (2,) rad made."""
        if not tilt.any():
            whole = spectrum(texture(panorama))
            return Leveled(panorama, panorama, tilt, whole, whole, *self._unmatched())
        level = leveled(panorama, tilt, self.sphere)
        image = texture(level)
        rows = [part.stop - part.start for part in self.channels]
        mask = np.concatenate([visible(tilt, n, self.columns, self.sphere) for n in rows])
        part = image * mask
        # What was not seen would count as unlike.
        part /= np.float32(max(float(np.linalg.norm(part)), 1e-6) * math.sqrt(mask.mean()))
        spectra = spectrum(image), spectrum(part)
        return Leveled(panorama, level, tilt, *spectra, *self._unmatched())

    def _compared(self, panorama: Image, tilt: Array) -> Leveled:
        """The same, correlated with the keyframes that it is likest."""
        known = self._seen(panorama, tilt)
        scores = coarse_scores(known.visible[None], self.coarse)[0]
        self._add(known, np.sort(_least(-scores, _CANDIDATES)))
        return known

    def _upright(self, known: Leveled) -> Leveled:
        """An image without the tilt that it has against one of its likest keyframes."""
        likely = np.flatnonzero(np.isfinite(known.scores))
        likely = likely[_least(-known.scores[likely], _LEVELED)]
        level, turn = self.aligned(likely), -self._sign * known.yaws[likely]
        others = level, turn.astype(float), self.columns, self.channels, self.sphere
        tilts, scores = find_tilt(known.spectrum, *others)
        return self._leveled(known, tilts[int(scores.argmax())])

    def _leveled(self, known: Leveled, tilt: Array) -> Leveled:
        """What is known of an image after a roll and pitch (2,) rad more, if they matter; the
        same keyframes are correlated.
        """
        if np.hypot(*tilt) < TILTED_RAD:
            return known
        new = self._seen(known.seen, known.tilt + tilt)
        self._add(new, np.flatnonzero(np.isfinite(known.scores)))
        return new

    def match_level(self, known: Leveled, pattern: Spectra | None = None) -> Match:
        """The same for a leveled panorama; what is left of its tilt is taken out."""
        known = replace(known, scores=known.scores.copy(), yaws=known.yaws.copy())
        match = self._match_around(known, pattern)
        finer = self._leveled(known, match.tilt)
        if finer is not known:
            match = self._match_around(finer, pattern)
        return replace(match, tilt=finer.tilt + match.tilt)

    def _match_around(self, known: Leveled, pattern: Spectra | None) -> Match:
        best = self.poses[int(known.scores.argmax()), :2]
        around = [self._around(best, drive) for drive in self._likeliest_drives(known.scores)]
        self._add(known, np.unique(np.concatenate(around)))
        return self.located(known.spectrum, known.scores, known.yaws, pattern)

    def match_among(self, spectrum: Spectra, rows: NDArray[np.int64]) -> Match:
        """Find the spectrum (rows, F) of an image with some keyframes alone."""
        scores, yaws = self._unmatched()
        scores[rows], yaws[rows] = (found[0] for found in self.correlated(spectrum[None], rows))
        return self.located(spectrum, scores, yaws)

    def _unmatched(self) -> Scores:
        """Correlations (K,) that are all unknown, and yaws (K,)."""
        count = len(self.poses)
        return np.full(count, -np.inf, np.float32), np.zeros(count, np.float32)

    def correlated(self, spectra: Spectra, rows: NDArray[np.int64]) -> Scores:
        """Largest correlations (T, M) of spectra (T, rows, F) with some keyframes (M,), and the
        yaws (T, M) rad at which they are reached.
        """
        images = np.conj(spectra).transpose(2, 1, 0) * np.float32(self.step)
        held = self.values[rows].astype(np.float32).view(np.complex64)
        scores, shifts = _peaks(held.swapaxes(0, 1) @ images, self.columns)
        return scores, shifts * np.float32(-2 * self._sign * np.pi / self.columns)

    def _add(self, known: Leveled, wanted: NDArray[np.int64]) -> None:
        """Fill in what is still missing of the wanted keyframes' correlations."""
        wanted = wanted[np.isneginf(known.scores[wanted])]
        scores, yaws = self.correlated(known.visible[None], wanted)
        known.scores[wanted], known.yaws[wanted] = scores[0], yaws[0]

    def _likeliest_drives(self, scores: NDArray[np.float32]) -> list[int]:
        """The drives of the training that the likeliest keyframes are of, by correlations (K,)."""
        own = {drive: scores[self.drives == drive] for drive in range(self.trained)}
        likest = {drive: float(one.max()) for drive, one in own.items() if len(one)}
        return sorted(likest, key=likest.__getitem__, reverse=True)[:_DRIVES]

    def _around(self, place: Array, drive: int) -> NDArray[np.int64]:
        """The keyframes of the regression about a place (2,) m: the nearest of a drive of the
        training, in that order, and of those that later drives added as many that are no farther.
        """
        apart = self._squares(place)
        own, added = np.flatnonzero(self.drives == drive), np.flatnonzero(~self.first)
        own = own[_least(apart[own], _REGRESSED)]
        added = added[apart[added] <= apart[own].max(initial=0.0)]
        return np.concatenate([own, added[_least(apart[added], _REGRESSED)]])

    def located(
        self,
        spectrum: Spectra,
        scores: NDArray[np.float32],
        yaws: NDArray[np.float32],
        pattern: Spectra | None = None,
    ) -> Match:
        """The match of an image (rows, F) without the `pattern` of its light, by its correlations
        (K,), -inf where unknown, and the yaws (K,) rad that each of them shows.
        """
        best = int(scores.argmax())
        reach, start = self.reach(best), np.append(self.poses[best, :2], yaws[best])
        plain = spectrum
        if pattern is not None:
            plain = spectrum - turned(pattern, -self._sign * start[2])
        found = self._regressed(plain, scores, start, reach)
        *place, yaw = found.pose.tolist()
        elsewhere = np.zeros((3, 3))
        weight = self.likelihood(scores, self.noise.temperature)
        offset = self.elsewhere(scores, found.pose[:2], reach)
        elsewhere[:2, :2] = (offset * weight[:, None]).T @ offset
        turns = np.square(wrap_angle(yaws[np.isfinite(scores)].astype(float) - yaw))
        turns[(turns < _PARALLAX_RAD**2) & ~offset.any(axis=1)] = 0.0
        elsewhere[2, 2] = weight @ turns + self._turned_otherwise(spectrum, best)
        return replace(
            found,
            pose=np.array([*place, wrap_angle(yaw)]),
            elsewhere=elsewhere,
            left=None if found.left is None else turned(found.left, self._sign * yaw),
            score=float(scores[best]),
            known=bool(scores[best] >= self.noise.lowest),
        )

    def _regressed(
        self, spectrum: Spectra, scores: NDArray[np.float32], start: Array, reach: float
    ) -> Match:
        """Where the spectrum (rows, F) of an image is among the keyframes around the best one, of
        those whose correlations (K,) are known; its pose is the `start` (3,), `reach` m how far the
        place may be from it. Each drive of the training says so by itself, and counts by how
        certain it is.
        """
        seen, known = self._with_tilts(spectrum), np.isfinite(scores)
        drives = self._likeliest_drives(scores)
        by_drive = [self._among(drive, seen, start, known, reach) for drive in drives]
        parts = [one for one in by_drive if one is not None]
        if not parts:
            return Match(start, unlikeness(float(scores.max())), 0.0, 1.0)
        return averaged(parts, [1 / self._variance(one) for one in parts])

    def _among(
        self, drive: int, seen: Spectra, start: Array, known: NDArray[np.bool_], reach: float
    ) -> Match | None:
        """The same of a spectrum with its derivatives by tilt (3, rows, F) among the `known` (K,)
        keyframes of one drive; None where they are too few.
        """
        match, pose, limit = None, start.copy(), 2 * np.pi / self.columns
        for _ in range(_REPEATED):
            near = self._around(pose[:2], drive)
            near = np.sort(near[known[near]])
            if len(near) < _FEWEST:
                break
            found = self._near(near).find(seen, self._sign * float(pose[2]))
            step = found.pose[:2] - start[:2]
            apart = float(np.hypot(*step))
            pose[:2] = start[:2] + step * min(1.0, reach / max(apart, 1e-9))
            pose[2] += np.clip(self._sign * found.pose[2], -limit, limit)
            match = found.match()
            facing = complex(match.shares @ np.exp(1j * self.poses[near, 2]))
            match = replace(match, facing=facing)
            if apart < _NEARER * reach:
                break
        return None if match is None else replace(match, pose=pose)

    def place(self, image: Spectra, yaw: float, near: NDArray[np.int64]) -> Match:
        """Where the spectrum (rows, F) of an image with about this yaw rad is among some keyframes:
        `Match.shares` of them.
        """
        found = self._near(near).find(self._with_tilts(image), self._sign * yaw).match()
        found.pose[2] = yaw + self._sign * found.pose[2]
        return found

    def _near(self, rows: NDArray[np.int64]) -> Neighbors:
        """Some keyframes. Their products are costly, and a robot stays among them for a while."""
        key = rows.tobytes()
        found = self._last.pop(key, None)
        if found is None:
            vectors = Neighbors.vectors_of(self.aligned(rows), self.columns)
            of_rows = self.poses[rows, :2], self.drives[rows], self.channels, self.columns
            found = Neighbors(vectors, *of_rows)
        self._last[key] = found
        if len(self._last) > _KEPT:
            self._last.pop(next(iter(self._last)), None)
        return found

    def _with_tilts(self, image: Spectra) -> Spectra:
        """Of an image (rows, F) and of its derivatives by roll and pitch: (3, rows, F)."""
        slopes = derivatives(columns_of(image, self.columns), self.channels, self.sphere)
        return np.concatenate([image[None], spectrum(slopes)])

    def _variance(self, match: Match) -> float:
        """Variance m^2 along each axis of a place by the keyframes of one drive."""
        beyond = self.noise.beyond(match)
        by_place = self.noise.variance(self.noise.by_place(match))
        return by_place + float(np.trace(match.noise)) / 2 + beyond**2

    def likelihood(self, scores: NDArray[np.float32], temperature: float) -> Array:
        """How likely each of the keyframes (M,) whose correlations (K,) are known is the place, of
        sum 1.
        """
        known = scores[np.isfinite(scores)]
        weight = np.exp((known - known.max()) / temperature, dtype=np.float64)
        return np.asarray(weight / weight.sum())

    def _turned_otherwise(self, image: Spectra, best: int) -> float:
        """Variance rad^2 of the yaw of an image (rows, F) by the other turn that makes it as like
        its best keyframe: in a corridor the one by 180 degrees.
        """
        product = (self.aligned([best])[0] * image.conj()).sum(0)
        curve = 2 * columns_of(product, 2 * self.columns)
        turn = wrap_angle((np.arange(len(curve)) - curve.argmax()) * np.pi / self.columns)
        other = np.where(np.abs(turn) > _PARALLAX_RAD, curve, -np.inf)
        likely = math.exp((float(other.max()) - float(curve.max())) / self.noise.temperature)
        return float(turn[other.argmax()]) ** 2 * likely / (1 + likely)

    def elsewhere(self, scores: NDArray[np.float32], place: Array, reach: float) -> Array:
        """Offsets (M, 2) m from a place of the keyframes whose correlations (K,) are known; 0 for
        those that are near it, by a `reach`.
        """
        offset = self.poses[np.isfinite(scores), :2] - place
        near = np.hypot(*offset.T) <= 2 * reach
        return np.where(near[:, None], 0.0, offset)

    @property
    def _sign(self) -> int:
        """Of the angle by which `turned` makes of an image at some yaw that at another."""
        return 1 if self.sphere.clockwise else -1

    @property
    def channels(self) -> tuple[slice, ...]:
        return channels(self.values.shape[2] // 2)

    def reach(self, best: int) -> float:
        """How far, m, the regression may put an image from the best keyframe."""
        drive = self.drives[best]
        own = self.drives == drive if drive < self.trained else self.first
        apart = self._squares(self.poses[best, :2])[own]
        farthest = np.partition(apart, min(NEIGHBORS, len(apart)) - 1)[:NEIGHBORS].max()
        return _REACH_SHARE * max(math.sqrt(farthest), 1e-6)

    def _squares(self, place: Array) -> Array:
        """Squared distances (K,) m^2 from a place (2,) m."""
        x, y = self.poses[:, 0] - place[0], self.poses[:, 1] - place[1]
        return np.asarray(x * x + y * y)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save, without pickle."""
        kept = 'values', 'step', 'columns', 'poses', 'drives', 'trained'
        arrays = {name: np.asarray(getattr(self, name)) for name in kept}
        return {**arrays, 'noise': np.array(dataclasses.astuple(self.noise))}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]], sphere: Sphere) -> Keyframes:
        """Read the arrays of `to_arrays`, of panoramas that show so much of the `sphere`."""
        values, step = np.asarray(arrays['values'], np.int8), float(arrays['step'])
        poses, drives = arrays['poses'].astype(float), arrays['drives'].astype(np.int32)
        noise = MatchNoise(*arrays['noise'].astype(float).tolist())
        columns, trained = int(arrays['columns']), int(arrays['trained'])
        return cls(values, step, columns, poses, noise, sphere, drives, trained)


def parts_of(textures: NDArray[np.int8], poses: Array, sphere: Sphere) -> Texture:
    """`Keyframes.values` of textures (K, rows, columns) with poses (K, 3), as they are."""
    spectra = turned(spectra_of(textures), poses[:, 2] * (1 if sphere.clockwise else -1))
    return spectra.swapaxes(1, 2).copy().view(np.float32)


def encoded(parts: Texture, step: float = 0.0) -> tuple[NDArray[np.int8], float]:
    """The same (K, F, 2 rows) with one byte each, and the step, by default the one with which the
    largest is 127: one thousandth of their squares is lost.
    """
    step = step or max(float(np.abs(parts).max()) / _LARGEST, _LEAST_STEP)
    return np.rint(parts / step).clip(-_LARGEST, _LARGEST).astype(np.int8), step
