# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration of a camera from the circles in its images, and an image to check the result."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sfa_localization.camera.calibration_files import CALIBRATION_TITLE, read_calibration
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.panorama import Unwrapper, panorama_rays
from sfa_localization.camera.point_tracks import mean_and_change
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.camera.surround import Surround
from sfa_localization.data.errors import CameraError
from sfa_localization.data.files import first_bytes
from sfa_localization.data.geometry import Array, Complex, Mask
from sfa_localization.data.run import Image
from sfa_localization.data.sphere import rotation

# directions from the center in which edges are searched
_RAYS = 360
_COARSE_RAYS = 48
# longer side of the image in the fine and the coarse search
_SEARCHED_PX = 640
_COARSE_PX = 160
_COARSE_STEP = 4  # px between the centers of the coarse search
_TOLERANCE = 0.012  # of the radius, from an edge to the circle that it supports
_TRIALS = 400  # random circles; enough to find the rim among two thirds of wrong edges
_ENOUGH_FOR_MOTION = 3  # images; the change between two is mostly noise
_BESIDE = np.array([0.03, 0.06, 0.09])  # samples on both sides of a circle, over its radius
_CONTRAST = 0.06  # of the range of a cue: more than its noise, less than a dim scene at the rim
# the border may cut off a rim, but no hole
_RIM_SUPPORT = 0.3
_HOLE_SUPPORT = 0.6


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in an image: column and row of its center, and radius, in pixels.

    `support` is the share of its visible directions in which an edge lies on the circle.
    """

    column: float
    row: float
    radius: float
    support: float


@dataclass(frozen=True, slots=True)
class MirrorCircles:
    """The rim of a mirror or fisheye, and the hole in its middle, where there is any."""

    rim: Circle
    hole: Circle | None


def find_circles(images: Sequence[Image]) -> MirrorCircles:
    """Find the rim of the mirror, and its hole, in images (H, W, 3) of one size.

    Just outside of the rim the image is dark or, in several images taken while driving, does not
    change; the cue with the clearer circle counts. The same holds just inside of the hole. Raises
    CameraError when no circle stands out.
    """
    rng = np.random.default_rng(0)
    scale = min(_SEARCHED_PX / max(images[0].shape), 1.0)
    cues = _cues(images, scale)

    def clearest(rim: Circle | None) -> Circle | None:
        circles = [circle for cue in cues if (circle := _find_circle(cue, rng, rim))]
        return max(circles, key=attrgetter('support'), default=None)

    rim = clearest(None)
    if rim is None:
        few = len(images) < _ENOUGH_FOR_MOTION
        more = f'{_ENOUGH_FOR_MOTION} or more, not {len(images)}' if few else 'others'
        raise CameraError(
            f'no mirror or fisheye stands out: take images ({more}) while driving in good light'
        )
    hole = clearest(rim)
    return MirrorCircles(_enlarged(rim, scale), hole and _enlarged(hole, scale))


def _enlarged(circle: Circle, scale: float) -> Circle:
    """The circle in the image, from that in an image shrunk by `scale`."""
    column = (circle.column + 0.5) / scale - 0.5
    row = (circle.row + 0.5) / scale - 0.5
    return Circle(column, row, circle.radius / scale, circle.support)


def _cues(images: Sequence[Image], scale: float) -> list[Array]:
    """Brightness and, of enough images, change (h, w), 0..255: the mirror differs in them."""
    grays = list[Array]()
    for number, image in enumerate(images, 1):
        gray = _scaled(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), scale)
        grays.append(np.asarray(cv2.GaussianBlur(gray, (0, 0), 1.0), float))
        if gray.shape != grays[0].shape:
            raise CameraError(
                f'image {number} differs in size from the first: give images of one camera'
            )
    brightness, change = mean_and_change(grays)
    return [brightness] if len(images) < _ENOUGH_FOR_MOTION else [brightness, change]


def _scaled(cue: Any, scale: float) -> Array:
    size = max(round(cue.shape[1] * scale), 1), max(round(cue.shape[0] * scale), 1)
    return np.asarray(cv2.resize(cue, size, interpolation=cv2.INTER_AREA))


def _find_circle(cue: Array, rng: np.random.Generator, rim: Circle | None) -> Circle | None:
    """The rim in a cue (h, w), or the hole inside of a given rim."""
    low, high = np.quantile(cue, (0.02, 0.98))
    contrast = _CONTRAST * (high - low)
    if contrast < 1.0:
        return None
    scale = min(_COARSE_PX / max(cue.shape), 1.0)
    start = _coarse_circle(_scaled(cue, scale), contrast, rim, scale)
    circle = None
    for _ in range(2):
        circle = _fit_circle(_edges(cue, start, contrast, rim is not None), rng)
        if circle is None:
            return None
        start = np.array([circle.column, circle.row, circle.radius])
    if circle is None or circle.support < (_HOLE_SUPPORT if rim else _RIM_SUPPORT):
        return None
    _, dark = _sides(cue, start[None, :2], circle.radius, _RAYS, rim is not None)
    return dataclasses.replace(circle, support=circle.support / float(np.isfinite(dark).mean()))


def _coarse_circle(cue: Array, contrast: float, rim: Circle | None, scale: float) -> Array:
    """Column, row, radius at scale 1 of the clearest circle in the cue shrunk by `scale`."""
    centers, radii = _candidates(cue.shape, rim, scale)
    hole = rim is not None
    circles = [_sides(cue, centers, radius, _COARSE_RAYS, hole) for radius in radii]
    clearness = np.array([_clearness(*sides, contrast) for sides in circles])
    size, place = np.unravel_index(np.argmax(clearness), clearness.shape)
    return np.array([*centers[place], radii[size]]) / scale


def _candidates(size: tuple[int, ...], rim: Circle | None, scale: float) -> tuple[Array, Array]:
    """Centers (N, 2) and radii (M,) of circles, in a cue of a size shrunk by `scale`."""
    height, width = size
    if rim is None:
        middle = np.array([width, height]) / 2
        steps = [np.arange(-0.3, 0.31, _COARSE_STEP / side) * side for side in (width, height)]
        radii = np.geomspace(0.2 * min(size), 0.6 * math.hypot(*size), 40)
    else:
        middle = np.array([rim.column, rim.row]) * scale
        reach = rim.radius * scale
        steps = [np.linspace(-0.1, 0.1, 7) * reach] * 2
        radii = np.geomspace(max(0.05 * reach, 2.0), 0.6 * reach, 30)
    return middle + np.stack(np.meshgrid(*steps), -1).reshape(-1, 2), radii


def _clearness(bright: Array, dark: Array, contrast: float) -> Array:
    """How clear circles are (N,) by values (N, rays) on their sides, -inf where hardly visible."""
    visible = np.isfinite(dark).mean(1)
    kept = visible >= _RIM_SUPPORT
    clearness = np.full(len(dark), -np.inf)
    dark = dark[kept]
    level = np.nanmedian(dark, axis=1, keepdims=True) + contrast
    share = np.mean((bright[kept] > level) & (dark < level), 1) - np.mean(dark >= level, 1)
    # Directions beyond the border do not count.
    clearness[kept] = share / (visible[kept] + _RIM_SUPPORT)
    return clearness


def _values(cue: Array, points: Complex, order: int) -> Array:
    """Values of a cue at points, column + i row, by splines of an order; NaN outside of it."""
    from scipy.ndimage import map_coordinates  # for images of mirrors alone

    rows_columns = [points.imag, points.real]
    return np.asarray(map_coordinates(cue, rows_columns, float, order=order, cval=np.nan))


def _sides(cue: Array, centers: Array, radius: float, rays: int, hole: bool) -> tuple[Array, Array]:
    """Mean values (N, rays) on both sides of circles about centers (N, 2), NaN outside the image.

    The side of the mirror's picture comes first: inside of a rim, outside of a hole.
    """
    directions = np.exp(2j * np.pi * np.arange(rays) / rays)
    sides = []
    for factors in (1 - _BESIDE, 1 + _BESIDE):
        offsets = radius * factors[:, None, None] * directions
        values = _values(cue, centers @ np.array([[1.0], [1j]]) + offsets, order=0)
        inside = np.isfinite(values)
        mean = np.nansum(values, axis=0) / np.maximum(inside.sum(0), 1)
        sides.append(np.where(inside.any(0), mean, np.nan))
    return (sides[1], sides[0]) if hole else (sides[0], sides[1])


def _edges(cue: Array, start: Array, contrast: float, hole: bool) -> Array:
    """Points (N, 2) near a circle where the cue passes the middle between its two sides."""
    bright, dark = (side[0] for side in _sides(cue, start[None, :2], start[2], _RAYS, hole))
    level = np.median(dark[np.isfinite(dark)]) if np.isfinite(dark).any() else np.inf
    factors = np.arange(0.85, 1.15, 0.25 / start[2])
    directions = np.exp(2j * np.pi * np.arange(_RAYS) / _RAYS)
    points = complex(*start[:2]) + start[2] * factors * directions[:, None]
    values = _values(cue, points, order=1)
    above = values > ((np.fmax(bright, level) + level) / 2)[:, None]
    if hole:
        index = np.argmax(above, axis=1)
        complete = index > 0
    else:
        index = factors.size - 1 - np.argmax(above[:, ::-1], axis=1)
        complete = index < np.isfinite(values).sum(1) - 3
    clear = (bright > level + contrast) & (dark < level + contrast) & above.any(1)
    edges = points[clear & complete, index[clear & complete]]
    return np.column_stack([edges.real, edges.imag])


def _fit_circle(points: Array, rng: np.random.Generator) -> Circle | None:
    """Fit a circle to points (N, 2) with many outliers (RANSAC); None with fewer than 8."""
    if len(points) < 8:
        return None
    best = np.zeros(len(points), bool)
    for _ in range(_TRIALS):
        circle = _least_squares(points[rng.choice(len(points), 3, replace=False)])
        inliers = _inliers(points, circle)
        if inliers.sum() > best.sum():
            best = inliers
    for _ in range(3):
        if best.sum() < 3:
            return None
        circle = _least_squares(points[best])
        best = _inliers(points, circle)
    column, row, radius = circle.tolist()
    return Circle(column, row, radius, float(best.sum() / _RAYS))


def _least_squares(points: Array) -> Array:
    """Column, row, radius of the algebraic best circle: x^2 + y^2 = 2 a x + 2 b y + c."""
    origin = points.mean(axis=0)
    x, y = (points - origin).T
    design = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
    (a, b, c), *_ = np.linalg.lstsq(design, x**2 + y**2, rcond=None)
    return np.array([a + origin[0], b + origin[1], np.sqrt(max(c + a**2 + b**2, 0.0))])


def _inliers(points: Array, circle: Array) -> Mask:
    """Which points (N, 2) lie on a circle."""
    off = np.hypot(*(points - circle[:2]).T) - circle[2]
    return np.asarray(np.abs(off) < _TOLERANCE * circle[2])


def described(calibration_file: Path, given: Mapping[str, Any]) -> LensCalibration:
    """The lens in a calibration file, with the fields of LensCalibration that are `given` instead.
    Raises CameraError.
    """
    return dataclasses.replace(read_calibration(calibration_file), **given)


def given_radii(radii: Sequence[float] | None) -> dict[str, Any]:
    """Fields of a lens from its radii (hole, rim) in pixels, if given. Raises CameraError."""
    if radii is not None and (len(radii) != 2 or not 0 <= radii[0] < radii[1]):
        raise CameraError('--radii takes INNERxOUTER in pixels')
    return dict(zip(('radius_min', 'radius_max'), radii or (), strict=False))


_GREEN = (80, 220, 80)
_RED = (60, 60, 255)
_YELLOW = (60, 230, 250)
_CHECK_WIDTH = 1200  # px: the labels of a panorama of this width can be read
_CHECK_HEIGHT = 200  # of the panorama of several cameras
_NAMES_DEG = 5.0  # elevation of their names
_SIDES = {'FRONT': 0, 'LEFT': 90, 'BACK': 180, 'RIGHT': 270}
_LOWEST_LABEL = -20  # degrees: lower ones would cover each other in a mirror
_LABELS_DEG = 45  # azimuth of the labels of elevations
# step of the search for the pixel of a label, px; its least cosine
_STEP = 4
_NEAR = 0.999


def check_image(image: Image, unwrapper: Unwrapper) -> Image:
    """The raw image above its panorama, 1200 px wide, both with the front, left, back and right
    in red, elevations every ten degrees in green, and the edges of the panorama in yellow.
    """
    strip = _resized(unwrapper(image), _CHECK_WIDTH)
    _draw(strip, _resized(panorama_rays(unwrapper.panorama), _CHECK_WIDTH), unwrapper.panorama)
    raw = _resized(image, min(image.shape[1], _CHECK_WIDTH))
    height, width = raw.shape[:2]
    lens = unwrapper.calibration
    model = make_camera(lens, (height, width), unwrapper.panorama, lens.mount_rpy)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    rays = model.unproject(pixels.reshape(-1, 2)).reshape(height, width, 3)
    _draw(raw, rays, unwrapper.panorama)
    margin = (_CHECK_WIDTH - width) // 2
    framed = np.zeros((height + len(strip), _CHECK_WIDTH, 3), np.uint8)
    framed[:height, margin : margin + width] = raw
    framed[height:] = strip
    return framed


def check_surround(panorama: Image, around: Surround) -> Image:
    """A panorama (H, W, 3) of several cameras, enlarged, with directions, elevations, the seams
    between cameras and their names.
    """
    size = around.panorama
    larger = dataclasses.replace(size, width=_CHECK_WIDTH, height=_CHECK_HEIGHT)
    canvas = np.asarray(cv2.resize(panorama, (larger.width, larger.height)), np.uint8)
    rays = panorama_rays(larger)
    _draw(canvas, rays, larger)
    owners = np.asarray(around.owners, np.int16)
    seams = cv2.morphologyEx(owners, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8))
    seams = cv2.resize(seams, (larger.width, larger.height), interpolation=cv2.INTER_NEAREST)
    canvas[seams > 0] = _YELLOW
    for camera in around.cameras:
        _write(canvas, camera.name, rays, (math.degrees(camera.yaw), _NAMES_DEG), _YELLOW)
    return canvas


def _resized(image: Any, width: int) -> Any:
    """A copy of an image (H, W, 3) scaled to a width."""
    height = max(round(image.shape[0] * width / image.shape[1]), 1)
    method = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method)


def _draw(canvas: Image, rays: Array, panorama: PanoramaConfig) -> None:
    """Draw directions, elevations, and the edges of the panorama into an image whose pixels see the
    rays (H, W, 3).
    """
    x, y, z = np.moveaxis(np.nan_to_num(rays), -1, 0)
    square = np.ones((3, 3), np.uint8)
    visible = cv2.erode(np.isfinite(rays[..., 0]).astype(np.uint8), square) > 0
    elevations = np.degrees(np.arcsin(np.clip(z, -1, 1)))
    inside = (elevations > panorama.elevation_min) & (elevations < panorama.elevation_max)
    quadrants = 2 * (x > 0) + (y > 0)
    for regions, color in (
        (np.floor(elevations / 10), _GREEN),
        (quadrants, _RED),
        (inside, _YELLOW),
    ):
        border = cv2.morphologyEx(regions.astype(np.int16), cv2.MORPH_GRADIENT, square[:2, :2])
        canvas[(border > 0) & visible] = color
    for elevation in range(_LOWEST_LABEL, 90, 10):
        name = f'{elevation:+d} deg' if elevation else 'HORIZON'
        _write(canvas, name, rays, (_LABELS_DEG, elevation), _GREEN)
    for name, azimuth in _SIDES.items():
        _write(canvas, name, rays, (azimuth, 0), _RED)


def _write(
    canvas: Image, text: str, rays: Array, toward: tuple[float, float], color: tuple[int, int, int]
) -> None:
    """Write a text at the pixel of an azimuth and elevation (degrees), if the image shows it."""
    ray = rotation(0.0, *np.radians([-toward[1], toward[0]]))[:, 0]
    likeness = np.nan_to_num(rays[::_STEP, ::_STEP] @ ray, nan=-1.0)
    place = np.unravel_index(np.argmax(likeness), likeness.shape)
    if likeness[place] < _NEAR:
        return
    font = cv2.FONT_HERSHEY_SIMPLEX
    (width, height), _ = cv2.getTextSize(text, font, 0.5, 1)
    column = int(np.clip(_STEP * place[1] + 3, 2, max(canvas.shape[1] - width - 2, 2)))
    row = int(np.clip(_STEP * place[0] - 3, height + 2, max(canvas.shape[0] - 4, height + 2)))
    for ink, thickness in (((0, 0, 0), 3), (color, 1)):  # with a black outline
        cv2.putText(canvas, text, (column, row), font, 0.5, ink, thickness, cv2.LINE_AA)


def require_replaceable(path: Path) -> None:
    """Raise CameraError for a file that is no calibration written here."""
    start = first_bytes(path)
    if start and not start.startswith(CALIBRATION_TITLE.encode()):
        raise CameraError(f'{path}: is no file of calibrate: give another name, or remove it')
