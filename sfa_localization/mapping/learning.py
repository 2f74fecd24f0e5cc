# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning: meters from slow features and odometry, section 3 of the paper.

Where offsets or points tie a drive, its places are those of a sparse graph (pose_graph.py), and the
map is a regression to them. Else the same solver finds both by eq. 1; the paper's own descent is in
paper_solver.py. Complex numbers are x + i y in meters.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import (
    Array,
    Complex,
    Indices,
    RigidTransform,
    align_complex,
    wrap_angle,
)
from sfa_localization.data.statistics import evenly
from sfa_localization.mapping import paper_solver
from sfa_localization.mapping.drive_check import Diagnostics, check, check_amount, diagnose
from sfa_localization.mapping.fitted_map import (
    map_frame,
    metric_map,
    places_of_points,
    plane,
)
from sfa_localization.mapping.forecast import Forecast
from sfa_localization.mapping.map_fit import MapFit, MetricProblem
from sfa_localization.mapping.saved_map import MetricMap
from sfa_localization.mapping.selection import HeldOut, choose, hold_out
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.mapping.turned_maps import TurnedMaps
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.pose_graph import Graph
from sfa_localization.metric.segments import Segments
from sfa_localization.sfa.image_features import Spectrum

logger = logging.getLogger(__name__)

LITTLE = 0.9
OVERFIT = 4.0
"""Where features explain less than this share of the places of images held out, whose variance is
so many times that of the others, a map follows noise: it leaves no residuals, and would bend the
drive as it likes. Then the drive keeps the shape of its odometry."""
# Images that the components are found from, evenly along the drives: they are smooth statistics.
_COMPONENT_IMAGES = 1500
# Images turned at a time: memory.
_BATCH = 1000


@dataclass(frozen=True, slots=True)
class MetricResult:
    """The map of segments with M images, all but `graph` in the map frame."""

    map: MetricMap
    poses: Array
    """(M, 3) x m, y m, yaw rad of the camera at `images`, by the segments."""
    images: Indices
    """(M,) images of the segments, in order."""
    residuals: Array
    """(M, 2) m: where the segments put an image minus where the map does."""
    held_out: Array
    """(M, 2) m: `residuals` of maps learned without that part of the drive."""
    held_out_variance: Array
    """(M,) m^2 per axis, of `held_out` by the map, inflated."""
    explained: float
    """Share of the spread of the places that the features explain in held-out images."""
    forecast: Forecast
    """Errors to expect on paths between the trained ones."""
    points: Complex
    """(K,) x + i y m: where the segments put the robot at measured points."""
    points_covariance: Complex
    """(K, K) m^2 per axis, relative to the whole map."""
    diagnostics: Diagnostics
    graph: Graph
    """The poses of the segments in their own frame, with the biases of the odometry and the
    certificate; of the paper's descent that of the minimum near which it ended."""
    mount: Mount
    """Where the camera sits on the robot."""

    @property
    def held_out_error_m(self) -> float:
        """Mean error of maps at parts of the drive that they were learned without.

        Most parts lie beyond the others: `forecast` is about paths between them.
        """
        return float(np.hypot(*self.held_out.T).mean())

    @property
    def quality(self) -> dict[str, Any]:
        """Figures of merit; plain numbers and lists."""
        x, y, error = self.forecast.worst
        return {
            'certified': bool(self.graph.certificate.certified),
            'certificate': float(self.graph.certificate.eigenvalue),
            'residual_m': float(np.hypot(*self.residuals.T).mean()),
            'expected_error_m': self.forecast.expected_m,
            'worst': {'x_m': x, 'y_m': y, 'expected_error_m': error},
            'left_out_error_m': self.held_out_error_m,
            'explained': self.explained,
            'coverage': asdict(self.diagnostics),
        }


def learn_metric(
    features: Array,
    segments: Segments,
    config: MetricConfig,
    seed: int = 0,
    scale: Array | None = None,
    onto: MetricResult | None = None,
) -> MetricResult:
    """Learn meters from features (N, K), one row per image of the runs, and segments.

    `scale` (K,) weights the features; without it, their slowness does. Where no points give a
    frame, it is that of `onto`, another result of the same segments.

    Raises DataError when the features are unusable, when the drive cannot determine a map, or when
    optimality is not proven.
    """
    problem = MetricProblem.of(features, segments, config, seed)
    check_amount(problem.stack, problem.links)
    tied = len(segments.offsets.images) or segments.points
    if tied and config.solver == 'certified':
        problem = replace(problem, graph=onto.graph if onto else Graph.of(segments))
    fit = paper_solver.learn(problem) if config.solver == 'paper' else choose(problem, scale)
    held = hold_out(fit)
    overfits = held.explained < LITTLE and held.variance > OVERFIT * fit.variance
    by_features = config.solver == 'certified' and problem.graph is None
    if overfits and by_features and not diagnose(fit).single_route:
        fit = choose(replace(problem, graph=Graph.of(segments)), scale)
        held = hold_out(fit)
    if fit.problem.graph is not None:
        # Neighbors err alike, and a map follows them: the variance is that of held-out images.
        held = replace(held, variances=held.variances * (held.variance / fit.variance))
        fit = replace(fit, variance=held.variance)
    diagnostics = diagnose(fit)
    _check_certificate(fit)
    check(diagnostics)
    return _result(fit, held, _frame(fit, onto), diagnostics)


