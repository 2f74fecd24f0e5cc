# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""From the picture of an omnidirectional camera to a panorama, by fixed-point lookup tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.lenses import is_mirrored, make_camera
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image

Mask = NDArray[np.bool_]
_ASPECT = 3.5  # a picture wider than this times its height is a panorama
_SIZES_KEPT = 4  # tables are kept for this many sizes of pictures


def looks_like_panorama(height: int, width: int) -> bool:
    """Whether a picture of this shape is a panorama already."""
    return width >= _ASPECT * height


def panorama_rays(panorama: PanoramaConfig, supersampling: int = 1) -> Array:
    """Unit rays (H, W, 3) of the panorama's pixels in the robot's axes (x forward, y left, z up).

    `supersampling` multiplies H and W. Raises CameraError for an empty range of elevations.
    """
    low, high = np.radians([panorama.elevation_min, panorama.elevation_max])
    if low >= high:
        raise CameraError('elevation_min of the panorama must be below elevation_max')
    height, width = panorama.height * supersampling, panorama.width * supersampling
    turn = (np.arange(width) + 0.5 - width / 2) * 2 * np.pi / width
    azimuth = -turn if panorama.clockwise else turn
    elevation = high - (np.arange(height) + 0.5) * (high - low) / height
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], (height, width))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)


@dataclass(frozen=True, slots=True)
class _Tables:
    """Where each panorama pixel is read from: OpenCV's fixed-point maps, and what was seen."""

    pixels: NDArray[np.int16]
    fractions: NDArray[np.uint16]
    border: int
    seen: Mask


