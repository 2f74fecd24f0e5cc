# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What a few images tell about a lens: its kind and rim, and the models that may fit a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sfa_localization.camera import kinds, lens_models
from sfa_localization.camera.calibration import Circle, MirrorCircles, find_circles
from sfa_localization.camera.lens_models import LensCircle, LensModel
from sfa_localization.camera.lenses import CameraModel, make_camera
from sfa_localization.camera.point_tracks import changing
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.data.errors import CameraError
from sfa_localization.data.geometry import Mask
from sfa_localization.data.rig import Quantity
from sfa_localization.data.run import Image

_CENTERED = 0.004  # of the radius: standard deviation of the lens's center about that of its rim
_UNCERTAIN = 0.03  # the same for a rim that is hardly visible
# of a rim's directions; of its disc that changes
_CLEAR_SUPPORT = 0.9
_CLEAR_SHARE = 0.95
_EDGE_STD = np.radians(20.0)  # of the elevation of an edge of a panorama
_STILL = 0.2  # share of the area beyond a rim, or in a hole, that changes
_CONTRAST = 0.05  # relative difference of brightness that tells the sky from the ground


@dataclass(frozen=True, slots=True)
class LensGuess:
    """A kind of camera (see `kinds`), its rims, and what is known of its calibration."""

    kind: str
    circles: tuple[LensCircle, ...]
    base: LensCalibration

    @classmethod
    def of(cls, samples: Sequence[Image]) -> LensGuess:
        """From images (H, W, 3) from all over a drive. Raises CameraError for ordinary cameras."""
        height, width = samples[0].shape[:2]
        geometry = kinds.guess_geometry(samples)
        kind = kinds.CameraKind(*geometry[:2], width, height)
        base = LensCalibration(
            image_width=width, image_height=height, radius_min=0.0, radius_max=0.0
        )
        if kind.lack:
            raise CameraError(f'{kind}: {kind.lack}')
        if kind.is_panorama:
            return cls(kind.name, (), base)
        if kind.name == kinds.DUAL_FISHEYE:
            halves = [sample[:, :height] for sample in samples], [s[:, height:] for s in samples]
            first, second = map(_circle, halves, geometry.circles)
            second = replace(second, column=second.column + width - height)
            return cls(kind.name, (first, second), base)
        circle = _circle(samples, *geometry.circles)
        corner = float(np.hypot(height, width)) / 2
        limit = circle.radius if circle.radius < corner else 0.0
        base = replace(base, radius_min=circle.hole, radius_max=limit)
        return cls(kind.name, (circle,), base)

    @property
    def cameras(self) -> list[CameraModel]:
        """Two guesses, whose images rotate in opposite directions as the robot turns."""
        (model, *_), (other, *_) = self.models(0), self.models(1)
        return [_camera(model, self.base), _camera(other, self.base)]

    def models(self, direction: int) -> list[LensModel]:
        """The models of lenses whose images rotate as those of camera `direction`."""
        base = self.base
        mirrored = ('no', 'yes')[direction]
        if self.kind == kinds.DUAL_FISHEYE:
            return [lens_models.dual_fisheye(base, self.circles, upside_down=bool(direction))]
        if not self.circles:
            base = replace(base, camera_model='equirectangular', mirrored=mirrored)
            usual = PanoramaConfig().sphere
            edges = [Quantity(edge, _EDGE_STD) for edge in (usual.low, usual.high)]
            edges = [] if self.kind == kinds.EQUIRECTANGULAR else edges
            return [lens_models.equirectangular(base, edges)]
        (circle,) = self.circles
        other = ('yes', 'no')[direction]
        up = replace(base, axis='up', mirrored=mirrored)
        down = replace(base, axis='down', mirrored=other)
        fisheyes = [lens_models.fisheye(lens, circle) for lens in (up, down)]
        return [*fisheyes, lens_models.mirror(down, circle)]

    def sides(self, horizon: float, samples: Sequence[Image]) -> tuple[str, ...]:
        """Where the center of the image may look (up, down, forward), as what is beyond one side of
        the `horizon`, px, is brighter: the sky, or a ceiling.
        """
        if len(self.circles) != 1:
            return ('forward',)
        contrast = self._contrast(horizon, samples)
        if abs(contrast) < _CONTRAST:
            return ('up', 'down')
        return ('down',) if contrast > 0 else ('up',)

    def _contrast(self, horizon: float, samples: Sequence[Image]) -> float:
        """By how much the ring outside of the horizon is brighter than the one inside, relative to
        both.
        """
        (circle,) = self.circles
        height, width = samples[0].shape[:2]
        rows, columns = np.mgrid[:height, :width]
        radius = np.hypot(columns - circle.column, rows - circle.row)
        mean = np.mean([sample.mean(axis=2) for sample in samples], axis=0)
        inside = mean[(radius > max(0.6 * horizon, circle.hole)) & (radius < 0.95 * horizon)]
        outside = mean[(radius > 1.05 * horizon) & (radius < min(1.5 * horizon, circle.radius))]
        if not (inside.size and outside.size):
            return 0.0
        bright = float(outside.mean())
        dark = float(inside.mean())
        return (bright - dark) / (bright + dark + 1e-9)


