# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn a place model from recorded drives: the paper in nine steps; ground truth is never read.

1  read the drives                            bags/drives.py
2  find loop closures                         features/closures.py
3  train the SFA hierarchy (section 2)        features/network_training.py
4  slow features of all images                features/image_features.py
5  cut the odometry into segments             metric/segments.py
6  learn the certified map (section 3)        metric/learning.py
7  learn the compass                          metric/compass_training.py
8  refine the map with turned maps            metric/refinement.py
9  assemble the place model                   place_model.py

Steps 4 to 7 find the place and the heading by slow features. Steps 2 and 8 go beyond the paper.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sfa_localization.bags.drives import ReadingRecipe, image_cache, read_drives
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.turns import headings as visual_headings
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array
from sfa_localization.data.progress import announce, progress_bar
from sfa_localization.data.run import Run
from sfa_localization.data.threads import one_core
from sfa_localization.features import mdp_engine
from sfa_localization.features.checkpoint import Checkpoint
from sfa_localization.features.closures import Closures, Views, find_closures, views_of
from sfa_localization.features.image_features import ImageFeatures, features_of_runs
from sfa_localization.features.network import Architecture, Network, standard_architecture
from sfa_localization.features.network_training import ImageSequence, train_network
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.features.zero_time_edges import edges_between
from sfa_localization.fusion.camera_clock import CameraClock, camera_clock
from sfa_localization.fusion.motion import TURN_RADIUS_M
from sfa_localization.fusion.pose_filter import DELAY_LIMIT_NS
from sfa_localization.metric.compass_training import LearnedHeading, compass_layers, learn_heading
from sfa_localization.metric.dead_reckoning import OdometryTrack, TurnCorrection, Way
from sfa_localization.metric.drive_check import ROUTE
from sfa_localization.metric.keyframe_map import KeyframeMap, learn_keyframes
from sfa_localization.metric.learning import (
    MetricResult,
    correlation_along_drive,
    headings,
    learn_metric,
    left_out_agreement,
    positions,
)
from sfa_localization.metric.odometry_noise import against_images, expected_noise
from sfa_localization.metric.refinement import LearnedRefinement, learn_refinement
from sfa_localization.metric.saved_map import fast_map
from sfa_localization.metric.seen_turns import Headings, corrections
from sfa_localization.metric.segments import Segments, cut, join, tracked
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.metric.shared_tracks import with_closures
from sfa_localization.metric.turn_loss import Shown, way_of
from sfa_localization.place_model import PlaceModel

logger = logging.getLogger(__name__)

STEPS = 9
"""Of the paper as it is here: see above."""
COARSE_POINTS = 700
"""Inducing points of a first map that is refined: with more, the refined map and the heading are
no better, and the model file is larger."""
_LOSS_ROUNDS = 2
"""The first map hides a third of the way that wheels lose in turns, the next one a tenth."""
_NOISE_FACTOR = 2.0
"""Noise of turns that differs by less bends no map: links weigh a little more or less."""


