# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What is unknown of a lens before a drive shows it: few parameters of each model, with priors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfa_localization.camera.settings import LensCalibration
from sfa_localization.data.rig import Quantity

Values = Mapping[str, float]
_RIGHT_ANGLE = np.pi / 2
# Priors of the shapes. Unified model: hyperbolic mirrors have xi of 0.7 to 0.97, a parabolic one 1.
# Kannala-Brandt: of the lenses in the examples of OpenCV and Kalibr, |k1| < 0.05 and |k2| < 0.01.
_XI = Quantity(0.9, 0.1)
_MIRROR_K1 = Quantity(0.0, 0.02)
_MIRROR_K2 = Quantity(0.0, 0.01)
_FISHEYE_K1 = Quantity(0.0, 0.03)
_FISHEYE_K2 = Quantity(0.0, 0.006)
_HORIZON_STD = 0.3  # of the rim's radius: the drive shows the horizon
_UPRIGHT_STD = 0.1  # rad, between the axes of two lenses back to back
LEAN_STD = 0.15
"""Standard deviation of roll and pitch of a camera on a robot, rad."""


@dataclass(frozen=True, slots=True)
class LensCircle:
    """The rim of a lens: column, row and radius, px, the standard deviation of its center as that
    of the lens, px, and the radius of the hole in its middle, px; 0 for none.
    """

    column: float
    row: float
    radius: float
    std: float
    hole: float = 0.0


@dataclass(frozen=True, slots=True)
class LensModel:
    """A model of a lens: its unknowns by name with their prior, values of the `horizons` from which
    a search starts, and the calibration with given values of the unknowns. `axis` is where the
    center of the image looks.
    """

    name: str
    axis: str
    prior: dict[str, Quantity]
    horizons: tuple[float, ...]
    calibration: Callable[[Values], LensCalibration]


def mirror(base: LensCalibration, circle: LensCircle) -> LensModel:
    """The unified model of central mirrors; `horizon` is its radius, px."""

    def calibration(values: Values) -> LensCalibration:
        xi = values['xi']
        k1 = values['k1']
        k2 = values['k2']
        plane = 1.0 / xi
        focal = values['horizon'] / (plane * (1 + k1 * plane**2 + k2 * plane**4))
        return replace(
            base,
            camera_model='mirror',
            xi=xi,
            distortion=(k1, k2, 0.0, 0.0),
            **_centered(values, focal),
        )

    shape = {'xi': _XI, 'k1': _MIRROR_K1, 'k2': _MIRROR_K2}
    return LensModel(
        'mirror',
        base.axis,
        _prior(circle, 0.55) | shape,
        _starts(circle, 0.4, 0.55, 0.7),
        calibration,
    )


def fisheye(base: LensCalibration, circle: LensCircle) -> LensModel:
    """The model of Kannala and Brandt; `horizon` is the radius, px, at 90 degrees from the axis."""

    def calibration(values: Values) -> LensCalibration:
        shape = values['k1'], values['k2'], 0.0, 0.0
        focal = _fisheye_focal(values['horizon'], *shape[:2])
        return replace(base, camera_model='fisheye', distortion=shape, **_centered(values, focal))

    shape = {'k1': _FISHEYE_K1, 'k2': _FISHEYE_K2}
    return LensModel(
        'fisheye',
        base.axis,
        _prior(circle, 0.9) | shape,
        _starts(circle, 0.65, 0.8, 0.95),
        calibration,
    )


def dual_fisheye(
    base: LensCalibration, circles: Sequence[LensCircle], upside_down: bool
) -> LensModel:
    """Two fisheyes back to back in one image."""
    first, second = circles

    def calibration(values: Values) -> LensCalibration:
        of_second = {name[7:]: value for name, value in values.items() if name[:7] == 'second_'}
        shape, other = ((v['k1'], v['k2'], 0.0, 0.0) for v in (values, of_second))
        focal = _fisheye_focal(values['horizon'], *shape[:2])
        second_focal = _fisheye_focal(of_second['horizon'], *other[:2])
        turn = np.degrees([of_second[name] for name in ('roll', 'pitch', 'yaw')])
        return replace(
            base,
            camera_model='dual_fisheye',
            distortion=shape,
            **_centered(values, focal),
            second_cx=of_second['cx'],
            second_cy=of_second['cy'],
            second_focal=second_focal,
            second_distortion=other,
            second_roll=float(turn[0]),
            second_tilt=tuple(turn[1:].tolist()),
        )

    shape = {'k1': _FISHEYE_K1, 'k2': _FISHEYE_K2}
    other = _prior(second, 0.95) | shape
    other |= dict.fromkeys(('roll', 'pitch', 'yaw'), Quantity(0.0, _UPRIGHT_STD))
    prior = _prior(first, 0.95) | shape
    prior |= {f'second_{name}': quantity for name, quantity in other.items()}
    prior['roll'] = Quantity(np.pi * upside_down, LEAN_STD)
    starts = _starts(first, 0.88, 0.95)
    return LensModel('two fisheyes', 'forward', prior, starts, calibration)


def equirectangular(base: LensCalibration, elevations: Sequence[Quantity]) -> LensModel:
    """A panorama whose elevations, rad, of the lower and upper edge are uncertain, if given."""

    def calibration(values: Values) -> LensCalibration:
        edges: dict[str, Any] = {name: float(np.degrees(values[name])) for name in prior}
        return replace(base, **edges)

    prior = dict(zip(('elevation_min', 'elevation_max'), elevations, strict=False))
    return LensModel('panorama', 'forward', prior, (), calibration)


def _prior(circle: LensCircle, horizon: float) -> dict[str, Quantity]:
    return {
        'cx': Quantity(circle.column, circle.std),
        'cy': Quantity(circle.row, circle.std),
        'horizon': Quantity(horizon * circle.radius, _HORIZON_STD * circle.radius),
    }


def _starts(circle: LensCircle, *shares: float) -> tuple[float, ...]:
    return tuple(share * circle.radius for share in shares)


def _centered(values: Values, focal: float) -> dict[str, Any]:
    return {'cx': values['cx'], 'cy': values['cy'], 'fx': focal, 'fy': focal}


def _fisheye_focal(horizon: float, k1: float, k2: float) -> float:
    bent = _RIGHT_ANGLE * (1 + k1 * _RIGHT_ANGLE**2 + k2 * _RIGHT_ANGLE**4)
    return horizon / bent
