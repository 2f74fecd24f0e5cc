# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How cameras around the robot are really turned, by what they see of one place one after another.

When the robot has turned, another camera sees what one saw before. The azimuths differ by the
errors of both yaws, by the error of the turn that the odometry counted, and by parallax: where the
two cameras were is known, and how far things are, on average, is one unknown. One robust fit over
pairs of images gives all of them. What is stated of most cameras counts as right: the median error
is 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.sectors import MountedCamera, Part, SurroundView
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Image, Stamps
from sfa_localization.data.sphere import rotation
from sfa_localization.data.statistics import outlier_factor, parabola_peak

MOST_PAIRS = 200
"""Pairs of images that are compared; with 100 yaws are as certain to 0.1 degrees."""
WITHIN_NS = 60_000_000_000
"""Time between two images of a pair, for which odometry is good to a degree."""
_WITHIN_M = 0.6  # between the robot's places of a pair
_TURNED_RAD = np.radians(30.0)  # at least, else each camera sees what it saw before
_ROWS = 12
_WIDE_DEG = 36.0  # wider structures are light
_SEARCHED_DEG = 15.0  # around the expected azimuth
_FEWEST_DEG = 15.0  # of the overlap of two views
_ALIKE = 0.6  # correlation of views of one thing
# of the views of two cameras are alike, at most, if these show different things: 57 to 100 % in two
# gardens, with random pixels none, and with exchanged images 8 % at most
_STRANGE = 0.1
_FEWEST_VIEWS = 12  # that show so
_WHOLE = 0.95  # of the rows of a column that is compared
# standard deviations: of yaws as people measure them, of turns by odometry, of an azimuth, rad; of
# the inverse distance of things, 1/m
_YAW_STD = np.radians(3.0)
_TURN_STD = np.radians(1.0)
_SHIFT_STD = np.radians(0.5)
_INVERSE_STD = 0.15
_NEAREST_INVERSE = 1.0  # things are farther than a meter
_PASSES = 8
_CERTAIN_STD = np.radians(0.5)  # else a drive has too few pairs
_LEAST = np.radians(0.3)  # half a column of the panorama
KNOCKED_RAD = np.radians(5.0)
"""A camera that differs by more from the model's was turned since: people err by 2 degrees."""
AS_TRAINED = 'it was in training'
Texture = NDArray[np.float32]


class Shown(NamedTuple):
    """What each camera shows at a pose (3,) of base_link: the first of its columns of the panorama
    that are compared, and the local contrast (rows, columns) there.
    """

    pose: Array
    views: dict[str, tuple[int, Texture]]


class Sighting(NamedTuple):
    """Two cameras that see one thing: their names, the number of the pair of images, by how much
    the azimuth of the second exceeds that of the first, rad, and what it changes by the inverse
    distance of the thing, m. The shift is NaN where they should see one thing, and are not alike.
    """

    first: str
    second: str
    pair: int
    shift: float
    parallax: float


@dataclass(frozen=True, slots=True)
class Yaws:
    """How much cameras are turned beyond their stated poses, rad, by name, and the mean `inverse`
    distance of what they see, 1/m. `strange` cameras show nothing that others see.
    """

    errors: dict[str, Quantity]
    inverse: float = 0.0
    strange: tuple[str, ...] = ()

    def corrected(self, cameras: Sequence[MountedCamera]) -> tuple[MountedCamera, ...]:
        """The cameras as they are turned, if that is certain, for things at the mean distance."""
        return tuple(
            turned(changed, error.value) if (error := self._certain(changed.name)) else changed
            for changed in (replace(camera, inverse=self.inverse) for camera in cameras)
        )

    def _certain(self, name: str) -> Quantity | None:
        """The error of a camera, if it is known well and matters."""
        error = self.errors[name]
        fit = error.std < _CERTAIN_STD and abs(error.value) > _LEAST
        return error if fit else None

    def sentences(self, stated: str, least: float = 0.0) -> list[str]:
        """What is certain about cameras that are turned by more than `least`, rad, from what is
        `stated`, and about strange ones.
        """
        texts = [
            f'camera {name} shows nothing that the others see: is it dirty, broken or exchanged?'
            for name in self.strange
        ]
        for name in self.errors:
            error = self._certain(name)
            if error is None or abs(error.value) <= least:
                continue
            aside = 'left' if error.value > 0 else 'right'
            degrees = np.degrees(abs(error.value))
            std = max(np.degrees(error.std), 0.1)
            angle = f'{degrees:.1f} degrees (+- {std:.1f})'
            texts.append(f'camera {name} looks {angle} to the {aside} of what {stated}')
        return texts


