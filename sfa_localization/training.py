# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn a place model from recorded drives; ground truth is never read."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sfa_localization.bags.run_loader import ODOMETRY_TOLERANCE_S, load_run
from sfa_localization.bags.settings import BagConfig, TopicNames
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.camera.turns import headings
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import DataError, ModelError
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import BATCH, Run
from sfa_localization.data.threads import one_core
from sfa_localization.features import mdp_engine
from sfa_localization.features.agreement import Agreement, disagreement, share_within
from sfa_localization.features.network import Architecture, Network, Node
from sfa_localization.features.network_training import (
    Drive,
    Executor,
    Partial,
    architecture_of,
    in_this_process,
    train_network,
)
from sfa_localization.features.novelty import Novelty, describe
from sfa_localization.features.rotation import Map
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.features.sfa import Solution
from sfa_localization.fusion.camera_clock import CameraClock, camera_clock
from sfa_localization.fusion.motion import TURN_RADIUS_M
from sfa_localization.fusion.pose_filter import DELAY_LIMIT_NS
from sfa_localization.metric import learning as metric_learning
from sfa_localization.metric.compass import HeadingFit, fit_compass
from sfa_localization.metric.forecast import nearest_used
from sfa_localization.metric.learning import MetricResult
from sfa_localization.metric.segments import Segments, assignment, cut, join
from sfa_localization.metric.settings import HeadingConfig, MetricConfig, SegmentConfig
from sfa_localization.place_model import (
    PlaceModel,
    heading_input,
    read_arrays,
    top_features,
    write_arrays,
)

logger = logging.getLogger(__name__)

CHECKPOINT = 'sfa_localization training checkpoint'
CHECKPOINT_VERSION = 1
# Left-out maps bridge a gap that the whole map does not have, and so err more alike than it does.
_LARGEST_SHARE = 0.8
# Pictures whose maps are kept for the compass and for novelty, however long the drives.
_SAMPLES = 3000
_DELAY_SHOWN_S = 0.02


