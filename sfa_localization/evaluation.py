# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far the estimates are from the truth: the paper's protocol (section 4).

The map is known up to a rotation and a translation. They are fitted on the estimates of a training
drive and applied unchanged to the drive that is judged; the error is the Euclidean distance.
"""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from sfa_localization.bags.drives import as_live, image_folder, read_drive
from sfa_localization.bags.reader import Bag
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.camera.turns import headings
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import (
    Array,
    RigidTransform,
    align,
    compose,
    invert,
    rotation,
    wrap_angle,
)
from sfa_localization.data.progress import progress_bar, progress_over
from sfa_localization.data.run import Count, Run, Stamps, Trajectory
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.camera_clock import CameraClock, camera_clock
from sfa_localization.fusion.inputs import OpenLoop
from sfa_localization.fusion.motion import State
from sfa_localization.fusion.odometry import COAST_S
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.replay import Track
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother
from sfa_localization.fusion.status import Level
from sfa_localization.localizer import Localizer, Observation, Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe

Scores = dict[str, dict[str, Any]]
_TRUTH_TOLERANCE_NS = 500_000_000
WRONG_M = 1.0
"""A LOCALISED robot that is farther off is wrong."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A judged drive. `estimates` are in the truth's frame.

    `features` (N, K) are those of the usable images, of which `estimates['sfa']` is.
    `aligned_on` names the drives on which `transform`, from map to truth, was fitted.
    """

    truth: Trajectory
    estimates: dict[str, Trajectory]
    scores: Scores
    counts: dict[str, Any]
    features: Array
    aligned_on: str
    transform: RigidTransform

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers: one entry per estimate, and the counts."""
        return {**self.scores, 'counts': self.counts, 'aligned_on': self.aligned_on}


@dataclass(frozen=True, slots=True)
class _Drive:
    """What model and filter make of a drive.

    `tracks` holds 'sfa', the usable images, of which `features` (N, K) are; 'ekf', the filter at
    each odometry message, and whether it was LOCALISED there, `sure` (T,); and 'smoothed', if
    wanted. `counts` are those of messages, of observations, of what was fused, and of states.
    """

    run: Run
    truth: Trajectory
    tracks: dict[str, Track]
    features: Array
    sure: NDArray[np.bool_]
    counts: dict[str, Any]

    @property
    def images(self) -> Trajectory:
        """The usable images in the map."""
        return self.tracks['sfa'].poses


@one_core()
def evaluate(
    model: PlaceModel,
    bag: Path,
    *,
    align_bags: Sequence[Path] = (),
    recipe: Recipe | None = None,
    config: FilterConfig | None = None,
    watch: WatchConfig | None = None,
    progress: bool = False,
    smooth: bool = False,
    transform: RigidTransform | None = None,
) -> Evaluation:
    """Judge a model on a drive with ground truth, by what sfa_node and ekf_node would publish.

    The transform to the truth is fitted on `align_bags`, training drives; without any, on the
    drive itself; a known `transform`, of an earlier evaluation, is used as it is. `smooth` adds the
    filter's estimates smoothed after the drive. Unusable images count as skipped observations.
    Raises BagError or DataError, also without ground truth.
    """
    recipe = as_live(recipe or Recipe(), model.panorama)
    given = [(one, Localizer(model, config, watch), _present(one, recipe)) for one in align_bags]
    trained = [_driven(*one, progress) for one in given]
    kind = Smoother if smooth else PoseFilter
    drive = _driven(bag, Localizer(model, config, watch, kind), recipe, progress)
    bags = ', '.join(map(str, align_bags or [bag]))
    aligned_on = 'nothing: the transform was given' if transform else bags
    transform = transform or fit_transform(*((one.truth, one.images) for one in trained or [drive]))
    estimates = {'odometry': odometry_from_start(drive.truth, drive.run)}
    estimates |= {name: moved(track.poses, transform) for name, track in drive.tracks.items()}
    return Evaluation(
        drive.truth,
        estimates,
        _scores(drive, estimates, transform),
        {**drive.counts, 'false_localised_s': _false_localised_s(drive, estimates['ekf'])},
        drive.features,
        aligned_on,
        transform,
    )


