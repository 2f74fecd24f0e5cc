# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Omnidirectional camera models with one interface: ray to pixel, and pixel to ray.

A lens maps unit rays (N, 3) of its optical frame (x along columns, y along rows, z into the scene)
to pixels (N, 2), column and row of the calibrated image with centers at integers, and back; NaN
where it sees nothing. `CameraModel` mounts a lens on the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from sfa_localization.camera.settings import UNCALIBRATED, LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.sphere import Sphere, rotation

_LEAST_AFFINE = 1e-3  # determinant of the affine part: 1 for square pixels, 0 if singular
_WIDEST_PLANE = 20.0  # radius in the plane of a mirror up to which its distortion is inverted
# inversion of a curve: interpolated, then refined
_SAMPLES = 2048
_NEWTON_STEPS = 3


class Curve(NamedTuple):
    """A function of arrays and its inverse, NaN where there is none."""

    value: Callable[[Array], Array]
    inverse: Callable[[Array], Array]


def increasing(f: Callable[[Array], Array], df: Callable[[Array], Array], limit: float) -> Curve:
    """A smooth y = f(x) with f(0) = 0 and derivative df, on the interval from 0 on which it
    increases, at most up to `limit`. Raises CameraError where it does not increase at 0.
    """
    x = np.linspace(0.0, limit, _SAMPLES)
    falling = np.flatnonzero(df(x) <= 0.0)
    x = x[: falling[0]] if falling.size else x
    if len(x) < 2:
        raise CameraError('the distortion or polynomial does not increase from the center')
    y = f(x)
    end = x[-1]

    def value(at: Array) -> Array:
        return np.where(at <= end, f(np.minimum(at, end)), np.nan)

    def inverse(of: Array) -> Array:
        reachable = np.minimum(of, y[-1])
        at = np.interp(reachable, y, x)
        for _ in range(_NEWTON_STEPS):
            at = np.clip(at - (f(at) - reachable) / df(at), 0.0, end)
        return np.where(of <= y[-1] * (1 + 1e-12), at, np.nan)

    return Curve(value, inverse)


def _normalized(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, np.nan))


def _polar(plane: Array) -> tuple[Array, Array]:
    """Length (N,) and unit direction (N, 2) of plane vectors (N, 2), 0 at the center."""
    radius = np.hypot(plane[:, 0], plane[:, 1])
    return radius, plane / np.where(radius > 0, radius, 1.0)[:, None]


