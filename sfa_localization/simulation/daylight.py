# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Daylight of the simulated garden: sun, ambient light, sky, and exposure of the camera.

Colors are BGR: of sun and ambient light the linear light of a white surface, of the sky display
brightness, the square root of the light. Day is the default, with a fixed exposure; in all other
lights the camera meters every image.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sfa_localization.data.geometry import Array
from sfa_localization.data.sphere import directions
from sfa_localization.simulation.textures import Floats, SkyLook

Color = tuple[float, float, float]

MEAN_BRIGHTNESS = 109.0
"""Mean gray level of metered images: that of the default panoramas by day."""
WHITE_BALANCE = 0.6
"""Exponent of the color cast that the white balance removes; the evening stays warm."""


@dataclass(frozen=True, slots=True)
class Daylight:
    """Light of the sun, ambient light, sky, and exposure of the camera.

    The sun stands `turn_deg` counterclockwise of the azimuth that the garden drew, at
    `elevation_deg` or, if None, at the elevation that it drew. `brightness` is the mean gray level
    of metered images, None for a fixed exposure.
    """

    sun: Color = (1.04, 1.21, 1.30)
    ambient: Color = (0.78, 0.65, 0.56)
    turn_deg: float = 0.0
    elevation_deg: float | None = None
    sky: SkyLook = field(default_factory=SkyLook)
    brightness: float | None = MEAN_BRIGHTNESS

    def toward_sun(self, rng: np.random.Generator) -> Array:
        """Unit vector (3,) toward the sun in the frame `world`; `rng` draws the garden's sun."""
        azimuth = rng.uniform(0, 2 * np.pi)
        elevation = np.radians(rng.uniform(32, 52))
        if self.elevation_deg is not None:
            elevation = np.radians(self.elevation_deg)
        azimuth += np.radians(self.turn_deg)
        return directions(azimuth, elevation)

    @property
    def balance(self) -> Floats:
        """Factor (3,) of the BGR display brightness, the camera's white balance."""
        if self.brightness is None:
            return np.ones(3, np.float32)
        cast = _illuminant(self) / _illuminant(LIGHTS['day'])
        return np.asarray((cast[1] / cast) ** (WHITE_BALANCE / 2), np.float32)


def _illuminant(light: Daylight) -> Array:
    """Linear color (3,) of a white surface under the whole sky, half turned toward the sun."""
    return np.asarray(np.array(light.sun) / 2 + np.array(light.ambient))


LIGHTS = {
    'day': Daylight(brightness=None),
    'morning': Daylight(
        sun=(0.63, 0.86, 1.05), ambient=(0.54, 0.45, 0.40), turn_deg=115.0, elevation_deg=16.0,
        sky=SkyLook(horizon=(0.80, 0.76, 0.74), fall=(0.06, 0.22, 0.34), cloud=(0.86, 0.87, 0.90),
                    cover=0.15, wind=170.0, glow=(0.10, 0.20, 0.25), hills=(0.85, 0.80, 0.80)),
    ),
    'overcast': Daylight(
        sun=(0.0, 0.0, 0.0), ambient=(1.02, 1.00, 0.96), turn_deg=40.0,
        sky=SkyLook(horizon=(0.90, 0.90, 0.90), fall=(-0.06, -0.06, -0.06),
                    cloud=(0.98, 0.98, 0.97), cover=0.55, contrast=0.15, wind=90.0,
                    hills=(0.95, 0.90, 0.90)),
    ),
    'evening': Daylight(
        sun=(0.27, 0.46, 0.77), ambient=(0.30, 0.22, 0.19), turn_deg=-130.0, elevation_deg=9.0,
        sky=SkyLook(horizon=(0.55, 0.52, 0.54), fall=(0.04, 0.14, 0.24), cloud=(0.50, 0.52, 0.60),
                    cover=0.35, wind=-130.0, glow=(0.02, 0.22, 0.45), hills=(0.62, 0.52, 0.52)),
    ),
}  # fmt: skip
"""The choices of `simulate --light`."""