def _scores(
    drive: _Drive, estimates: Mapping[str, Trajectory], transform: RigidTransform
) -> Scores:
    """The errors of every estimate; of the model's also calibration and similarity."""
    truth, turn = drive.truth, rotation(transform.yaw_rad)
    scores = {name: score(truth, estimate) for name, estimate in estimates.items()}
    for name, track in drive.tracks.items():
        scores[name] |= calibration(truth, estimates[name], turn, track.covariances)
        scores[name]['similarity'] = similarity(truth, estimates[name])
    return scores


def observed(
    bag: Path, observer: Observer, recipe: Recipe, progress: bool, want_truth: bool = True
) -> tuple[Run, list[Observation]]:
    """A drive, and what the model makes of its images as the nodes see them; `recipe` is live.

    Raises BagError or DataError, also without a wanted truth.
    """
    run = _read(bag, recipe, progress, want_truth)
    images, title = observer.observe_run(run), f'locate the images of {run.name}'
    return run, [*progress_over(images, title, len(run.panoramas), visible=progress)]


def _present(path: Path, recipe: Recipe) -> Recipe:
    """The recipe with the names of topics that a bag has; others are found by their types there."""
    with Bag(path) as bag:
        there = {f'/{name.lstrip("/")}' for name in bag.topics}
    missing = {
        item.name: ''
        for item in fields(recipe.topics)
        if f'/{getattr(recipe.topics, item.name).partition(":")[0].lstrip("/")}' not in there
    }
    return replace(recipe, topics=replace(recipe.topics, **missing))


def _read(bag: Path, recipe: Recipe, progress: bool, truth: bool = True) -> Run:
    cache = image_folder(Path(tempfile.gettempdir()) / 'sfa_localization_evaluate')
    run = read_drive(bag, cache, recipe, progress, want_truth=truth)
    if truth and (run.ground_truth is None or len(run.ground_truth) < 2):
        raise DataError(f'{bag}: no ground truth to judge by; name it with --ground-truth-topic')
    return run


def _driven(bag: Path, localizer: Localizer, recipe: Recipe, progress: bool) -> _Drive:
    """Run model and filter over a bag. Raises BagError or DataError."""
    run = _read(bag, recipe, progress)
    observations, moments = _replayed(localizer, run, progress)
    clock = camera_clock(run.odometry, run.panoramas.stamps_ns, headings(run.panoramas))
    usable = [one for one in observations if not one.problem]
    if not usable:
        raise DataError(f'{run.name}: no image can be used: {observations[0].problem}')
    skipped = Counter(one.problem for one in observations if one.problem)
    counts: dict[str, Any] = {name: count.as_dict() for name, count in run.counts.items()}
    counts['observations'] = Count(len(usable), dict(skipped)).as_dict()
    stamps, levels, states = zip(*moments, strict=True) if moments else ((), (), ())
    lasted_s = _lasted_s(np.array([run.odometry.stamps_ns[0], *stamps]))[1:]
    counts['fusion'], counts['states_s'] = (
        dict(localizer.filter.counts),
        {
            level.name: float(lasted_s[np.array(levels) == level].sum())
            for level in dict.fromkeys(levels)
        },
    )
    counts['nis'] = None if math.isnan(localizer.filter.nis) else localizer.filter.nis
    if clock.delay_ns:
        counts['camera_delay_s'] = round(clock.delay_s, 3)
    if OpenLoop.of(run.odometry.twists).found:  # the robot is late, not the images
        clock = CameraClock()
    located = [(state, level) for level, state in zip(levels, states, strict=True) if state]
    tracks = {'sfa': _images(usable, clock), 'ekf': Track.of([state for state, _ in located])}
    if isinstance(localizer.filter, Smoother):
        tracks['smoothed'] = Track.of(localizer.filter.smoothed())
    sure = np.array([level is Level.LOCALISED for _, level in located], bool)
    assert run.ground_truth is not None
    features = np.array([one.slow_features for one in usable])
    return _Drive(run, run.ground_truth, tracks, features, sure, counts)


