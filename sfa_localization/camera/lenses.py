# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Omnidirectional camera models with one interface: ray to pixel, and pixel to ray.

A lens maps between rays (N, 3) of its optical frame (x along columns, y along rows, z along the
axis into the scene) and pixels (N, 2) as column, row of the calibrated image, pixel centers at
integers. What a lens cannot see is NaN. `CameraModel` mounts a lens on the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation

from sfa_localization.camera.settings import UNCALIBRATED, LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array

LEAST_AFFINE = 1e-3
"""Determinant of the affine part of a lens: 1 for square pixels; at 0 all pixels lie on a line."""
_SAMPLES = 2048  # of a curve that is inverted, before Newton's method
_NEWTON_STEPS = 3


class Lens(Protocol):
    """A camera model in its own optical frame."""

    @property
    def center(self) -> Array | None:
        """Column and row that radii are measured from; None where there is no such point."""

    def project(self, rays: Array) -> Array:
        """Pixels (N, 2) of unit rays (N, 3); NaN where not visible."""

    def unproject(self, pixels: Array) -> Array:
        """Unit rays (N, 3) of pixels (N, 2); NaN where a pixel sees nothing."""


class IncreasingCurve:
    """A smooth y = f(x), f(0) = 0, on the part of [0, limit] where it increases; and its inverse.

    `f` and its derivative `df` take and return arrays.
    """

    def __init__(
        self, f: Callable[[Array], Array], df: Callable[[Array], Array], limit: float
    ) -> None:
        x = np.linspace(0.0, limit, _SAMPLES)
        falling = np.flatnonzero(df(x) <= 0.0)
        end = falling[0] if falling.size else _SAMPLES
        if end < 2:
            raise CameraError('the distortion or polynomial does not increase from the center')
        self._f, self._df, self._x, self._y = f, df, x[:end], f(x[:end])

    def value(self, x: Array) -> Array:
        """Return f(x), NaN beyond the increasing part."""
        return np.where(x <= self._x[-1], self._f(np.minimum(x, self._x[-1])), np.nan)

    def inverse(self, y: Array) -> Array:
        """Return x with f(x) = y, NaN beyond the increasing part."""
        reachable = np.minimum(y, self._y[-1])
        x = np.interp(reachable, self._y, self._x)
        for _ in range(_NEWTON_STEPS):
            x = np.clip(x - (self._f(x) - reachable) / self._df(x), 0.0, self._x[-1])
        return np.where(y <= self._y[-1] * (1 + 1e-12), x, np.nan)


def _normalized(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, np.nan))


def _angle_and_direction(rays: Array) -> tuple[Array, Array]:
    """Angle (N,) from the axis, and the unit direction (N, 2) across it (0 on the axis)."""
    across = np.hypot(rays[:, 0], rays[:, 1])
    direction = rays[:, :2] / np.where(across > 0, across, 1.0)[:, None]
    return np.arctan2(across, rays[:, 2]), direction


def _radius_and_direction(plane: Array) -> tuple[Array, Array]:
    """Length (N,) and unit direction (N, 2) of plane vectors (N, 2)."""
    radius = np.hypot(plane[:, 0], plane[:, 1])
    return radius, plane / np.where(radius > 0, radius, 1.0)[:, None]


def _ray(angle: Array, direction: Array) -> Array:
    """Unit rays (N, 3) at an angle (N,) from the axis toward directions (N, 2)."""
    return np.column_stack([np.sin(angle)[:, None] * direction, np.cos(angle)])


@dataclass(frozen=True)
class MirrorLens:
    """The unified model: C. Mei and P. Rives, ICRA 2007, as in OpenCV's omnidir and Kalibr's omni.

    A ray meets the unit sphere, is seen from a point `xi` behind the sphere's center, distorted
    (radial k1 k2, tangential p1 p2) and scaled. Central mirrors have 0 < xi <= 1; xi = 0 is a
    pinhole camera.
    """

    focal: Array
    center: Array
    xi: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @cached_property
    def _radial(self) -> IncreasingCurve:
        k1, k2 = self.distortion[:2]
        curve = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2])
        return IncreasingCurve(curve, curve.deriv(), 20.0)

    def project(self, rays: Array) -> Array:
        depth = rays[:, 2] + self.xi
        # Beyond this cone the sphere's far side would be seen a second time.
        visible = rays[:, 2] > -(self.xi if self.xi <= 1.0 else 1.0 / self.xi)
        plane = rays[:, :2] / np.where(visible & (depth > 1e-9), depth, np.nan)[:, None]
        return np.asarray(self.focal * self._distorted(plane) + self.center)

    def unproject(self, pixels: Array) -> Array:
        plane = self._undistorted((pixels - self.center) / self.focal)
        square = np.sum(plane**2, axis=1)
        root = 1.0 + (1.0 - self.xi**2) * square
        scale = (self.xi + np.sqrt(np.where(root >= 0, root, np.nan))) / (1.0 + square)
        return np.column_stack([plane * scale[:, None], scale - self.xi])

    def _tangential(self, plane: Array) -> Array:
        p1, p2 = self.distortion[2:]
        x, y = plane[:, 0], plane[:, 1]
        square = x**2 + y**2
        shift_x = 2 * p1 * x * y + p2 * (square + 2 * x**2)
        shift_y = p1 * (square + 2 * y**2) + 2 * p2 * x * y
        return np.column_stack([shift_x, shift_y])

    def _distorted(self, plane: Array) -> Array:
        if not any(self.distortion):
            return plane
        radius, direction = _radius_and_direction(plane)
        return self._radial.value(radius)[:, None] * direction + self._tangential(plane)

    def _undistorted(self, plane: Array) -> Array:
        """Invert `_distorted`: the tangential part is small, so its fixed point contracts."""
        if not any(self.distortion):
            return plane
        result = plane
        for _ in range(50):
            radius, direction = _radius_and_direction(plane - self._tangential(result))
            previous, result = result, self._radial.inverse(radius)[:, None] * direction
            if not np.any(np.abs(result - previous) > 1e-13):
                break
        return result


