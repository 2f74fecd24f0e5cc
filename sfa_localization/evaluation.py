# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far the estimates are from the ground truth: the paper's protocol (section 4).

Training determines the map up to a rotation and a translation. Both are fitted on the estimates of
the training drives and applied unchanged to the test drive; the error is the Euclidean distance.
"""

from __future__ import annotations

import logging
import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import signal, stats

from sfa_localization.bags.drives import as_live, image_folder, read_drive
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.surround_drive import yaws_of
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.camera.yaws import AS_TRAINED, KNOCKED_RAD
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import (
    Array,
    Mask,
    RigidTransform,
    align,
    compose,
    invert,
    rotation,
    wrap_angle,
)
from sfa_localization.data.progress import progress_over
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import Count, Run, Stamps, Trajectory
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.camera_clock import SIGNIFICANT_STDS, CameraClock, camera_clock
from sfa_localization.fusion.inputs import OpenLoop
from sfa_localization.fusion.odometry import COAST_S
from sfa_localization.fusion.pose_filter import PoseFilter, State, Status
from sfa_localization.fusion.replay import FilterTrack, replay
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother
from sfa_localization.fusion.status import MOST_SILENCE_S, Level
from sfa_localization.keyframes.closures import Closures
from sfa_localization.localizer import Localizer
from sfa_localization.motion.check import MotionCheck, check_motion
from sfa_localization.motion.dead_reckoning import OdometryTrack, Way
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.motion.sources import Drift
from sfa_localization.motion.truth import NO_OFFSET, TruePoses, true_poses
from sfa_localization.motion.turns import Headings, by_images
from sfa_localization.observer import Observation, Observer
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe

logger = logging.getLogger(__name__)
Scores = dict[str, dict[str, Any]]
_TRUTH_TOLERANCE_NS = 500_000_000
WRONG_M = 1.0
"""Position error from which a filter that says LOCALISED is wrong."""


class Step(NamedTuple):
    """What ekf_node would publish after a message: its `status`, and its `state` at the stamp of
    the message. `image` is what sfa_node would publish of it; None after odometry.
    """

    stamp_ns: int
    image: Observation | None
    status: Status
    state: State | None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A test drive with its errors. `estimates` are in the frame of the ground truth.

    `features` (N, K) belong to the usable images, as `estimates['sfa']` does. `transform` leads
    from the map to the truth; `aligned_on` names the drives on which it was fitted.
    """

    truth: Trajectory
    estimates: dict[str, Trajectory]
    scores: Scores
    counts: dict[str, Any]
    features: Array
    aligned_on: str
    transform: RigidTransform
    run: Run
    steps: list[Step]
    """What the nodes would publish on the run, in the frame of the map."""
    corrections: tuple[str, ...] = ()
    """What was corrected of the ground truth of each drive, in sentences."""

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers: one entry per estimate, and the counts."""
        notes = {'aligned_on': self.aligned_on, 'corrections': list(self.corrections)}
        return {**self.scores, 'counts': self.counts, **notes}


@dataclass(frozen=True, slots=True)
class _Located:
    """A drive whose images the model located, compared with its ground truth.

    `images` are the poses of the usable ones in the map, where they were taken; `clock` is that of
    the camera. The `sentences` say what was corrected, of the truth and of clocks.
    """

    run: Run
    observations: list[Observation]
    true: TruePoses
    images: FilterTrack
    clock: CameraClock
    sentences: tuple[str, ...]


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
    """Compare with the ground truth of a drive what sfa_node and ekf_node would publish on it.

    The transform from map to truth is fitted on `align_bags`, the training drives, or without any
    on the test drive; a given `transform` is used as it is. `smooth` adds the filter's estimates
    smoothed after the drive. Unusable images count as skipped observations. Raises BagError or
    DataError, also without ground truth.
    """
    recipe = as_live(recipe or Recipe(), model.panorama, model.lens, model.surround)
    recipe = replace(recipe, origin=model.origin)
    drives = list[_Located]()
    for path in align_bags:
        here = _with_topics_of(path, recipe)
        drives.append(_located(path, Observer(model, watch), here, progress))
        recipe = replace(recipe, origin=drives[-1].run.origin)
    localizer = Localizer(model, config, watch, Smoother if smooth else PoseFilter)
    usual = np.median([drive.true.offset for drive in drives] or [NO_OFFSET], axis=0)
    drives.append(_located(bag, localizer.observer, recipe, progress, usual.tolist()))
    aligned_on = 'nothing: coordinates of the map'
    if transform is None:
        aligned_on = ', '.join(map(str, align_bags or [bag]))
        fitted = drives[: len(align_bags) or 1]
        transform = fit_transform(*((d.true.poses, d.images.poses) for d in fitted))
    corrections = tuple(f'{d.run.name}: {text}' for d in drives for text in d.sentences)
    corrections += _knocked(bag, recipe, progress)
    return _judged(drives[-1], localizer.filter, transform, aligned_on, corrections)


def _knocked(bag: Path, recipe: Recipe, progress: bool) -> tuple[str, ...]:
    """Sentences about cameras of a rig that were turned since the training."""
    if not recipe.surround:
        return ()
    stated = f'{AS_TRAINED}: mount it as it was, or train again'
    texts = yaws_of(bag, recipe, progress).sentences(stated, KNOCKED_RAD)
    return tuple(f'{bag.name}: {text}' for text in texts)


def _judged(
    drive: _Located,
    fused: PoseFilter,
    transform: RigidTransform,
    aligned_on: str,
    corrections: tuple[str, ...],
) -> Evaluation:
    """Feed a filter with a drive, and compare the estimates with the truth."""
    truth = drive.true
    steps = [*_steps(drive.run, drive.observations, fused)]
    outputs = [
        (step.stamp_ns, step.status.level, step.state) for step in steps if step.image is None
    ]
    states = [state for *_, state in outputs if state]
    tracks = {'sfa': drive.images, 'ekf': FilterTrack.of(states)}
    if isinstance(fused, Smoother):
        tracks['smoothed'] = FilterTrack.of(fused.smoothed())
    poses = {'odometry': odometry_from_start(truth.poses, drive.run)}
    poses |= {name: moved(track.poses, transform) for name, track in tracks.items()}
    axes = [1.0, 1.0, 1.0 if truth.headings else np.nan]
    estimates = {name: Trajectory(p.stamps_ns, p.poses * axes) for name, p in poses.items()}
    scores = _scores(truth.poses, estimates, tracks, rotation(transform.yaw_rad))
    localised = np.array([level is Level.LOCALISED for _, level, state in outputs if state], bool)
    wrong_s = _false_localised_s(truth.poses, estimates['ekf'], localised)
    counts = {**_counts(drive, outputs, fused), 'false_localised_s': wrong_s}
    usable = [image.slow_features for image in drive.observations if not image.problem]
    features = np.array(usable)
    judged = truth.poses, estimates, scores, counts, features
    return Evaluation(*judged, aligned_on, transform, drive.run, steps, corrections)


def _steps(run: Run, images: Sequence[Observation], fused: PoseFilter) -> Iterator[Step]:
    """Feed a filter with a drive and the observations of its images."""
    fed = replay(fused, run.odometry, run.panoramas.stamps_ns, images)
    lacking = iter(run.lacking)
    for stamp_ns, image, update in fed:
        if image is not None:
            fused.lacking = next(lacking, '')
        at_ns = update.stamp_ns if update else stamp_ns
        yield Step(stamp_ns, image, fused.status, fused.at(at_ns))


def _scores(
    truth: Trajectory,
    estimates: Mapping[str, Trajectory],
    tracks: Mapping[str, FilterTrack],
    turn: Array,
) -> Scores:
    """Errors of the estimates, and of the tracks behind them, which `turn` (2, 2) rotates to the
    truth, also whether their covariances are right.
    """
    scores = {name: score(truth, estimate) for name, estimate in estimates.items()}
    for name, track in tracks.items():
        scores[name] |= calibration(truth, estimates[name], turn, track.covariances)
        scores[name]['similarity'] = similarity(truth, estimates[name])
    return scores


def observed(
    bag: Path, observer: Observer, recipe: Recipe, progress: bool, want_truth: bool = True
) -> tuple[Run, list[Observation]]:
    """A drive, and the observations of its images as sfa_node makes them; `recipe` is live.

    Raises BagError or DataError, also without a wanted truth.
    """
    run = _read(bag, recipe, progress, want_truth)
    observations = _observations(run, observer, progress)
    if want_truth:
        open_loop = OpenLoop.of(run.odometry.twists).repeats
        _, true, _ = _compared(run, _turns(run, observations), open_loop, observer.model.rig)
        for text in true.sentences:
            logger.warning('%s: %s', run.name, text)
        run = replace(run, ground_truth=true.poses)
    return run, observations


def _observations(run: Run, observer: Observer, progress: bool) -> list[Observation]:
    title = f'locate the images of {run.name}'
    images = observer.observe_run(run)
    return list(progress_over(images, title, len(run.panoramas), visible=progress))


def _turns(run: Run, observations: Sequence[Observation]) -> tuple[Stamps, Array]:
    """Stamps (N,) of the usable images, and how far they have turned from any start, rad."""
    turned = np.array([image.turned for image in observations])
    usable = np.isfinite(turned)
    return run.panoramas.stamps_ns[usable], turned[usable]


def _with_topics_of(path: Path, recipe: Recipe) -> Recipe:
    """The recipe, without names of topics that the bag lacks: it finds these topics by type."""
    with Bag(path) as bag:
        recorded = {f'/{name.lstrip("/")}' for name in bag.topics}
    missing = {
        item.name: ''
        for item in fields(recipe.topics)
        if f'/{getattr(recipe.topics, item.name).partition(":")[0].lstrip("/")}' not in recorded
    }
    return replace(recipe, topics=replace(recipe.topics, **missing))


def _read(bag: Path, recipe: Recipe, progress: bool, truth: bool = True) -> Run:
    cache = image_folder(Path(tempfile.gettempdir()) / 'sfa_localization_evaluate')
    run = read_drive(bag, cache, recipe, progress, want_truth=truth)
    if truth and (run.ground_truth is None or len(run.ground_truth) < 2):
        raise DataError(f'{bag}: has no ground truth; name its topic with --ground-truth-topic')
    return run


def _compared(
    run: Run,
    turns: tuple[Stamps, Array],
    open_loop: bool,
    rig: Rig,
    usual: Sequence[float] = NO_OFFSET,
) -> tuple[MotionCheck, TruePoses, CameraClock]:
    """The comparison of the sources of motion, the poses of base_link by the ground truth, as
    compared with the odometry, corrected as in training, and the camera's clock. Raises DataError
    for the truth of another drive.
    """
    assert run.ground_truth is not None
    check = check_motion(run.odometry, turns, run.yaw_rate, commands=open_loop)
    track = OdometryTrack.of(check.odometry, SegmentConfig(), check.gyro)
    clock = camera_clock(run.odometry, *turns)
    stamps_ns, headings = turns
    stamps_ns = stamps_ns - clock.delay_ns
    shown = Headings.of(track, stamps_ns, headings.tolist())
    (track,) = by_images([track], [shown], Closures.none())
    track = track.driven(Way(rig.wheel_scale.value, rig.turn_loss, rig.speed_offset))
    try:
        true = true_poses(run.ground_truth, track, check.confirmed, open_loop, usual)
    except DataError as error:
        raise DataError(f'{run.name}: {error}') from None
    return check, true, clock


def _located(
    bag: Path,
    observer: Observer,
    recipe: Recipe,
    progress: bool,
    usual: Sequence[float] = NO_OFFSET,
) -> _Located:
    """Locate the images of a bag; the `usual` offset of the truth is that of other drives. Raises
    BagError or DataError.
    """
    run = _read(bag, recipe, progress)
    observations = _observations(run, observer, progress)
    usable = [observation for observation in observations if not observation.problem]
    if not usable:
        raise DataError(f'{run.name}: no image can be used: {observations[0].problem}')
    turns = _turns(run, observations)
    open_loop = OpenLoop.of(run.odometry.twists).repeats
    check, true, clock = _compared(run, turns, open_loop, observer.model.rig, usual)
    late = check.image_drift or Drift(0, clock.delay_ns * 1e-9, 0.0)
    if open_loop:  # the robot is late, not the images
        late = Drift(0, 0.0, 0.0)
    sentences = (
        *check.timing,
        *_other_turns(clock.turn_factor, observer.model.rig),
        *true.sentences,
    )
    return _Located(run, observations, true, _track(usable, late), clock, sentences)


def _other_turns(shown: Quantity, rig: Rig) -> list[str]:
    """A sentence if the robot turns otherwise than in training, for each turn counted."""
    known = rig.turn_factor
    beside = abs(shown.value - known.value)
    if beside <= SIGNIFICANT_STDS * math.hypot(shown.std, known.std):
        return []
    times = f'{shown.value:.2f} times the turns counted'
    return [f'wheels: {times}, {known.value:.2f} times in training; the filter learns it']


def _counts(
    drive: _Located, outputs: Sequence[tuple[int, Level, State | None]], fused: PoseFilter
) -> dict[str, Any]:
    """Used and skipped messages and images, the filter's counts, and seconds in each state."""
    run = drive.run
    observations = drive.observations
    clock = drive.clock
    skipped = Counter(problem for item in observations if (problem := item.problem))
    usable = Count(len(observations) - skipped.total(), dict(skipped))
    states_s = Counter[str]()
    stamps_ns = [run.odometry.stamps_ns[0], *(stamp_ns for stamp_ns, *_ in outputs)]
    seconds = _seconds_since_last(np.array(stamps_ns))[1:].tolist()
    for (_, level, _), lasted_s in zip(outputs, seconds, strict=True):
        states_s[level.name] += lasted_s
    return {
        **{name: count.as_dict() for name, count in run.counts.items()},
        'observations': usable.as_dict(),
        'fusion': dict(fused.counts),
        'states_s': dict(states_s),
        **_longest_silence(run, observations),
        'drowned': float(np.mean([item.drowned for item in observations])),
        'nis': None if math.isnan(fused.nis) else fused.nis,
        **({'camera_delay_s': round(clock.delay_s, 3)} if clock.delay_ns else {}),
    }


