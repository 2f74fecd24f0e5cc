# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Procedural textures of the simulated garden: tileable surfaces with mip levels, and the sky.

Values are display brightness, the square root of reflected light; images are BGR. The texture of a
surface covers PERIOD_M by PERIOD_M meters and repeats without a seam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sfa_localization.data.run import Image

Floats = NDArray[np.float32]

TILE = 512
PERIOD_M = 4.0
LEVELS = 7
SKY_ROWS = 384
SKY_COLUMNS = 2048
SKY_LOWEST_DEG = -6.0
SKY_HIGHEST_DEG = 90.0


def noise(
    rng: np.random.Generator, low: float, high: float, stretch: float = 1.0, fall: float = 1.0
) -> Floats:
    """Tileable noise (TILE, TILE) of unit variance, between `low` and `high` cycles per tile.

    `stretch` > 1 draws it out into vertical streaks; amplitudes fall with frequency ** `fall`.
    """
    across = np.fft.fftfreq(TILE)[None] * TILE
    along = np.fft.fftfreq(TILE)[:, None] * TILE * stretch
    cycles = np.hypot(across, along)
    spectrum = np.where((cycles >= low) & (cycles <= high), np.maximum(cycles, 1) ** -fall, 0)
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((TILE, TILE))) * spectrum).real
    return np.asarray(field / field.std(), np.float32)


def _colored(brightness: Floats, hue: Floats | float = 0.0) -> Floats:
    """Stack to BGR; a positive `hue` makes it redder, a negative one bluer."""
    blue = brightness - hue
    green = brightness + 0 * hue
    red = brightness + hue
    return np.stack(np.broadcast_arrays(blue, green, red), -1).astype(np.float32)


