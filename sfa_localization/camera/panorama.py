# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Panoramas from images of an omnidirectional camera, by lookup tables."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from sfa_localization.camera.calibration_files import calibration_of
from sfa_localization.camera.encodings import read_image
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import (
    UNCALIBRATED,
    CameraConfig,
    LensCalibration,
    PanoramaConfig,
)
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array, Indices, Mask
from sfa_localization.data.run import Image

_ASPECT = 3.5  # an image wider than this times its height is a panorama
_SAME_LEVELS = 2  # of gray, between repeated columns in a JPEG
_ANY_PANORAMA = 1, 4  # rows, columns


def looks_like_panorama(height: int, width: int) -> bool:
    """Whether an image of this shape is a panorama already."""
    return width >= _ASPECT * height


def panorama_rays(panorama: PanoramaConfig) -> Array:
    """Unit rays (H, W, 3) of the pixels, in the robot's axes (x forward, y left, z up)."""
    return panorama.sphere.rays(panorama.height, panorama.width)


@dataclass(frozen=True, slots=True)
class _Tables:
    """Where each panorama pixel is read from: OpenCV's fixed-point maps, and what is visible."""

    pixels: NDArray[np.int16]
    fractions: NDArray[np.uint16]
    border: int
    visible: Mask
    hides: bool


class Unwrapper:
    """Turns images of one camera into panoramas; tables are built when their size changes.

    Invisible panorama pixels (outside the image or its radii, masked, in a blind sector) repeat the
    nearest visible pixel of their row, or of the nearest row that has one. Unlike a constant color
    this adds no edges that turn with the robot.

    `calibration` is the lens; by default the one that the camera describes.
    """

    def __init__(
        self,
        camera: CameraConfig,
        panorama: PanoramaConfig,
        calibration: LensCalibration | None = None,
    ) -> None:
        self.camera = camera
        self.panorama = panorama
        self._calibration = calibration
        self._tables: dict[tuple[int, int], _Tables] = {}

    @cached_property
    def calibration(self) -> LensCalibration:
        """The lens and its mounting. Raises CameraError where none is described, or its file cannot
        be used.
        """
        lens = self._calibration or calibration_of(self.camera)
        mount_rpy = self.camera.mount_rpy
        return replace(lens, mount_rpy=mount_rpy) if any(mount_rpy) else lens

    @property
    def model(self) -> str:
        """The camera model; '' where none is described. Raises CameraError as `calibration`."""
        camera = self.camera
        described = self._calibration or camera.calibration_file or camera.camera_model
        return self.calibration.camera_model if described else ''

    def __call__(self, image: Image) -> Image:
        """Unwrap a BGR image (H, W, 3) uint8 to (panorama.height, panorama.width, 3) uint8.

        An image that is a panorama already is resized before. Raises CameraError for any other
        array, and for an image of another camera.
        """
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            raise CameraError('an image must be an array of uint8')
        if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
            raise CameraError(f'an image must have shape (H, W, 3), not {image.shape}')
        size = (image.shape[0], image.shape[1])
        image = self._resized(image) if self.is_panorama(size) else image
        tables = self._tables_of(size)
        maps = tables.pixels, tables.fractions
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=tables.border))

    def visible(self, size: tuple[int, int]) -> Mask:
        """Mask (H, W) of the panorama pixels visible in images of `size` (rows, columns)."""
        return self._tables_of(size).visible

    def seen(self, size: tuple[int, int]) -> Mask | None:
        """The same mask, but None where neither a mask nor a sector hides any, nor the mount of
        panoramas moves any beyond their edges.
        """
        tables = self._tables_of(size)
        return tables.visible if tables.hides else None

    def check(self, size: tuple[int, int] | None = None) -> None:
        """Raise CameraError for a lens, mount, mask or sector that cannot be used for images of
        `size` (rows, columns), by default of that of the calibration, or panoramas.
        """
        if self.camera.mask_file:
            read_mask(self.camera.mask_file, _ANY_PANORAMA)
        lens = self.calibration if self.model else None
        size = size or ((lens.image_height, lens.image_width) if lens else _ANY_PANORAMA)
        if 0 not in size:
            self.visible(size)

    def is_panorama(self, size: tuple[int, int]) -> bool:
        """Whether images of `size` (rows, columns) are panoramas already."""
        if self.model == 'panorama':
            return True
        return self.model != 'equirectangular' and looks_like_panorama(*size)

    @property
    def lens(self) -> LensCalibration | None:
        """The lens, or that of panoramas which are mounted at an angle; None for neither."""
        lens = self.calibration if self.model else self._of_panoramas()[1]
        return lens if self.model or any(lens.mount_rpy) else None

    def keeping_size(self, size: tuple[int, int]) -> Unwrapper:
        """The same for panoramas of `size` (rows, columns), which keep it."""
        panorama = replace(self.panorama, height=size[0], width=size[1])
        return Unwrapper(self.camera, panorama, self._calibration)

    def _resized(self, image: Image) -> Image:
        """A panorama of another size, resized."""
        height = self.panorama.height
        width = self.panorama.width
        shrinks = image.shape[0] > height or image.shape[1] > width
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (width, height), interpolation=method))

    def _tables_of(self, size: tuple[int, int]) -> _Tables:
        """The tables for images of a size; those of panoramas are for the resized ones."""
        is_panorama = self.is_panorama(size)
        size = (self.panorama.height, self.panorama.width) if is_panorama else size
        if size not in self._tables:
            lens = self._of_panoramas() if is_panorama else (self.camera, self.calibration)
            self._tables = {size: build_tables(*lens, self.panorama, size)}
        return self._tables[size]

    def _of_panoramas(self) -> tuple[CameraConfig, LensCalibration]:
        """The camera and lens of images that are panoramas already.

        With the lens of another camera they come from omnicam_node, which has mounted and masked
        them.
        """
        if self.model == 'panorama':
            return self.camera, self.calibration
        # Their columns grow as declared.
        mirrored = 'no' if self.panorama.clockwise else 'yes'
        calibration = LensCalibration(camera_model='panorama', mirrored=mirrored)
        if self.model:
            return CameraConfig(blind_sectors=self.camera.blind_sectors), calibration
        return self.camera, replace(calibration, mount_rpy=self.camera.mount_rpy)


