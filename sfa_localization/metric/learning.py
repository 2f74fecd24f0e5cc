# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning: meters from slow features and odometry, section 3 of the paper.

Where closures or points tie a drive, its places are those of a sparse graph (pose_graph.py), and
the map is a regression to them. Else the certified solver finds the global optimum of the paper's
problem; the paper's own descent is in paper_solver.py. Complex numbers are x + i y in meters.
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
from sfa_localization.metric import paper_solver
from sfa_localization.metric.drive_check import Diagnostics, check, check_amount, diagnose
from sfa_localization.metric.fitted_map import (
    angle_covariance,
    map_frame,
    metric_map,
    places_of_points,
    plane,
)
from sfa_localization.metric.forecast import Forecast
from sfa_localization.metric.map_fit import MapFit, MetricProblem
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.phases import Certificate, certify, refine
from sfa_localization.metric.pose_graph import Graph
from sfa_localization.metric.saved_map import MetricMap
from sfa_localization.metric.segments import Segments
from sfa_localization.metric.selection import LeftOut, choose, leave_out
from sfa_localization.metric.settings import MetricConfig
from sfa_localization.metric.turned_maps import TurnedMaps
from sfa_localization.sfa.image_features import Spectrum

logger = logging.getLogger(__name__)

LITTLE, OVERFIT = 0.9, 4.0
"""Where features explain less than this share of the places of images left out, whose variance is
so many times that of the others, a map follows noise: it leaves no residuals, and would bend the
drive as it likes. Then the drive keeps the shape of its odometry."""
# Images that the components are found from, evenly along the drives: they are smooth statistics.
_COMPONENT_IMAGES = 1500
# Images turned at a time: memory.
_BATCH = 1000