def _frame(fit: MapFit, onto: MetricResult | None) -> RigidTransform:
    """The transform from the fit's frame to the map frame."""
    points = fit.problem.segments.points
    if onto is None or (points and points.settled.used.any()):
        return map_frame(fit)
    turn, shift = align_complex(fit.places, onto.poses[:, 0] + 1j * onto.poses[:, 1])
    return RigidTransform(shift.real, shift.imag, float(np.angle(turn)))


def _check_certificate(fit: MapFit) -> None:
    """Raise DataError for directions that are not proven to be the best."""
    if fit.graph.certificate.certified:
        return
    value = f'(certificate {fit.graph.certificate.eigenvalue:.1e})'
    if fit.problem.config.solver == 'paper':
        raise DataError(f'the descent ended in a wrong minimum {value}: set solver: certified')
    raise DataError(
        f'the best directions found are not proven to be optimal {value}: the odometry contradicts '
        'the images; check odometry and gyroscope, or drive more'
    )


def _result(
    fit: MapFit, held: HeldOut, frame: RigidTransform, diagnostics: Diagnostics
) -> MetricResult:
    inflation = held.inflation
    drive_std = np.sqrt(inflation) * held.forecast.drive_std
    common_m = float(np.sqrt((drive_std**2).mean() / 2))
    turn = np.exp(1j * frame.yaw_rad)
    shift = frame.x_m + 1j * frame.y_m
    points, points_covariance = places_of_points(fit)
    yaw = fit.stack.yaws(fit.graph.poses)
    return MetricResult(
        map=metric_map(fit, frame, inflation, common_m),
        poses=np.column_stack([plane(fit.places * turn + shift), wrap_angle(yaw + frame.yaw_rad)]),
        images=fit.stack.images,
        residuals=plane(fit.residuals * turn),
        held_out=plane(held.errors * turn),
        held_out_variance=held.variances * inflation,
        explained=held.explained,
        forecast=replace(held.forecast, drive_std=drive_std).moved(frame),
        points=points * turn + shift,
        points_covariance=points_covariance,
        diagnostics=diagnostics,
        graph=fit.graph,
        mount=fit.problem.segments.mount,
    )


def learn_turned(
    spectra: Spectrum, segments: Segments, first: MetricResult, sign: float, seed: int = 0
) -> tuple[TurnedMaps, MetricResult]:
    """Learn a map of the spectra (N, H, J) of all images, turned by the certified headings of the
    first map of the same segments, and in its frame. Raises DataError as ``learn_metric``.
    """
    images = first.images
    yaw = first.poses[:, 2]
    rows = evenly(len(images), _COMPONENT_IMAGES)
    turned = TurnedMaps.fit(spectra[images[rows]], yaw[rows], sign)
    features = np.zeros((len(spectra), turned.axes.shape[1]))
    for start in range(0, len(images), _BATCH):
        part = slice(start, start + _BATCH)
        features[images[part]] = turned.features(spectra[images[part]], yaw[part])
    # The principal components keep their variances as weights.
    scale = np.full(features.shape[1], 1.0 / np.sqrt(features[images].var(0).sum()))
    return turned, learn_metric(features, segments, MetricConfig(), seed, scale, first)


def with_turned(
    spectra: Spectrum | None,
    segments: Segments,
    first: MetricResult,
    sign: float,
    config: MetricConfig,
    seed: int = 0,
) -> tuple[TurnedMaps | None, MetricResult]:
    """As `learn_turned`. Returns the first map if the network has no layer to turn, if the second
    map cannot be learned, and for the paper's descent and monomials.
    """
    if spectra is None or config.solver == 'paper' or config.metric_map == 'monomials':
        return None, first
    try:
        return learn_turned(spectra, segments, first, sign, seed)
    except DataError as error:
        logger.warning('the map reads slow features, not turned maps: %s', error)
        return None, first