def build_tables(
    camera: CameraConfig,
    calibration: LensCalibration,
    panorama: PanoramaConfig,
    size: tuple[int, int],
) -> _Tables:
    """Build the lookup tables for images of `size` (rows, columns)."""
    model = make_camera(calibration, size, panorama, calibration.mount_rpy)
    rays = panorama_rays(panorama)
    pixels = model.project(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
    visible = np.isfinite(pixels[..., 0])
    wraps = calibration.camera_model in UNCALIBRATED  # its columns close on themselves
    if wraps:  # beyond its upper and lower edge, as leveling does, these are repeated
        pixels = model.lens.project(rays @ model.rotation)
    hidden = hidden_sectors(rays, camera.blind_sectors)
    if camera.mask_file:
        hidden |= _masked(read_mask(camera.mask_file, size), pixels)
    visible &= ~hidden
    from_rows, from_columns = nearest_visible(~hidden if wraps and visible.any() else visible)
    columns, rows = np.moveaxis(pixels[from_rows, from_columns], -1, 0)
    if not wraps:
        columns = np.clip(columns, 0, size[1] - 1)
    rows = np.clip(rows, 0, size[0] - 1)
    maps = cv2.convertMaps(columns.astype(np.float32), rows.astype(np.float32), cv2.CV_16SC2)
    border = cv2.BORDER_WRAP if wraps else cv2.BORDER_REPLICATE
    hides = bool(hidden.any() or (wraps and not visible.all()))
    return _Tables(np.asarray(maps[0]), np.asarray(maps[1]), border, visible, hides)


def _masked(mask: Mask, pixels: Array) -> Mask:
    """Which pixels (H, W, 2), column and row in an image, are not in its mask."""
    rows, columns = mask.shape
    nearest = np.rint(np.nan_to_num(pixels)).astype(int).clip(0, [columns - 1, rows - 1])
    return np.asarray(~mask[nearest[..., 1], nearest[..., 0]])


def hidden_sectors(rays: Array, sectors: tuple[float, ...]) -> Mask:
    """Mask (H, W) of the rays whose azimuth is in a sector from start to end, degrees.

    A sector whose end meets its start, as from -180 to 180, is the whole circle.
    """
    if len(sectors) % 2:
        raise CameraError('blind_sectors must hold a start and an end for each sector')
    azimuth = np.degrees(np.arctan2(rays[..., 1], rays[..., 0]))
    hidden = np.zeros(azimuth.shape, bool)
    for start, end in zip(sectors[::2], sectors[1::2], strict=True):
        width = (end - start) % 360.0
        if end - start >= 360.0 or (end != start and width == 0.0):
            width = 360.0
        hidden |= (azimuth - start) % 360.0 <= width
    return hidden


def read_mask(path: str, size: tuple[int, int]) -> Mask:
    """Read a mask image for images of `size` (rows, columns): True where it is not black."""
    try:
        image = read_image(path)
    except CameraError as error:
        raise CameraError(f'mask_file is missing or is no image ({error})') from None
    mask = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    resized = cv2.resize(mask, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized) >= 128


def filled(panoramas: Image, repeated: Indices) -> Image:
    """Panoramas (N, H, W, 3) whose pixels (H, W) repeat others, see `repeated_pixels`."""
    pixels = panoramas.reshape(len(panoramas), -1, 3)
    return np.asarray(pixels[:, repeated.ravel()].reshape(panoramas.shape))


def repeated_pixels(visible: Mask) -> Indices:
    """The visible pixel, row by row, that each pixel of `visible` (H, W) repeats."""
    rows, columns = nearest_visible(visible)
    return np.asarray(rows * visible.shape[1] + columns)


def repeated_columns(panorama: Image) -> NDArray[np.bool_]:
    """Which columns (W,) of a panorama (H, W, 3) repeat one beside them, as hidden ones do, also
    after it was compressed.
    """
    after = cv2.absdiff(panorama, np.roll(panorama, -1, axis=1)).max(axis=(0, 2)) <= _SAME_LEVELS
    return np.asarray(after | np.roll(after, 1))


def nearest_visible(visible: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns (H, W) of the visible pixel that each pixel of `visible` (H, W) repeats: the
    nearest in its row, or in the nearest row with any. Raises CameraError when nothing is visible.
    """
    usable_rows = np.flatnonzero(visible.any(axis=1))
    if usable_rows.size == 0:
        raise CameraError(
            'the camera sees no part of the panorama: check its axis, radii, masks and the '
            "panorama's elevations"
        )
    rows = usable_rows[np.abs(np.arange(len(visible))[:, None] - usable_rows).argmin(axis=1)]
    columns = np.stack([_nearest_column(visible[row]) for row in rows])
    return np.broadcast_to(rows[:, None], visible.shape), columns


def _nearest_column(visible: Mask) -> NDArray[np.intp]:
    """The nearest visible column (W,) of each column of a row (W,), around the back."""
    width = len(visible)
    columns = np.flatnonzero(visible)
    around = np.concatenate([columns - width, columns, columns + width])
    after = np.searchsorted(around, np.arange(width))
    before = np.maximum(after - 1, 0)
    nearer = np.arange(width) - around[before] < around[after] - np.arange(width)
    return np.asarray(np.where(nearer, around[before], around[after]) % width)
