# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Ray-cast images of a scene of triangles for an omnidirectional camera.

Rays are cast along a *dome*, a grid of elevations and azimuths around the camera. The dome is then
resampled to a panorama or to the raw image of a mirror. The light of sun and sky is computed once
for every vertex, so an image costs one ray per point of the dome.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray

from sfa_localization.camera.leveling import resampled
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import Array
from sfa_localization.data.sphere import directions, rotation
from sfa_localization.simulation.daylight import LIGHTS, Daylight
from sfa_localization.simulation.textures import (
    SKY_COLUMNS,
    SKY_HIGHEST_DEG,
    SKY_LOWEST_DEG,
    SKY_ROWS,
    SURFACE_INDEX,
    Atlas,
    Floats,
    sky,
)

BOUNCE = 0.22
METER_ROUNDS = 4  # iterations of metering, since overexposed pixels count as white
METER_COLUMNS = 5  # one column of so many is metered


@dataclass(frozen=True, slots=True)
class Shape:
    """Triangles of one surface: `vertices` (V, 3) m, `normals` (V, 3), `faces` (F, 3).

    `tint` is the BGR albedo, `shade` (V,) a factor of brightness; `plant` names the kind of plant,
    '' for everything else.
    """

    vertices: Array
    normals: Array
    faces: NDArray[np.int64]
    surface: str
    tint: tuple[float, float, float]
    shade: Array
    plant: str = ''


@dataclass(frozen=True, slots=True)
class Light:
    """The light at a moment: factors of the sun and of all light, and the tint toward red."""

    sun: float = 1.0
    exposure: float = 1.0
    warmth: float = 0.0

    @property
    def gain(self) -> Floats:
        """Factor (3,) of the BGR brightness on display."""
        tone = np.array([1 - self.warmth, 1, 1 + self.warmth])
        return np.asarray(np.sqrt(self.exposure) * tone, np.float32)


@dataclass(frozen=True, slots=True)
class Dome:
    """Rays of the camera in the robot's axes: `rays` (rows, columns, 3), x ahead, z up.

    `columns` are those of a whole turn. Those of a grid of elevations and azimuths, which `build`
    makes, look toward azimuth -(c + 0.5 - columns / 2) * 2 pi / columns, clockwise.
    """

    elevations_rad: Array
    columns: int
    rays: Floats

    @classmethod
    def build(cls, elevations_rad: Array, columns: int) -> Dome:
        """Rays at falling elevations (R,) and evenly spaced azimuths."""
        azimuth = -(np.arange(columns) + 0.5 - columns / 2) * 2 * np.pi / columns
        e, a = np.meshgrid(elevations_rad, azimuth, indexing='ij')
        return cls(elevations_rad, columns, directions(a, e).astype(np.float32))

    def wrapped_pixels(self, azimuth: Array, elevation: Array) -> tuple[Floats, Floats]:
        """Columns and rows (N,) of directions (N,) rad, 0 where NaN, in an image of the dome that
        repeats a column on either side.
        """
        column = (0.5 - azimuth / (2 * np.pi)) * self.columns - 0.5 + 1
        rising = self.elevations_rad[::-1]
        row = np.interp(elevation, rising, np.arange(len(rising))[::-1])
        return np.nan_to_num(column).astype(np.float32), np.nan_to_num(row).astype(np.float32)

    def turned(self, yaw: float, roll: float = 0.0, pitch: float = 0.0) -> Floats:
        """The rays (rows, columns, 3) in the frame `world`, by yaw, roll and pitch, rad."""
        return np.asarray(self.rays @ rotation(roll, pitch, yaw).T.astype(np.float32))


@dataclass(frozen=True, slots=True)
class View:
    """A kind of image: its dome, and the function that turns dome and gain into the image."""

    dome: Dome
    image: Callable[[Floats, Floats], Floats]


def panorama_view(config: PanoramaConfig) -> View:
    """A panorama: each of its pixels is the mean of 2 x 2 rays."""
    band = np.radians([config.elevation_max, config.elevation_min])
    rows = band[0] - (np.arange(2 * config.height) + 0.5) * (band[0] - band[1]) / config.height / 2
    size = (config.width, config.height)

    def image(dome: Floats, gain: Floats) -> Floats:
        small = cv2.resize(dome, size, interpolation=cv2.INTER_AREA) * gain
        return np.asarray(small if config.clockwise else small[:, ::-1], np.float32)

    return View(Dome.build(rows, 2 * config.width), image)