def _camera(model: LensModel, base: LensCalibration) -> CameraModel:
    """The camera that a model expects."""
    lens = model.calibration({name: quantity.value for name, quantity in model.prior.items()})
    roll = model.prior.get('roll', Quantity(0.0, 0.0)).value
    size = base.image_height, base.image_width
    return make_camera(lens, size, mount_rpy=(float(np.degrees(roll)), 0.0, 0.0))


def _circle(samples: Sequence[Image], circles: MirrorCircles) -> LensCircle:
    """The rim with its hole; the whole image where it is no rim, as things move beyond it."""
    moves = changing(samples)
    rim = circles.rim
    hole = circles.hole
    height, width = moves.shape
    hole_radius = hole.radius if hole and not _share(moves, hole, 0.0, 0.8) > _STILL else 0.0
    if _share(moves, rim, 1.1, np.inf) > _STILL:
        radius = float(np.hypot(height, width)) / 2
        center = (width - 1) / 2, (height - 1) / 2
        return LensCircle(*center, radius, _UNCERTAIN * radius, hole_radius)
    clear = _clear_rim(moves, rim)
    if clear is None:
        return LensCircle(rim.column, rim.row, rim.radius, _UNCERTAIN * rim.radius, hole_radius)
    return LensCircle(*clear, _CENTERED * clear[2], hole_radius)


def _share(moves: Mask, circle: Circle, nearest: float, farthest: float) -> float:
    """The share that moves (H, W) between two radii, given as multiples of that of a circle."""
    rows, columns = np.mgrid[: moves.shape[0], : moves.shape[1]]
    radius = np.hypot(columns - circle.column, rows - circle.row) / circle.radius
    ring = moves[(radius >= nearest) & (radius < farthest)]
    return float(ring.mean()) if ring.size else 0.0


def rim_of(samples: Sequence[Image]) -> tuple[float, float, float] | None:
    """Column, row and radius, px, of a rim in images (H, W, 3) that is clear; None without."""
    try:
        return _clear_rim(changing(samples), find_circles(samples).rim)
    except CameraError:
        return None


def _clear_rim(moves: Mask, rim: Circle) -> tuple[float, float, float] | None:
    """The rim, or the smallest circle around what moves (H, W) where that is clearer."""
    if rim.support >= _CLEAR_SUPPORT:
        return rim.column, rim.row, rim.radius
    rows, columns = np.nonzero(moves)
    if not len(rows):
        return None
    points = np.column_stack([columns, rows]).astype(np.float32)
    (column, row), radius = cv2.minEnclosingCircle(points)
    share = cv2.contourArea(cv2.convexHull(points)) / (np.pi * radius**2)
    return (float(column), float(row), float(radius)) if share >= _CLEAR_SHARE else None
