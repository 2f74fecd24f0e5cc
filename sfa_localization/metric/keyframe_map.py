# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes at the places of the certified map, and how well they and slow features do together."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.sphere import Sphere
from sfa_localization.features.closures import Views
from sfa_localization.features.keyframe_training import fit_keyframes, left_out, spread
from sfa_localization.features.keyframes import Keyframes
from sfa_localization.features.observation import UNKNOWN_YAW_VARIANCE, Observation, combine
from sfa_localization.features.rotation_spread import Agreement, needed_factor, share_within
from sfa_localization.metric.learning import MetricResult
from sfa_localization.metric.segments import Segments, assignment
from sfa_localization.metric.stack import tracks

# Between the drives: farther than any stretch.
_ANOTHER_DRIVE_M = 1e6
_ENOUGH = 50


@dataclass(frozen=True, slots=True)
class KeyframeMap:
    """Keyframes of a map; from parts of the drive that both were learned without:
    `improvement`, the mean error of slow features and keyframes together over that of slow
    features alone, `within_95`, the share of errors in the ellipses of 95 %, and `yaw_error`, the
    mean error of headings, rad.
    """

    keyframes: Keyframes
    improvement: float = 1.0
    within_95: float = 0.95
    yaw_error: float | None = None

    @property
    def quality(self) -> dict[str, float]:
        """Figures that are stored in the model."""
        figures = {'keyframes': len(self.keyframes.poses), 'left_out_within_95': self.within_95}
        if self.yaw_error is None:
            return figures
        return {**figures, 'expected_yaw_error_deg': math.degrees(self.yaw_error)}


def learn_keyframes(
    views: Views,
    disagreement: Array,
    segments: Segments,
    result: MetricResult,
    agreement: Agreement,
    sphere: Sphere,
) -> KeyframeMap:
    """Keyframes where the certified solution puts the images of `views`; `disagreement` (N,) is
    that of all images' rotated views. Raises DataError for too few.
    """
    _, seen, row = np.intersect1d(views.images, result.images, return_indices=True)
    poses = result.poses[row]
    path = _along_tracks(views, segments)[seen]
    drives = views.run[seen].astype(np.int32)
    own = fit_keyframes(views.textures[seen], poses, path, sphere, drives)
    turn_std = usual_turn_std(result.angle_covariance)
    keyframes = replace(own, noise=own.noise.with_map(result.map.common_m, turn_std))
    kept = spread(poses)
    variance = result.left_out_variance * agreement.factor(disagreement[result.images])
    return _judged(keyframes, path[kept], row[kept], result, variance)


def usual_turn_std(covariance: Array) -> float:
    """Standard deviation rad of a map's directions, by those of its N segments, (N, N) rad^2: one
    that hardly anything ties to the others is no matter of the map as a whole.
    """
    return float(np.sqrt(np.median(np.diag(covariance))))


def _along_tracks(views: Views, segments: Segments) -> Array:
    """Distance (S,) m driven until each image, far apart between drives; of a segment along an
    earlier track it is that of the earlier one."""
    path = views.path_m + _ANOTHER_DRIVE_M * views.run
    owner = assignment(segments, int(views.images.max()) + 1)[views.images]
    for n, first in enumerate(tracks(segments).tolist()):
        if first != n and (owner == first).any():
            path[owner == n] = path[owner == first].mean()
    return path


def _judged(
    keyframes: Keyframes,
    path_m: Array,
    rows: NDArray[np.int64],
    result: MetricResult,
    variance: Array,
) -> KeyframeMap:
    """Errors of both together where both were left out; keyframe k is row `rows[k]` (K,)."""
    errors, variances, alone, weights, turned = [], [], [], [], []
    for k, scores, yaws in left_out(keyframes, path_m):
        row, place, error = rows[k], keyframes.poses[k, :2], result.left_out[rows[k]]
        spread = np.diag([variance[row], variance[row], UNKNOWN_YAW_VARIANCE])
        slow = Observation(np.append(place + error, 0.0), spread, np.zeros(0))
        match = keyframes.located(keyframes.spectra([k])[0], scores, yaws)
        pose, covariance = combine(slow, match, keyframes.noise)
        errors.append(pose[:2] - place)
        variances.append(np.trace(covariance[:2, :2]) / 2)
        turned.append(abs(wrap_angle(pose[2] - keyframes.poses[k, 2])))
        alone.append(error)
        weights.append(result.forecast.weight[row])
    if len(errors) < _ENOUGH or not sum(weights) > 0:
        return KeyframeMap(keyframes)
    weight, ratio = np.array(weights), (np.array(errors) ** 2).sum(1) / np.array(variances)
    factor = max(needed_factor(ratio, 2, weight), 1.0)
    joint, single = (np.average(np.hypot(*np.array(e).T), weights=weight) for e in (errors, alone))
    return KeyframeMap(
        replace(keyframes, noise=replace(keyframes.noise, joint_factor=factor)),
        float(joint / max(single, 1e-9)),
        share_within(ratio / factor, 2, 0.95, weight),
        float(np.average(turned, weights=weight)),
    )