@dataclass(frozen=True, slots=True)
class MetricResult:
    """What was learned of N segments, M images in them, R periods. All in the map frame."""

    map: MetricMap
    poses: Array
    """(M, 3) x m, y m, yaw rad of the camera: where the certified solution puts `images`."""
    angle_covariance: Array
    """(N, N) rad^2, of the directions of the segments."""
    yaw_bias: Array
    """(R,) rad/s: by how much the odometry turned too fast in each period."""
    certificate: Certificate
    """Of the directions; the paper's descent seldom ends close enough to have one."""
    images: Indices
    """(M,) images of the segments, in order."""
    residuals: Array
    """(M, 2) m: where the segments put an image minus where the map does."""
    left_out: Array
    """(M, 2) m: as `residuals`, of a map learned without that stretch of the drive."""
    left_out_variance: Array
    """(M,) m^2 per axis: what the map claimed for `left_out`, with its inflation."""
    explained: float
    """Share of the spread of the places that the features explain in images left out."""
    forecast: Forecast
    """Errors to expect on paths between the trained ones."""
    points: Complex
    """(K,) x + i y m: where the drive puts the robot at measured points."""
    points_covariance: Complex
    """(K, K) m^2 per axis, without a motion of the whole map."""
    diagnostics: Diagnostics
    graph: Graph | None
    """That gave the places, instead of features."""
    mount: Mount
    """Where the camera sits on the robot."""

    @property
    def left_out_error_m(self) -> float:
        """Mean error of a map at stretches of the drive that it was learned without.

        The distance to where the certified solution of all data puts the stretch; needs no ground
        truth. Most stretches lie beyond the others: `forecast` is about paths between them.
        """
        return float(np.hypot(*self.left_out.T).mean())

    @property
    def quality(self) -> dict[str, Any]:
        """Figures of merit; plain numbers and lists."""
        x, y, error = self.forecast.worst
        return {
            'certified': bool(self.certificate.certified),
            'certificate': float(self.certificate.eigenvalue),
            'residual_m': float(np.hypot(*self.residuals.T).mean()),
            'expected_error_m': self.forecast.expected_m,
            'worst': {'x_m': x, 'y_m': y, 'expected_error_m': error},
            'left_out_error_m': self.left_out_error_m,
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

    `scale` (K,) weights the features, without it their slowness does. The result lies in its own
    map frame, or in that of `onto`, another result of the same segments, where no points give it.

    Raises DataError when the features are unusable, when the drive cannot determine a map (the
    message names what to drive instead), or when optimality is not proven.
    """
    problem = MetricProblem.of(features, segments, config, seed)
    check_amount(problem.stack, problem.links)
    tied = len(segments.closures) or len(segments.offsets.images) or segments.anchors
    if tied and config.solver == 'certified':
        problem = replace(problem, graph=(onto and onto.graph) or Graph.of(segments))
    fit = paper_solver.learn(problem) if config.solver == 'paper' else choose(problem, scale)
    left = leave_out(fit)
    overfits = left.explained < LITTLE and left.variance > OVERFIT * fit.variance
    searched = config.solver == 'certified' and problem.graph is None
    if overfits and searched and not diagnose(fit).single_route:
        fit = choose(replace(problem, graph=Graph.of(segments)), scale)
        left = leave_out(fit)
    if fit.problem.graph is not None:
        # Neighbors err alike, and a map follows them: the variance is that of left-out images.
        left = replace(left, variances=left.variances * (left.variance / fit.variance))
        fit = replace(fit, variance=left.variance)
    diagnostics = diagnose(fit)
    _check_certificate(fit)
    check(diagnostics)
    by_points = segments.anchors is not None and segments.anchors.settled.used.any()
    frame = map_frame(fit) if onto is None or by_points else _frame_of(onto, fit)
    return _result(fit, left, frame, diagnostics)


def _check_certificate(fit: MapFit) -> None:
    """Reject directions that are not proven; of the paper's descent, those near a wrong minimum."""
    solution, certificate = fit.solution, fit.certificate
    paper = fit.problem.config.solver == 'paper'
    if paper:
        certificate = certify(solution.h, refine(solution.h, solution.z))
    if certificate.certified:
        return
    value = f'(certificate {certificate.eigenvalue:.1e})'
    if paper:
        raise DataError(f'the descent ended in a wrong minimum {value}: set solver: certified')
    raise DataError(
        f'the best directions found are not proven to be optimal {value}: the odometry contradicts '
        'the images; check odometry and gyroscope, or drive more'
    )


def _frame_of(other: MetricResult, fit: MapFit) -> RigidTransform:
    """From the fit's arbitrary frame to that of another result of the same segments."""
    turn, shift = align_complex(fit.places, other.poses[:, 0] + 1j * other.poses[:, 1])
    return RigidTransform(shift.real, shift.imag, float(np.angle(turn)))


def _result(
    fit: MapFit, left: LeftOut, frame: RigidTransform, diagnostics: Diagnostics
) -> MetricResult:
    inflation = left.inflation
    drive_std = np.sqrt(inflation) * left.forecast.drive_std
    common_m = float(np.sqrt((drive_std**2).mean() / 2))
    turn, shift = np.exp(1j * frame.yaw_rad), frame.x_m + 1j * frame.y_m
    points, points_covariance = places_of_points(fit)
    yaw = fit.stack.yaws(fit.solution)
    return MetricResult(
        map=metric_map(fit, frame, inflation, common_m),
        poses=np.column_stack([plane(fit.places * turn + shift), wrap_angle(yaw + frame.yaw_rad)]),
        angle_covariance=angle_covariance(fit),
        yaw_bias=fit.solution.bias,
        certificate=fit.certificate,
        images=fit.stack.images,
        residuals=plane(fit.residuals * turn),
        left_out=plane(left.errors * turn),
        left_out_variance=left.variances * inflation,
        explained=left.explained,
        forecast=replace(left.forecast, drive_std=drive_std).moved(frame),
        points=points * turn + shift,
        points_covariance=points_covariance,
        diagnostics=diagnostics,
        graph=fit.problem.graph,
        mount=fit.problem.segments.mount,
    )


def learn_turned(
    spectra: Spectrum, segments: Segments, first: MetricResult, sign: float, seed: int = 0
) -> tuple[TurnedMaps, MetricResult]:
    """Learn a map of the spectra (N, H, J) of all images, turned by the certified headings of the
    first map of the same segments, and in its frame. Raises DataError as ``learn_metric``.
    """
    images, yaw = first.images, first.poses[:, 2]
    rows = evenly(len(images), _COMPONENT_IMAGES)
    turned = TurnedMaps.fit(spectra[images[rows]], yaw[rows], sign)
    features = np.zeros((len(spectra), turned.axes.shape[1]))
    for start in range(0, len(images), _BATCH):
        part = slice(start, start + _BATCH)
        features[images[part]] = turned.features(spectra[images[part]], yaw[part])
    # They count by their own size, as principal components do.
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
    """As `learn_turned`; the first map alone without a layer to turn, where no other can be
    learned, and for the paper's descent and its monomials, which are there for comparison.
    """
    if spectra is None or config.solver == 'paper' or config.metric_map == 'monomials':
        return None, first
    try:
        return learn_turned(spectra, segments, first, sign, seed)
    except DataError as error:
        logger.warning('the map reads slow features, not turned maps: %s', error)
        return None, first