@dataclass(frozen=True)
class RadialLens:
    """A lens with one center: rays meet a plane, which is distorted and scaled to pixels.

    With `xi` it is the unified model of C. Mei and P. Rives, ICRA 2007 (OpenCV's omnidir, Kalibr's
    omni): a ray (x, y, z) meets the plane at (x, y) / (z + xi). Central mirrors have 0 < xi <= 1; a
    pinhole camera has xi = 0. Without `xi` the radius in the plane is the angle (rad) from the
    axis. `bend` distorts the radius, `tangential` holds p1 and p2, and pixels are
    focal * (affine @ plane) + center.
    """

    center: Array
    focal: Array
    xi: float | None = None
    bend: Curve | None = None
    tangential: tuple[float, float] = (0.0, 0.0)
    affine: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))

    def project(self, rays: Array) -> Array:
        bent = self._bent(self._to_plane(rays)) @ np.array(self.affine).T
        return np.asarray(self.focal * bent + self.center)

    def unproject(self, pixels: Array) -> Array:
        bent = ((pixels - self.center) / self.focal) @ np.linalg.inv(self.affine).T
        return self._from_plane(self._straight(bent))

    def _to_plane(self, rays: Array) -> Array:
        if self.xi is None:
            across, direction = _polar(rays[:, :2])
            return np.arctan2(across, rays[:, 2])[:, None] * direction
        depth = rays[:, 2] + self.xi
        # Beyond this cone the far side of the sphere would appear a second time.
        visible = rays[:, 2] > -(self.xi if self.xi <= 1.0 else 1.0 / self.xi)
        return rays[:, :2] / np.where(visible & (depth > 1e-9), depth, np.nan)[:, None]

    def _from_plane(self, plane: Array) -> Array:
        if self.xi is None:
            angle, direction = _polar(plane)
            angle = np.where(angle <= np.pi, angle, np.nan)
            return np.column_stack([np.sin(angle)[:, None] * direction, np.cos(angle)])
        square = np.sum(plane**2, axis=1)
        root = 1.0 + (1.0 - self.xi**2) * square
        scale = (self.xi + np.sqrt(np.where(root >= 0, root, np.nan))) / (1.0 + square)
        return np.column_stack([plane * scale[:, None], scale - self.xi])

    def _shift(self, plane: Array) -> Array:
        """The tangential part of a distortion (N, 2)."""
        p1, p2 = self.tangential
        x, y = plane.T
        shift_x = 2 * p1 * x * y + p2 * (3 * x**2 + y**2)
        shift_y = p1 * (x**2 + 3 * y**2) + 2 * p2 * x * y
        return np.column_stack([shift_x, shift_y])

    def _bent(self, plane: Array) -> Array:
        if self.bend is None:
            return plane
        radius, direction = _polar(plane)
        return self.bend.value(radius)[:, None] * direction + self._shift(plane)

    def _straight(self, plane: Array) -> Array:
        """Invert `_bent` by a fixed point, which contracts as the tangential part is small."""
        if self.bend is None:
            return plane
        result = np.zeros_like(plane)
        for _ in range(50 if any(self.tangential) else 1):
            radius, direction = _polar(plane - self._shift(result))
            previous = result
            result = self.bend.inverse(radius)[:, None] * direction
            if not np.any(np.abs(result - previous) > 1e-13):
                break
        return result


@dataclass(frozen=True)
class CylinderLens:
    """An image linear in azimuth and elevation, its axis in the center column; `size` is rows and
    columns.
    """

    sphere: Sphere
    size: tuple[int, int]
    center: None = None

    def project(self, rays: Array) -> Array:
        return self.sphere.pixels(rays @ _AXES['forward'].T, *self.size)

    def unproject(self, pixels: Array) -> Array:
        return np.asarray(self.sphere.directions(pixels, *self.size) @ _AXES['forward'])


@dataclass(frozen=True)
class DualFisheyeLens:
    """Two fisheyes back to back in one image; `turn` (3, 3) takes rays to the second's frame."""

    first: RadialLens
    second: RadialLens
    turn: Array
    center: None = None

    def project(self, rays: Array) -> Array:
        """Each lens sees what lies ahead of it."""
        return self.project_by(rays[:, 2] < 0.0, rays)

    def unproject(self, pixels: Array) -> Array:
        by_second = self.by_second(pixels)
        rays = self.unproject_by(by_second, pixels)
        ahead = np.where(by_second, (rays @ self.turn.T)[:, 2], rays[:, 2]) >= 0.0
        return np.where(ahead[:, None], rays, np.nan)

    def by_second(self, pixels: Array) -> Mask:
        """Which pixels (N, 2) are nearer to the center of the second lens."""
        to_first = np.linalg.norm(pixels - self.first.center, axis=1)
        return np.asarray(np.linalg.norm(pixels - self.second.center, axis=1) < to_first)

    def project_by(self, by_second: Mask, rays: Array) -> Array:
        """Pixels (N, 2) of rays (N, 3) in the second lens, or in the first."""
        second = self.second.project(rays @ self.turn.T)
        return np.where(by_second[:, None], second, self.first.project(rays))

    def unproject_by(self, by_second: Mask, pixels: Array) -> Array:
        """Rays (N, 3) of pixels (N, 2) in the second lens, or in the first."""
        second = self.second.unproject(pixels) @ self.turn
        return np.where(by_second[:, None], second, self.first.unproject(pixels))


