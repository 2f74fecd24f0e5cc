# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes of a satellite receiver as places in a plane: x east, y north of an origin, m."""

from __future__ import annotations

import math
from typing import Any

from sfa_localization.bags.motion_arrays import StampedValues
from sfa_localization.data.errors import MessageError
from sfa_localization.data.messages import require_sane
from sfa_localization.data.run import Origin

# of WGS84
_SEMI_MAJOR_M = 6_378_137.0
_ECCENTRICITY_SQUARE = 6.694_379_990_14e-3
_STD_M = 2.5
_STD_AUGMENTED_M = 0.3
_AUGMENTED = 2
"""Errors of fixes that state none: data sheets of single receivers promise 2.5 m. Drivers set the
status GBAS for corrections of a base station, both for 0.02 m and for the 0.3 m of a float one."""


def fix_of(message: Any) -> tuple[float, float, float]:
    """Latitude and longitude, degrees, and std, m, of a NavSatFix. Raises MessageError."""
    if message.status.status < 0:
        raise MessageError('the receiver has no fix')
    latitude = float(message.latitude)
    longitude = float(message.longitude)
    require_sane('place', latitude, longitude)
    if abs(latitude) > 90 or abs(longitude) > 360 or latitude == longitude == 0:
        raise MessageError('latitude and longitude are impossible')
    variance = max(float(message.position_covariance[0]), float(message.position_covariance[4]))
    if message.position_covariance_type and 0 < variance < math.inf:
        return latitude, longitude, math.sqrt(variance)
    augmented = message.status.status == _AUGMENTED
    return latitude, longitude, _STD_AUGMENTED_M if augmented else _STD_M


def in_plane(fixes: StampedValues, origin: Origin) -> StampedValues:
    """The values latitude, longitude, third as x, y m and the third."""
    return [(at, (*east_north(fix[0], fix[1], origin), *fix[2:])) for at, fix in fixes]


def east_north(latitude: float, longitude: float, origin: Origin) -> tuple[float, float]:
    """Place, m east and north, in the plane that touches the ellipsoid of WGS84 at the origin."""
    first = math.radians(origin[0])
    turn = math.radians(longitude - origin[1])
    meridian = []  # distances from the axis and from the plane of the equator
    for angle in (math.radians(latitude), first):
        radius = _SEMI_MAJOR_M / math.sqrt(1 - _ECCENTRICITY_SQUARE * math.sin(angle) ** 2)
        height = radius * (1 - _ECCENTRICITY_SQUARE) * math.sin(angle)
        meridian.append((radius * math.cos(angle), height))
    (axis, height), (first_axis, first_height) = meridian
    outward = axis * math.cos(turn) - first_axis
    north = (height - first_height) * math.cos(first) - outward * math.sin(first)
    return axis * math.sin(turn), north
