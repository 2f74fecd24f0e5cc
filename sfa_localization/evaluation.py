# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How far the estimates are from the truth: the paper's protocol (section 4).

The map is known up to a rotation and a translation. They are fitted on the estimates of a training
drive and applied unchanged to the drive that is judged; the error is the Euclidean distance.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import linalg
from tqdm import tqdm

from sfa_localization.bags.drives import as_live, read_drive
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.camera.turns import headings
from sfa_localization.data.errors import DataError
from sfa_localization.data.files import atomic_write
from sfa_localization.data.geometry import (
    Array,
    RigidTransform,
    align,
    compose,
    invert,
    wrap_angle,
)
from sfa_localization.data.run import Count, Run, Stamps, Trajectory
from sfa_localization.fusion.camera_clock import CameraClock, camera_clock
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.localizer import Localizer, Observation
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import Recipe

Scores = dict[str, dict[str, Any]]
_TRUTH_TOLERANCE_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A judged drive. `estimates` are in the truth's frame.

    `features` (N, K) are those of the usable pictures, of which `estimates['sfa']` is.
    `aligned_on` names the drive on which the transform was fitted.
    """

    truth: Trajectory
    estimates: dict[str, Trajectory]
    scores: Scores
    counts: dict[str, Any]
    features: Array
    aligned_on: str

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers: one entry per estimate, and the counts."""
        return {**self.scores, 'counts': self.counts, 'aligned_on': self.aligned_on}


@dataclass(frozen=True, slots=True)
class _Drive:
    """A drive as the model sees it: map poses (N, 3) of its usable pictures, features (N, K)."""

    run: Run
    truth: Trajectory
    sfa: Trajectory
    features: Array
    observations: Count
    clock: CameraClock


def evaluate(
    model: PlaceModel,
    bag: Path,
    *,
    align_bag: Path | None = None,
    recipe: Recipe | None = None,
    config: FilterConfig | None = None,
    watch: WatchConfig | None = None,
    progress: bool = False,
) -> Evaluation:
    """Judge a model on a drive with ground truth, by what sfa_node and ekf_node would publish.

    The transform to the truth is fitted on `align_bag`, a training drive; without one, on the
    drive itself. Pictures that cannot be believed count as skipped observations. Raises
    BagError or DataError, also when there is no ground truth.
    """
    recipe = as_live(recipe or Recipe(), model.panorama)
    transform, supervised = None, None
    if align_bag is not None:
        with tempfile.TemporaryDirectory(prefix='sfa_localization-') as cache:
            run = _read(align_bag, Path(cache), recipe, progress)
            trained, _, _ = _replayed(Localizer(model, config, watch), run, progress)
            transform = fit_transform(trained.truth, trained.sfa)
            supervised = _supervised_weights(model, trained)
    with tempfile.TemporaryDirectory(prefix='sfa_localization-') as cache:
        run = _read(bag, Path(cache), recipe, progress)
        localizer = Localizer(model, config, watch)
        drive, ekf, states = _replayed(localizer, run, progress)
    transform = transform or fit_transform(drive.truth, drive.sfa)
    estimates = {'odometry': odometry_from_start(drive.truth, run)}
    estimates['sfa'] = moved(drive.sfa, transform)
    estimates['ekf'] = moved(ekf, transform)
    if supervised is not None:
        estimates['supervised'] = _supervised(model, supervised, drive)
    scores = {name: score(drive.truth, estimate) for name, estimate in estimates.items()}
    counts: dict[str, Any] = {name: count.as_dict() for name, count in run.counts.items()}
    counts['observations'] = drive.observations.as_dict()
    counts['fusion'] = dict(localizer.filter.counts)
    if drive.clock.delay_ns:
        counts['camera_delay_s'] = round(drive.clock.delay_s, 3)
    counts['states_s'] = states
    aligned_on = str(align_bag or bag)
    return Evaluation(drive.truth, estimates, scores, counts, drive.features, aligned_on)


