# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from drives: by likelihood, or by the paper's grid search.

The likelihood needs no ground truth: the innovations of a well-tuned filter are as large as its
covariances. The grid search of the paper (section 5.1) takes the least mean error against truth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from sfa_localization.bags.drives import as_live
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, align
from sfa_localization.data.progress import progress_bar, progress_over
from sfa_localization.data.run import Odometry, Trajectory
from sfa_localization.data.statistics import surprise
from sfa_localization.evaluation import observed
from sfa_localization.fusion.pose_filter import PoseFilter, State, Update
from sfa_localization.fusion.replay import replay
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.localizer import filter_of
from sfa_localization.observer import Observation, Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""The grid: factors on the variances of images and of odometry."""
TUNED = ('measurement_factor', 'odometry_factor', 'slip_per_meter', 'yaw_per_radian')
"""The parameters that the likelihood decides, each on a logarithmic scale."""
MIN_IMAGES = 20
"""Fewer images do not tell the settings apart."""
TRIALS = 120
"""Settings to try by likelihood."""
_LEAST = 1e-9  # stands for a parameter of zero, which has no logarithm
_FIRST_STEP = 0.7  # of each logarithm: a factor of two
_PULL = 1e-3  # cost per squared logarithm: holds what the data do not determine at the start


@dataclass(frozen=True, slots=True)
class TuningDrive:
    """A drive: odometry, and the observations of all images, also of unusable ones.

    `truth` is for the grid search only; `filter_for` makes a filter that begins with the model's
    rig.
    """

    odometry: Odometry
    observations: Sequence[Observation]
    truth: Trajectory | None = None
    filter_for: Callable[[FilterConfig], PoseFilter] = PoseFilter

    def fuse(self, fused: PoseFilter) -> Iterator[tuple[Observation, Update, State | None]]:
        """Feed a filter; yields what it made of each usable image, and its state there."""
        stamps = np.array([image.stamp_ns for image in self.observations])
        for stamp_ns, image, update in replay(fused, self.odometry, stamps, self.observations):
            if image is not None and update is not None and not image.problem:
                yield image, update, fused.at(stamp_ns)


def read_drive(
    bag: Path, model: PlaceModel, recipe: Recipe, watch: WatchConfig | None, want_truth: bool
) -> TuningDrive:
    """A bag's odometry, and the poses of its images by the model. Raises BagError, DataError."""
    live = as_live(recipe, model.panorama, model.lens, model.surround)
    run, observations = observed(bag, Observer(model, watch), live, True, want_truth)
    usable = sum(not image.problem for image in observations)
    if usable < MIN_IMAGES:
        raise DataError(f'{bag}: {usable} images are too few to tune on: {MIN_IMAGES} at least')
    return TuningDrive(run.odometry, observations, run.ground_truth, partial(filter_of, model))


def tune_by_likelihood(drives: Sequence[TuningDrive], config: FilterConfig) -> FilterConfig:
    """The setting that maximizes the likelihood of the innovations.

    Nelder-Mead over the logarithms of TUNED: the cost is not smooth where the gate decides.
    """
    start = np.log([getattr(config, name) or _LEAST for name in TUNED])
    ranges = {item.name: item.metadata for item in fields(config)}
    lows, highs = ([ranges[name][end] for name in TUNED] for end in ('low', 'high'))

    def at(logs: Array) -> FilterConfig:
        values = np.clip(np.exp(logs), lows, highs).tolist()
        return replace(config, **dict(zip(TUNED, values, strict=True)))

    def cost(logs: Array) -> float:
        bar.update()
        return likelihood_cost(drives, at(logs)) + _PULL * float(np.sum((logs - start) ** 2))

    simplex = np.vstack([start, start + _FIRST_STEP * np.eye(len(TUNED))])
    options = {'maxfev': TRIALS, 'initial_simplex': simplex, 'xatol': 0.05, 'fatol': 1e-3}
    with progress_bar('tune by likelihood', TRIALS, 'trials', visible=True) as bar:
        best = minimize(cost, start, method='Nelder-Mead', options=options)
    if not math.isfinite(best.fun):
        raise DataError('the filter fused nothing: give longer drives, of one clock')
    return at(best.x)


def tune_by_grid(drives: Sequence[TuningDrive], config: FilterConfig) -> FilterConfig:
    """The pair of FACTORS with the least mean error (paper)."""
    pairs = list(itertools.product(FACTORS, FACTORS))
    trials = [replace(config, measurement_factor=a, odometry_factor=b) for a, b in pairs]
    tried = progress_over(trials, 'tune by grid', len(trials), 'trials', visible=True)
    return min(tried, key=lambda trial: error_cost(drives, trial))


def likelihood_cost(drives: Sequence[TuningDrive], config: FilterConfig) -> float:
    """Negative log-likelihood per innovation component, under Student's distribution.

    Its tails limit the weight of rejected images; under a Gaussian cut at the gate, the best filter
    would reject everything.
    """
    fused = [(drive, drive.filter_for(config)) for drive in drives]
    updates = [update for drive, of_drive in fused for _, update, _ in drive.fuse(of_drive)]
    innovations = [(u.d2, u.covariance) for u in updates if u.covariance is not None]
    total = sum(
        np.linalg.slogdet(spread)[1] / 2 + surprise(d2, len(spread)) for d2, spread in innovations
    )
    count = sum(len(spread) for _, spread in innovations)
    return float(total / count) if count else math.inf


def error_cost(drives: Sequence[TuningDrive], config: FilterConfig) -> float:
    """Mean position error, m, after rigid alignment of the poses from images alone (paper)."""
    errors = [np.zeros(0)]
    for drive in drives:
        assert drive.truth is not None
        fused = drive.filter_for(config)
        images, _, states = zip(*drive.fuse(fused), strict=True)
        stamps = np.array([image.stamp_ns for image in images])
        taken = drive.truth.at(stamps - fused.camera_clock.delay_ns)[:, :2]
        to_truth = align(np.array([image.position for image in images]), taken)
        believed = np.array([state.pose if state else np.full(3, np.nan) for state in states])
        miss = to_truth.apply(believed[:, :2]) - drive.truth.at(stamps)[:, :2]
        errors.append(np.hypot(*miss[np.isfinite(miss[:, 0])].T))
    every = np.concatenate(errors)
    return float(every.mean()) if len(every) else math.inf