@dataclass(frozen=True, slots=True)
class Recipe(ReadingRecipe):
    """Everything that decides what is learned from a bag.

    `architecture` replaces the standard network for the size of the panoramas.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    segments: SegmentConfig = field(default_factory=SegmentConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)
    architecture: Architecture | None = None


@dataclass(frozen=True, slots=True)
class Trained:
    """The model and the intermediate results of its training, for reports.

    `features` (N, K) of all images, drive after drive; `metric` is that of the finest map.
    """

    model: PlaceModel
    runs: tuple[Run, ...]
    features: Array
    segments: Segments
    metric: MetricResult
    heading: LearnedHeading | None


def train(
    bags: Sequence[Path],
    output: Path,
    recipe: Recipe | None = None,
    *,
    progress: bool = False,
    resume: bool = False,
    strict: bool = False,
) -> Trained:
    """Learn a place model from bags and write it to `output`.

    A training that was interrupted leaves a checkpoint beside the output; with `resume` it goes on
    from there and gives the same bytes (the engine mdp starts again). Raises BagError,
    ConfigError, DataError or ModelError; then no model is written.
    """
    recipe, output = recipe or Recipe(), Path(output)
    with image_cache(output) as cache:
        runs = read_drives(bags, cache, recipe, progress, strict=strict)
        settings = (recipe.network, recipe.architecture, recipe.panorama, recipe.camera)
        checkpoint = Checkpoint.beside(output, settings, runs)
        if not resume:
            checkpoint.remove()
        with one_core():
            known = match_images(runs, recipe, progress)
        network = _train_hierarchy(runs, known.closures, recipe, checkpoint, progress)
        with one_core():
            trained = learn_place(network, runs, recipe, progress, strict, known)
        trained.model.save(output)
        checkpoint.remove()
    return trained


@dataclass(frozen=True, slots=True)
class Matched:
    """What images show before anything is learned: their local contrast, and loop closures."""

    views: Views
    closures: Closures


def match_images(runs: Sequence[Run], recipe: Recipe, progress: bool = False) -> Matched:
    """Step 2: loop closures of the drives, also between drives in different lights."""
    total = sum(len(run.panoramas) for run in runs)
    with progress_bar(f'find loop closures (step 2 of {STEPS})', total, shown=progress) as bar:
        views = views_of(runs, bar.update)
    return Matched(views, find_closures(views, recipe.panorama.clockwise))


def _train_hierarchy(
    runs: Sequence[Run],
    closures: Closures,
    recipe: Recipe,
    checkpoint: Checkpoint,
    progress: bool,
) -> Network:
    """Step 3, from the checkpoint where there is one."""
    size = runs[0].panoramas.shape[:2]
    architecture = recipe.architecture or standard_architecture(size, recipe.network.normalization)
    start = checkpoint.read(architecture)
    drives, seed = [run.panoramas for run in runs], recipe.network.seed
    sequences = [ImageSequence.of(run) for run in runs]
    rotations, clockwise = architecture.rotations, recipe.panorama.clockwise
    sequences += edges_between(drives, closures, rotations, clockwise)
    images, passes = sum(len(s.panoramas) for s in sequences), 2 * len(architecture.layers)
    with progress_bar(
        f'learn slow features in {passes} passes (step 3 of {STEPS})',
        images * passes,
        initial=images * start.stages if start else 0,
        shown=progress,
    ) as bar:
        if recipe.network.engine == 'mdp':
            return mdp_engine.train_network(architecture, sequences, seed, on_shard=bar.update)
        return train_network(
            architecture,
            sequences,
            seed,
            start=start,
            on_stage=checkpoint.write,
            on_shard=bar.update,
        )


def learn_place(
    network: Network,
    runs: Sequence[Run],
    recipe: Recipe,
    progress: bool = False,
    strict: bool = False,
    known: Matched | None = None,
) -> Trained:
    """Steps 4 to 9: maps, compass and keyframes for a trained network.

    Raises DataError; `strict` also for a single route, of which else a warning says so.
    """
    known = known or match_images(runs, recipe, progress)
    images = _slow_features(network, runs, progress)
    seen = [list(visual_headings(run.panoramas)) for run in runs]
    clocks = [clock_of(run, own) for run, own in zip(runs, seen, strict=True)]
    points = COARSE_POINTS if _refines(recipe.metric, images) else None
    seed = recipe.network.seed
    segments, first, heading = _learn_map(
        images, known.closures, runs, clocks, seen, recipe, points, progress
    )
    if first.diagnostics.one_route:
        if strict:
            raise DataError(f'{ROUTE}, or train without --strict')
        logger.warning(ROUTE)
    announce(f'refine the map (step 8 of {STEPS})', shown=progress)
    finer = _refine(images, segments, first, heading, recipe)
    if points is not None and finer is None:
        first = learn_metric(images.slow, segments, recipe.metric, seed, onto=first)
    announce(f'choose keyframes, and check the map (step 9 of {STEPS})', shown=progress)
    model, result = _assemble(
        network, runs, clocks, recipe, images, known.views, segments, first, heading, finer
    )
    return Trained(model, tuple(runs), images.slow, segments, result, heading)


def _slow_features(network: Network, runs: Sequence[Run], progress: bool) -> ImageFeatures:
    """Step 4: what the network outputs for all images."""
    total = sum(len(run.panoramas) for run in runs)
    title = f'compute the slow features of all images (step 4 of {STEPS})'
    with progress_bar(title, total, shown=progress) as bar:
        return features_of_runs(network, runs, compass_layers(len(network.nodes)), bar.update)


def clock_of(run: Run, seen: Sequence[float] | None = None) -> CameraClock:
    """The delay of the camera's clock, by the headings rad that its images show.

    Warns of one that the filter cannot compensate.
    """
    shown = visual_headings(run.panoramas) if seen is None else seen
    clock = camera_clock(run.odometry, run.panoramas.stamps_ns, shown)
    if abs(clock.delay_ns) > DELAY_LIMIT_NS:
        logger.warning(
            '%s: the stamps of images and odometry are %.2f s apart: the filter compensates half '
            'a second only; synchronize both clocks', run.name, abs(clock.delay_s),
        )  # fmt: skip
    return clock


def _learn_map(
    images: ImageFeatures,
    closures: Closures,
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    seen: Sequence[Sequence[float]],
    recipe: Recipe,
    points: int | None,
    progress: bool,
) -> tuple[Segments, MetricResult, LearnedHeading | None]:
    """Steps 5 to 7; where no map can be learned with the noise of turns that is stated or assumed,
    once more with the one that the shifts of the images, `seen` in each run (N,) rad, show; and
    where the map shows that wheels lose way in turns, once more without it.
    """
    turns = _seen_turns(runs, clocks, seen, closures, recipe.segments)

    def learned(
        noise: float | None = None, ways: Sequence[Way | None] | None = None
    ) -> tuple[Segments, MetricResult, LearnedHeading | None]:
        cuts = cut_odometry(runs, clocks, recipe.segments, noise, turns, ways)
        segments = with_closures(cuts, closures)
        return segments, *_map_and_compass(images, segments, recipe, points, progress)

    noise = None
    try:
        found = learned()
    except DataError:
        noise = None if turns else _needed_noise(runs, clocks, seen, recipe.segments)
        if noise is None:
            raise
        found = learned(noise)
    try:
        for _ in range(_LOSS_ROUNDS):
            ways = _driven(runs, clocks, turns, found[0], found[1], recipe)
            if not any(ways):
                break
            found = learned(noise, ways)
    except DataError as error:
        logger.warning('the way that wheels lose in turns stays in the map: %s', error)
    return found


def _needed_noise(
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    seen: Sequence[Sequence[float]],
    config: SegmentConfig,
) -> float | None:
    """The noise of turns that the images show; None where it is known, or hardly differs."""
    assumed = SegmentConfig().yaw_noise
    noise = _bound(runs, clocks, seen, config) if config.yaw_noise == assumed else None
    if noise is None:
        return None
    stated = expected_noise(cut_odometry(runs, clocks, config))
    return noise if noise >= _NOISE_FACTOR * max(assumed, stated) else None


def _driven(
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    turns: Sequence[TurnCorrection] | None,
    segments: Segments,
    result: MetricResult,
    recipe: Recipe,
) -> list[Way | None]:
    """The way of each run by the map, where its wheels lose some in turns.

    All have the same scale: it is that of the map, and the runs are not better known by themselves.
    """
    if recipe.metric.solver == 'paper':
        return []
    images, places = positions(result, segments)
    places, yaw = places - result.residuals, headings(result, segments)[1]
    shown = places[:, 0] + 1j * places[:, 1]
    found, start = [], 0
    for k, (run, clock) in enumerate(zip(runs, clocks, strict=True)):
        correction = turns[k] if turns else None
        track = tracked(run.odometry, recipe.segments, run.yaw_rate, turns=correction)
        stamps_ns = run.panoramas.stamps_ns - clock.delay_ns - track.stamps_ns[0]
        own = (images >= start) & (images < start + len(stamps_ns))
        time_s = stamps_ns[images[own] - start] * 1e-9
        found.append(way_of(track, Shown(time_s, shown[own], yaw[own]), segments.ways[k]))
        start += len(stamps_ns)
    scales = [way.scale for way in found if way]
    return [way and way._replace(scale=float(np.mean(scales))) for way in found]


def _map_and_compass(
    images: ImageFeatures,
    segments: Segments,
    recipe: Recipe,
    points: int | None,
    progress: bool,
) -> tuple[MetricResult, LearnedHeading | None]:
    seed = recipe.network.seed
    announce(f'learn the map from {len(segments)} segments (step 6 of {STEPS})', shown=progress)
    first = learn_metric(images.slow, segments, recipe.metric, seed, points=points)
    announce(f'learn the heading (step 7 of {STEPS})', shown=progress)
    return first, learn_heading(images, segments, first)


def _bound(
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    seen: Sequence[Sequence[float]],
    config: SegmentConfig,
) -> float | None:
    """The noise of turns by the images alone, of all runs together."""
    found = [
        against_images(
            run.odometry, run.yaw_rate, run.panoramas.stamps_ns - clock.delay_ns, own, config
        )
        for run, clock, own in zip(runs, clocks, seen, strict=True)
    ]
    squares = [noise**2 for noise in found if noise is not None]
    return float(np.sqrt(np.mean(squares))) if squares else None


def _seen_turns(
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    seen: Sequence[Sequence[float]],
    closures: Closures,
    config: SegmentConfig,
) -> list[TurnCorrection] | None:
    """By the headings `seen` in each run (N,) rad; None where the odometry is as good."""
    drives = [
        Headings.of(
            OdometryTrack.of(run.odometry, config, run.yaw_rate),
            run.panoramas.stamps_ns - clock.delay_ns,
            own,
        )
        for run, clock, own in zip(runs, clocks, seen, strict=True)
    ]
    return corrections(drives, closures)


def cut_odometry(
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    config: SegmentConfig,
    noise: float | None = None,
    turns: Sequence[TurnCorrection] | None = None,
    ways: Sequence[Way | None] | None = None,
) -> Segments:
    """Step 5: segments of all runs, at the stamps of the images by the clock of the odometry."""
    parts = [
        cut(
            run.odometry,
            run.panoramas.stamps_ns - clock.delay_ns,
            config,
            run.yaw_rate,
            noise,
            turns[k] if turns else None,
            ways[k] if ways else None,
        )
        for k, (run, clock) in enumerate(zip(runs, clocks, strict=True))
    ]
    counts = [len(run.panoramas) for run in runs]
    return join(parts, [sum(counts[:k]) for k in range(len(runs))])


def _refines(config: MetricConfig, images: ImageFeatures) -> bool:
    """Whether step 8 refines the map, if there is a heading.

    The paper's descent and its monomials stay as they are: they are there for comparison.
    """
    article = config.solver == 'paper' or config.metric_map == 'monomials'
    return images.spectra is not None and not article


def _refine(
    images: ImageFeatures,
    segments: Segments,
    first: MetricResult,
    heading: LearnedHeading | None,
    recipe: Recipe,
) -> LearnedRefinement | None:
    """Step 8, where there are a heading and a layer to refine with."""
    if heading is None or images.spectra is None or not _refines(recipe.metric, images):
        return None
    views, sign, seed = images.disagreement, heading.compass.sign, recipe.network.seed
    try:
        return learn_refinement(images.spectra, views, segments, first, sign, recipe.metric, seed)
    except DataError as error:
        logger.warning('positions are not refined: %s', error)
        return None


def _assemble(
    network: Network,
    runs: Sequence[Run],
    clocks: Sequence[CameraClock],
    recipe: Recipe,
    images: ImageFeatures,
    views: Views,
    segments: Segments,
    first: MetricResult,
    heading: LearnedHeading | None,
    finer: LearnedRefinement | None,
) -> tuple[PlaceModel, MetricResult]:
    """Step 9: the model, with its figures of merit, and its map with what keyframes improve."""
    height, width, _ = runs[0].panoramas.shape
    agreement = left_out_agreement(images.disagreement, first)
    result = finer.metric if finer else first
    finest = finer.refinement.agreement if finer else agreement
    known = learn_keyframes(
        views, images.disagreement, segments, result, finest, recipe.panorama.clockwise
    )
    # Of each run, s; None where the drive does not show it.
    delays = [clock.delay_ns * 1e-9 if clock.known else None for clock in clocks]
    result = replace(result, forecast=result.forecast.improved(known.improvement))
    quality = _quality(network, images, segments, result, known)
    quality |= {'features_used': first.map.features, 'refined': finer is not None}
    model = PlaceModel(
        network,
        fast_map(first.map),
        PanoramaConfig(**{**asdict(recipe.panorama), 'height': height, 'width': width}),
        known.keyframes,
        agreement,
        heading.compass if heading else None,
        heading.agreement if heading else None,
        compass_layers(len(network.nodes)) if heading else (),
        {**quality, **(heading.quality if heading else {}), 'camera_delay_s': delays},
        correlation_along_drive(result, segments, TURN_RADIUS_M),
        finer.refinement if finer else None,
    )
    return model, result


def _quality(
    network: Network,
    images: ImageFeatures,
    segments: Segments,
    result: MetricResult,
    known: KeyframeMap,
) -> dict[str, Any]:
    """Figures of merit that are stored in the model; plain numbers and lists."""
    x, y, error = result.forecast.worst
    return {
        'delta': network.deltas[-1].tolist(),
        'rank': [list(ranks) for ranks in network.ranks],
        **images.variance_shares,
        'pictures': len(images.slow),
        'segments': len(segments),
        'turn_loss': [way.loss if way else 0.0 for way in segments.ways],
        'certified': bool(result.certificate.certified),
        'certificate': float(result.certificate.eigenvalue),
        'residual_m': float(np.hypot(*result.residuals.T).mean()),
        'keyframes': len(known.keyframes.poses),
        'expected_error_m': result.forecast.expected_m,
        'worst': {'x_m': x, 'y_m': y, 'expected_error_m': error},
        'left_out_error_m': result.left_out_error_m,
        'left_out_within_95': known.within_95,
        'coverage': result.diagnostics.as_dict(),
    }