def _read(bag: Path, cache: Path, recipe: Recipe, progress: bool) -> Run:
    run = read_drive(bag, cache, recipe, progress, want_truth=True, odometry_tolerance_s=0.0)
    if run.ground_truth is None or len(run.ground_truth) < 2:
        raise DataError(f'{bag}: no ground truth to judge by; name it with --ground-truth-topic')
    return run


def _replayed(
    localizer: Localizer, run: Run, progress: bool
) -> tuple[_Drive, Trajectory, dict[str, float]]:
    """What the model makes of a drive, the filter at each odometry message, seconds by state."""
    seen: list[Observation] = []
    stamps, poses, states = [], [], dict[str, float]()
    before_ns = int(run.odometry.stamps_ns[0])
    title = f'locating {run.name}'
    with tqdm(desc=title, total=len(run.panoramas), unit='img', disable=not progress) as bar:
        for stamp_ns, observation, state in localizer.replay(run):
            if observation is not None:
                seen.append(observation)
                bar.update()
                continue
            level = localizer.status.level.name
            states[level] = states.get(level, 0.0) + (stamp_ns - before_ns) * 1e-9
            before_ns = stamp_ns
            if state is not None:
                stamps.append(stamp_ns)
                poses.append(state.pose)
    path = Trajectory(np.array(stamps, np.int64), np.reshape(poses, (-1, 3)))
    # The map is judged where images were taken; the filter has to find out by itself.
    return (
        _drive(
            run, seen, camera_clock(run.odometry, run.panoramas.stamps_ns, headings(run.panoramas))
        ),
        path,
        states,
    )


def _drive(run: Run, seen: list[Observation], clock: CameraClock) -> _Drive:
    assert run.ground_truth is not None
    usable = [one for one in seen if not one.problem]
    if not usable:
        raise DataError(f'{run.name}: no picture can be used: {seen[0].problem}')
    estimates = [one.estimate for one in usable]
    stamps = np.array([one.stamp_ns for one in usable], np.int64) - clock.delay_ns
    poses = np.array([np.append(e.position, e.yaw) for e in estimates])
    features = np.array([e.slow_features for e in estimates])
    skipped = Counter(one.problem for one in seen if one.problem)
    count = Count(len(usable), dict(skipped))
    return _Drive(run, run.ground_truth, Trajectory(stamps, poses), features, count, clock)


def known(truth: Trajectory, stamps_ns: Stamps) -> Any:
    """Mask (N,) of the stamps at which the truth is known."""
    return truth.covers(stamps_ns, _TRUTH_TOLERANCE_NS)


def fit_transform(truth: Trajectory, estimate: Trajectory) -> RigidTransform:
    """Rotation and translation that lay the estimates (in the map) on the truth. DataError."""
    mask = known(truth, estimate.stamps_ns) & np.isfinite(estimate.poses[:, 0])
    if np.count_nonzero(mask) < 2:
        raise DataError('the ground truth covers fewer than two pictures: are the clocks the same?')
    return align(estimate.poses[mask, :2], truth.at(estimate.stamps_ns[mask])[:, :2])


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


def _supervised_weights(model: PlaceModel, drive: _Drive) -> Array:
    """The model's own regression, fitted on the ground truth of a training drive: (m, 2)."""
    basis = model.metric.basis
    mask = known(drive.truth, drive.sfa.stamps_ns)
    expanded = basis.expand(drive.features[mask])
    places = drive.truth.at(drive.sfa.stamps_ns[mask])[:, :2]
    normal = expanded.T @ expanded + np.diag(basis.ridge)
    return np.asarray(linalg.lstsq(normal, expanded.T @ places)[0])


def _supervised(model: PlaceModel, weights: Array, drive: _Drive) -> Trajectory:
    positions = model.metric.basis.expand(drive.features) @ weights
    unknown = np.full(len(positions), np.nan)
    return Trajectory(drive.sfa.stamps_ns, np.column_stack([positions, unknown]))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON, at once or not at all. Raises LocalizationError."""
    text = json.dumps(content, indent=2) + '\n'
    with atomic_write(path, make_folder=True) as file:
        file.write(text.encode())