Lens = RadialLens | CylinderLens | DualFisheyeLens


@dataclass(frozen=True)
class CameraModel:
    """A lens on the robot, for images of `size` (rows, columns).

    `rotation` (3, 3) takes rays of the lens to the robot's axes, x forward, y left, z up; its
    determinant is -1 for a mirrored image. `scale` (2,) takes pixels of the calibrated image to
    those of the image. Only pixels between `radii`, px of the calibrated image, are visible.
    """

    lens: Lens
    rotation: Array
    size: tuple[int, int]
    scale: Array
    radii: tuple[float, float]

    def project(self, rays: Array) -> Array:
        """Columns and rows (N, 2) of rays (N, 3) in the robot's axes; NaN where invisible."""
        pixels = self._limited(self.lens.project(_normalized(np.asarray(rays)) @ self.rotation))
        return self._inside((pixels + 0.5) * self.scale - 0.5)

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


_AXES = {  # columns: directions of the image's right, bottom and center
    'down': np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    'up': np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    'forward': np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
OPTICAL_AXES = _AXES['forward']
"""The axes of an optical frame (REP 103) on a robot that looks ahead."""
_BACK = np.diag([-1.0, -1.0, 1.0])  # the axes of a camera that looks back, x forward
_USUAL_AXIS = {'mirror': 'down', 'polar': 'down', 'fisheye': 'up', 'ocam': 'up'}
_ASPECT_TOLERANCE = 0.02  # between image and calibration, for rounded sizes


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
    axis = calibration.axis
    if axis == 'auto' or calibration.camera_model in UNCALIBRATED:
        axis = _USUAL_AXIS.get(calibration.camera_model, 'forward')
    to_robot = rotation(*np.radians(mount_rpy)) @ _AXES[axis]
    return turned_camera(calibration, size, to_robot, panorama)


def turned_camera(
    calibration: LensCalibration,
    size: tuple[int, int],
    to_robot: Array,
    panorama: PanoramaConfig | None = None,
) -> CameraModel:
    """Build the camera whose optical axes (x along columns, y along rows, z into the scene, as of
    REP 103) `to_robot` (3, 3) turns to the robot's. Raises CameraError as `make_camera`.
    """
    lens = _make_lens(calibration, size, panorama or PanoramaConfig())
    reversal = np.diag([-1.0 if calibration.is_mirrored else 1.0, 1.0, 1.0])
    radii = (calibration.radius_min, calibration.radius_max)
    return CameraModel(lens, to_robot @ reversal, size, _scale(calibration, size), radii)


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
            f'{calibrated[0]} x {calibrated[1]}, which is no scaling of it: set the camera to the '
            'size of the training, or name the calibration_file of this camera, or, if the images '
            'were cropped to calibrate it, add the columns and rows cut off at the left and top '
            'to its cx and cy, and set image_width and image_height'
        )
    return scale


def _make_lens(
    calibration: LensCalibration, size: tuple[int, int], panorama: PanoramaConfig
) -> Lens:
    model = calibration.camera_model
    if model == 'panorama':
        return CylinderLens(replace(panorama.sphere, clockwise=True), size)
    if model == 'equirectangular':
        edges = np.radians([calibration.elevation_min, calibration.elevation_max])
        return CylinderLens(Sphere(*edges.tolist()), size)
    center = np.array([calibration.cx, calibration.cy])
    if model == 'polar':
        return RadialLens(center, np.ones(2), bend=_polar_bend(calibration))
    if model == 'ocam':
        return _ocam_lens(calibration, center, size)
    focal = np.array([calibration.fx, calibration.fy])
    k1, k2, k3, k4 = _four(calibration.distortion)
    if model == 'mirror':
        curve = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2])
        bend = increasing(curve, curve.deriv(), _WIDEST_PLANE) if any((k1, k2, k3, k4)) else None
        return RadialLens(center, focal, calibration.xi, bend, (k3, k4))
    fisheye = _fisheye_lens(center, focal, calibration.distortion)
    return fisheye if model == 'fisheye' else DualFisheyeLens(fisheye, *_second(calibration))


