# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""One panorama from images of several cameras: where each of its pixels is read, and by which.

It is composed on a sphere about the middle of the cameras, whose radius is the mean distance of
things as training measures it. In a garden of 8 m x 8 m (7 m) one image and the filter err by .043
and .037 m with four cameras 0.2 m off the center, and by .051 and .040 with 0.4 m; composed at
infinity by .049 and .044, and by .064 and .051; with an ideal panorama by .041 and .040. Seams of 4
degrees give what those of 10 do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.lenses import OPTICAL_AXES, turned_camera
from sfa_localization.camera.panorama import (
    hidden_sectors,
    nearest_visible,
    panorama_rays,
    repeated_pixels,
)
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.run import Image
from sfa_localization.data.sphere import rotation

FEATHER_DEG = 10.0
"""Width of a seam between two cameras: four cameras of 100 degrees overlap by so much."""
_BOTH_DEG = 1.0  # pixels so far inside the views of two cameras compare their exposures
_COMPARED = 300  # such pixels of a pair: their median is certain to a gray level
_NEARLY = 0.95
_LEAST_WHITE = 0.7
"""Of the range of gray levels: so much is kept where one camera is exposed far more than others."""
Part = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera on the robot: its `name`, its lens, and the pose of its optical frame (x along
    columns, y along rows, z into the scene, REP 103) on base_link: the rows of the rotation (3, 3)
    to the axes of base_link, and its place, m. Panoramas are composed for things at an `inverse`
    distance, 1/m, from the middle of all cameras; 0: far away.
    """

    name: str
    lens: LensCalibration
    rotation: tuple[tuple[float, ...], ...]
    place: tuple[float, ...] = (0.0, 0.0, 0.0)
    inverse: float = 0.0

    @classmethod
    def at(cls, name: str, lens: LensCalibration, pose: Array) -> MountedCamera:
        """From the pose (4, 4) of its optical frame on base_link."""
        rows = tuple(tuple(row) for row in pose[:3, :3].tolist())
        return cls(name, lens, rows, tuple(pose[:3, 3].tolist()))

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> MountedCamera:
        """From `dataclasses.asdict`, also as read from JSON. Raises ConfigError."""
        lens = LensCalibration.from_mapping(mapping['lens'], 'lens')
        rows = tuple(tuple(map(float, row)) for row in mapping['rotation'])
        place = tuple(map(float, mapping['place']))
        return cls(str(mapping['name']), lens, rows, place, float(mapping['inverse']))

    @property
    def ahead(self) -> Array:
        """The direction (3,) of the optical axis in the axes of base_link."""
        return np.array(self.rotation)[:, 2]

    @property
    def yaw(self) -> float:
        """The azimuth of the optical axis, rad, counterclockwise from forward."""
        x, y, _ = self.ahead
        return float(np.arctan2(y, x))


def optical_pose(place: Sequence[float], angles_deg: Sequence[float]) -> Array:
    """The pose (4, 4) on base_link of the optical frame of a camera at a place, m, by roll, pitch
    and yaw; with angles of 0 it looks ahead.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotation(*np.radians(angles_deg)) @ OPTICAL_AXES
    pose[:3, 3] = place
    return pose