@dataclass(frozen=True)
class FisheyeLens:
    """Kannala-Brandt model as in OpenCV's fisheye; equidistant where all coefficients are 0.

    The radius is focal * (a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9) of the angle a from the axis.
    """

    focal: Array
    center: Array
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @cached_property
    def _radial(self) -> IncreasingCurve:
        k1, k2, k3, k4 = self.distortion
        curve = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])
        return IncreasingCurve(curve, curve.deriv(), np.pi)

    def project(self, rays: Array) -> Array:
        angle, direction = _angle_and_direction(rays)
        plane = self._radial.value(angle)[:, None] * direction
        return np.asarray(self.focal * plane + self.center)

    def unproject(self, pixels: Array) -> Array:
        radius, direction = _radius_and_direction((pixels - self.center) / self.focal)
        return _ray(self._radial.inverse(radius), direction)


@dataclass(frozen=True)
class OcamLens:
    """Polynomial model: D. Scaramuzza, A. Martinelli and R. Siegwart, ICVS 2006 (OCamCalib).

    A pixel at radius r from the center sees the ray (x, y, -(a0 + a1 r + a2 r^2 + ...)); the
    affine matrix [[c, d], [e, 1]] acts on (row, column). `limit` is the largest radius in use.
    """

    polynomial: Polynomial
    center: Array
    affine: tuple[float, float, float]
    limit: float

    @cached_property
    def _matrix(self) -> Array:
        c, d, e = self.affine  # of (row, column), so swapped for (column, row)
        return np.array([[1.0, e], [d, c]])

    @cached_property
    def _angle(self) -> IncreasingCurve:
        """Angle from the axis as a function of the radius."""
        slope = self.polynomial.deriv()

        def angle(radius: Array) -> Array:
            return np.asarray(np.arctan2(radius, -self.polynomial(radius)))

        def derivative(radius: Array) -> Array:
            depth = self.polynomial(radius)
            return np.asarray((radius * slope(radius) - depth) / (radius**2 + depth**2))

        return IncreasingCurve(angle, derivative, self.limit)

    def project(self, rays: Array) -> Array:
        angle, direction = _angle_and_direction(rays)
        plane = self._angle.inverse(angle)[:, None] * direction
        return np.asarray(plane @ self._matrix.T + self.center)

    def unproject(self, pixels: Array) -> Array:
        plane = (pixels - self.center) @ np.linalg.inv(self._matrix).T
        radius, direction = _radius_and_direction(plane)
        return _ray(self._angle.value(radius), direction)


@dataclass(frozen=True)
class PolarLens:
    """No calibration but two circles: the angle from the axis grows linearly with the radius."""

    center: Array
    radii: tuple[float, float]
    angles: tuple[float, float]

    def project(self, rays: Array) -> Array:
        angle, direction = _angle_and_direction(rays)
        (near, far), (low, high) = self.radii, self.angles
        radius = near + (angle - low) * (far - near) / (high - low)
        plane = np.where(radius >= 0.0, radius, np.nan)[:, None] * direction
        return np.asarray(plane + self.center)

    def unproject(self, pixels: Array) -> Array:
        radius, direction = _radius_and_direction(pixels - self.center)
        (near, far), (low, high) = self.radii, self.angles
        angle = low + (radius - near) * (high - low) / (far - near)
        return _ray(np.where((angle >= 0.0) & (angle <= np.pi), angle, np.nan), direction)