def _cells(rng: np.random.Generator, wide: int, high: int, joint: int, shift: float) -> Floats:
    """Rectangles of wide x high pixels, of random brightness, with dark joints between them."""
    row = np.arange(TILE)[:, None] // high
    column = (np.arange(TILE)[None] + (row * int(shift * wide))) % TILE
    shades = 0.80 + 0.07 * rng.standard_normal((TILE // high, TILE // wide))
    cells = shades[row, column // wide]
    gap = (column % wide < joint) | (np.arange(TILE)[:, None] % high < joint)
    return np.asarray(np.where(gap, 0.55, cells), np.float32)


def _stones(rng: np.random.Generator) -> Floats:
    """Rubble: the Voronoi cells of random points, dark at their borders."""
    points = rng.uniform(0, TILE, (320, 2))
    rows, columns = np.mgrid[0:TILE, 0:TILE] + 0.5
    pixels = np.stack([rows.ravel(), columns.ravel()], -1)
    distance, nearest = cKDTree(points, boxsize=TILE).query(pixels, 2)
    shades = 0.78 + 0.10 * rng.standard_normal(len(points))
    edge = np.clip((distance[:, 1] - distance[:, 0]) / 4, 0, 1)
    field = shades[nearest[:, 0]] * (0.6 + 0.4 * edge)
    return _colored(field.reshape(TILE, TILE).astype(np.float32) + 0.04 * noise(rng, 30, 160))


_ROOF_SHADE = np.float32(0.15) * (np.arange(TILE, dtype=np.float32)[:, None] % 32 / 32)
SURFACES: dict[str, Callable[[np.random.Generator], Floats]] = {
    'plain': lambda rng: _colored(0.85 + 0.03 * noise(rng, 2, 60)),
    'grass': lambda rng: _colored(
        0.76 + 0.09 * noise(rng, 20, 220) + 0.05 * noise(rng, 2, 14), 0.035 * noise(rng, 2, 40)
    ),
    'leaves': lambda rng: _colored(
        0.72 + 0.12 * noise(rng, 6, 24) + 0.13 * noise(rng, 24, 120), 0.04 * noise(rng, 8, 60)
    ),
    'bark': lambda rng: _colored(0.72 + 0.15 * noise(rng, 16, 160, stretch=4)),
    'boards': lambda rng: _colored(_cells(rng, 16, TILE, 2, 0) + 0.06 * noise(rng, 8, 160, 6)),
    'bricks': lambda rng: _colored(_cells(rng, 32, 16, 2, 0.5) + 0.04 * noise(rng, 20, 160)),
    'plaster': lambda rng: _colored(0.86 + 0.035 * noise(rng, 1, 10) + 0.03 * noise(rng, 30, 200)),
    'stones': _stones,
    'roof': lambda rng: _colored(np.asarray(_cells(rng, 32, 32, 2, 0.5) - _ROOF_SHADE)),
    'paving': lambda rng: _colored(_cells(rng, 64, 64, 3, 0) + 0.05 * noise(rng, 10, 160)),
}
SURFACE_INDEX = {name: index for index, name in enumerate(SURFACES)}


@dataclass(frozen=True, slots=True)
class Atlas:
    """All surfaces at all mip levels in one BGR image: a row of tiles per surface."""

    pixels: Image

    @classmethod
    def build(cls, rng: np.random.Generator) -> Atlas:
        """Draw every surface."""
        return cls(np.concatenate([_strip(surface(rng)) for surface in SURFACES.values()]))

    def sample(self, u: Floats, v: Floats, surface: Floats, footprint_m: Floats) -> Image:
        """Colors (..., 3) at meters (u, v) on surfaces by index, averaged over footprint_m."""
        texel = PERIOD_M / TILE
        widest = np.minimum(footprint_m, texel * 2.0**LEVELS)
        level = np.clip(np.rint(np.log2(widest / texel + 1e-6)), 0, LEVELS - 1)
        side = np.exp2(-level) * TILE
        # The wider levels lie to the left, each with two columns of padding.
        start = 2 * TILE - 2 * side + 2 * level
        x = start + 0.5 + _fraction(u) * side
        y = surface * (TILE + 2) + 0.5 + _fraction(v) * side
        return np.asarray(cv2.remap(self.pixels, x, y, cv2.INTER_LINEAR), np.uint8)


def _fraction(meters: Floats) -> Floats:
    turns = meters * np.float32(1 / PERIOD_M)
    return np.asarray(turns - np.floor(turns), np.float32)


def _strip(texture: Floats) -> Image:
    """One surface's levels side by side, each with a wrapped border of one pixel."""
    strip = []
    for level in range(LEVELS):
        side = TILE >> level
        tile = cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA)
        tile = np.pad(tile, ((1, TILE + 1 - side), (1, 1), (0, 0)), mode='wrap')
        strip.append(np.clip(np.rint(tile * 255), 0, 255).astype(np.uint8))
    return np.concatenate(strip, 1)


@dataclass(frozen=True, slots=True)
class SkyLook:
    """A sky in display brightness, BGR: `horizon`, `fall` from there up to the zenith, and clouds.

    Clouds have a color `cloud`, a mean `cover` and a `contrast`; `wind` shifts them by pixels of
    their noise. `glow` is added around the sun; `hills` are factors of the hills' color.
    """

    horizon: tuple[float, float, float] = (0.93, 0.74, 0.55)
    fall: tuple[float, float, float] = (0.05, 0.18, 0.28)
    cloud: tuple[float, float, float] = (0.95, 0.94, 0.93)
    cover: float = 0.25
    contrast: float = 0.45
    wind: float = 0.0
    glow: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hills: tuple[float, float, float] = (1.0, 1.0, 1.0)


def sky(rng: np.random.Generator, look: SkyLook, sun: NDArray[np.float64]) -> Image:
    """Sky with clouds, haze and far hills: BGR (SKY_ROWS, SKY_COLUMNS, 3), highest row first.

    Columns grow counterclockwise from the world's +x axis; `sun` (3,) points toward the sun.
    """
    elevation = np.linspace(SKY_HIGHEST_DEG, SKY_LOWEST_DEG, SKY_ROWS, dtype=np.float32)[:, None]
    azimuth = np.linspace(0, 2 * np.pi, SKY_COLUMNS, endpoint=False, dtype=np.float32)[None]
    height = np.clip(elevation / 60, 0, 1)
    blue = np.array(look.horizon, np.float32) - height[..., None] * look.fall
    white = np.array(look.cloud, np.float32)
    color = _mix(blue.astype(np.float32), white, _clouds(rng, elevation, azimuth, look))
    color = color + _glow(elevation, azimuth, sun)[..., None] * np.array(look.glow, np.float32)
    for distance in (1.0, 0.5):
        hills = 0.6 + 2.2 * (1.2 - distance) + 1.1 * _outline(rng, azimuth)
        cover = np.clip((hills - elevation) / 0.3 + 0.5, 0, 1)
        green = np.array([0.42, 0.44, 0.38], np.float32) * (0.55 + 0.55 * distance)
        color = _mix(color, (green * look.hills).astype(np.float32), cover)
    return np.clip(np.rint(color * 255), 0, 255).astype(np.uint8)


def _mix(below: Floats, above: Floats, cover: Floats) -> Floats:
    return np.asarray(below + (above - below) * cover[..., None], np.float32)


def _glow(elevation: Floats, azimuth: Floats, sun: NDArray[np.float64]) -> Floats:
    """1 toward the sun, 1/e at 0.7 rad from it; elevations (R, 1) degrees, azimuths (1, C) rad."""
    up = np.radians(elevation)
    level = np.cos(azimuth) * sun[0] + np.sin(azimuth) * sun[1]
    toward = np.clip(np.cos(up) * level + np.sin(up) * sun[2], -1, 1)
    return np.asarray(np.exp(-((np.arccos(toward) / 0.7) ** 2)), np.float32)


def _clouds(rng: np.random.Generator, elevation: Floats, azimuth: Floats, look: SkyLook) -> Floats:
    field = noise(rng, 2, 50, fall=2.0)
    radius = 75 / (np.radians(np.maximum(elevation, 0)) + 0.35)
    x, y = (np.mod(256 + look.wind + radius * f(azimuth), TILE) for f in (np.cos, np.sin))
    clouds = cv2.remap(
        field,
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return np.asarray(np.clip(look.cover + look.contrast * clouds, 0, 0.9), np.float32)


def _outline(rng: np.random.Generator, azimuth: Floats) -> Floats:
    """A wavy line around the horizon, of about unit height."""
    waves = np.zeros_like(azimuth)
    for cycles in (1, 2, 3, 5, 8, 13, 21, 34, 55, 89):
        waves += rng.normal() / cycles**0.6 * np.sin(cycles * azimuth + rng.uniform(0, 6.3))
    return 0.6 * waves
