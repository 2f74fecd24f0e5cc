# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A learned lens in words, beside the one that was described, and the panorama that fits it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfa_localization.camera.learned_lens import LearnedLens
from sfa_localization.camera.lenses import make_camera
from sfa_localization.camera.settings import LensCalibration, PanoramaConfig
from sfa_localization.data.geometry import Complex, wrap_angle
from sfa_localization.data.rig import Quantity
from sfa_localization.data.sphere import directions

_MARGIN_DEG = 1.0  # inside of what the lens sees: its edge is blurred
_BELOW_DEG = -3.0  # what lies lower shows by parallax where a robot is
# of a difference: it matters, and exceeds so many deviations
_LEAST_DEG = 1.5
_CERTAIN = 4.0
_LEAST_TURN_DEG = 3.0
_WORSE = 0.25  # quantile of the cosine
_BESIDE = 0.1  # sine of elevations at which a stretch of all hardly shows


def sentence(lens: LearnedLens) -> str:
    """Kind, horizon, center and view of a lens."""
    parts = [lens.name]
    calibration = lens.calibration
    if lens.horizon is not None:
        parts.append(f'horizon at {lens.horizon.value:.0f} px (+- {max(lens.horizon.std, 1):.0f})')
        center = f'{calibration.cx:.0f}, {calibration.cy:.0f}'
        parts.append(f'center at {center} (+- {max(lens.center_std, 1):.0f})')
    roll, pitch, yaw = calibration.mount_rpy
    turned = f'turned by {wrapped_deg(yaw):.0f} degrees' if abs(wrapped_deg(yaw)) >= 1 else ''
    lean = np.hypot(wrapped_deg(roll), pitch)
    leans = f'leaning by {lean:.0f} degrees (+- {max(lens.lean_std, 1):.0f})' if lean >= 1.5 else ''
    low, high = lens.sees
    sees = f'sees about {low:.0f} to {high:.0f} degrees of elevation'
    return ', '.join(filter(None, [*parts, turned, leans, sees]))


def wrapped_deg(angle: float) -> float:
    """An angle between -180 and 180 degrees."""
    return float(np.degrees(wrap_angle(np.radians(angle))))


def advice(lens: LearnedLens) -> list[str]:
    """A sentence about a lens that sees too little."""
    low, _ = lens.sees
    if low <= _BELOW_DEG:
        return []
    return [
        f'the lens sees nothing below {low:.0f} degrees of elevation: what is near the robot shows '
        'best where it is; level the camera, or use a lens that sees below the horizon'
    ]


def fitting_panorama(panorama: PanoramaConfig, sees: tuple[float, float]) -> PanoramaConfig:
    """The panorama with elevations between those that are seen, unless others than usual are asked;
    all are degrees.
    """
    usual = PanoramaConfig()
    edges = panorama.elevation_min, panorama.elevation_max
    if edges != (usual.elevation_min, usual.elevation_max):
        return panorama
    lowest = sees[0] + _MARGIN_DEG
    highest = sees[1] - _MARGIN_DEG
    low = max(usual.elevation_min, lowest)
    high = min(low + usual.elevation_max - usual.elevation_min, highest)
    low = max(lowest, min(low, high - usual.elevation_max + usual.elevation_min))
    return replace(panorama, elevation_min=low, elevation_max=high)


def contradictions(lens: LearnedLens, described: LensCalibration, name: str) -> list[str]:
    """What the drive shows to be otherwise than in a description of this name, with its size."""
    texts = [] if lens.horizon is None else _of_circle(lens, lens.horizon, described, name)
    off = _between(lens.calibration, described)
    if not texts and off > _LEAST_TURN_DEG:
        texts = [f'{name} is {off:.0f} degrees off what the drive shows']
    remedy = 'the description is used; remove it to use the lens that the drive shows'
    return [f'{text}: {remedy}' for text in texts]


def _between(lens: LensCalibration, other: LensCalibration) -> float:
    """Angle between the rays of pixels of two lenses, beside the horizon, deg: that of the worse
    quarter, as one of two lenses may be right.
    """
    size = lens.image_height, lens.image_width
    columns, rows = np.meshgrid(np.arange(0, size[1], 7.0), np.arange(0, size[0], 7.0))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = make_camera(lens, size, mount_rpy=lens.mount_rpy).unproject(pixels)
    others = make_camera(other, size, mount_rpy=other.mount_rpy).unproject(pixels)
    cosine = np.sum(rays * others, axis=1)[np.abs(rays[:, 2]) < _BESIDE]
    cosine = cosine[np.isfinite(cosine)]
    low = np.quantile(cosine, _WORSE) if cosine.size else -1.0
    return float(np.degrees(np.arccos(np.clip(low, -1, 1))))


def _of_circle(
    lens: LearnedLens, horizon: Quantity, described: LensCalibration, name: str
) -> list[str]:
    """What a description says otherwise of a lens with one center."""
    size = lens.calibration.image_height, lens.calibration.image_width
    shown = _Horizon.of(lens.calibration, size)
    told = _Horizon.of(described, size)
    texts = []
    std = max(horizon.std, 1.0)
    off = abs(told.radius - shown.radius)
    if off > max(_CERTAIN * std, _LEAST_DEG * shown.px_per_deg):
        texts.append(
            f'{name} puts the horizon at {told.radius:.0f} px, the drive shows '
            f'{shown.radius:.0f} (+- {std:.0f})'
        )
    off = abs(told.center - shown.center)
    std = max(lens.center_std, 1.0)
    if off > max(_CERTAIN * std, _LEAST_DEG * shown.px_per_deg):
        texts.append(
            f'{name} puts the center at {told.center.real:.0f}, {told.center.imag:.0f}, the drive '
            f'shows {shown.center.real:.0f}, {shown.center.imag:.0f} (+- {std:.0f}): {off:.0f} px '
            'away'
        )
    turn = float(np.degrees(np.angle(np.mean(shown.forward * told.forward.conj()))))
    if abs(turn) > _LEAST_TURN_DEG:
        yaw = wrapped_deg(lens.calibration.mount_rpy[2])
        texts.append(
            f'{name} and mount_rpy are {abs(turn):.0f} degrees off the heading of the camera: the '
            f'drive shows a yaw of {yaw:.0f} degrees (+- 1)'
        )
    return texts


class _Horizon(NamedTuple):
    """The horizon in images of a level camera: its center, column + i row, px, its mean radius, px,
    its unit directions `forward` (N,) from there, and pixels per degree of elevation beside it.
    """

    center: complex
    radius: float
    forward: Complex
    px_per_deg: float

    @classmethod
    def of(cls, lens: LensCalibration, size: tuple[int, int]) -> _Horizon:
        camera = make_camera(lens, size, mount_rpy=(0.0, 0.0, lens.mount_rpy[2]))
        azimuth = np.radians(np.arange(0.0, 360.0, 5.0))

        def pixels(elevation_deg: float) -> Complex:
            rays = directions(azimuth, np.radians(elevation_deg))
            seen = camera.lens.project(rays @ camera.rotation)
            scaled = (seen + 0.5) * camera.scale - 0.5
            return np.asarray(scaled[:, 0] + 1j * scaled[:, 1])

        horizon = pixels(0.0)
        center = complex(horizon.mean())
        radius = np.abs(horizon - center)
        slope = np.abs(np.abs(pixels(1.0) - center) - np.abs(pixels(-1.0) - center)).mean() / 2
        return cls(center, float(radius.mean()), (horizon - center) / radius, float(slope))