def _replayed(
    localizer: Localizer, run: Run, progress: bool
) -> tuple[list[Observation], list[tuple[int, Level, State | None]]]:
    """Observations of all images; stamp, level and estimate at each odometry message."""
    observations, moments = list[Observation](), list[tuple[int, Level, State | None]]()
    title = f'locate the images of {run.name}'
    with progress_bar(title, len(run.panoramas), visible=progress) as bar:
        for stamp_ns, observation, state in localizer.replay(run):
            if observation is None:
                moments.append((stamp_ns, localizer.status.level, state))
                continue
            observations.append(observation)
            bar.update()
    return observations, moments


def _lasted_s(stamps_ns: Stamps) -> Array:
    """Seconds (N,) until each stamp from the one before, at most COAST_S: in a pause of the
    recording nobody says anything.
    """
    return np.minimum(np.diff(stamps_ns, prepend=stamps_ns[:1]) * 1e-9, COAST_S)


def _images(usable: list[Observation], clock: CameraClock) -> Track:
    """The usable images in the map.

    The map is judged where images were taken, by `clock`; the filter has to find out by itself.
    """
    stamps = np.array([one.stamp_ns for one in usable], np.int64) - clock.delay_ns
    poses = np.array([[*one.position, one.yaw] for one in usable])
    return Track(Trajectory(stamps, poses), np.array([one.covariance for one in usable]))


def known(truth: Trajectory, stamps_ns: Stamps) -> Any:
    """Mask (N,) of the stamps at which the truth is known."""
    return truth.covers(stamps_ns, _TRUTH_TOLERANCE_NS)


def fit_transform(*drives: tuple[Trajectory, Trajectory]) -> RigidTransform:
    """Rotation and translation that lay estimates, in the map, on the truth: of each drive its
    truth and its estimates. Raises DataError.
    """
    found, right = (np.concatenate(parts) for parts in zip(*map(_pairs, drives), strict=True))
    if len(found) < 2:
        raise DataError('the ground truth covers fewer than two images: are the clocks the same?')
    return align(found, right)


def _pairs(drive: tuple[Trajectory, Trajectory]) -> tuple[Array, Array]:
    """Estimated and true positions (N, 2) m of a truth and its estimates, where both are known."""
    truth, estimate = drive
    mask = known(truth, estimate.stamps_ns) & np.isfinite(estimate.poses[:, 0])
    return estimate.poses[mask, :2], truth.at(estimate.stamps_ns[mask])[:, :2]


def similarity(truth: Trajectory, estimate: Trajectory) -> dict[str, float | None]:
    """`mean` error (m) that is left when rotation, translation and `scale` are fitted on the
    estimate itself: what remains when the wheels' radius and the map's place do not matter.
    """
    found, right = _pairs((truth, estimate))
    if len(found) < 2:
        return {'mean': None, 'scale': None}
    laid = align(found, right).apply(found)
    offset, center = laid - laid.mean(0), right.mean(0)
    square = float((offset**2).sum())
    scale = float((offset * (right - center)).sum()) / square if square > 0 else 1.0
    errors = np.hypot(*(scale * offset + center - right).T)
    return {'mean': float(errors.mean()), 'scale': scale}


def calibration(
    truth: Trajectory, estimate: Trajectory, turn: Array, covariances: Array
) -> dict[str, Any]:
    """Shares of the errors that regions of 95 % hold: `within_95` of the positions' ellipses,
    `yaw_within_95` of the headings' intervals; and `nees`, the normalized squared error of the
    positions over its expectation. `nees_right` [low, high] holds it on 95 % of drives with right
    covariances: neighboring errors are alike, so that one drive shows few of them.

    `covariances` (N, 3, 3) of [x, y, yaw] are in the map, `turn` (2, 2) rotates it to the truth.
    """
    mask = known(truth, estimate.stamps_ns)
    if not mask.any():
        return dict.fromkeys(('within_95', 'yaw_within_95', 'nees', 'nees_right'))
    apart = estimate.poses[mask] - truth.at(estimate.stamps_ns[mask])
    offset, covariances = apart[:, :2] @ turn, covariances[mask]
    roots = np.linalg.cholesky(covariances[:, :2, :2])
    normalized = np.linalg.solve(roots, offset[:, :, None])[:, :, 0]
    squares = (normalized**2).sum(1)
    freedom = 2 * _independent(normalized)
    yaw = wrap_angle(apart[:, 2]) ** 2 / covariances[:, 2, 2]
    yaw = yaw[np.isfinite(yaw)]
    return {
        'within_95': float((squares <= stats.chi2.ppf(0.95, 2)).mean()),
        'yaw_within_95': float((yaw <= stats.chi2.ppf(0.95, 1)).mean()) if len(yaw) else None,
        'nees': float(squares.mean() / 2),
        'nees_right': (stats.chi2.ppf((0.025, 0.975), freedom) / freedom).tolist(),
    }