def raw_view(unproject: Callable[[Array], Array], size: tuple[int, int]) -> View:
    """The raw image of a camera, in full resolution within the default panorama.

    `unproject` maps pixels (N, 2) to unit rays (N, 3) in the robot's axes, NaN where nothing is
    visible; `size` is (rows, columns). Below the dome the image shows the robot itself.
    """
    config = PanoramaConfig()
    columns, rows = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    rays = unproject(np.stack([columns.ravel(), rows.ravel()], -1).astype(float))
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    elevation = np.arcsin(np.clip(rays[:, 2], -1, 1))
    dome = Dome.build(_rows_for(elevation, config), 2 * config.width)
    map_x, map_y = (part.reshape(size) for part in dome.wrapped_pixels(azimuth, elevation))
    below = elevation < dome.elevations_rad[-1] - np.radians(1)
    cover = np.where(np.isnan(elevation), 1.0, below).reshape(size).astype(np.float32)
    hull = np.nan_to_num(_hull(azimuth, elevation)).reshape(*size, 3)

    def image(dome_image: Floats, gain: Floats) -> Floats:
        scene = resampled(dome_image, map_x, map_y)
        return np.asarray((scene * (1 - cover[..., None]) + hull * cover[..., None]) * gain)

    return View(dome, image)


def pixel_view(
    unproject: Callable[[Array], Array], size: tuple[int, int], pixel_rad: float
) -> View:
    """The image of a camera that does not see all around: a ray for each pixel, black where
    `unproject`, as of `raw_view`, sees nothing. `pixel_rad` is the angle of a pixel in the center.
    """
    columns, rows = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    rays = unproject(np.stack([columns.ravel(), rows.ravel()], -1).astype(float))
    blind = np.isnan(rays).any(1)
    rays[blind] = rays[~blind].mean(0)
    grid = rays.reshape(*size, 3).astype(np.float32)
    seen = (~blind).reshape(*size, 1)

    def image(dome_image: Floats, gain: Floats) -> Floats:
        return np.asarray(dome_image * seen * gain, np.float32)

    return View(Dome(np.zeros(size[0]), round(2 * np.pi / pixel_rad), grid), image)


def _rows_for(elevation: Array, config: PanoramaConfig) -> Array:
    """Falling elevations (R,) rad: fine in the panorama's band, coarse outside."""
    step = np.radians(config.elevation_max - config.elevation_min) / config.height / 2
    top = np.radians(config.elevation_max)
    bottom = np.radians(config.elevation_min)
    fine = np.arange(top + 2.5 * step, bottom - 3 * step, -step)
    highest = np.nanmax(elevation)
    lowest = max(np.nanmin(elevation), HULL_RAD)
    above = np.arange(fine[0] + 2 * step, highest + 2 * step, 2 * step)[::-1]
    below = np.arange(fine[-1] - 4 * step, lowest - 4 * step, -4 * step)
    return np.concatenate([above, fine, below])


HULL_RAD = float(np.radians(-38.0))


def _hull(azimuth: Array, elevation: Array) -> Floats:
    """Brightness (N, 3) of the robot itself: a dark deck with an orange bonnet in front."""
    light = 70 + 18 * np.cos(azimuth - 0.7) + 12 * np.sin(6 * elevation)
    bonnet = (np.cos(azimuth) > 0.55) & (elevation > np.radians(-70))
    tint = np.where(bonnet[:, None], [0.35, 1.1, 2.2], [0.95, 0.9, 0.85])
    return np.asarray(light[:, None] * tint, np.float32)