@dataclass(frozen=True, slots=True)
class Recipe:
    """Everything that decides what is learnt from a bag."""

    topics: TopicNames = field(default_factory=TopicNames)
    bag: BagConfig = field(default_factory=BagConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    panorama: PanoramaConfig = field(default_factory=PanoramaConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    segments: SegmentConfig = field(default_factory=SegmentConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)
    heading: HeadingConfig = field(default_factory=HeadingConfig)


@dataclass(frozen=True, slots=True)
class Trained:
    """The model and everything a report may tell of its making.

    `features` (N, K) of all pictures, drive after drive.
    """

    model: PlaceModel
    runs: tuple[Run, ...]
    features: Array
    segments: Segments
    metric: MetricResult
    heading: HeadingFit | None
    heading_images: NDArray[np.int64]


def train(
    bags: Sequence[Path],
    output: Path,
    recipe: Recipe | None = None,
    *,
    progress: bool = False,
    resume: bool = False,
    strict: bool = False,
    executor: Executor = in_this_process,
) -> Trained:
    """Learn a place model from bags and write it to `output`.

    A training that was cut off leaves a checkpoint beside the output; with `resume` it goes on
    from there and gives the same bytes (the engine mdp begins anew). Raises BagError,
    ConfigError, DataError or ModelError; then no model is written.
    """
    recipe = recipe or Recipe()
    output = Path(output)
    with _cache(output) as cache:
        runs = _load(bags, cache, recipe, progress, strict)
        architecture = architecture_of(recipe.network, runs[0].panoramas.shape[:2])
        checkpoint = _Checkpoint.beside(output, recipe, runs)
        start = checkpoint.read(architecture) if resume else None
        if not resume:
            checkpoint.remove()
        network = _train_network(architecture, runs, recipe, checkpoint, start, executor, progress)
        with one_core():
            trained = learn_place(network, runs, recipe, progress)
        trained.model.save(output)
        checkpoint.remove()
    return trained


@contextmanager
def _cache(output: Path) -> Iterator[Path]:
    """A folder beside the output for decoded pictures; also clears what a killed run left."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        for stale in output.parent.glob(f'.{output.name}.cache-*'):
            shutil.rmtree(stale, ignore_errors=True)
        folder = tempfile.mkdtemp(prefix=f'.{output.name}.cache-', dir=output.parent)
    except OSError as error:
        raise ModelError(f'{output}: cannot be written: {error.strerror}') from None
    try:
        yield Path(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _load(
    bags: Sequence[Path], cache: Path, recipe: Recipe, progress: bool, strict: bool
) -> tuple[Run, ...]:
    """Read all bags; their panoramas must be of one size."""
    runs = tuple(read_drive(bag, cache, recipe, progress, strict=strict) for bag in bags)
    for k, run in enumerate(runs):
        for other in runs[:k]:
            stamps = run.panoramas.stamps_ns, other.panoramas.stamps_ns
            if not np.array_equal(*stamps):
                continue
            middle = len(run.panoramas) // 2
            image, copy = (drive.panoramas.read(middle, middle + 1) for drive in (run, other))
            if np.array_equal(image, copy):
                raise DataError(
                    f'{bags[k]}: the same drive as {other.name}: name each drive once, for a drive '
                    'that is left out must not be known from its copy'
                )
    sizes = {run.panoramas.shape for run in runs}
    if len(sizes) > 1:
        told = ', '.join(f'{r.name}: {r.panoramas.shape[1]}x{r.panoramas.shape[0]}' for r in runs)
        raise DataError(f'the bags hold panoramas of different sizes ({told}): train on one size')
    return runs


def read_drive(
    bag: Path,
    cache: Path,
    recipe: Recipe,
    progress: bool = False,
    *,
    want_truth: bool = False,
    strict: bool = False,
    odometry_tolerance_s: float = ODOMETRY_TOLERANCE_S,
) -> Run:
    """One bag as a run of panoramas, unwrapped by the recipe's camera where they are none yet."""
    with tqdm(desc=f'reading {Path(bag).name}', unit='img', disable=not progress) as bar:

        def told(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return load_run(
            bag,
            topics=recipe.topics,
            unwrap=Unwrapper(recipe.camera, recipe.panorama),
            cache=cache,
            progress=told,
            want_truth=want_truth,
            strict=strict,
            config=recipe.bag,
            odometry_tolerance_s=odometry_tolerance_s,
        )


def as_live(recipe: Recipe, model: PlaceModel) -> Recipe:
    """The recipe to read a drive with the model's panorama, as the nodes do.

    Read it with `odometry_tolerance_s` 0: training leaves out images far from any odometry, but
    the filter fuses them too.
    """
    return replace(recipe, panorama=model.panorama)


def drive_of(run: Run, config: NetworkConfig) -> Drive:
    """A run's panoramas, and which of them are neighbors."""
    stamps = run.panoramas.stamps_ns
    seconds = np.diff(stamps) * 1e-9
    places = run.odometry.trajectory.at(stamps)[:, :2]
    metres = np.hypot(*np.diff(places, axis=0).T)
    joined = (seconds > 0) & (seconds <= config.break_time) & (metres <= config.break_distance)
    steps = {'picture': np.ones_like(seconds), 'distance': metres, 'time': seconds}
    scale = _relative_rate(steps[config.difference], joined)
    return Drive(run.panoramas, np.where(joined, scale, 0).astype(np.float32))


def _relative_rate(steps: Array, joined: NDArray[np.bool_]) -> Array:
    """Median step over step, so that differences keep their size; short steps are limited."""
    typical = float(np.median(steps[joined])) if joined.any() else 1.0
    typical = typical if typical > 0 else 1.0
    return np.asarray(typical / np.maximum(steps, 0.2 * typical))


def _train_network(
    architecture: Architecture,
    runs: Sequence[Run],
    recipe: Recipe,
    checkpoint: _Checkpoint,
    start: Partial | None,
    executor: Executor,
    progress: bool,
) -> Network:
    drives = [drive_of(run, recipe.network) for run in runs]
    stages = 2 * len(architecture.layers)
    done = _stages_done(start) if start else 0
    total = sum(len(run.panoramas) for run in runs) * stages
    with tqdm(
        desc=f'slow features, {stages} passes',
        total=total,
        initial=total // stages * done,
        unit='img',
        disable=not progress,
    ) as bar:
        if recipe.network.engine == 'mdp':
            return mdp_engine.train_network(
                architecture, drives, recipe.network, on_shard=bar.update
            )
        return train_network(
            architecture,
            drives,
            recipe.network,
            start=start,
            executor=executor,
            on_stage=checkpoint.write,
            on_shard=bar.update,
        )


def _stages_done(partial: Partial) -> int:
    return 2 * partial.depth + (partial.linear is not None)


@dataclass(frozen=True, slots=True)
class _Views:
    """What the network makes of all pictures: features of each, more of a sample of them.

    `disagreement` (N,) of the views of each picture.
    `sampled` (S,) are the sample's indices, `harmonic` (S, J), `descriptions` per layer (S, D).
    """

    features: Array
    disagreement: Array
    sampled: NDArray[np.int64]
    harmonic: NDArray[np.complex128]
    descriptions: tuple[Array, ...]
    eta: dict[str, list[float]]


def learn_place(
    network: Network, runs: Sequence[Run], recipe: Recipe, progress: bool = False
) -> Trained:
    """Metric map, compass and novelty for a trained network. Raises DataError."""
    layers = _heading_layers(network, recipe.heading)
    views = _view(network, runs, layers, progress)
    offsets = np.cumsum([0, *(len(run.panoramas) for run in runs)])
    clocks = [_clock_of(run) for run in runs]
    segments = join(
        [
            cut(r.odometry, r.panoramas.stamps_ns - c.delay_ns, recipe.segments, r.yaw_rate)
            for r, c in zip(runs, clocks, strict=True)
        ],
        [int(offset) for offset in offsets[:-1]],
    )
    result = metric_learning.learn(views.features, segments, recipe.metric)
    agreement = Agreement.fit(
        views.disagreement[result.images],
        (result.left_out**2).sum(1),
        result.left_out_variance,
        axes=2,
        weight=result.left_out_weight,
    )
    correlation = _error_correlation(segments, result)
    heading, labelled = _learn_heading(views, segments, result, recipe.heading)
    # Of each run, s; None where the drive does not show it.
    delays = [c.delay_ns * 1e-9 if c.known else None for c in clocks]
    part = _heading_part(labelled, segments, len(views.features), recipe.heading)
    yaw_weight = _yaw_weight(labelled, part, segments, result)
    yaw_agreement = _yaw_agreement(heading, views.disagreement[labelled], yaw_weight)
    model = PlaceModel(
        network,
        result.map,
        _panorama_of(runs, recipe),
        Novelty.fit(views.descriptions),
        agreement,
        heading.compass if heading else None,
        yaw_agreement,
        layers if heading else (),
        {
            **_quality(network, views, segments, result, agreement),
            **_yaw_quality(views.disagreement[labelled], heading, yaw_agreement, yaw_weight),
            'camera_delay_s': delays,
        },
        correlation,
    )
    return Trained(model, tuple(runs), views.features, segments, result, heading, labelled)


def _clock_of(run: Run) -> CameraClock:
    """The camera's clock beside the odometry's; what no filter can make up for is warned of."""
    clock = camera_clock(run.odometry, run.panoramas.stamps_ns, headings(run.panoramas))
    if abs(clock.delay_ns) > DELAY_LIMIT_NS:
        logger.warning(
            '%s: the stamps of images and odometry are %.2f s apart: the filter makes up for half '
            'a second only; bring both to one clock', run.name, abs(clock.delay_s),
        )  # fmt: skip
    return clock


def _panorama_of(runs: Sequence[Run], recipe: Recipe) -> PanoramaConfig:
    """The panorama that the model expects: the recipe's, in the size that was trained on."""
    height, width, _ = runs[0].panoramas.shape
    return PanoramaConfig(**{**asdict(recipe.panorama), 'height': height, 'width': width})


def _heading_layers(network: Network, config: HeadingConfig) -> tuple[int, ...]:
    depth = len(network.nodes)
    return tuple(sorted({min(layer, depth) - 1 for layer in config.heading_layers}))


def _view(network: Network, runs: Sequence[Run], layers: tuple[int, ...], progress: bool) -> _Views:
    """Run all pictures through the network once."""
    total = sum(len(run.panoramas) for run in runs)
    sampled = np.unique(np.linspace(0, total - 1, min(total, _SAMPLES)).round().astype(np.int64))
    kept = np.zeros(total, bool)
    kept[sampled] = True
    features, spread, harmonic = [], [], []
    eta = _Eta(network.architecture.outputs)
    descriptions: list[list[Array]] = [[] for _ in network.nodes]
    for start, maps in _all_maps(network, runs, progress):
        keep = kept[start : start + len(maps[0])]
        features.append(top_features(maps))
        spread.append(disagreement(maps[-1]))
        eta.add(maps[-1])
        harmonic.append(heading_input([m[keep] for m in maps], layers))
        for layer, of_layer in zip(maps, descriptions, strict=True):
            of_layer.append(describe(layer[keep]))
    return _Views(
        np.concatenate(features),
        np.concatenate(spread),
        sampled,
        np.concatenate(harmonic),
        tuple(np.concatenate(d) for d in descriptions),
        eta.result(),
    )


def _all_maps(
    network: Network, runs: Sequence[Run], progress: bool
) -> Iterator[tuple[int, list[Map]]]:
    """Number of the first picture of each batch, and every layer's maps."""
    start = 0
    total = sum(len(run.panoramas) for run in runs)
    with tqdm(
        desc='features of all pictures', total=total, unit='img', disable=not progress
    ) as bar:
        for run in runs:
            for images in run.panoramas.batches(BATCH):
                yield start, network.maps(images)
                start += len(images)
                bar.update(len(images))


class _Eta:
    """Shares of the variance of each slow feature over rotations, and over places.

    eta_phi = variance over the rotation at a place / total, ideally 0; eta_p = variance over the
    places / total, ideally 1.
    """

    def __init__(self, outputs: int) -> None:
        self._count = 0
        self._mean, self._square, self._place = np.zeros((3, outputs))

    def add(self, top: Map) -> None:
        """Add top maps (T, 1, R, K)."""
        views = top.reshape(len(top), -1, top.shape[-1]).astype(np.float64)
        mean = views.mean(1)
        self._count += len(top)
        self._mean += mean.sum(0)
        self._square += (views**2).mean(1).sum(0)
        self._place += (mean**2).sum(0)

    def result(self) -> dict[str, list[float]]:
        mean, square, place = (
            part / self._count for part in (self._mean, self._square, self._place)
        )
        total = np.maximum(square - mean**2, 1e-12)
        return {
            'eta_phi': ((square - place) / total).tolist(),
            'eta_p': ((place - mean**2) / total).tolist(),
        }


def _learn_heading(
    views: _Views, segments: Segments, result: MetricResult, config: HeadingConfig
) -> tuple[HeadingFit | None, NDArray[np.int64]]:
    """The compass from the segments' certified headings, and the pictures that taught it."""
    labelled, yaw = metric_learning.headings(result, segments)
    if not config.learn_heading:
        return None, labelled[:0]
    known, at_sample, at_label = np.intersect1d(views.sampled, labelled, return_indices=True)
    try:
        fit = fit_compass(
            views.features[known],
            views.harmonic[at_sample],
            yaw[at_label],
            _heading_part(known, segments, len(views.features), config),
            config,
        )
    except DataError as error:
        logger.warning('no heading is learnt: %s', error)
        return None, labelled[:0]
    return fit, known


def _error_correlation(segments: Segments, result: MetricResult) -> ErrorCorrelation:
    """How the errors of pictures that the map had not seen hang together along the drive."""
    ways = [
        np.cumsum(np.abs(np.diff(s.path, prepend=s.path[0])))
        + TURN_RADIUS_M * np.cumsum(np.abs(np.diff(s.headings, prepend=s.headings[0])))
        for s in segments
    ]
    owner = np.repeat(np.arange(len(ways)), [len(way) for way in ways])
    found = ErrorCorrelation.fit(
        result.left_out, result.left_out_variance, np.concatenate(ways), owner
    )
    return ErrorCorrelation(min(found.share, _LARGEST_SHARE), found.distance_m)


def _heading_part(
    labelled: NDArray[np.int64], segments: Segments, images: int, config: HeadingConfig
) -> NDArray[np.int64]:
    """(T,) which part each labelled one (T,) of so many images is left out with."""
    return assignment(segments, images)[labelled] % config.heading_folds


def _yaw_weight(
    labelled: NDArray[np.int64],
    part: NDArray[np.int64],
    segments: Segments,
    result: MetricResult,
) -> Array:
    """(T,) how much each left-out heading says of paths between the trained ones."""
    images, places = metric_learning.positions(result, segments)
    distances = nearest_used(places[np.searchsorted(images, labelled)], part)
    return result.forecast.importance(distances)


def _yaw_agreement(heading: HeadingFit | None, spread: Array, weight: Array) -> Agreement | None:
    if heading is None:
        return None
    return Agreement.fit(
        spread, heading.left_out_error**2, heading.left_out_std**2, axes=1, weight=weight
    )


def _quality(
    network: Network,
    views: _Views,
    segments: Segments,
    result: MetricResult,
    agreement: Agreement,
) -> dict[str, Any]:
    """Figures of merit that travel with the model; plain numbers and lists."""
    x, y, error = result.forecast.worst
    variance = result.left_out_variance * agreement.factor(views.disagreement[result.images])
    ratio = (result.left_out**2).sum(1) / variance
    return {
        'delta': network.deltas[-1].tolist(),
        'rank': [list(ranks) for ranks in network.ranks],
        **views.eta,
        'pictures': len(views.features),
        'segments': len(segments),
        'certified': bool(result.certificate.certified),
        'certificate': float(result.certificate.eigenvalue),
        'features_used': result.map.features,
        'residual_m': float(np.hypot(*result.residuals.T).mean()),
        'expected_error_m': result.forecast.expected_m,
        'worst': {'x_m': x, 'y_m': y, 'expected_error_m': error},
        'left_out_error_m': result.left_out_error_m,
        'left_out_within_95': share_within(ratio, 2, 0.95, result.left_out_weight),
        'coverage': result.diagnostics.as_dict(),
    }


def _yaw_quality(
    spread: Array, heading: HeadingFit | None, agreement: Agreement | None, weight: Array
) -> dict[str, float]:
    """Figures of the heading, of the left-out images by how much they say of paths between."""
    if heading is None or agreement is None:
        return {}
    error = heading.left_out_error
    ratio = error**2 / (heading.left_out_std**2 * agreement.factor(spread))
    return {
        'expected_yaw_error_deg': float(np.degrees(np.average(np.abs(error), weights=weight))),
        'left_out_yaw_within_95': share_within(ratio, 1, 0.95, weight),
    }


def summary(trained: Trained) -> str:
    """What a person should know of a training, in a few lines; no ground truth is needed."""
    quality = trained.model.quality
    coverage = quality['coverage']
    worst = quality['worst']
    along, across = coverage['extent_m']
    proof = 'proven the best' if quality['certified'] else 'NOT proven the best'
    lines = [
        f'pictures: {quality["pictures"]} in {quality["segments"]} segments of odometry, '
        f'{coverage["length_m"]:.0f} m driven, about {along:.0f} m x {across:.0f} m covered',
        f'map: {quality["features_used"]} slow features, directions {proof} '
        f'(certificate {quality["certificate"]:.1e})',
        f'position: expect {quality["expected_error_m"]:.2f} m mean error of one image on paths '
        f'between the trained ones; worst near x {worst["x_m"]:.1f} m, y {worst["y_m"]:.1f} m: '
        f'{worst["expected_error_m"]:.2f} m',
    ]
    if 'expected_yaw_error_deg' in quality:
        lines.append(
            f'heading: expect {quality["expected_yaw_error_deg"]:.1f} degrees mean error, likewise'
        )
    for run, delay in zip(trained.runs, quality['camera_delay_s'], strict=True):
        if delay is not None and abs(delay) > _DELAY_SHOWN_S:
            late = 'late' if delay > 0 else 'early'
            lines.append(
                f'{run.name}: images are stamped {abs(delay):.2f} s {late}: taken into account'
            )
    for name, count in _counts(trained).items():
        lines += [f'{name}: {n} skipped: {why}' for why, n in sorted(count.items())]
    return '\n'.join(lines)


def _counts(trained: Trained) -> dict[str, dict[str, int]]:
    """What was not used, by reason: of every bag, and of the segments."""
    skipped = {
        f'{run.name}: {stream}': count.skipped
        for run in trained.runs
        for stream, count in run.counts.items()
    }
    skipped['metric learning: images'] = trained.segments.images.skipped
    skipped['metric learning: odometry'] = trained.segments.odometry.skipped
    return skipped


@dataclass(frozen=True, slots=True)
class _Checkpoint:
    """Finished stages of a training, kept beside the output until the model is written."""

    path: Path
    fingerprint: str

    @classmethod
    def beside(cls, output: Path, recipe: Recipe, runs: Sequence[Run]) -> _Checkpoint:
        """The checkpoint of training `recipe` on `runs`; other data have another fingerprint."""
        told = [repr(recipe.network), repr(recipe.panorama), repr(recipe.camera)]
        digest = hashlib.sha256('\n'.join(told).encode())
        for run in runs:
            digest.update(run.panoramas.stamps_ns.tobytes())
            digest.update(run.odometry.poses.tobytes())
            for at in range(0, len(run.panoramas), max(1, len(run.panoramas) // 16)):
                digest.update(run.panoramas.read(at, at + 1).tobytes())
        return cls(output.with_name(f'.{output.name}.checkpoint.npz'), digest.hexdigest())

    def write(self, partial: Partial) -> None:
        """Save the stages finished so far."""
        arrays: dict[str, NDArray[Any]] = {}
        for depth, node in enumerate(partial.nodes):
            for item in fields(Node):
                arrays[f'{depth}/{item.name}'] = getattr(node, item.name)
            arrays[f'{depth}/delta'] = partial.deltas[depth]
        if partial.linear is not None:
            for name in ('mean', 'weights', 'delta'):
                arrays[f'linear/{name}'] = getattr(partial.linear, name)
        header = {
            'format': CHECKPOINT,
            'version': CHECKPOINT_VERSION,
            'fingerprint': self.fingerprint,
            'ranks': partial.ranks,
            'linear_rank': None if partial.linear is None else partial.linear.rank,
        }
        write_arrays(self.path, {**arrays, 'header': np.array(json.dumps(header))})

    def read(self, architecture: Architecture) -> Partial | None:
        """The stages finished so far; None when there are none. Raises ModelError."""
        if not self.path.is_file():
            return None
        remedy = 'train without --resume'
        arrays = read_arrays(self.path, CHECKPOINT, CHECKPOINT_VERSION, remedy)
        header = json.loads(str(arrays['header']))
        if header['fingerprint'] != self.fingerprint:
            raise ModelError(f'{self.path}: of other bags or parameters: {remedy}')
        ranks = tuple((int(a), int(b)) for a, b in header['ranks'])
        nodes = tuple(
            Node(*(arrays[f'{depth}/{item.name}'] for item in fields(Node)))
            for depth in range(len(ranks))
        )
        deltas = tuple(arrays[f'{depth}/delta'] for depth in range(len(ranks)))
        linear = None
        if header['linear_rank'] is not None:
            mean, weights, delta = (arrays[f'linear/{n}'] for n in ('mean', 'weights', 'delta'))
            linear = Solution(mean, weights, delta, int(header['linear_rank']))
        return Partial(architecture, nodes, linear, deltas, ranks)

    def remove(self) -> None:
        """Forget the stages."""
        self.path.unlink(missing_ok=True)
