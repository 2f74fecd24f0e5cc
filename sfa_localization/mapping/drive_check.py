# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a drive can determine a map at all, and what to drive instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Complex, Indices
from sfa_localization.data.statistics import quantile
from sfa_localization.mapping.map_fit import MapFit
from sfa_localization.metric.links import Links
from sfa_localization.metric.stack import Stack

ANGLE_STD_MAX_DEG = 10.0
"""Standard deviation of a segment's direction beyond which the map bends visibly."""
SURE_SHARE = 0.9
"""Of the driven length whose directions must be surer: a short piece between two breaks of the
odometry bends nothing, because only the map places it."""
ROUTE = (
    'no track crosses another: the model holds the route in the shape of its odometry, and little '
    'beside it; cross earlier tracks to learn an area'
)
# Fewer directions leave any shear possible; narrower drives do not cover an area.
_SEGMENTS_MIN = 3
_WIDTH_MIN_M = 0.5


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """Amount and geometry of the data."""

    segments: int
    images: int
    length_m: float
    extent_m: tuple[float, float]
    """Four standard deviations of the positions along and across their main axis."""
    directions: float
    """Spread of driving directions: 0 all parallel, 1 even; opposite ones count as parallel."""
    crossings: int
    """Pairs of segments that cross, without neighbors."""
    angle_std_rad: float
    """Standard deviation of a segment's direction in the map: see SURE_SHARE."""

    @property
    def single_route(self) -> bool:
        """Whether no place is passed on different tracks, so that only odometry connects them."""
        return min(self.extent_m) < _WIDTH_MIN_M or self.crossings == 0


def check_amount(stack: Stack, links: Links) -> None:
    """Raises DataError for too few segments, or if there are neither turns nor curves: the mirror
    image of straight lines, or any shear of them, explains their images as well.
    """
    if stack.segments < _SEGMENTS_MIN:
        raise DataError(
            f'only {stack.segments} segments of odometry with images: drive at least '
            f'{_SEGMENTS_MIN}, in different directions and crossing each other'
        )
    variances = np.concatenate([links.turn_variance, links.displacement_variance])
    if not np.isfinite(variances).any() and not stack.path.imag.any():
        raise DataError(
            'the odometry breaks between all straight lines: check it, or set segments: any'
        )


def diagnose(fit: MapFit) -> Diagnostics:
    """Diagnostics of a fit."""
    places = fit.places
    stack = fit.stack
    lengths = stack.sums(stack.steps)
    same = np.diff(stack.owner, prepend=-1) == 0
    heading = (np.diff(stack.path, prepend=0.0) * fit.graph.poses.z[stack.owner])[same]
    return Diagnostics(
        segments=stack.segments,
        images=len(places),
        length_m=float(lengths.sum()),
        extent_m=_extent(places),
        directions=_directions(heading),
        crossings=_crossings(places, stack.first),
        angle_std_rad=quantile(np.sqrt(np.diag(fit.graph.angle_covariance)), SURE_SHARE, lengths),
    )


def check(diagnostics: Diagnostics) -> None:
    """Raises DataError, naming what to drive, if the data do not determine the map of an area."""
    if diagnostics.single_route:
        return
    uncertain = min(float(np.rad2deg(diagnostics.angle_std_rad)), 180.0)
    if uncertain > ANGLE_STD_MAX_DEG:
        raise DataError(
            f'directions are uncertain by up to {uncertain:.0f} deg: '
            'drive longer, in more directions, and cross earlier tracks '
            f'({diagnostics.crossings} crossings now)'
        )


def is_single_route(places: Complex, length_m: float) -> bool:
    """`Diagnostics.single_route` of places (M,), x + i y m by odometry, in pieces of a length."""
    steps = np.abs(np.diff(places, prepend=places[:1]))
    piece = np.floor(np.cumsum(steps) / length_m).astype(int)
    first = np.flatnonzero(np.diff(piece, prepend=-1))
    return min(_extent(places)) < _WIDTH_MIN_M or _crossings(places, first) == 0


def _extent(places: Complex) -> tuple[float, float]:
    spread = np.linalg.eigvalsh(np.cov(places.real, places.imag))
    major, minor = 4.0 * np.sqrt(np.maximum(spread[::-1], 0.0))
    return float(major), float(minor)


def _directions(steps: Complex) -> float:
    """From the length-weighted double angle, which is the same for driving back and forth."""
    total = np.abs(steps).sum()
    return 1.0 - float(abs((steps**2 / np.maximum(np.abs(steps), 1e-12)).sum()) / max(total, 1e-12))


def _crossings(places: Complex, first: Indices) -> int:
    """How many chords of segments, which start at the rows `first` (N,), cross without being
    neighbors.
    """
    ends = np.append(first[1:], len(places)) - 1
    a = places[first]
    b = places[ends]
    i, j = np.triu_indices(len(a), 2)

    def side(p: Complex, q: Complex, r: Complex) -> Array:
        return np.asarray(np.sign(np.imag(np.conj(q - p) * (r - p))))

    cross = side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]) < 0
    return int((cross & (side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]) < 0)).sum())
