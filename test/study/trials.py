# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from any features, judged on training drives and a test drive in one place.

Every map is judged by the paper's protocol (section 4): aligned with the truth on a training drive,
and compared with a regression of the same features on the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from places import distances

from sfa_localization.bags.drives import read_drive
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, RigidTransform, align, compose, invert, rotation
from sfa_localization.data.run import Image, Run, Trajectory
from sfa_localization.evaluation import Evaluation, has_truth, score
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.replay import FilterTrack, replay
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.keyframes.closures import Closures
from sfa_localization.keyframes.light import Conditions
from sfa_localization.mapping.basis import PAPER_FEATURES, Basis, expand
from sfa_localization.mapping.drives import Drive, Drives
from sfa_localization.mapping.saved_map import MetricMap
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.segments import Segments, join
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.sfa.image_features import slow_features
from sfa_localization.sfa.network import Network
from sfa_localization.training import Recipe
from sfa_localization.training_input import drive_of
from study.results import BATCH, Cell

Rows = NDArray[np.int64]
Features = Callable[[Image], Array]
TRUE_START = FilterConfig(initial_position_std=0.02, initial_yaw_std=0.02)
"""Section 5.1: the robot starts from a known location, with known heading; as from a dock."""
STRAIGHT = SegmentConfig(segments='straight')
MONOMIALS = MetricConfig(metric_map='monomials', slow_features=PAPER_FEATURES)
"""Settings of the paper's recipe."""


@dataclass(frozen=True, slots=True)
class Study:
    """Training drives and a test drive, with the true positions (N, 2) and (T, 2) m of images; the
    map is aligned on the last training drive.
    """

    drives: tuple[Drive, ...]
    test: Run
    places: Array
    test_truth: Trajectory

    @classmethod
    def read(cls, bags: Sequence[Path], test: Path, cache: Path, recipe: Recipe) -> Study:
        """Read bags; their images go to the folder `cache`. Raises BagError or DataError."""
        drives = []
        for bag in [*bags, test]:
            folder = cache / bag.name
            folder.mkdir(exist_ok=True)
            drives.append(drive_of(read_drive(bag, folder, recipe, want_truth=True)))
        truths = [_truth(drive) for drive in drives]
        places = np.concatenate([truth.poses[:, :2] for truth in truths[:-1]])
        return cls(tuple(drives[:-1]), drives[-1].run, places, truths[-1])

    @property
    def training(self) -> tuple[Run, ...]:
        """The runs of the training drives."""
        return tuple(drive.run for drive in self.drives)

    @property
    def truth(self) -> Trajectory:
        """The true path of the test drive."""
        assert self.test.ground_truth is not None
        return self.test.ground_truth

    @property
    def starts(self) -> list[int]:
        """The first row of each training drive, among the images of all."""
        counts = [len(run.panoramas) for run in self.training]
        return [sum(counts[:k]) for k in range(len(counts))]

    def segments(self, config: SegmentConfig, only_last: bool = False) -> Segments:
        """Segments of all training drives or of the last one, as rows among the images of all."""
        first = len(self.training) - 1 if only_last else 0
        cut = [Drives((drive,), Closures.none(), config).cut() for drive in self.drives[first:]]
        return join(cut, self.starts[first:])

    def laid_on(self, config: SegmentConfig) -> Rows:
        """Rows of the images in segments of the last drive, on which the map is aligned."""
        segments = self.segments(config, only_last=True)
        return self.with_truth(np.concatenate([segment.images for segment in segments]))

    def with_truth(self, rows: Rows) -> Rows:
        """The rows (M,) of training images that have a true position."""
        return np.asarray(rows[np.isfinite(self.places[rows, 0])])

    def batches(self) -> Iterator[Image]:
        """All training images in batches (T, H, W, 3)."""
        return (batch for run in self.training for batch in run.panoramas.batches(BATCH))

    def features(self, of: Features) -> tuple[Array, Array]:
        """Features (N, K) of all training images, and (T, K) of the test drive's."""
        training = np.concatenate([features_of(of, run) for run in self.training])
        return training, features_of(of, self.test)


def features_of(of: Features, run: Run) -> Array:
    """Features (N, K) of all images of a drive."""
    return np.concatenate([of(batch) for batch in run.panoramas.batches(BATCH)])


def _truth(drive: Drive) -> Trajectory:
    """True poses where the images were taken, NaN where unknown."""
    truth, stamps = drive.run.ground_truth, drive.stamps_ns
    if truth is None:
        raise DataError(f'{drive.run.name}: no ground truth to judge by')
    poses = truth.at(stamps)
    poses[~has_truth(truth, stamps)] = np.nan
    return Trajectory(stamps, poses)


def slow_of(network: Network) -> Features:
    """The slow features of images."""
    return lambda images: slow_features(network.maps(images))


