# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from drives: by likelihood, or by the paper's grid search.

The likelihood needs no ground truth: the innovations of a well-tuned filter are as large as its
covariances. The grid search of the paper (section 5.1) takes the least mean error against truth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from sfa_localization.bags.drives import as_live
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.events import ODOMETRY, merge_by_stamp
from sfa_localization.data.geometry import Array, align
from sfa_localization.data.progress import progress_bar
from sfa_localization.data.run import Odometry, Stamps, Trajectory
from sfa_localization.data.settings import Settings, setting
from sfa_localization.evaluation import observed
from sfa_localization.fusion.pose_filter import PoseFilter, Update
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.localizer import Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""The grid: factors on the variances of images and of odometry."""
TUNED = ('measurement_factor', 'odometry_factor', 'slip_per_metre', 'yaw_per_radian')
"""What the likelihood decides, each on a logarithmic scale."""
MIN_IMAGES = 20
"""With fewer images, chance decides between the settings."""
_LEAST = 1e-9  # stands for a parameter of zero, which has no logarithm
_FIRST_STEP = 0.7  # of each logarithm: a factor of two
_PULL = 1e-3  # cost per squared logarithm: holds what the data do not determine at the start
_TAIL = 4.0  # degrees of freedom of Student's distribution: moderate tails


@dataclass(frozen=True, slots=True)
class TuneConfig(Settings):
    """How to search for the filter's noise parameters."""

    method: str = setting(
        'likelihood',
        'likelihood (needs no ground truth), or grid (the search of the paper, which does)',
        choices=('likelihood', 'grid'),
    )
    trials: int = setting(120, 'settings to try by likelihood', low=10, high=100_000)


class ImagePoses(NamedTuple):
    """Of the usable images of a drive: stamps (N,), poses (N, 3), covariances (N, 3, 3)."""

    stamps_ns: Stamps
    poses: Array
    covariances: Array


@dataclass(frozen=True, slots=True)
class TuningDrive:
    """One drive to tune on; `truth` only for the grid search. `correlation` is the model's."""

    odometry: Odometry
    images: ImagePoses
    truth: Trajectory | None = None
    correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)

    def halves(self) -> list[TuningDrive]:
        """The drive before and after the middle of its images."""
        stamps = self.images.stamps_ns
        middle_ns = int(np.median(stamps)) if len(stamps) else 0
        parts = []
        for early in (True, False):
            rows = (self.odometry.stamps_ns < middle_ns) == early
            seen = (stamps < middle_ns) == early
            odometry = [getattr(self.odometry, item.name)[rows] for item in fields(self.odometry)]
            images = ImagePoses(*(part[seen] for part in self.images))
            parts.append(replace(self, odometry=Odometry(*odometry), images=images))
        return parts


@dataclass(frozen=True, slots=True)
class Outcome:
    """Cost of one setting: negative mean log-likelihood, or mean error in meters."""

    config: FilterConfig
    cost: float


@dataclass(frozen=True, slots=True)
class Validation:
    """Mean costs on drives that were not tuned on: of the settings `before`, and `after`."""

    before: float
    after: float

    @property
    def better(self) -> bool:
        return self.after < self.before


def read_drive(
    bag: Path, model: PlaceModel, recipe: Recipe, watch: WatchConfig | None, want_truth: bool
) -> TuningDrive:
    """A bag's odometry, and the poses of its images by the model. Raises BagError, DataError."""
    live = as_live(recipe, model.panorama)
    with observed(bag, Observer(model, watch), live, True, want_truth) as (run, observations):
        usable = [one for one in observations if not one.problem]
    images = ImagePoses(
        np.array([one.stamp_ns for one in usable], np.int64),
        np.reshape([one.pose for one in usable], (-1, 3)),
        np.reshape([one.covariance for one in usable], (-1, 3, 3)),
    )
    return TuningDrive(run.odometry, images, run.ground_truth, model.error_correlation)


def tune(
    drives: Sequence[TuningDrive], config: FilterConfig, how: TuneConfig, progress: bool
) -> Outcome:
    """The best setting by the method of `how`. Raises DataError without enough data."""
    images = sum(len(drive.images.stamps_ns) for drive in drives)
    if images < MIN_IMAGES:
        raise DataError(f'{images} images are too few to tune on: {MIN_IMAGES} at least')
    total = len(FACTORS) ** 2 if how.method == 'grid' else how.trials
    with progress_bar(f'tune by {how.method}', total, 'trials', shown=progress) as bar:
        if how.method == 'grid':
            return tune_by_grid(drives, config, bar.update)
        return tune_by_likelihood(drives, config, how.trials, bar.update)


