# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Finding the mirror in pictures, and camera parameters as a file with a picture to check them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.encodings import decode_compressed, encode_png
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CalibrationConfig, CameraConfig, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.files import atomic_write
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Image

_RAYS = 360
_TOLERANCE_PX = 2.0
_TRIALS = 400
_ENOUGH_TO_TELL_MOTION = 3  # pictures


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in a picture: column and row of its center and radius in pixels.

    `support` is the share of the directions around it in which an edge lies on it.
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


def read_pictures(paths: Sequence[Path]) -> list[Image]:
    """Read pictures of one camera. Raises CameraError naming the file that is unusable."""
    pictures = []
    for path in paths:
        try:
            pictures.append(decode_compressed(path.read_bytes()))
        except OSError as error:
            raise CameraError(f'{path}: {error.strerror or error}') from None
        except CameraError as error:
            raise CameraError(f'{path}: {error}') from None
        if pictures[-1].shape != pictures[0].shape:
            raise CameraError(f'{path} and {paths[0]} differ in size: give pictures of one camera')
    return pictures


def find_circles(pictures: Sequence[Image], seed: int = 0) -> MirrorCircles:
    """Find the rim of the mirror, and its hole, in pictures (H, W, 3) of one size.

    The rim is where, coming from outside, the picture first becomes bright or, with several
    pictures taken while driving, first changes: what stands out better. The hole likewise, coming
    from the center. Raises CameraError when no circle stands out.
    """
    rng = np.random.default_rng(seed)
    cues = [(cue, _threshold(cue)) for cue in _cues(pictures)]
    rims = [_find_rim(cue, threshold, rng) for cue, threshold in cues]
    rim = _best(rims)
    if rim is None:
        raise CameraError(
            'no mirror or fisheye stands out: take several pictures while driving in good light, '
            'or give --center and --radii'
        )
    holes = [_find_hole(cue, rim, threshold, rng) for cue, threshold in cues]
    return MirrorCircles(rim, _best(holes))


def _best(circles: Sequence[Circle | None]) -> Circle | None:
    known = [circle for circle in circles if circle is not None]
    return max(known, key=lambda circle: circle.support, default=None)


def _cues(pictures: Sequence[Image]) -> list[Array]:
    """What tells the mirror from its surroundings (H, W), 0..255: brightness, and change."""
    stack = [cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in pictures]
    grey = np.stack([cv2.GaussianBlur(picture, (0, 0), 1.0) for picture in stack]).astype(float)
    brightness = np.asarray(grey.mean(axis=0))
    if len(pictures) < _ENOUGH_TO_TELL_MOTION:
        return [brightness]
    change = cv2.GaussianBlur(grey.std(axis=0), (0, 0), 2.0)
    scaled = np.clip(change * 255 / max(float(np.quantile(change, 0.95)), 1e-9), 0, 255)
    return [brightness, np.asarray(scaled)]


def _threshold(cue: Array) -> float:
    """A little above the darkness around the mirror, as the darker side of Otsu's split tells."""
    coarse = np.clip(cue, 0, 255).astype(np.uint8)
    split, _ = cv2.threshold(coarse, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    dark, bright = cue[cue <= split], cue[cue > split]
    low = float(np.median(dark)) if dark.size else 0.0
    high = float(np.median(bright)) if bright.size else 255.0
    return low + 0.25 * (high - low)


def _find_rim(cue: Array, threshold: float, rng: np.random.Generator) -> Circle | None:
    middle = _middle(cue > threshold)
    if middle is None:
        return None
    rim = _fit_circle(_edges(cue, middle, threshold, outermost=True), rng)
    return rim if rim is not None and rim.support >= 0.3 else None


def _middle(bright: NDArray[np.bool_]) -> Array | None:
    """A point well inside the mirror: the middle of the largest bright area's bounding box."""
    count, _, boxes, _ = cv2.connectedComponentsWithStats(bright.astype(np.uint8))
    if count < 2:
        return None
    x, y, w, h, _ = boxes[1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))]
    return np.array([x + (w - 1) / 2, y + (h - 1) / 2])


