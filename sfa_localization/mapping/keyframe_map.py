# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes at the places of the map, and the errors of keyframes and slow features together."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import Array, Indices
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import share_within
from sfa_localization.keyframes.closures import Textures
from sfa_localization.keyframes.errors import ErrorModel, LeftOut
from sfa_localization.keyframes.keyframes import Keyframes
from sfa_localization.keyframes.training import choose_keyframes, located_without
from sfa_localization.mapping.forecast import ground_distances, importance
from sfa_localization.mapping.learning import MetricResult
from sfa_localization.metric.segments import Segments, assignment
from sfa_localization.metric.stack import Stack, tracks

# Distance between drives: longer than any stretch.
_ANOTHER_DRIVE_M = 1e6
# Fewest held-out images for statistics.
_ENOUGH = 50


@dataclass(frozen=True, slots=True)
class KeyframeMap:
    """Keyframes of a map, and figures of held-out images: `improvement`, the mean error of slow
    features and keyframes together over that of slow features alone, `within_95`, the share of
    errors in the ellipses of 95 %, `yaw_error`, the mean error of headings, rad, and the
    correlation of the errors of neighbors."""

    keyframes: Keyframes
    improvement: float = 1.0
    within_95: float = 0.95
    yaw_error: float | None = None
    correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)

    @property
    def quality(self) -> dict[str, float]:
        """Figures that are stored in the model."""
        figures = {'keyframes': len(self.keyframes.poses), 'left_out_within_95': self.within_95}
        if self.yaw_error is None:
            return figures
        return {**figures, 'expected_yaw_error_deg': math.degrees(self.yaw_error)}


def learn_keyframes(
    views: Textures, segments: Segments, result: MetricResult, sphere: Sphere, turn_radius_m: float
) -> KeyframeMap:
    """Keyframes of the images of `views`, where the segments put them; along the drive a turn
    counts as `turn_radius_m` per rad. Raises DataError for too few images."""
    _, seen, row = np.intersect1d(views.images, result.images, return_indices=True)
    drives = views.run[seen].astype(np.int32)
    keyframes, kept = choose_keyframes(
        views.textures[seen], result.poses[row], sphere, drives, views.seen
    )
    path = _along_tracks(views, segments)[seen][kept]
    tried, fits, near_m = located_without(keyframes, path)
    if len(tried) < _ENOUGH:
        return KeyframeMap(_with_errors(keyframes, ErrorModel(), result))
    ground_m = ground_distances(keyframes.poses[:, :2], np.random.default_rng(0))
    trials = LeftOut.of(fits, keyframes.poses[tried], importance(near_m, ground_m))
    rows = row[kept][tried]
    slow = result.held_out[rows]
    claimed = result.held_out_variance[rows]
    errors = trials.learn_slow(trials.learn(), slow, claimed)
    both, variance = trials.fused(errors, slow, claimed)
    driven, owner = _driven(segments, turn_radius_m)
    return KeyframeMap(
        _with_errors(keyframes, errors, result),
        trials.mean_m(both) / max(trials.mean_m(slow), 1e-9),
        share_within((both**2).sum(1) / variance, 0.95, trials.weight),
        float(np.average(np.abs(trials.turn), weights=trials.weight)),
        ErrorCorrelation.fit(both, variance, driven[rows], owner[rows]),
    )


def _with_errors(keyframes: Keyframes, errors: ErrorModel, result: MetricResult) -> Keyframes:
    """Keyframes with these errors, and those that all images share by the map."""
    turn_std = usual_turn_std(result.graph.angle_covariance)
    errors = replace(errors, map_m=result.map.common_m, turn_std=turn_std)
    return replace(keyframes, errors=errors)


def _driven(segments: Segments, turn_radius_m: float) -> tuple[Array, Indices]:
    """The distance driven until each image of the segments, (M,) m, and its segment."""
    stack = Stack.of(segments)
    turns = np.abs(np.diff(stack.headings, prepend=0.0))
    turns[stack.first] = 0.0
    return np.cumsum(stack.steps + turn_radius_m * turns), stack.owner


def usual_turn_std(covariance: Array) -> float:
    """Standard deviation, rad, of a map's directions with covariance (N, N) rad^2: the median, as a
    segment that is hardly tied to the others says nothing of the map."""
    return float(np.sqrt(np.median(np.diag(covariance))))


def _along_tracks(views: Textures, segments: Segments) -> Array:
    """Distance (S,) m driven until each image, with a large step between drives; for a segment
    along an earlier track, that of the earlier one."""
    path = views.path_m + _ANOTHER_DRIVE_M * views.run
    owner = assignment(segments, int(views.images.max()) + 1)[views.images]
    for n, first in enumerate(tracks(segments).tolist()):
        if first != n and (owner == first).any():
            path[owner == n] = path[owner == first].mean()
    return path