def _longest_silence(run: Run, observations: Sequence[Observation]) -> dict[str, Any]:
    """`without_images`: the longest time within the odometry without a usable image, if the filter
    would name it: `from_s` after the start of the odometry, `seconds`, and whether it lasts
    `to_the_end` of the drive.
    """
    usable_ns = [image.stamp_ns for image in observations if not image.problem]
    start_ns = run.odometry.stamps_ns[0]
    end_ns = run.odometry.stamps_ns[-1]
    marks_ns = np.clip([start_ns, *usable_ns, end_ns], start_ns, end_ns)
    gaps_ns = np.diff(marks_ns)
    longest = int(np.argmax(gaps_ns))
    if gaps_ns[longest] <= MOST_SILENCE_S * 1e9:
        return {}
    silence = {
        'from_s': float(marks_ns[longest] - start_ns) * 1e-9,
        'seconds': float(gaps_ns[longest]) * 1e-9,
        'to_the_end': longest == len(gaps_ns) - 1,
    }
    return {'without_images': silence}


def _seconds_since_last(stamps_ns: Stamps) -> Array:
    """Seconds (N,) from the stamp before to each stamp, COAST_S at most: in a pause of the
    recording the filter publishes nothing.
    """
    return np.minimum(np.diff(stamps_ns, prepend=stamps_ns[:1]) * 1e-9, COAST_S)