def _edges(cue: Array, start: Array, threshold: float, outermost: bool, reach: float = 0) -> Array:
    """Points (N, 2) where the cue crosses the threshold along rays from `start`; N <= rays.

    The outermost crossing, or the innermost one. A ray that has none within `reach` pixels (or in
    the picture), or still is bright at its border, gives no point.
    """
    height, width = cue.shape
    longest = reach or float(np.hypot(height, width))
    radii = np.arange(0.0, longest, 0.25)
    angles = np.arange(_RAYS) * 2 * np.pi / _RAYS
    columns = start[0] + radii * np.cos(angles)[:, None]
    rows = start[1] + radii * np.sin(angles)[:, None]
    inside = (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
    maps = columns.astype(np.float32), rows.astype(np.float32)
    bright = (cv2.remap(cue.astype(np.float32), *maps, cv2.INTER_LINEAR) > threshold) & inside
    last = inside.sum(axis=1) - 1
    if outermost:
        index = radii.size - 1 - np.argmax(bright[:, ::-1], axis=1)
        found = bright.any(axis=1) & (index < last - 2)
    else:
        index = np.argmax(bright, axis=1)
        found = bright.any(axis=1) & (index > 0)
    picked = np.flatnonzero(found), index[found]
    return np.column_stack([columns[picked], rows[picked]])


def _fit_circle(points: Array, rng: np.random.Generator) -> Circle | None:
    """Fit a circle to points (N, 2) of which many may be wrong; None with fewer than 8."""
    if len(points) < 8:
        return None
    best = np.zeros(len(points), bool)
    for _ in range(_TRIALS):
        circle = _least_squares(points[rng.choice(len(points), 3, replace=False)])
        agree = _off(points, circle) < _TOLERANCE_PX
        if agree.sum() > best.sum():
            best = agree
    for _ in range(3):
        if best.sum() < 3:
            return None
        circle = _least_squares(points[best])
        best = _off(points, circle) < _TOLERANCE_PX
    return Circle(float(circle[0]), float(circle[1]), float(circle[2]), float(best.sum() / _RAYS))


def _least_squares(points: Array) -> Array:
    """Column, row, radius of the algebraic best circle: x^2 + y^2 = 2 a x + 2 b y + c."""
    origin = points.mean(axis=0)
    x, y = (points - origin).T
    design = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
    (a, b, c), *_ = np.linalg.lstsq(design, x**2 + y**2, rcond=None)
    return np.array([a + origin[0], b + origin[1], np.sqrt(max(c + a**2 + b**2, 0.0))])


def _off(points: Array, circle: Array) -> Array:
    return np.asarray(np.abs(np.hypot(*(points - circle[:2]).T) - circle[2]))


def _find_hole(
    cue: Array, rim: Circle, threshold: float, rng: np.random.Generator
) -> Circle | None:
    """The dark or unchanging disc about the rim's center, if there is one."""
    center = np.array([rim.column, rim.row])
    points = _edges(cue, center, threshold, outermost=False, reach=0.6 * rim.radius)
    hole = _fit_circle(points, rng)
    if hole is None or hole.support < 0.4:
        return None
    off_center = np.hypot(hole.column - rim.column, hole.row - rim.row)
    return hole if off_center < 0.1 * rim.radius else None


def camera_of_circles(
    circles: MirrorCircles, size: tuple[int, int], config: CalibrationConfig
) -> dict[str, Any]:
    """Fields of CameraConfig for a camera known by its circles; `size` is rows and columns."""
    fields: dict[str, Any] = {
        'camera_model': config.model,
        'cx': circles.rim.column,
        'cy': circles.rim.row,
        'image_width': size[1],
        'image_height': size[0],
        **_limits(circles),
    }
    if config.model == 'polar' and circles.hole is None:
        raise CameraError(
            'no inner circle was found, which the polar model needs: give --center and --radii'
        )
    if config.model == 'polar':
        return fields
    focal = float(circles.rim.radius / np.radians(config.field_of_view / 2))
    return {**fields, 'fx': focal, 'fy': focal, 'radius_min': 0.0}


def calibrate(
    pictures: Sequence[Image],
    calibration: Path | None,
    circles: MirrorCircles | None,
    config: CalibrationConfig,
    known: Mapping[str, Any],
) -> CameraConfig:
    """Camera parameters from a calibration file, or from circles, given or to be found.

    With a file, given circles only limit what is seen. `known` holds further fields of
    CameraConfig, such as its angles and how it is mounted. Raises CameraError when this does not
    tell enough.
    """
    if calibration is None:
        if not pictures:
            raise CameraError('give pictures of the camera, or --calibration')
        circles = circles or find_circles(pictures)
        fields = camera_of_circles(circles, (pictures[0].shape[0], pictures[0].shape[1]), config)
    else:
        fields = {'radius_min': 0.0, 'radius_max': 0.0, **read_calibration(calibration)}
        fields.update(_limits(circles) if circles else {})
    return CameraConfig.from_mapping({**fields, **known}, str(calibration or 'calibration'))


def _limits(circles: MirrorCircles) -> dict[str, float]:
    hole = circles.hole.radius if circles.hole else 0.0
    return {'radius_min': hole, 'radius_max': circles.rim.radius}


def given_circles(
    center: Sequence[float] | None, radii: Sequence[float] | None, pictures: Sequence[Image] = ()
) -> MirrorCircles:
    """Circles told by the user: center as column, row, and radii as hole, rim, in pixels.

    What is not told is found in the pictures (H, W, 3). Raises CameraError.
    """
    if center is None or radii is None:
        if not pictures:
            raise CameraError('without pictures, give both --center and --radii')
        found = find_circles(pictures)
        center = center or (found.rim.column, found.rim.row)
        radii = radii or (found.hole.radius if found.hole else 0.0, found.rim.radius)
    if len(center) != 2 or len(radii) != 2 or not 0 <= radii[0] < radii[1]:
        raise CameraError('--center takes COLUMNxROW, --radii takes INNERxOUTER in pixels')
    column, row = center
    hole = Circle(column, row, radii[0], 1.0) if radii[0] else None
    return MirrorCircles(Circle(column, row, radii[1], 1.0), hole)


_OF_EVERY_CAMERA = (
    *('camera_model', 'image_width', 'image_height', 'cx', 'cy', 'radius_min', 'radius_max'),
    *('axis', 'mirrored', 'mount_roll', 'mount_pitch', 'mount_yaw'),
)
_OF_MODEL = {
    'mirror': ('fx', 'fy', 'xi', 'distortion'),
    'fisheye': ('fx', 'fy', 'distortion'),
    'ocam': ('polynomial', 'affine'),
    'polar': ('angle_min', 'angle_max'),
}


def parameters_text(camera: CameraConfig) -> str:
    """The camera as a ROS parameter file: every parameter that its model uses."""
    names = _OF_EVERY_CAMERA + _OF_MODEL[camera.camera_model]
    lines = [f'    {name}: {_as_yaml(getattr(camera, name))}' for name in names]
    return '\n'.join([_PARAMETERS_HEAD, *lines, ''])


_PARAMETERS_HEAD = """\
# Camera of the omnicam node: merge into your parameter file, or pass it with
# --ros-args --params-file.
omnicam_node:
  ros__parameters:"""


def _as_yaml(value: Any) -> str:
    plain = list(value) if isinstance(value, tuple) else value
    text = str(yaml.safe_dump(plain, default_flow_style=True, width=10_000))
    return text.removesuffix('...\n').strip()


_GREEN, _RED, _WHITE = (80, 220, 80), (60, 60, 255), (255, 255, 255)


def check_picture(picture: Image, camera: CameraConfig, panorama: PanoramaConfig) -> Image:
    """The raw picture with its directions and elevations drawn in, above its panorama."""
    raw = _annotated(picture, camera, panorama)
    unwrapped = Unwrapper(camera, panorama)(picture)
    width = max(raw.shape[1], 1200)
    factor = width / unwrapped.shape[1]
    size = (width, max(round(unwrapped.shape[0] * factor), 1))
    resized = cv2.resize(unwrapped, size, interpolation=cv2.INTER_LINEAR)
    strip = _labelled(np.asarray(resized, np.uint8), panorama)
    side = (width - raw.shape[1]) // 2
    rest = width - raw.shape[1] - side
    framed = cv2.copyMakeBorder(raw, 0, 0, side, rest, cv2.BORDER_CONSTANT)
    return np.vstack([np.asarray(framed, np.uint8), strip])


def _annotated(picture: Image, camera: CameraConfig, panorama: PanoramaConfig) -> Image:
    drawn = picture.copy()
    model = make_camera(camera, (picture.shape[0], picture.shape[1]), panorama)
    turn = np.radians(45.0 + np.arange(0, 361, 1.0))
    for elevation in (panorama.elevation_min, 0.0, panorama.elevation_max):
        ring = model.project(_rays(turn, np.radians(elevation)))
        _draw(drawn, ring, _GREEN, f'{elevation:+g} deg')
    heights = np.radians(np.linspace(panorama.elevation_min, panorama.elevation_max, 50))
    for name, azimuth in (('FRONT', 0.0), ('LEFT', 90.0), ('BACK', 180.0), ('RIGHT', 270.0)):
        spoke = model.project(_rays(np.radians(azimuth), heights))
        _draw(drawn, spoke, _RED, name)
    return drawn


def _rays(azimuth: Any, elevation: Any) -> Array:
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _draw(drawn: Image, line: Array, color: tuple[int, int, int], name: str) -> None:
    """Draw the seen parts of a line (N, 2) and its name at its end."""
    seen = np.asarray(np.isfinite(line).all(axis=1))
    for run in np.split(np.arange(len(line)), np.flatnonzero(np.diff(seen)) + 1):
        if seen[run[0]]:
            points = np.rint(line[run]).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(drawn, [points], False, color, 1, cv2.LINE_AA)
    if seen.any():
        _write(drawn, name, line[np.flatnonzero(seen)[-1]], color)


def _write(drawn: Image, text: str, place: Array, color: tuple[int, int, int]) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    limit = np.array([drawn.shape[1] - width - 2, drawn.shape[0] - 4])
    column, row = np.clip(np.rint(place).astype(int), [2, height + 2], np.maximum(limit, 2))
    for ink, thickness in (((0, 0, 0), 3), (color, 1)):
        cv2.putText(
            drawn,
            text,
            (int(column), int(row)),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.5,
            ink,
            thickness,
            cv2.LINE_AA,
        )


def _labelled(strip: Image, panorama: PanoramaConfig) -> Image:
    """The panorama with its directions and its horizon."""
    height, width = strip.shape[:2]
    sides = (
        ('BACK', 'LEFT', 'FRONT', 'RIGHT')
        if panorama.clockwise
        else ('BACK', 'RIGHT', 'FRONT', 'LEFT')
    )
    span = panorama.elevation_max - panorama.elevation_min
    horizon = panorama.elevation_max / span * height - 0.5
    if 0 <= horizon < height:
        cv2.line(strip, (0, round(horizon)), (width, round(horizon)), _GREEN, 1)
    for place, name in enumerate(sides):
        column = place * width // 4
        cv2.line(strip, (column, 0), (column, height), _RED, 1)
        _write(strip, name, np.array([column + 4, height - 6]), _WHITE)
    return strip


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that is there whole or not at all. Raises CameraError naming it."""
    with atomic_write(path, CameraError, make_folder=True) as file:
        file.write(data)


def write_check(path: Path, picture: Image) -> None:
    """Write a picture as PNG. Raises CameraError naming the file."""
    write_whole(path, encode_png(picture))