def validate(
    drives: Sequence[TuningDrive], config: FilterConfig, how: TuneConfig, progress: bool
) -> Validation | None:
    """Leave out one drive at a time, or one half of a single one: tune on the others, judge on it.

    None where one has too few images to decide anything.
    """
    parts = drives if len(drives) > 1 else drives[0].halves()
    if min(len(part.images.stamps_ns) for part in parts) < MIN_IMAGES:
        return None
    cost = error_cost if how.method == 'grid' else likelihood_cost
    costs = []
    for part in parts:
        found = tune([other for other in parts if other is not part], config, how, progress)
        costs.append((cost([part], config), cost([part], found.config)))
    return Validation(*np.mean(costs, axis=0).tolist())


def tune_by_likelihood(
    drives: Sequence[TuningDrive], config: FilterConfig, trials: int, tried: Callable[[], object]
) -> Outcome:
    """The setting under which the innovations are likeliest; `tried` is called after each trial.

    Nelder-Mead over the logarithms of TUNED: the cost is not smooth where the gate decides.
    """
    start = np.log([getattr(config, name) or _LEAST for name in TUNED])

    def cost(logs: Array) -> float:
        tried()
        pull = _PULL * float(np.sum((logs - start) ** 2))
        return likelihood_cost(drives, with_logs(config, logs)) + pull

    simplex = np.vstack([start, start + _FIRST_STEP * np.eye(len(TUNED))])
    options = {'maxfev': trials, 'initial_simplex': simplex, 'xatol': 0.05, 'fatol': 1e-3}
    found = minimize(cost, start, method='Nelder-Mead', options=options)
    return Outcome(with_logs(config, found.x), float(found.fun))


def tune_by_grid(
    drives: Sequence[TuningDrive], config: FilterConfig, tried: Callable[[], object]
) -> Outcome:
    """The paper's grid search: the pair of factors with the least mean error against truth."""
    if any(drive.truth is None for drive in drives):
        raise DataError('the grid search needs ground truth in every bag; use the likelihood')
    outcomes = []
    for images, odometry in itertools.product(FACTORS, FACTORS):
        trial = replace(config, measurement_factor=images, odometry_factor=odometry)
        outcomes.append(Outcome(trial, error_cost(drives, trial)))
        tried()
    return min(outcomes, key=lambda outcome: outcome.cost)


def likelihood_cost(drives: Iterable[TuningDrive], config: FilterConfig) -> float:
    """Negative log-likelihood per innovation component, under Student's distribution.

    Its tails let the gate's outliers count without ruling; under a Gaussian cut at the gate the
    best filter would be one that rejects everything.
    """
    total, count = 0.0, 0
    for drive in drives:
        for update in _fuse(PoseFilter(config, drive.correlation), drive):
            if update.covariance is None:
                continue
            size = len(update.covariance)
            log_det = float(np.linalg.slogdet(update.covariance)[1])
            total += log_det / 2 + (_TAIL + size) / 2 * math.log1p(update.d2 / _TAIL)
            count += size
    return total / count if count else math.inf


def error_cost(drives: Iterable[TuningDrive], config: FilterConfig) -> float:
    """Mean position error, m, after rigid alignment of the poses from images alone (paper)."""
    errors = []
    for drive in drives:
        if drive.truth is None:
            continue
        fused = PoseFilter(config, drive.correlation)
        true = drive.truth.at(drive.images.stamps_ns)[:, :2]
        to_truth = align(drive.images.poses[:, :2], true)
        for update, position in zip(_fuse(fused, drive), true, strict=True):
            state = fused.at(update.stamp_ns)
            if state is not None:
                estimate = to_truth.apply(state.pose[None, :2])[0]
                errors.append(math.hypot(*(estimate - position)))
    return float(np.mean(errors)) if errors else math.inf


def _fuse(fused: PoseFilter, drive: TuningDrive) -> Iterator[Update]:
    """Feed a drive in the order of time; yields an update for each image."""
    odometry, images = drive.odometry, drive.images
    for stamp_ns, kind, i in merge_by_stamp(odometry.stamps_ns, images.stamps_ns):
        if kind == ODOMETRY:
            v, omega = odometry.twists[i]
            pose = odometry.poses[i].tolist()
            fused.add_odometry(stamp_ns, v, omega, odometry.variances[i], pose)
        else:
            yield fused.add_measurement(stamp_ns, images.poses[i], images.covariances[i])


def with_logs(config: FilterConfig, logs: Array) -> FilterConfig:
    """The settings with other values of TUNED, given as logarithms (4,), kept in their ranges."""
    ranges = {item.name: item.metadata for item in fields(config)}
    changes: dict[str, Any] = {}
    for name, log in zip(TUNED, logs, strict=True):
        low, high = ranges[name]['low'] or _LEAST, ranges[name]['high']
        changes[name] = float(np.clip(math.exp(min(log, 50.0)), low, high))
    return replace(config, **changes)