def pairs(stamps_ns: Stamps, poses: Array, second: int | None = None) -> list[tuple[int, int]]:
    """Numbers of images at stamps (N,) and poses (N, 3) that show one place in two headings, the
    nearest first, each image at most twice; or those whose `second` image is given.
    """
    from scipy.spatial import cKDTree  # for several cameras alone

    first, other = cKDTree(poses[:, :2]).query_pairs(_WITHIN_M, output_type='ndarray').T
    turned = np.abs(wrap_angle(poses[first, 2] - poses[other, 2])) > _TURNED_RAD
    soon = np.abs(stamps_ns[first] - stamps_ns[other]) < WITHIN_NS
    fit = np.flatnonzero(turned & soon & ((second is None) | (other == second)))
    distance = np.hypot(*(poses[first[fit], :2] - poses[other[fit], :2]).T)
    uses = np.zeros(len(poses), int)
    chosen: list[tuple[int, int]] = []
    for row in fit[np.argsort(distance, kind='stable')].tolist():
        pair = int(first[row]), int(other[row])
        if uses[[*pair]].max() < 2 and len(chosen) < MOST_PAIRS:
            uses[[*pair]] += 1
            chosen.append(pair)
    return chosen


class YawComparison:
    """Compares what cameras see in pairs of images, and fits the errors of their yaws."""

    def __init__(self, cameras: Sequence[MountedCamera], panorama: PanoramaConfig) -> None:
        self._cameras = {camera.name: camera for camera in cameras}
        self._panorama = panorama
        self._view = SurroundView([replace(camera, inverse=0.0) for camera in cameras], panorama)
        self._fewest = int(_FEWEST_DEG / 360 * panorama.width)
        self._per_column = 2 * np.pi / panorama.width * (-1.0 if panorama.clockwise else 1.0)

    def shown(self, pose: Array, images: Mapping[str, Image]) -> Shown:
        """What images (H, W, 3) of cameras show at a pose (3,) of base_link. Raises CameraError."""
        parts = self._view.parts(images)
        return Shown(pose, {name: self._contrast(name, part) for name, part in parts.items()})

    def _contrast(self, name: str, part: Part) -> tuple[int, Texture]:
        """The first compared column of a sector (H, w, 3), and the contrast (rows, columns)."""
        sector = self._view.known(name)
        whole = sector.visible[:, sector.columns].mean(axis=0) >= _WHOLE
        inside = np.flatnonzero(whole)
        run = slice(inside[0], inside[-1] + 1) if inside.size else slice(0, 0)
        gray = np.log1p(part[:, run].mean(axis=2))
        small = cv2.resize(gray, (gray.shape[1], _ROWS), interpolation=cv2.INTER_AREA)
        reach = max(int(_WIDE_DEG / 360 * self._panorama.width), 1)
        wide = cv2.blur(small, (reach, 1), borderType=cv2.BORDER_REFLECT)
        return int(sector.columns[run.start]), np.asarray(small - wide, np.float32)

    def sightings(self, number: int, one: Shown, other: Shown) -> Iterator[Sighting]:
        """What two cameras should see alike in two images, a pair of this number."""
        turn = float(wrap_angle(other.pose[2] - one.pose[2]))
        expected = -turn / self._per_column
        for first, view in one.views.items():
            for second, later in other.views.items():
                match = self._match(view, later, expected)
                if match is None:
                    continue
                columns, middle = match
                shift = columns * self._per_column
                azimuth = one.pose[2] + self._panorama.sphere.azimuths(self._panorama.width)[middle]
                moved = self._place(second, other.pose) - self._place(first, one.pose)
                parallax = float((moved * np.exp(-1j * azimuth)).imag)
                yield Sighting(first, second, number, shift, -parallax)

    def _place(self, name: str, pose: Array) -> complex:
        """The place of a camera, x + i y, m, at a pose of base_link."""
        on_robot = complex(*self._cameras[name].place[:2])
        return complex(pose[0], pose[1]) + on_robot * complex(np.exp(1j * pose[2]))

    def _match(
        self, view: tuple[int, Texture], later: tuple[int, Texture], expected: float
    ) -> tuple[float, int] | None:
        """By how many columns the later view lies beyond the expected ones, NaN where they are not
        alike, and the middle column of what both see, in the first; None where nothing is.
        """
        start, texture = view
        later_start, later_texture = later
        width = self._panorama.width
        offset = start + round(expected) - later_start
        offset = (offset + width // 2) % width - width // 2
        low, high = _both(texture, later_texture, offset)
        if high - low < self._fewest:
            return None
        lag = self._lag(texture, later_texture, offset)
        if np.isfinite(lag):
            low, high = _both(texture, later_texture, offset + round(lag))
        return lag + round(expected) - expected, (start + (low + high) // 2) % width

    def _lag(self, texture: Texture, later: Texture, offset: int) -> float:
        """By how many columns more than an offset the later texture lies; NaN where it does not
        correlate.
        """
        reach = int(_SEARCHED_DEG / 360 * self._panorama.width)
        lags = range(-reach, reach + 1)
        scores = np.array(
            [_correlation(texture, later, offset + lag, self._fewest) for lag in lags]
        )
        top = int(np.argmax(scores))
        around = scores[max(top - 1, 0) : top + 2]
        if scores[top] < _ALIKE or len(around) < 3 or around.min() < 0:
            return float('nan')
        return top - reach + float(parabola_peak(*np.split(around, 3))[0])

    def fit(self, sightings: Sequence[Sighting]) -> Yaws:
        """The errors of all yaws, by sightings, and strange cameras."""
        yaws = self._fit([seen for seen in sightings if np.isfinite(seen.shift)])
        return replace(yaws, strange=_strange([*self._cameras], sightings))

    def _fit(self, sightings: Sequence[Sighting]) -> Yaws:
        """The errors of all yaws, by what cameras see alike: a ridge regression whose weights are
        those of errors with outliers.
        """
        names = [*self._cameras]
        cameras = len(names)
        design = self._design(sightings)
        shift = np.array([seen.shift for seen in sightings])
        variance = _SHIFT_STD**2 + (design[:, cameras] * _INVERSE_STD) ** 2
        prior = np.full(design.shape[1], _TURN_STD)
        prior[:cameras] = _YAW_STD
        prior[cameras] = _NEAREST_INVERSE
        weight = 1.0 / variance
        for _ in range(_PASSES):
            information = design.T @ (design * weight[:, None]) + np.diag(prior**-2)
            solution = np.linalg.solve(information, design.T @ (weight * shift))
            residual = shift - design @ solution
            weight = 1.0 / (variance * outlier_factor(residual**2 / variance))
        errors = solution[:cameras] - np.median(solution[:cameras])
        mean = np.eye(cameras) - 1.0 / cameras
        covariance = np.linalg.inv(information)[:cameras, :cameras]
        std = np.sqrt(np.diag(mean @ covariance @ mean))
        quantities = map(Quantity, errors.tolist(), std.tolist())
        return Yaws(dict(zip(names, quantities, strict=True)), max(float(solution[cameras]), 0.0))

    def _design(self, sightings: Sequence[Sighting]) -> Array:
        """Derivatives of shifts by yaws, the inverse distance of things, and turns of pairs."""
        names = [*self._cameras]
        pair_count = 1 + max((sighting.pair for sighting in sightings), default=-1)
        design = np.zeros((len(sightings), len(names) + 1 + pair_count))
        for row, seen in enumerate(sightings):
            design[row, names.index(seen.first)] += 1.0
            design[row, names.index(seen.second)] -= 1.0
            design[row, len(names)] = seen.parallax
            design[row, len(names) + 1 + seen.pair] = 1.0
        return design


def _strange(names: Sequence[str], sightings: Sequence[Sighting]) -> tuple[str, ...]:
    """Cameras that show nothing of what the others see, while most views of these are alike."""
    from scipy.sparse.csgraph import connected_components  # for several cameras alone

    views = np.zeros((len(names), len(names)))
    alike = np.zeros_like(views)
    for seen in sightings:
        pair = names.index(seen.first), names.index(seen.second)
        views[pair] += 1
        alike[pair] += np.isfinite(seen.shift)
    both = views + views.T
    count, group = connected_components(alike + alike.T > _STRANGE * both)
    within = [alike[group == k][:, group == k].sum() for k in range(count)]
    trusted = group == np.argmax(within)
    certain = both[trusted][:, ~trusted].sum() >= _FEWEST_VIEWS
    if not certain or max(within) <= 0.5 * views[trusted][:, trusted].sum():
        return ()
    return tuple(name for name, is_trusted in zip(names, trusted, strict=True) if not is_trusted)


def _both(one: Texture, other: Texture, offset: int) -> tuple[int, int]:
    """The columns of a texture, from and up to, that another, `offset` columns further, has too."""
    return max(0, -offset), min(one.shape[1], other.shape[1] - offset)


def _correlation(one: Texture, other: Texture, offset: int, fewest: int) -> float:
    """Correlation of a texture (rows, N) with the columns of another that lie `offset` columns
    further; -1 for fewer columns than `fewest`.
    """
    low, high = _both(one, other, offset)
    if high - low < fewest:
        return -1.0
    a = one[:, low:high]
    b = other[:, low + offset : high + offset]
    product = float((a * b).sum())
    return product / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-9)


def turned(camera: MountedCamera, angle: float) -> MountedCamera:
    """A camera that is turned counterclockwise about the vertical through it, rad."""
    rows = (rotation(0.0, 0.0, angle) @ np.array(camera.rotation)).tolist()
    return replace(camera, rotation=tuple(tuple(row) for row in rows))
