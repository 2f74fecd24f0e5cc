# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Find the filter's noise parameters from drives: by likelihood, or by the paper's grid search.

The likelihood needs no ground truth: the innovations of a well-tuned filter are as large as it
says that they are. The grid search of the paper compares poses with ground truth, where there is
some, and takes the least mean error.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from tqdm import tqdm

from sfa_localization.bags.drives import as_live, read_drive
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.errors import DataError
from sfa_localization.data.events import ODOMETRY, in_order
from sfa_localization.data.geometry import Array, align
from sfa_localization.data.run import Odometry, Run, Stamps, Trajectory
from sfa_localization.data.settings import Settings, setting
from sfa_localization.fusion.pose_filter import PoseFilter, Update
from sfa_localization.fusion.settings import FilterConfig, resolved
from sfa_localization.localizer import Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""The grid: factors on the variances of pictures and of odometry."""
TUNED = (
    'measurement_factor',
    'odometry_factor',
    'slip_per_metre',
    'yaw_per_metre',
    'decorrelation',
)
"""What the likelihood decides, each on a logarithmic scale."""
_SPREAD = 0.7
_ENOUGH = 20
_TAIL = 4.0


@dataclass(frozen=True, slots=True)
class TuneConfig(Settings):
    """How the filter's noise parameters are sought."""

    method: str = setting(
        'likelihood',
        'likelihood (needs no ground truth), or grid (the search of the paper, which does)',
        choices=('likelihood', 'grid'),
    )
    trials: int = setting(120, 'settings to try by likelihood', low=10, high=100_000)


@dataclass(frozen=True, slots=True)
class Sight:
    """What the usable pictures of a drive show: stamps (N,), poses (N, 3), covariances (N, 3, 3).

    An unusable picture changes nothing in the filter.
    """

    stamps_ns: Stamps
    poses: Array
    covariances: Array


@dataclass(frozen=True, slots=True)
class Tour:
    """One drive to tune on; `truth` only for the grid search."""

    odometry: Odometry
    sight: Sight
    truth: Trajectory | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Cost of one setting: negative mean log-likelihood, or mean error in metres."""

    config: FilterConfig
    cost: float


def read_tours(
    bags: Sequence[Path],
    model: PlaceModel,
    recipe: Recipe,
    want_truth: bool,
    progress: bool,
    watch: WatchConfig | None = None,
) -> list[Tour]:
    """What the model sees in the pictures of each bag, and the bag's odometry. Raises BagError."""
    tours = []
    for bag in bags:
        with TemporaryDirectory(prefix='sfa_localization_tune_') as cache:
            run = read_drive(
                bag, Path(cache), as_live(recipe, model.panorama), progress, want_truth=want_truth
            )
            sight = _sight(run, Observer(model, watch), progress)
            tours.append(Tour(run.odometry, sight, run.ground_truth))
    return tours


def _sight(run: Run, observer: Observer, progress: bool) -> Sight:
    with tqdm(total=len(run.panoramas), desc='locating', unit='img', disable=not progress) as bar:
        seen = []
        for observation in observer.observe_run(run):
            bar.update()
            if not observation.problem:
                seen.append(observation)
    return Sight(
        np.array([one.stamp_ns for one in seen], np.int64),
        np.reshape([one.pose for one in seen], (-1, 3)),
        np.reshape([one.covariance for one in seen], (-1, 3, 3)),
    )


def tune(tours: Sequence[Tour], config: FilterConfig, how: TuneConfig, progress: bool) -> Outcome:
    """The best setting found the way that `how` says. Raises DataError without enough data."""
    total = len(FACTORS) ** 2 if how.method == 'grid' else how.trials
    with tqdm(total=total, desc=how.method, unit='trial', disable=not progress) as bar:
        if how.method == 'grid':
            return tune_by_grid(tours, config, bar.update)[0]
        return tune_by_likelihood(tours, config, how.trials, bar.update)