def _track(usable: Sequence[Observation], clock: Drift) -> FilterTrack:
    """The poses of single images, at the times when they were taken by `clock`."""
    stamps = np.array([image.stamp_ns for image in usable], np.int64)
    stamps -= clock.late_ns(stamps)
    poses = np.array([[*image.position, image.yaw] for image in usable])
    return FilterTrack(Trajectory(stamps, poses), np.array([image.covariance for image in usable]))


def has_truth(truth: Trajectory, stamps_ns: Stamps) -> Mask:
    """Mask (N,) of the stamps for which the ground truth was recorded."""
    return truth.covers(stamps_ns, _TRUTH_TOLERANCE_NS)


def fit_transform(*drives: tuple[Trajectory, Trajectory]) -> RigidTransform:
    """Least-squares rotation and translation from the map to the truth, over drives that are each
    given as (truth, estimate in the map). Raises DataError.
    """
    estimated, true = (
        np.concatenate(parts) for parts in zip(*starmap(_pairs, drives), strict=True)
    )
    if len(estimated) < 2:
        raise DataError('the ground truth covers fewer than two images: are the clocks the same?')
    return align(estimated, true)


def _errors(truth: Trajectory, estimate: Trajectory) -> tuple[Mask, Array]:
    """Mask (N,) of the estimates for which the truth was recorded, and their errors (M, 3): x m,
    y m, yaw rad.
    """
    mask = has_truth(truth, estimate.stamps_ns)
    errors = estimate.poses[mask] - truth.at(estimate.stamps_ns[mask])
    errors[:, 2] = wrap_angle(errors[:, 2])
    return mask, errors