def _independent(normalized: Array) -> float:
    """How many independent squares are worth those of errors (N, 2) that neighbors share.

    A mean of squares of Gaussian errors with correlation r(lag) varies as that of
    N / sum of r(lag)^2 independent ones; r counts as far as it is positive.
    """
    count = len(normalized)
    lagged = (signal.correlate(one, one, method='fft')[count - 1 :] for one in normalized.T)
    shared: Array = np.sum([*lagged], axis=0)
    fades = np.flatnonzero(shared <= 0)
    shared = shared[: fades[0]] if len(fades) else shared
    return count / (1 + 2 * float(((shared[1:] / shared[0]) ** 2).sum())) if len(shared) else count


def _false_localised_s(drive: _Drive, ekf: Trajectory) -> float:
    """Seconds in which the filter was LOCALISED and more than `WRONG_M` off."""
    stamps, truth = ekf.stamps_ns, drive.truth
    apart = np.hypot(*(ekf.poses - truth.at(stamps))[:, :2].T)
    wrong = drive.sure & known(truth, stamps) & (apart > WRONG_M)
    return float(_lasted_s(stamps)[wrong].sum())


def moved(estimate: Trajectory, transform: RigidTransform) -> Trajectory:
    """A trajectory in the frame that the transform leads to."""
    positions = transform.apply(estimate.poses[:, :2])
    yaw = transform.apply_yaw(estimate.poses[:, 2])
    return Trajectory(estimate.stamps_ns, np.column_stack([positions, yaw]))


def odometry_from_start(truth: Trajectory, run: Run) -> Trajectory:
    """Odometry alone, from the true pose where the truth begins."""
    path = run.odometry.trajectory
    stamps = path.stamps_ns[known(truth, path.stamps_ns)]
    if len(stamps) == 0:
        raise DataError(f'{run.name}: ground truth and odometry share no time')
    start = compose(truth.at(stamps[:1])[0], invert(path.at(stamps[:1])[0]))
    return Trajectory(stamps, compose(np.broadcast_to(start, (len(stamps), 3)), path.at(stamps)))


def score(truth: Trajectory, estimate: Trajectory) -> dict[str, Any]:
    """Mean, median, 95th percentile, rmse, max (m) and count of the position errors.

    `yaw_deg` holds mean, median and p95 of the heading errors where there is a heading. The
    numbers are None where no estimate can be judged.
    """
    mask = known(truth, estimate.stamps_ns)
    at = truth.at(estimate.stamps_ns[mask])
    errors = np.hypot(*(estimate.poses[mask, :2] - at[:, :2]).T)
    yaw = np.degrees(np.abs(wrap_angle(estimate.poses[mask, 2] - at[:, 2])))
    yaw = yaw[np.isfinite(yaw)]
    if len(errors) == 0:
        empty = dict.fromkeys(('mean', 'median', 'p95', 'rmse', 'max'))
        return {**empty, 'n': 0, 'yaw_deg': None}
    return {
        **_summary(errors),
        'rmse': float(np.sqrt((errors**2).mean())),
        'max': float(errors.max()),
        'n': len(errors),
        'yaw_deg': _summary(yaw) if len(yaw) else None,
    }


def _summary(values: Array) -> dict[str, float]:
    return {
        'mean': float(values.mean()),
        'median': float(np.median(values)),
        'p95': float(np.percentile(values, 95)),
    }