def tune_by_likelihood(
    tours: Sequence[Tour], config: FilterConfig, steps: int, told: Callable[[], object]
) -> Outcome:
    """The setting under which the innovations are likeliest; `told` is called after each trial.

    Nelder-Mead over the logarithms of TUNED: the cost is not smooth where the gate decides.
    """
    _require_data(tours)
    config = resolved(config)
    start = np.log([getattr(config, name) for name in TUNED])

    def cost(logs: NDArray[np.float64]) -> float:
        told()
        # A weak pull to the start keeps what the data say nothing about where it was.
        pull = 1e-3 * float(np.sum((logs - start) ** 2))
        return likelihood_cost(tours, _with_logs(config, logs)) + pull

    simplex = np.vstack([start, start + _SPREAD * np.eye(len(TUNED))])
    found = minimize(
        cost,
        start,
        method='Nelder-Mead',
        options={'maxfev': steps, 'initial_simplex': simplex, 'xatol': 0.05, 'fatol': 1e-3},
    )
    return Outcome(_with_logs(config, found.x), float(found.fun))


def tune_by_grid(
    tours: Sequence[Tour], config: FilterConfig, told: Callable[[], object]
) -> list[Outcome]:
    """The paper's grid search: every pair of factors, the least mean error against truth first."""
    _require_data(tours)
    if any(tour.truth is None for tour in tours):
        raise DataError('the grid search needs ground truth in every bag; use the likelihood')
    outcomes = []
    for pictures, odometry in itertools.product(FACTORS, FACTORS):
        trial = dataclasses.replace(config, measurement_factor=pictures, odometry_factor=odometry)
        outcomes.append(Outcome(trial, error_cost(tours, trial)))
        told()
    return sorted(outcomes, key=lambda outcome: outcome.cost)


def likelihood_cost(tours: Iterable[Tour], config: FilterConfig) -> float:
    """Negative log-likelihood per innovation component, under Student's distribution.

    Its tails let the gate's outliers count without ruling; under a Gaussian cut at the gate the
    best filter would be one that refuses everything.
    """
    total, count = 0.0, 0
    for tour in tours:
        for update in _fuse(PoseFilter(config), tour):
            if update.covariance is None:
                continue
            size = len(update.covariance)
            spread = float(np.linalg.slogdet(update.covariance)[1])
            total += spread / 2 + (_TAIL + size) / 2 * math.log1p(update.d2 / _TAIL)
            count += size
    return total / count if count else math.inf


def error_cost(tours: Iterable[Tour], config: FilterConfig) -> float:
    """Mean position error, m, after rigid alignment of what the pictures alone tell (paper)."""
    errors = []
    for tour in tours:
        if tour.truth is None:
            continue
        fused = PoseFilter(config)
        to_truth = align(tour.sight.poses[:, :2], tour.truth.at(tour.sight.stamps_ns)[:, :2])
        for update in _fuse(fused, tour):
            state = fused.at(update.stamp_ns)
            if state is not None:
                true = tour.truth.at(np.array([update.stamp_ns]))[0]
                miss = to_truth.apply(state.pose[None, :2])[0] - true[:2]
                errors.append(math.hypot(*miss))
    return float(np.mean(errors)) if errors else math.inf


def _fuse(fused: PoseFilter, tour: Tour) -> Iterator[Update]:
    """Feed a tour in the order of time; yields the updates."""
    odometry, sight = tour.odometry, tour.sight
    for stamp_ns, kind, i in in_order(odometry.stamps_ns, sight.stamps_ns):
        if kind == ODOMETRY:
            v, omega = odometry.twists[i]
            pose = odometry.poses[i].tolist()
            fused.add_odometry(stamp_ns, v, omega, odometry.variances[i], pose)
        else:
            yield fused.add_measurement(stamp_ns, sight.poses[i], sight.covariances[i])


def _with_logs(config: FilterConfig, logs: NDArray[np.float64]) -> FilterConfig:
    """The settings with those of TUNED, kept inside their ranges."""
    ranges = {item.name: item.metadata for item in dataclasses.fields(config)}
    values: dict[str, Any] = {}
    for name, log in zip(TUNED, logs, strict=True):
        meta = ranges[name]
        values[name] = float(np.clip(math.exp(min(log, 50.0)), meta['low'] or 1e-9, meta['high']))
    return dataclasses.replace(config, **values)


def _require_data(tours: Sequence[Tour]) -> None:
    pictures = sum(len(tour.sight.stamps_ns) for tour in tours)
    if pictures < _ENOUGH:
        raise DataError(f'{pictures} pictures are too few to tune on: {_ENOUGH} at least')