def _pairs(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """Estimated and true positions (N, 2) m, where both exist."""
    mask = has_truth(truth, estimate.stamps_ns) & np.isfinite(estimate.poses[:, 0])
    return estimate.poses[mask, :2], truth.at(estimate.stamps_ns[mask])[:, :2]


def similarity(truth: Trajectory, estimate: Trajectory) -> dict[str, float | None]:
    """`mean` error (m) after rotation, translation and `scale` are fitted on the estimate itself:
    the error without that of the wheels' radius and of the place of the map.
    """
    estimated, true = _pairs(truth, estimate)
    if len(estimated) < 2:
        return {'mean': None, 'scale': None}
    places, target = ((z - z.mean()) for z in (estimated @ [1.0, 1.0j], true @ [1.0, 1.0j]))
    fit = np.vdot(places, target) / max(np.vdot(places, places).real, 1e-12)
    return {'mean': float(np.abs(fit * places - target).mean()), 'scale': float(abs(fit))}


def calibration(
    truth: Trajectory, estimate: Trajectory, turn: Array, covariances: Array
) -> dict[str, Any]:
    """Whether the covariances are right.

    `within_95` is the share of positions inside their 95 % ellipse, `yaw_within_95` that of
    headings inside their 95 % interval. `nees` is the mean normalized squared position error over
    its expectation. With right covariances it lies in `nees_right` [low, high] on 95 % of such
    drives; errors of neighboring images are correlated, so this range is wide.

    `covariances` (N, 3, 3) of [x, y, yaw] are in the map, which `turn` (2, 2) rotates to the truth.
    """
    mask, errors = _errors(truth, estimate)
    if not mask.any():
        return dict.fromkeys(('within_95', 'yaw_within_95', 'nees', 'nees_right'))
    roots = np.linalg.cholesky(covariances[mask, :2, :2])
    normalized = np.linalg.solve(roots, (errors[:, :2] @ turn)[:, :, None])[:, :, 0]
    squares = (normalized**2).sum(1)
    freedom = 2 * _effective_count(normalized)
    yaw = errors[:, 2] ** 2 / covariances[mask, 2, 2]
    yaw = yaw[np.isfinite(yaw)]
    return {
        'within_95': float((squares <= stats.chi2.ppf(0.95, 2)).mean()),
        'yaw_within_95': float((yaw <= stats.chi2.ppf(0.95, 1)).mean()) if len(yaw) else None,
        'nees': float(squares.mean() / 2),
        'nees_right': (stats.chi2.ppf((0.025, 0.975), freedom) / freedom).tolist(),
    }


def _effective_count(normalized: Array) -> float:
    """Number of independent errors whose mean square varies as that of correlated ones (N, 2).

    For Gaussian errors of autocorrelation r it is N / sum of r(lag)^2, up to the first r <= 0.
    """
    count = len(normalized)
    lagged = (signal.correlate(axis, axis, method='fft')[count - 1 :] for axis in normalized.T)
    shared: Array = np.sum([*lagged], axis=0)
    zeros = np.flatnonzero(shared <= 0)
    shared = shared[: zeros[0]] if len(zeros) else shared
    return count / (1 + 2 * float(((shared[1:] / shared[0]) ** 2).sum())) if len(shared) else count


def _false_localised_s(truth: Trajectory, ekf: Trajectory, localised: Mask) -> float:
    """Seconds in which the filter said LOCALISED and its position error exceeded `WRONG_M`."""
    mask, errors = _errors(truth, ekf)
    wrong = localised[mask] & (np.hypot(*errors[:, :2].T) > WRONG_M)
    return float(_seconds_since_last(ekf.stamps_ns)[mask][wrong].sum())


def moved(estimate: Trajectory, transform: RigidTransform) -> Trajectory:
    """The trajectory in the frame to which the transform leads."""
    return Trajectory(estimate.stamps_ns, compose(transform.pose, estimate.poses))


def odometry_from_start(truth: Trajectory, run: Run) -> Trajectory:
    """The path of the odometry from the true pose at the start of the truth. Raises DataError."""
    path = run.odometry.trajectory
    stamps = path.stamps_ns[has_truth(truth, path.stamps_ns)]
    if len(stamps) == 0:
        raise DataError(f'{run.name}: ground truth and odometry do not overlap in time')
    start = compose(truth.at(stamps[:1])[0], invert(path.at(stamps[:1])[0]))
    return Trajectory(stamps, compose(start, path.at(stamps)))


def score(truth: Trajectory, estimate: Trajectory) -> dict[str, Any]:
    """Mean, median, 95th percentile, rmse, max (m) and count of the position errors.

    `yaw_deg` holds mean, median and p95 of the heading errors, None without headings. The numbers
    are None where the truth covers no estimate.
    """
    _, errors = _errors(truth, estimate)
    position = np.hypot(*errors[:, :2].T)
    yaw = np.degrees(np.abs(errors[:, 2]))
    yaw = yaw[np.isfinite(yaw)]
    if len(position) == 0:
        return {**dict.fromkeys(('mean', 'median', 'p95', 'rmse', 'max')), 'n': 0, 'yaw_deg': None}
    return {
        **_summary(position),
        'rmse': float(np.sqrt((position**2).mean())),
        'max': float(position.max()),
        'n': len(position),
        'yaw_deg': _summary(yaw) if len(yaw) else None,
    }


def _summary(values: Array) -> dict[str, float]:
    mean = values.mean()
    median = np.median(values)
    p95 = np.percentile(values, 95)
    return {'mean': float(mean), 'median': float(median), 'p95': float(p95)}