@dataclass(frozen=True)
class CylinderLens:
    """An image linear in azimuth and elevation: equirectangular, or a panorama.

    The center column looks along the axis, columns grow to the right. Elevations in radians of
    the lower and upper edge; size as columns, rows.
    """

    size: tuple[int, int]
    elevation: tuple[float, float]
    center: None = None

    def project(self, rays: Array) -> Array:
        azimuth = np.arctan2(rays[:, 0], rays[:, 2])
        elevation = np.arctan2(-rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
        (width, height), (low, high) = self.size, self.elevation
        column = (azimuth / (2 * np.pi) + 0.5) * width - 0.5
        row = (high - elevation) / (high - low) * height - 0.5
        return np.column_stack([column, row])

    def unproject(self, pixels: Array) -> Array:
        (width, height), (low, high) = self.size, self.elevation
        azimuth = ((pixels[:, 0] + 0.5) / width - 0.5) * 2 * np.pi
        elevation = high - (pixels[:, 1] + 0.5) / height * (high - low)
        flat = np.cos(elevation)
        return np.column_stack([flat * np.sin(azimuth), -np.sin(elevation), flat * np.cos(azimuth)])


@dataclass(frozen=True)
class DualFisheyeLens:
    """Two fisheyes back to back in one image; `turn` (3, 3) takes rays to the second's frame."""

    first: FisheyeLens
    second: FisheyeLens
    turn: Array
    center: None = None

    def project(self, rays: Array) -> Array:
        behind = rays[:, 2:] < 0.0
        return np.where(behind, self.second.project(rays @ self.turn.T), self.first.project(rays))

    def unproject(self, pixels: Array) -> Array:
        first, second = self.first.unproject(pixels), self.second.unproject(pixels)
        to_first = np.linalg.norm(pixels - self.first.center, axis=1)
        to_second = np.linalg.norm(pixels - self.second.center, axis=1)
        rays = np.where((to_second < to_first)[:, None], second @ self.turn, first)
        ahead = np.where(to_second < to_first, second[:, 2], first[:, 2]) >= 0.0
        return np.where(ahead[:, None], rays, np.nan)


@dataclass(frozen=True)
class CameraModel:
    """A lens on the robot, for images of one size.

    `size` is rows and columns. `rotation` (3, 3) takes rays of the lens to the robot's axes (x
    forward, y left, z up; a mirrored image has determinant -1), `scale` (2,) pixels of the
    calibrated image to those of this size; nothing is visible outside `radii`, given in pixels of
    the calibrated image, nor outside the image.
    """

    lens: Lens
    rotation: Array
    size: tuple[int, int]
    scale: Array
    radii: tuple[float, float]

    def project(self, rays: Array) -> Array:
        """Columns and rows (N, 2) of rays (N, 3) in the robot's axes; NaN where not visible."""
        pixels = self._limited(self.lens.project(_normalized(np.asarray(rays)) @ self.rotation))
        pixels = (pixels + 0.5) * self.scale - 0.5
        return self._inside(pixels)

    def unproject(self, pixels: Array) -> Array:
        """Unit rays (N, 3) in the robot's axes of pixels (N, 2); NaN where they see nothing."""
        calibrated = (self._inside(np.asarray(pixels, float)) + 0.5) / self.scale - 0.5
        rays = self.lens.unproject(self._limited(calibrated))
        return np.asarray(_normalized(rays) @ self.rotation.T)

    def _limited(self, pixels: Array) -> Array:
        if self.lens.center is None:
            return pixels
        radius = np.hypot(*(pixels - self.lens.center).T)
        near, far = self.radii
        visible = (radius >= near) & ((radius <= far) | (far == 0.0))
        return np.where(visible[:, None], pixels, np.nan)

    def _inside(self, pixels: Array) -> Array:
        height, width = self.size
        visible = np.all((pixels >= -0.5) & (pixels <= [width - 0.5, height - 0.5]), axis=1)
        return np.where(visible[:, None], pixels, np.nan)


_AXES = {  # columns: where the image's right, its bottom and its center look
    'down': np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    'up': np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    'forward': np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
_USUAL_AXIS = {'mirror': 'down', 'polar': 'down', 'fisheye': 'up', 'ocam': 'up'}
_ASPECT_TOLERANCE = 0.02  # relative, of an image against the calibration; covers rounded sizes


def make_camera(
    calibration: LensCalibration,
    size: tuple[int, int],
    panorama: PanoramaConfig | None = None,
    mount_rpy: Sequence[float] = (0.0, 0.0, 0.0),
) -> CameraModel:
    """Build the camera for images of `size` (rows, columns), mounted at roll, pitch, yaw (deg).

    `panorama` gives the elevations of an image that is a panorama. Raises CameraError when the
    parameters describe no camera, or one whose images have another shape.
    """
    if min(size) < 1:
        raise CameraError(f'an image of {size[1]} x {size[0]} pixels is empty')
    lens = _make_lens(calibration, size, panorama or PanoramaConfig())
    radii = (calibration.radius_min, calibration.radius_max)
    return CameraModel(
        lens, _rotation(calibration, mount_rpy), size, _scale(calibration, size), radii
    )


def _rotation(calibration: LensCalibration, mount_rpy: Sequence[float]) -> Array:
    """Rays of the lens to the robot's axes: the axis, then roll, pitch and yaw (REP-103)."""
    mount = Rotation.from_euler('xyz', mount_rpy, degrees=True).as_matrix()
    axis = calibration.axis
    if axis == 'auto' or calibration.camera_model in UNCALIBRATED:
        axis = _USUAL_AXIS.get(calibration.camera_model, 'forward')
    reversal = np.diag([-1.0 if calibration.is_mirrored else 1.0, 1.0, 1.0])
    return np.asarray(mount @ _AXES[axis] @ reversal)


def _scale(calibration: LensCalibration, size: tuple[int, int]) -> Array:
    """Pixels of an image of `size` per pixel of the calibrated one, along columns and rows."""
    height, width = size
    calibrated = (calibration.image_width, calibration.image_height)
    if calibration.camera_model in UNCALIBRATED or 0 in calibrated:
        return np.ones(2)
    scale = np.array([width, height]) / calibrated
    if abs(scale[0] / scale[1] - 1.0) > _ASPECT_TOLERANCE:
        raise CameraError(
            f'the image is {width} x {height} but the camera is calibrated for '
            f'{calibrated[0]} x {calibrated[1]}, which is no scaling of it: name the '
            'calibration_file of this camera, or, if the images were cropped to calibrate it, add '
            'the columns and rows cut off at the left and top to its cx and cy, and set '
            'image_width and image_height'
        )
    return scale


def _make_lens(
    calibration: LensCalibration, size: tuple[int, int], panorama: PanoramaConfig
) -> Lens:
    model, (rows, columns) = calibration.camera_model, size
    if model == 'panorama':
        low, high = np.radians([panorama.elevation_min, panorama.elevation_max])
        return CylinderLens((columns, rows), (float(low), float(high)))
    if model == 'equirectangular':
        return CylinderLens((columns, rows), (-np.pi / 2, np.pi / 2))
    center = np.array([calibration.cx, calibration.cy])
    if model == 'polar':
        return _polar_lens(calibration, center)
    if model == 'ocam':
        return _ocam_lens(calibration, center, size)
    focal = np.array([calibration.fx, calibration.fy])
    if len(calibration.distortion) not in (0, 4):
        raise CameraError(
            f'distortion has {len(calibration.distortion)} coefficients; give 4, or none'
        )
    k1, k2, k3, k4 = calibration.distortion or (0.0,) * 4
    if model == 'mirror':
        return MirrorLens(focal, center, calibration.xi, (k1, k2, k3, k4))
    fisheye = FisheyeLens(focal, center, (k1, k2, k3, k4))
    return fisheye if model == 'fisheye' else _dual_fisheye_lens(calibration, fisheye)


def _ocam_lens(calibration: LensCalibration, center: Array, size: tuple[int, int]) -> OcamLens:
    if len(calibration.polynomial) < 2 or len(calibration.affine) != 3:
        raise CameraError('the ocam model needs polynomial (a0 a1 ...) and affine (c d e)')
    if calibration.polynomial[0] >= 0.0:
        raise CameraError('polynomial[0] of the ocam model must be negative')
    calibrated = (calibration.image_height, calibration.image_width)
    limit = calibration.radius_max or float(np.hypot(*np.maximum(size, calibrated)))
    c, d, e = calibration.affine
    if abs(c - d * e) < LEAST_AFFINE:
        raise CameraError('affine (c d e) of the ocam model is singular: c - d e must not be 0')
    return OcamLens(Polynomial(calibration.polynomial), center, (c, d, e), limit)


def _polar_lens(calibration: LensCalibration, center: Array) -> PolarLens:
    radii = (calibration.radius_min, calibration.radius_max)
    angles = (calibration.angle_min, calibration.angle_max)
    if radii[0] >= radii[1] or angles[0] >= angles[1]:
        raise CameraError('the polar model needs radius_min < radius_max and angle_min < angle_max')
    low, high = np.radians(angles)
    return PolarLens(center, radii, (float(low), float(high)))


def _dual_fisheye_lens(calibration: LensCalibration, first: FisheyeLens) -> DualFisheyeLens:
    center = np.array([calibration.second_cx, calibration.second_cy])
    roll = Rotation.from_euler('z', calibration.second_roll, degrees=True).as_matrix()
    to_second = roll @ np.diag([-1.0, 1.0, -1.0])
    return DualFisheyeLens(first, FisheyeLens(first.focal, center, first.distortion), to_second)