def turned_of(model: PlaceModel) -> Features:
    """The features of a model's map: reduced turned maps, or slow features without them."""
    turned = model.turned
    if turned is None:
        return slow_of(model.network)

    def components(images: Image) -> Array:
        views = model.views(images)
        yaw = np.array([model.located(view, Conditions()).pose[2] for view in views])
        return turned.features(np.stack([view.spectrum for view in views]), yaw)

    return components


def regression(basis: Basis, features: Array, places: Array) -> Array:
    """Weights (m, 2) from the expansion of features (M, K) to true places (M, 2) m."""
    expanded = expand(basis, features)
    normal = expanded.T @ expanded + np.diag(basis.ridge)
    return np.asarray(np.linalg.lstsq(normal, expanded.T @ places, rcond=None)[0])


@dataclass(frozen=True, slots=True)
class Trial:
    """Positions of the images by a map: in its own frame, in that of the truth, and by regression
    on the truth of the images `fitted`; `rows` (R,) of the training images lay it on the truth.

    `raw`, `laid` and `supervised` are pairs: (R, 2) m of these rows, and (T, 2) m of the test
    drive; `covariances` (T, 2, 2) m^2 are in the frame of the truth.
    """

    study: Study
    rows: Rows
    transform: RigidTransform
    raw: tuple[Array, Array]
    laid: tuple[Array, Array]
    supervised: tuple[Array, Array]
    covariances: Array

    @classmethod
    def of(
        cls,
        study: Study,
        metric: MetricMap,
        features: tuple[Array, Array],
        rows: Rows,
        fitted: Rows,
    ) -> Trial:
        """A map's estimates from features (N, K) and (T, K). Raises DataError."""
        training, test = features
        raw_test, covariances = metric.predict(test)
        raw = metric.predict(training[rows])[0], raw_test
        transform = align(raw[0], study.places[rows])
        fitted = study.with_truth(fitted)
        weights = regression(metric.basis, training[fitted], study.places[fitted])
        turn = rotation(transform.yaw_rad)
        return cls(
            study,
            rows,
            transform,
            raw,
            (transform.apply(raw[0]), transform.apply(raw[1])),
            (expand(metric.basis, training[rows]) @ weights, expand(metric.basis, test) @ weights),
            turn @ covariances @ turn.T,
        )

    @property
    def truth(self) -> tuple[Array, Array]:
        """True positions (R, 2) and (T, 2) m."""
        return self.study.places[self.rows], self.study.test_truth.poses[:, :2]

    def errors(self) -> Cell:
        """Mean distances (m) from the truth: `training` and `test`, each also `supervised`."""
        parts = enumerate(('training', 'test'))
        return {
            f'{part}{name}': mean_error(estimates[k], self.truth[k])
            for k, part in parts
            for name, estimates in (('', self.laid), ('_supervised', self.supervised))
        }

    def fused(self, correlation: ErrorCorrelation) -> Trajectory:
        """The filter's path in the frame of the truth, from a known start; images give positions
        only, whose errors have this correlation.
        """
        run, stamps = self.study.test, self.study.test_truth.stamps_ns
        settings = replace(TRUE_START, initial_pose=tuple(start_of(run).tolist()))
        fused = PoseFilter(settings, correlation)
        images = [
            SimpleNamespace(pose=place, covariance=covariance, turned=np.nan)
            for place, covariance in zip(self.laid[1], self.covariances, strict=True)
        ]
        steps = replay(fused, run.odometry, stamps, images)
        path = [fused.at(stamp_ns) for stamp_ns, image, _ in steps if image is None]
        return FilterTrack.of([state for state in path if state is not None]).poses


def start_of(run: Run) -> Array:
    """The true pose (3,) where the odometry begins."""
    assert run.ground_truth is not None
    return np.asarray(run.ground_truth.at(run.odometry.stamps_ns[:1])[0])


def true_start(run: Run, transform: RigidTransform) -> FilterConfig:
    """The filter's settings for a start at the true pose; `transform` leads from map to truth."""
    start = compose(invert(transform.pose), start_of(run))
    return replace(TRUE_START, initial_pose=tuple(start.tolist()))


def scores_of(judged: Evaluation) -> Cell:
    """Of `sfa`, single images, and of the filter, `ekf`: the mean error (m); the share `_within` of
    errors inside their 95 % ellipses; the mean squared error `_nees` over its expectation. And the
    seconds `false_localised_s`.
    """
    cell: Cell = {'false_localised_s': judged.counts['false_localised_s']}
    for name in ('sfa', 'ekf'):
        scores = judged.scores[name]
        cell[name] = scores['mean']
        cell[f'{name}_within'], cell[f'{name}_nees'] = scores['within_95'], scores['nees']
    return cell


def mean_distance(path: Trajectory, truth: Trajectory) -> float:
    """Mean distance (m) of a path from the truth, where the truth covers it."""
    return float(score(truth, path)['mean'])


def mean_error(places: Array, truth: Array) -> float:
    """Mean distance (m) of places (N, 2) from true ones (N, 2), without NaN."""
    return float(np.nanmean(distances(places, truth)))