class Sector(NamedTuple):
    """Where the columns of a panorama (w,) that a camera sees are read from its image: `pixels`
    (H, w, 2), column and row, which repeat the nearest visible ones where the camera sees nothing.
    """

    columns: Indices
    pixels: NDArray[np.float32]
    visible: Mask
    margin_deg: Array
    maps: tuple[Any, Any]

    @classmethod
    def of(
        cls,
        camera: MountedCamera,
        panorama: PanoramaConfig,
        size: tuple[int, int],
        aside: Array,
    ) -> Sector:
        """That of a camera `aside` (3,) of the middle, m, for images of `size` (rows, columns).
        Raises CameraError.
        """
        rays = panorama_rays(panorama) - camera.inverse * aside
        model = turned_camera(camera.lens, size, np.array(camera.rotation), panorama)
        pixels = model.project(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
        visible = np.isfinite(pixels[..., 0])
        if not visible.any():
            raise CameraError(
                f'camera {camera.name} sees no part of the panorama: check the pose of its optical '
                "frame on base_link, and the panorama's elevations"
            )
        columns = _arc(np.asarray(visible.any(axis=0)))
        rows, nearest = nearest_visible(visible)
        read = pixels[rows, nearest][:, columns].clip(0, [size[1] - 1, size[0] - 1])
        whole = read.astype(np.float32)
        fixed = cv2.convertMaps(whole[..., 0], whole[..., 1], cv2.CV_16SC2)
        return cls(columns, whole, visible, _margin_deg(visible, panorama), fixed)

    def read(self, image: Image, shift: float = 0.0) -> Part:
        """The columns (H, w, 3) by an image whose content is moved by `shift` columns."""
        maps = self.maps if abs(shift) < _LEAST_SHIFT else self._shifted(shift)
        return cv2.remap(image, *maps, cv2.INTER_LINEAR).astype(np.float32)

    def _shifted(self, shift: float) -> tuple[Any, Any]:
        last = len(self.columns) - 1
        at = np.clip(np.arange(last + 1) - shift, 0.0, last)
        before = np.minimum(at.astype(int), max(last - 1, 0))
        part = (at - before).astype(np.float32)[:, None]
        after = np.minimum(before + 1, last)
        pixels = self.pixels[:, before] * (1 - part) + self.pixels[:, after] * part
        return pixels[..., 0], pixels[..., 1]


_LEAST_SHIFT = 0.02  # columns: less than the error of interpolation


class Overlap(NamedTuple):
    """Pixels that two cameras see: their rows and their columns in both sectors, all (N,)."""

    rows: Indices
    first: Indices
    second: Indices


class View(NamedTuple):
    """What a set of cameras shows: the share (H, w, 3) of each in its columns; which pixels (H, W)
    are `visible`, and, unless all are, the pixel that each repeats; where two overlap.
    """

    shares: dict[str, Part]
    visible: Mask
    repeated: Indices | None
    overlaps: dict[tuple[str, str], Overlap]


class SurroundView:
    """The panorama of cameras around a robot, by lookup tables that are built for the sizes of
    their images.

    What no camera sees, and blind sectors, repeat the nearest visible pixel, as in the panoramas of
    one camera.
    """

    def __init__(
        self,
        cameras: Sequence[MountedCamera],
        panorama: PanoramaConfig,
        blind_sectors: tuple[float, ...] = (),
    ) -> None:
        self.cameras = {camera.name: camera for camera in cameras}
        self.panorama = panorama
        self._middle = np.mean([camera.place for camera in cameras], axis=0)
        self._blind = hidden_sectors(panorama_rays(panorama), blind_sectors)
        self._sectors: dict[str, tuple[tuple[int, int], Sector]] = {}
        self._views: dict[frozenset[str], View] = {}

    def sector(self, name: str, size: tuple[int, int]) -> Sector:
        """The sector of a camera for images of `size` (rows, columns). Raises CameraError."""
        if name not in self._sectors or self._sectors[name][0] != size:
            camera = self.cameras[name]
            aside = np.array(camera.place) - self._middle
            self._sectors[name] = size, Sector.of(camera, self.panorama, size, aside)
            self._views.clear()
        return self._sectors[name][1]

    def known(self, name: str) -> Sector:
        """The sector of a camera for the last size of its images."""
        return self._sectors[name][1]

    def view(self, sizes: Mapping[str, tuple[int, int]]) -> View:
        """What cameras show, by the sizes (rows, columns) of their images. Raises CameraError."""
        for name, size in sizes.items():
            self.sector(name, size)
        return self.of(frozenset(sizes))

    def of(self, names: frozenset[str]) -> View:
        """What cameras show whose sectors are known. Raises CameraError."""
        if names not in self._views:
            sectors = {name: self._sectors[name][1] for name in self.cameras if name in names}
            self._views[names] = self._view(sectors)
        return self._views[names]

    def _view(self, sectors: Mapping[str, Sector]) -> View:
        margins = {name: sector.margin_deg for name, sector in sectors.items()}
        widest = np.max([*margins.values()], axis=0)
        weights = {
            name: np.float32(np.maximum(np.minimum(margin, FEATHER_DEG - (widest - margin)), 0.0))
            for name, margin in margins.items()
        }
        total = np.maximum(sum(weights.values()), 1e-9).astype(np.float32)
        shares = {
            name: np.repeat((weight / total)[:, sectors[name].columns, None], 3, axis=2)
            for name, weight in weights.items()
        }
        visible = np.logical_or.reduce([sector.visible for sector in sectors.values()])
        visible &= ~self._blind
        if not visible.any():
            raise CameraError('blind_sectors hide all that the cameras see')
        repeated = None if visible.all() else repeated_pixels(visible)
        overlaps = {
            (one, other): overlap
            for one, other in combinations(sectors, 2)
            if len((overlap := _overlap(sectors[one], sectors[other])).rows)
        }
        return View(shares, visible, repeated, overlaps)

    def owners(self, view: View) -> Indices:
        """The number of the camera that shows most of each pixel (H, W) of a view; -1: hidden."""
        size = self.panorama.height, self.panorama.width
        shares = np.zeros((len(self.cameras), *size))
        for number, name in enumerate(self.cameras):
            if name in view.shares:
                shares[number][:, self.known(name).columns] = view.shares[name][..., 0]
        return np.asarray(np.where(view.visible, shares.argmax(axis=0), -1))

    def parts(
        self, images: Mapping[str, Image], shifts: Mapping[str, float] | None = None
    ) -> dict[str, Part]:
        """The sector of each camera by its image, moved by so many columns. Raises CameraError."""
        shifts = shifts or {}
        return {
            name: self.sector(name, image.shape[:2]).read(image, shifts.get(name, 0.0))
            for name, image in images.items()
        }

    def joined(self, parts: Mapping[str, Part], view: View, factors: Mapping[str, Array]) -> Image:
        """The panorama (H, W, 3) of sectors, their channels (3,) multiplied by `factors`.

        It is nowhere brighter than the white of the most exposed camera: else the sky would be as
        bright as the heading has it. With exposures of 0.7 to 1.3 one image errs by .040 and .064 m
        in two gardens, as with equal ones; without this by .053 and .074 m.
        """
        size = self.panorama.height, self.panorama.width, 3
        total = np.zeros(size, np.float32)
        for name, part in parts.items():
            columns = self._sectors[name][1].columns
            weighted = part * view.shares[name]
            rows = weighted.reshape(len(weighted), -1)
            if name in factors:
                rows *= np.tile(factors[name].astype(np.float32), len(columns))
            before = min(size[1] - columns[0], len(columns))  # those up to the right edge
            total[:, columns[0] : columns[0] + before] += weighted[:, :before]
            total[:, : len(columns) - before] += weighted[:, before:]
        if factors:
            white = 255.0 * np.min([*factors.values()], axis=0).clip(_LEAST_WHITE, 1.0)
            np.minimum(total, white.astype(np.float32), out=total)
        panorama = np.asarray(cv2.convertScaleAbs(total), np.uint8)
        if view.repeated is None:
            return panorama
        return np.asarray(panorama.reshape(-1, 3)[view.repeated.ravel()].reshape(size))


def visible_elevations(cameras: Sequence[MountedCamera]) -> tuple[float, float]:
    """The lowest and highest elevation, deg, that cameras see in nearly as many directions as they
    see at any; 0, 0 where they see nothing.
    """
    whole = PanoramaConfig(360, 160, -80.0, 80.0)
    rays = panorama_rays(whole).reshape(-1, 3)
    seen = np.zeros(len(rays), bool)
    for camera in cameras:
        size = camera.lens.image_height, camera.lens.image_width
        model = turned_camera(camera.lens, size, np.array(camera.rotation))
        seen |= np.isfinite(model.project(rays)[:, 0])
    share = seen.reshape(160, 360).mean(axis=1)
    inside = np.flatnonzero(share >= _NEARLY * max(share.max(), 1e-9))
    elevations = np.degrees(whole.sphere.elevations(160))[inside]
    return float(elevations[-1]), float(elevations[0])


def _arc(seen: Mask) -> Indices:
    """The shortest run of columns, around the back, with all that are `seen` (W,)."""
    columns = np.flatnonzero(seen)
    gaps = np.diff(columns, append=columns[0] + len(seen))
    widest = int(np.argmax(gaps))
    first = columns[(widest + 1) % len(columns)]
    return np.asarray((first + np.arange(len(seen) - gaps[widest] + 1)) % len(seen))


def _margin_deg(visible: Mask, panorama: PanoramaConfig) -> Array:
    """How far (H, W), in degrees, pixels lie inside what is visible (H, W)."""
    from scipy.ndimage import distance_transform_edt  # for several cameras alone

    if visible.all():
        return np.full(visible.shape, 180.0)
    width = visible.shape[1]
    around = np.concatenate([visible, visible, visible], axis=1)
    height_deg = panorama.elevation_max - panorama.elevation_min
    pitch = height_deg / visible.shape[0], 360.0 / width
    return np.asarray(distance_transform_edt(around, pitch)[:, width : 2 * width])


def _overlap(one: Sector, other: Sector) -> Overlap:
    """The pixels that two cameras see well inside their views."""
    both = (one.margin_deg > _BOTH_DEG) & (other.margin_deg > _BOTH_DEG)
    every = -(-np.count_nonzero(both) // _COMPARED) or 1
    rows, columns = (places[::every] for places in np.nonzero(both))
    places = []
    for sector in (one, other):
        number = np.zeros(both.shape[1], int)
        number[sector.columns] = np.arange(len(sector.columns))
        places.append(number[columns])
    return Overlap(rows, *places)