def _four(distortion: tuple[float, ...]) -> tuple[float, ...]:
    if len(distortion) not in (0, 4):
        raise CameraError(f'distortion has {len(distortion)} coefficients; give 4, or none')
    return distortion or (0.0,) * 4


def _fisheye_lens(center: Array, focal: Array, distortion: tuple[float, ...]) -> RadialLens:
    """Model of J. Kannala and S. Brandt, PAMI 2006."""
    k1, k2, k3, k4 = _four(distortion)
    curve = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])
    return RadialLens(center, focal, bend=increasing(curve, curve.deriv(), np.pi))


def _second(calibration: LensCalibration) -> tuple[RadialLens, Array]:
    """The second lens of two, and the rotation (3, 3) of rays to its frame."""
    center = np.array([calibration.second_cx, calibration.second_cy])
    focal = np.array([calibration.fx, calibration.fy])
    if calibration.second_focal:
        focal = np.full(2, calibration.second_focal)
    distortion = calibration.second_distortion or calibration.distortion
    turn = rotation(*np.radians([calibration.second_roll, *calibration.second_tilt])) @ _BACK
    return _fisheye_lens(center, focal, distortion), _AXES['forward'].T @ turn @ _AXES['forward']


def _polar_bend(calibration: LensCalibration) -> Curve:
    """The angle from the axis as a linear function of the radius, for uncalibrated cameras."""
    near = calibration.radius_min
    far = calibration.radius_max
    if near >= far or calibration.angle_min >= calibration.angle_max:
        raise CameraError('the polar model needs radius_min < radius_max and angle_min < angle_max')
    low, high = np.radians([calibration.angle_min, calibration.angle_max])
    slope = (far - near) / (high - low)

    def positive(values: Array) -> Array:
        return np.where(values >= 0.0, values, np.nan)

    return Curve(
        lambda angle: positive(near + (angle - low) * slope),
        lambda radius: positive(low + (radius - near) / slope),
    )


def _ocam_lens(calibration: LensCalibration, center: Array, size: tuple[int, int]) -> RadialLens:
    """Polynomial model: D. Scaramuzza, A. Martinelli and R. Siegwart, ICVS 2006 (OCamCalib).

    A pixel at radius r from the center sees the ray (x, y, -(a0 + a1 r + a2 r^2 + ...)); the
    affine matrix [[c, d], [e, 1]] acts on (row, column).
    """
    if len(calibration.polynomial) < 2 or len(calibration.affine) != 3:
        raise CameraError('the ocam model needs polynomial (a0 a1 ...) and affine (c d e)')
    if calibration.polynomial[0] >= 0.0:
        raise CameraError('polynomial[0] of the ocam model must be negative')
    c, d, e = calibration.affine
    if abs(c - d * e) < _LEAST_AFFINE:
        raise CameraError('affine (c d e) of the ocam model is singular: c - d e must not be 0')
    depth = -Polynomial(calibration.polynomial)
    slope = depth.deriv()

    def angle(radius: Array) -> Array:
        return np.asarray(np.arctan2(radius, depth(radius)))

    def derivative(radius: Array) -> Array:
        z = depth(radius)
        return np.asarray((z - radius * slope(radius)) / (radius**2 + z**2))

    calibrated = (calibration.image_height, calibration.image_width)
    limit = calibration.radius_max or float(np.hypot(*np.maximum(size, calibrated)))
    angles = increasing(angle, derivative, limit)
    bend = Curve(angles.inverse, angles.value)
    return RadialLens(center, np.ones(2), bend=bend, affine=((1.0, e), (d, c)))