class Unwrapper:
    """Turns pictures of one camera into panoramas; tables are built once per size of picture.

    Panorama pixels that the camera does not see (outside the picture or its radii, masked, in a
    blind sector) repeat the nearest seen pixel of their row, or row of the panorama where the whole
    row is unseen. The repetition is part of the tables, costs nothing, follows the light of
    the scene and, unlike a constant color, draws no edge that turns with the robot.
    """

    def __init__(self, camera: CameraConfig, panorama: PanoramaConfig) -> None:
        self.camera = camera
        self.panorama = panorama
        self._tables: dict[tuple[int, int], _Tables] = {}

    def __call__(self, image: Image) -> Image:
        """Unwrap a BGR picture (H, W, 3) uint8 to (panorama.height, panorama.width, 3) uint8.

        A picture shaped like a panorama is only resized. Raises CameraError when it is no such
        picture, or not one of this camera.
        """
        _check(image)
        if self.is_panorama((image.shape[0], image.shape[1])):
            result = self._aligned(image)
        else:
            result = self._remapped(image)
        if self.camera.normalization == 'off':
            return result
        return normalized(result, self.camera.normalization)

    def seen(self, size: tuple[int, int]) -> Mask:
        """Mask (H, W) of the panorama pixels seen in pictures of `size` (rows, columns)."""
        scale = self.camera.supersampling
        return self._tables_of(size).seen[scale // 2 :: scale, scale // 2 :: scale]

    def is_panorama(self, size: tuple[int, int]) -> bool:
        """Whether pictures of `size` (rows, columns) are panoramas already, so only resized."""
        if self.camera.camera_model == 'panorama':
            return self.camera.mount_roll == 0.0 and self.camera.mount_pitch == 0.0
        round_model = self.camera.camera_model != 'equirectangular'
        return round_model and looks_like_panorama(*size)

    def _aligned(self, image: Image) -> Image:
        """A panorama, resized; if the camera makes them, also turned to the convention."""
        height, width = self.panorama.height, self.panorama.width
        shrinks = image.shape[0] > height or image.shape[1] > width
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        result = image.copy()
        if image.shape[:2] != (height, width):
            result = np.asarray(cv2.resize(image, (width, height), interpolation=method))
        if self.camera.camera_model != 'panorama':
            return result
        shift = -round(self.camera.mount_yaw / 360.0 * width)
        if is_mirrored(self.camera):
            result = result[:, ::-1]
        result = np.roll(result, shift, axis=1)
        return np.ascontiguousarray(result if self.panorama.clockwise else result[:, ::-1])

    def _remapped(self, image: Image) -> Image:
        tables = self._tables_of((image.shape[0], image.shape[1]))
        result = cv2.remap(
            image, tables.pixels, tables.fractions, cv2.INTER_LINEAR, borderMode=tables.border
        )
        if self.camera.supersampling > 1:
            size = (self.panorama.width, self.panorama.height)
            result = cv2.resize(result, size, interpolation=cv2.INTER_AREA)
        return np.asarray(result)

    def _tables_of(self, size: tuple[int, int]) -> _Tables:
        tables = self._tables.get(size)
        if tables is None:
            if len(self._tables) >= _SIZES_KEPT:
                self._tables.clear()
            tables = self._tables[size] = build_tables(self.camera, self.panorama, size)
        return tables


def _check(image: Any) -> None:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        raise CameraError('a picture must be an array of uint8')
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise CameraError(f'a picture must have shape (H, W, 3), not {image.shape}')


def build_tables(camera: CameraConfig, panorama: PanoramaConfig, size: tuple[int, int]) -> _Tables:
    """Build the lookup tables for pictures of `size` (rows, columns)."""
    model = make_camera(camera, size, panorama)
    rays = panorama_rays(panorama, camera.supersampling)
    pixels = model.project(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
    seen = np.isfinite(pixels[..., 0]) & ~_in_sectors(rays, camera.blind_sectors)
    if camera.mask_file:
        seen &= _unmasked(pixels, read_mask(camera.mask_file, size))
    rows, columns = nearest_seen(seen)
    wraps = model.lens.center is None and camera.camera_model != 'dual_fisheye'
    return _fixed_point(_clamped(pixels[rows, columns], size, wraps), wraps, seen)


def _clamped(pixels: Array, size: tuple[int, int], wraps: bool) -> Array:
    """Move the outer half pixel inside; a picture that closes on itself keeps its columns."""
    rows = np.clip(pixels[..., 1], 0, size[0] - 1)
    columns = pixels[..., 0] if wraps else np.clip(pixels[..., 0], 0, size[1] - 1)
    return np.stack([columns, rows], axis=-1)


def _fixed_point(pixels: Array, wraps: bool, seen: Mask) -> _Tables:
    columns, rows = np.moveaxis(pixels.astype(np.float32), -1, 0)
    maps = cv2.convertMaps(columns, rows, cv2.CV_16SC2)
    border = cv2.BORDER_WRAP if wraps else cv2.BORDER_REPLICATE
    return _Tables(np.asarray(maps[0]), np.asarray(maps[1]), border, seen)


def _in_sectors(rays: Array, sectors: tuple[float, ...]) -> Mask:
    """Mask (H, W) of the rays whose azimuth lies in one of the sectors (start, end in degrees).

    A sector that comes around to where it starts, as from -180 to 180, is the whole circle.
    """
    if len(sectors) % 2:
        raise CameraError('blind_sectors must hold a start and an end for each sector')
    azimuth = np.degrees(np.arctan2(rays[..., 1], rays[..., 0]))
    hidden = np.zeros(azimuth.shape, bool)
    for start, end in zip(sectors[::2], sectors[1::2], strict=True):
        whole = end - start >= 360.0 or (end != start and (end - start) % 360.0 == 0.0)
        hidden |= (azimuth - start) % 360.0 <= (360.0 if whole else (end - start) % 360.0)
    return hidden


def read_mask(path: str, size: tuple[int, int]) -> Mask:
    """Read a mask picture for pictures of `size` (rows, columns): True where it is not black."""
    known = Path(path).is_file()  # else OpenCV would warn on its own
    picture = cv2.imread(path, cv2.IMREAD_GRAYSCALE) if known else None
    if picture is None:
        raise CameraError(f'mask_file {path} is missing or is no picture')
    resized = cv2.resize(picture, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized) >= 128


def _unmasked(pixels: Array, mask: Mask) -> Mask:
    """Mask (H, W) of the lookups (H, W, 2) whose nearest pixel is True in the mask."""
    known = np.nan_to_num(pixels, nan=0.0)
    rows = np.clip(np.rint(known[..., 1]).astype(int), 0, mask.shape[0] - 1)
    columns = np.clip(np.rint(known[..., 0]).astype(int), 0, mask.shape[1] - 1)
    return np.asarray(mask[rows, columns])


def nearest_seen(seen: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each pixel of `seen` (H, W) the row and column (H, W) of the seen pixel that stands in.

    The nearest in the same row, around the back; in a row without any, that of the nearest row
    with some. Raises CameraError when nothing is seen.
    """
    filled = np.flatnonzero(seen.any(axis=1))
    if filled.size == 0:
        raise CameraError(
            'the camera sees no part of the panorama: check its axis, radii, masks and the '
            "panorama's elevations"
        )
    source = filled[np.abs(np.arange(len(seen))[:, None] - filled).argmin(axis=1)]
    columns = np.stack([_nearest_column(seen[row]) for row in source])
    return np.broadcast_to(source[:, None], seen.shape), columns


def _nearest_column(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    width = len(seen)
    known = np.flatnonzero(seen)
    around = np.concatenate([known - width, known, known + width])
    right = np.searchsorted(around, np.arange(width))
    left = np.maximum(right - 1, 0)
    nearer = np.arange(width) - around[left] < around[right] - np.arange(width)
    return np.asarray(np.where(nearer, around[left], around[right]) % width)


_TARGET = 110.0  # mean brightness after normalization
_GAIN_MAX = 8.0


def normalized(panorama: Image, method: str) -> Image:
    """Normalize brightness: 'exposure' by one gain, 'local' by that of the surroundings."""
    grey = cv2.cvtColor(panorama, cv2.COLOR_BGR2GRAY)
    if method == 'exposure':
        gain = min(_TARGET / max(float(grey.mean()), 1.0), _GAIN_MAX)
        return np.asarray(cv2.convertScaleAbs(panorama, alpha=gain))
    gain_map = np.minimum(_TARGET / np.maximum(_surroundings(np.asarray(grey)), 1.0), _GAIN_MAX)
    return np.asarray(np.clip(panorama * gain_map[..., None] + 0.5, 0, 255), np.uint8)


def _surroundings(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Mean brightness (H, W) over an eighth of the circle, which closes on itself."""
    reach = max(grey.shape[1] // 16, 1)
    wide = cv2.copyMakeBorder(grey, 0, 0, reach, reach, cv2.BORDER_WRAP)
    window = (2 * reach + 1, 2 * (grey.shape[0] // 4) + 1)
    mean = cv2.blur(wide.astype(np.float32), window, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(mean[:, reach:-reach])
