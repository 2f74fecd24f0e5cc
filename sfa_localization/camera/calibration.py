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
from numpy.typing import NDArray

from sfa_localization.camera.calibration_files import CALIBRATION_TITLE, read_calibration
from sfa_localization.camera.encodings import encode_png, read_image
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.panorama import Unwrapper, panorama_rays
from sfa_localization.camera.settings import CalibrationConfig, LensCalibration
from sfa_localization.data.errors import CameraError
from sfa_localization.data.files import atomic_write, first_bytes
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image

_RAYS = 360  # directions from the center in which edges are looked for
_SEARCHED_PX = 640  # longer side at which circles are looked for: a soft rim is as narrow in all
_COARSE_PX, _COARSE_STEP, _COARSE_RAYS = 160, 4, 48  # and at which circles are tried one by one
_TOLERANCE = 0.012  # of the radius, from an edge to the circle that it supports
_TRIALS = 400  # random circles; enough to find the rim among two thirds of wrong edges
_ENOUGH_FOR_MOTION = 3  # images; the change between two is mostly noise
# Beside a circle, as shares of its radius: beyond the tenth over which light falls off at a rim.
_BESIDE = np.array([0.03, 0.06, 0.09])
_CONTRAST = 0.06  # of the range of a cue: more than its noise, less than a dim scene beside the rim
_RIM_SUPPORT, _HOLE_SUPPORT = 0.3, 0.6  # a rim may be cut off, a hole is whole
_CIRCLE = 'cx', 'cy', 'radius_min', 'radius_max'


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in an image: column and row of its center and radius in pixels.

    `support` is the share of the directions around it, of those in the image, in which an edge
    lies on it.
    """

    column: float
    row: float
    radius: float
    support: float


@dataclass(frozen=True, slots=True)
class MirrorCircles:
    """The rim of a mirror or fisheye, and what is hidden in its middle (None: not found)."""

    rim: Circle
    hole: Circle | None


class ImageFiles(Sequence[Image]):
    """Image files, each read anew when it is asked for: some kB may hold 200 MB of pixels."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: Any) -> Any:
        return read_image(self._paths[index])


def find_circles(images: Sequence[Image], seed: int = 0) -> MirrorCircles:
    """Find the rim of the mirror, and its hole, in images (H, W, 3) of one size.

    All around the rim the image is dark just outside of it or, with several images taken while
    driving, does not change: what stands out better. The same holds just inside of the hole.
    Raises CameraError when no circle stands out.
    """
    rng = np.random.default_rng(seed)
    scale = min(_SEARCHED_PX / max(images[0].shape), 1.0)
    cues = _cues(images, scale)
    by_support = attrgetter('support')
    found = filter(None, [_find_circle(cue, rng, None) for cue in cues])
    rim = max(found, key=by_support, default=None)
    if rim is None:
        few = len(images) < _ENOUGH_FOR_MOTION
        more = f'{_ENOUGH_FOR_MOTION} or more, not {len(images)}' if few else 'others'
        raise CameraError(
            f'no mirror or fisheye stands out: take images ({more}) while driving in good light, '
            'or give --center and --radii'
        )
    found = filter(None, [_find_circle(cue, rng, rim) for cue in cues])
    hole = max(found, key=by_support, default=None)
    return MirrorCircles(_enlarged(rim, scale), hole and _enlarged(hole, scale))


def _enlarged(circle: Circle, scale: float) -> Circle:
    """The circle of an image that was shrunk to a scale, in the image."""
    column, row = (circle.column + 0.5) / scale - 0.5, (circle.row + 0.5) / scale - 0.5
    return Circle(column, row, circle.radius / scale, circle.support)


def _cues(images: Sequence[Image], scale: float) -> list[Array]:
    """What distinguishes the mirror from its surroundings (h, w), 0..255: brightness, change."""
    brightness = squares = np.zeros(0)
    for number, image in enumerate(images):
        gray = _scaled(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), scale)
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), 1.0), float)
        if number and gray.shape != brightness.shape:
            raise CameraError(
                f'image {number + 1} differs in size from the first: give images of one camera'
            )
        brightness, squares = (brightness + gray, squares + gray**2) if number else (gray, gray**2)
    brightness = brightness / len(images)
    if len(images) < _ENOUGH_FOR_MOTION:
        return [brightness]
    variance = squares / len(images) - brightness**2
    change = cv2.GaussianBlur(np.sqrt(np.maximum(variance, 0)), (0, 0), 2.0)
    return [brightness, np.asarray(change, float)]


def _scaled(cue: Any, scale: float) -> Array:
    size = max(round(cue.shape[1] * scale), 1), max(round(cue.shape[0] * scale), 1)
    return np.asarray(cv2.resize(cue, size, interpolation=cv2.INTER_AREA))