class Scene:
    """Triangles with textures under a sun and a sky."""

    def __init__(
        self,
        shapes: Sequence[Shape],
        sun: Array,
        rng: np.random.Generator,
        daylight: Daylight | None = None,
    ) -> None:
        """Index the triangles of `shapes` and light them; `sun` (3,) points toward it."""
        self.sun = sun
        self._daylight = daylight or LIGHTS['day']
        self._atlas = Atlas.build(rng)
        self._sky = sky(rng, self._daylight.sky, sun)
        offsets = np.cumsum([0] + [len(shape.vertices) for shape in shapes])
        self._vertices = np.concatenate([shape.vertices for shape in shapes])
        self._faces = np.concatenate(
            [shape.faces + start for shape, start in zip(shapes, offsets, strict=False)]
        )
        self._embree = EmbreeScene()
        self._mesh = TriangleMesh(self._embree, self._vertices[self._faces].astype(np.float32))
        light = self._light_vertices(shapes, sun, rng)
        self._table = np.concatenate([self._corners(light), self._constants(shapes)], 1)

    def _light_vertices(
        self, shapes: Sequence[Shape], sun: Array, rng: np.random.Generator
    ) -> Array:
        """Light (V, 2) of every vertex from the sun, and from sky and surroundings."""
        normals = np.concatenate([shape.normals for shape in shapes])
        shade = np.concatenate([shape.shade for shape in shapes])
        start = (self._vertices + 0.03 * normals).astype(np.float32)
        toward = [sun + 0.03 * rng.standard_normal(3) for _ in range(4)]  # the sun is a disc
        sunny = np.mean([self._free(start, ray) for ray in toward], 0)
        sunny *= np.clip(normals @ sun, 0, None)
        open_sky = np.mean([self._open(start, normals, rng) for _ in range(24)], 0)
        return np.stack([sunny * shade, (open_sky + BOUNCE * (1 - open_sky)) * shade], -1)

    def _open(self, start: Floats, normals: Array, rng: np.random.Generator) -> Array:
        """Whether a random ray (cosine-weighted) from every vertex reaches the sky (V,)."""
        ray = rng.standard_normal(normals.shape)
        ray = normals + ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return np.asarray(self._free(start, ray) * (ray[:, 2] > 0))

    def _free(self, start: Floats, rays: Array) -> Array:
        """1 where nothing lies on the ray from start (V, 3) along rays (V, 3) or (3,), else 0."""
        rays = np.broadcast_to(rays, start.shape).astype(np.float32)
        hits: Array = self._embree.run(start, rays, query='OCCLUDED')
        return (hits < 0).astype(float)

    def _corners(self, light: Array) -> Floats:
        """Per face (F, 12): texture meters and light at corner 0, and changes to corners 1, 2."""
        corners = self._vertices[self._faces]
        normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        axes = np.array([[1, 2], [0, 2], [0, 1]])[normal.argmax(1)]
        meters = np.take_along_axis(corners, axes[:, None, :], 2)
        values = np.concatenate([meters, light[self._faces]], 2)
        parts = [values[:, 0], values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]]
        return np.concatenate(parts, 1).astype(np.float32)

    def _constants(self, shapes: Sequence[Shape]) -> Floats:
        """Per face (F, 4): BGR albedo and index of the surface."""
        rows = [[*shape.tint, SURFACE_INDEX[shape.surface]] for shape in shapes]
        return np.repeat(rows, [len(shape.faces) for shape in shapes], 0).astype(np.float32)

    def look(self, position: Array, turn: ArrayLike, dome: Dome, light: Light) -> Floats:
        """Brightness 0..255 (rows, columns, 3) BGR of a dome about `position` (3,) m, of a robot
        with yaw, or yaw, roll and pitch `turn` rad.
        """
        rays = dome.turned(*np.ravel(turn).tolist())
        start = np.broadcast_to(position, (rays.shape[0] * rays.shape[1], 3)).astype(np.float32)
        hits = self._embree.run(start, rays.reshape(-1, 3), output=True)
        surfaces = self._surfaces(hits, rays, 2 * np.pi / dome.columns, light)
        missed = (hits['primID'] < 0).reshape(rays.shape[:2])
        seen = np.asarray(np.where(missed[..., None], self._sky_at(rays), surfaces))
        target = self._daylight.brightness
        return seen if target is None else metered(seen * self._daylight.balance, dome, target)

    def _surfaces(
        self, hits: dict[str, NDArray[np.float32]], rays: Floats, pixel_rad: float, light: Light
    ) -> Floats:
        shape = rays.shape[:2]
        rows = self._table.take(np.maximum(hits['primID'], 0), 0)
        values = (
            rows[:, :4] + hits['u'][:, None] * rows[:, 4:8] + hits['v'][:, None] * rows[:, 8:12]
        )
        footprint = _footprint(hits, rays, pixel_rad)
        sampled = (values[:, 0], values[:, 1], rows[:, 15], footprint)
        texture = self._atlas.sample(*(part.reshape(shape) for part in sampled))
        hour = self._daylight
        sun = np.array(hour.sun, np.float32)
        ambient = np.array(hour.ambient, np.float32)
        lit = values[:, 2:3] * (sun * light.sun) + values[:, 3:4] * ambient
        return np.asarray(texture * np.sqrt(np.maximum(lit * rows[:, 12:15], 0)).reshape(*shape, 3))

    def _sky_at(self, rays: Floats) -> Floats:
        """The sky (rows, columns, 3) along rays."""
        x = np.mod(np.arctan2(rays[..., 1], rays[..., 0]) / (2 * np.pi), 1) * SKY_COLUMNS
        degrees = np.degrees(np.arcsin(np.clip(rays[..., 2], -1, 1)))
        y = (SKY_HIGHEST_DEG - degrees) / (SKY_HIGHEST_DEG - SKY_LOWEST_DEG) * (SKY_ROWS - 1)
        grid = np.asarray(x, np.float32), np.asarray(y, np.float32)
        return np.asarray(cv2.remap(self._sky, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def _footprint(hits: dict[str, NDArray[np.float32]], rays: Floats, pixel_rad: float) -> Floats:
    """Size (N,) in m of a pixel on the surface that each of N rays hits."""
    normal = hits['Ng']
    slant = np.abs(np.einsum('ij,ij->i', normal, rays.reshape(-1, 3)))
    slant /= np.sqrt(np.einsum('ij,ij->i', normal, normal)) + 1e-12
    return np.asarray(hits['tfar'] * pixel_rad / np.sqrt(slant + 0.01))


def metered(image: Floats, dome: Dome, target: float) -> Floats:
    """The image of a dome, exposed to the mean gray `target` in the band of the default panorama.

    Overexposed pixels count as white.
    """
    config = PanoramaConfig()
    degrees = np.degrees(dome.elevations_rad)
    band = (degrees <= config.elevation_max) & (degrees >= config.elevation_min)
    seen = image[band if band.any() else slice(None)][:, ::METER_COLUMNS]
    gain = 1.0
    for _ in range(METER_ROUNDS):
        gain *= target / max(float(np.minimum(gain * seen, 255).mean()), 1e-3)
    return np.asarray(image * np.float32(gain))