def _find_circle(cue: Array, rng: np.random.Generator, rim: Circle | None) -> Circle | None:
    """The rim in a cue (h, w), or the hole about the middle of a rim that was found."""
    low, high = np.quantile(cue, (0.02, 0.98))
    contrast = _CONTRAST * (high - low)
    if contrast < 1.0:
        return None
    scale = min(_COARSE_PX / max(cue.shape), 1.0)
    start = _coarse_circle(_scaled(cue, scale), contrast, rim, scale)
    circle = None
    for _ in range(2):
        points = _edges(cue, start, contrast, rim is not None)
        circle = _fit_circle(points, rng)
        if circle is None:
            return None
        start = np.array([circle.column, circle.row, circle.radius])
    if circle is None or circle.support < (_HOLE_SUPPORT if rim else _RIM_SUPPORT):
        return None
    _, dark = _sides(cue, start[None, :2], circle.radius, _RAYS, rim is not None)
    return dataclasses.replace(circle, support=circle.support / float(np.isfinite(dark).mean()))


def _coarse_circle(cue: Array, contrast: float, rim: Circle | None, scale: float) -> Array:
    """Column, row, radius at scale 1 of the circle that the cue, shrunk to a scale, shows best."""
    height, width = cue.shape
    if rim is None:
        middle = np.array([width, height]) / 2
        steps = [np.arange(-0.3, 0.31, _COARSE_STEP / side) * side for side in (width, height)]
        radii = np.geomspace(0.2 * min(cue.shape), 0.6 * math.hypot(*cue.shape), 40)
    else:
        middle, reach = np.array([rim.column, rim.row]) * scale, rim.radius * scale
        steps = [np.linspace(-0.1, 0.1, 7) * reach] * 2
        radii = np.geomspace(max(0.05 * reach, 2.0), 0.6 * reach, 30)
    centers = middle + np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    best, found = -np.inf, np.array([*middle, radii[0]])
    for radius in radii:
        bright, dark = _sides(cue, centers, radius, _COARSE_RAYS, rim is not None)
        seen = np.isfinite(dark).mean(1)
        kept = seen >= _RIM_SUPPORT
        if not kept.any():
            continue
        bright, dark = bright[kept], dark[kept]
        level = np.nanmedian(dark, axis=1, keepdims=True) + contrast
        score = np.mean((bright > level) & (dark < level), 1) - np.mean(dark >= level, 1)
        score /= seen[kept] + _RIM_SUPPORT  # what a border cuts off says nothing
        if score.max() > best:
            best = float(score.max())
            found = np.array([*centers[kept][np.argmax(score)], radius])
    return found / scale


def _sides(cue: Array, centers: Array, radius: float, rays: int, hole: bool) -> tuple[Array, Array]:
    """Means (N, rays) on both sides of circles about centers (N, 2), NaN outside of the image.

    First that where a mirror shows something: inside of a rim, outside of a hole.
    """
    angles = np.arange(rays) * 2 * np.pi / rays
    height, width = cue.shape
    sides = []
    for factors in (1 - _BESIDE, 1 + _BESIDE):
        reach = radius * factors[:, None, None]
        columns = centers[:, 0, None] + reach * np.cos(angles)
        rows = centers[:, 1, None] + reach * np.sin(angles)
        inside = (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
        values = cue[
            np.where(inside, rows, 0).astype(int), np.where(inside, columns, 0).astype(int)
        ]
        count = inside.sum(0)
        sides.append(
            np.where(count, np.where(inside, values, 0).sum(0) / np.maximum(count, 1), np.nan)
        )
    return (sides[1], sides[0]) if hole else (sides[0], sides[1])


def _edges(cue: Array, start: Array, contrast: float, hole: bool) -> Array:
    """Points (N, 2) near a circle where the cue passes the middle between its two sides."""
    bright, dark = (side[0] for side in _sides(cue, start[None, :2], start[2], _RAYS, hole))
    level = np.median(dark[np.isfinite(dark)]) if np.isfinite(dark).any() else np.inf
    factors = np.arange(0.85, 1.15, 0.25 / start[2])
    angles = np.arange(_RAYS) * 2 * np.pi / _RAYS
    columns = start[0] + start[2] * factors * np.cos(angles)[:, None]
    rows = start[1] + start[2] * factors * np.sin(angles)[:, None]
    height, width = cue.shape
    inside = (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
    maps = columns.astype(np.float32), rows.astype(np.float32)
    values = cv2.remap(cue.astype(np.float32), *maps, cv2.INTER_LINEAR)
    above = (values > ((np.fmax(bright, level) + level) / 2)[:, None]) & inside
    seen = (bright > level + contrast) & (dark < level + contrast)
    if hole:
        index = np.argmax(above, axis=1)
        found = seen & above.any(1) & (index > 0)
    else:
        index = factors.size - 1 - np.argmax(above[:, ::-1], axis=1)
        found = seen & above.any(1) & (index < inside.sum(1) - 3)
    picked = np.flatnonzero(found), index[found]
    return np.column_stack([columns[picked], rows[picked]])


def _fit_circle(points: Array, rng: np.random.Generator) -> Circle | None:
    """Fit a circle to points (N, 2) of which many may be wrong; None with fewer than 8."""
    if len(points) < 8:
        return None
    best = np.zeros(len(points), bool)
    for _ in range(_TRIALS):
        agree = _agree(points, _least_squares(points[rng.choice(len(points), 3, replace=False)]))
        if agree.sum() > best.sum():
            best = agree
    for _ in range(3):
        if best.sum() < 3:
            return None
        circle = _least_squares(points[best])
        best = _agree(points, circle)
    return Circle(float(circle[0]), float(circle[1]), float(circle[2]), float(best.sum() / _RAYS))


def _least_squares(points: Array) -> Array:
    """Column, row, radius of the algebraic best circle: x^2 + y^2 = 2 a x + 2 b y + c."""
    origin = points.mean(axis=0)
    x, y = (points - origin).T
    design = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
    (a, b, c), *_ = np.linalg.lstsq(design, x**2 + y**2, rcond=None)
    return np.array([a + origin[0], b + origin[1], np.sqrt(max(c + a**2 + b**2, 0.0))])


def _agree(points: Array, circle: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) lie on a circle."""
    off = np.hypot(*(points - circle[:2]).T) - circle[2]
    return np.asarray(np.abs(off) < _TOLERANCE * circle[2])


def calibrate(
    images: Sequence[Image],
    calibration_file: Path | None,
    config: CalibrationConfig,
    given: Mapping[str, Any],
) -> LensCalibration:
    """The lens from a calibration file, or from a circle in images (H, W, 3), found there or given.

    `given` holds fields of LensCalibration that count as they are: those of the circle, of which
    with a file the radii only limit what is visible, and others. Raises CameraError when this is
    not enough.
    """
    if calibration_file is not None:
        used = {name: value for name, value in given.items() if name not in _CIRCLE[:2]}
        return dataclasses.replace(read_calibration(calibration_file), **used)
    if not images:
        raise CameraError('give images of the camera, or --calibration')
    height, width = images[0].shape[:2]
    fields = {'camera_model': config.model, 'image_width': width, 'image_height': height}
    if not given.keys() >= set(_CIRCLE):
        circles = find_circles(images)
        hole, rim = circles.hole.radius if circles.hole else 0.0, circles.rim
        found = (rim.column, rim.row, hole, rim.radius)
        fields |= dict(zip(_CIRCLE, found, strict=True))
    fields |= given
    if config.model == 'fisheye':
        focal = float(fields['radius_max'] / np.radians(config.field_of_view / 2))
        fields |= {'fx': focal, 'fy': focal, 'radius_min': 0.0}
    elif fields['radius_min'] == 0.0:
        raise CameraError(
            'no inner circle was found, which the polar model needs: give --center and --radii'
        )
    lens = LensCalibration.from_mapping(fields, 'calibration')
    _require_inside(lens)
    return lens


def given_circle(center: Sequence[float] | None, radii: Sequence[float] | None) -> dict[str, Any]:
    """Fields of a lens from its center (column, row) and radii (hole, rim) in pixels, or from one
    of both. Raises CameraError.
    """
    fields: dict[str, Any] = {}
    for names, numbers in ((_CIRCLE[:2], center), (_CIRCLE[2:], radii)):
        if numbers and (
            len(numbers) != 2 or (numbers is radii and not 0 <= numbers[0] < numbers[1])
        ):
            raise CameraError('--center takes COLUMNxROW, --radii takes INNERxOUTER in pixels')
        fields |= dict(zip(names, numbers or (), strict=False))
    return fields


def _require_inside(lens: LensCalibration) -> None:
    column, row, width, height = lens.cx, lens.cy, lens.image_width, lens.image_height
    farthest = math.hypot(max(column, width - column), max(row, height - row))
    if not (0 <= column <= width and 0 <= row <= height and lens.radius_max <= farthest):
        raise CameraError(
            f'a center at {column:g}x{row:g} with a rim of {lens.radius_max:g} pixels is not in '
            f'an image of {width}x{height} pixels: correct --center or --radii'
        )


_GREEN, _RED = (80, 220, 80), (60, 60, 255)
_CHECK_WIDTH = 1200  # px: smaller images are framed, so that the labels of the panorama fit
_SIDES = {'FRONT': 0, 'LEFT': 90, 'BACK': 180, 'RIGHT': 270}
_LABELS_DEG = 45  # azimuth at which elevations are named
_STEP, _NEAR = 4, 0.999  # pixels among which the place of a label is looked for; its least cosine


def check_image(image: Image, unwrapper: Unwrapper) -> Image:
    """The raw image above its panorama, 1200 px wide: in both, directions red, and every ten
    degrees above and below the horizon green.
    """
    strip = _wide(unwrapper(image), _CHECK_WIDTH)
    rays = _wide(panorama_rays(unwrapper.panorama), _CHECK_WIDTH)
    _draw(strip, rays)
    raw = _wide(image, min(image.shape[1], _CHECK_WIDTH))
    height, width = raw.shape[:2]
    model = make_camera(
        unwrapper.calibration, (height, width), unwrapper.panorama, unwrapper.camera.mount_rpy
    )
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    _draw(raw, model.unproject(pixels.reshape(-1, 2)).reshape(height, width, 3))
    left = (_CHECK_WIDTH - width) // 2
    framed = np.zeros((height + len(strip), _CHECK_WIDTH, 3), np.uint8)
    framed[:height, left : left + width], framed[height:] = raw, strip
    return framed


def _wide(image: Any, width: int) -> Any:
    """A copy of an image (H, W, 3) scaled to a width."""
    height = max(round(image.shape[0] * width / image.shape[1]), 1)
    shrinks = width < image.shape[1]
    return cv2.resize(
        image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )


def _draw(drawn: Image, rays: Array) -> None:
    """Draw directions and elevations into an image whose pixels see rays (H, W, 3)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    for elevation in range(-80, 90, 10):
        above, width = z > np.sin(np.radians(elevation)), 2 if elevation else 3
        drawn[_border(above, x, width)] = _GREEN
    for seen in (x > 0, y > 0):
        drawn[_border(seen, x)] = _RED
    for elevation in range(-80, 90, 10):
        name = f'{elevation:+d} deg' if elevation else 'HORIZON'
        _write(drawn, name, rays, (_LABELS_DEG, elevation), _GREEN)
    for name, azimuth in _SIDES.items():
        _write(drawn, name, rays, (azimuth, 0), _RED)


def _border(inside: NDArray[np.bool_], seen: Array, width: int = 2) -> NDArray[np.bool_]:
    """Mask (H, W) of where a region ends, beside pixels that see something."""
    square = np.ones((width, width), np.uint8)
    border = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_GRADIENT, square)
    visible = cv2.erode(np.isfinite(seen).astype(np.uint8), square)
    return np.asarray((border > 0) & (visible > 0))


def _write(
    drawn: Image, text: str, rays: Array, toward: tuple[float, float], color: tuple[int, int, int]
) -> None:
    """Write a text where the image shows an azimuth and elevation (degrees), if it does."""
    azimuth, elevation = np.radians(toward)
    level = np.cos(elevation)
    ray = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    likeness = np.nan_to_num(rays[::_STEP, ::_STEP] @ ray, nan=-1.0)
    place = np.unravel_index(np.argmax(likeness), likeness.shape)
    if likeness[place] < _NEAR:
        return
    font = cv2.FONT_HERSHEY_SIMPLEX
    (width, height), _ = cv2.getTextSize(text, font, 0.5, 1)
    column = int(np.clip(_STEP * place[1] + 3, 2, max(drawn.shape[1] - width - 2, 2)))
    row = int(np.clip(_STEP * place[0] - 3, height + 2, max(drawn.shape[0] - 4, height + 2)))
    for ink, thickness in (((0, 0, 0), 3), (color, 1)):  # a black outline keeps it readable
        cv2.putText(drawn, text, (column, row), font, 0.5, ink, thickness, cv2.LINE_AA)


def require_own(path: Path) -> None:
    """Raise CameraError for a file that is there, and no calibration that was written here."""
    start = first_bytes(path)
    if start and not start.startswith(CALIBRATION_TITLE.encode()):
        raise CameraError(f'{path}: is no file of calibrate: give another name, or remove it')


def write_calibration(path: Path, text: str) -> None:
    """Write a calibration file, whole or not at all. Raises CameraError naming it."""
    with atomic_write(path, CameraError) as file:
        file.write(text.encode())


def write_check(path: Path, image: Image) -> None:
    """Write an image (H, W, 3) as PNG. Raises CameraError naming the file."""
    with atomic_write(path, CameraError) as file:
        file.write(encode_png(image))
