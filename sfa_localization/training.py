# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn a place model from recorded drives: the paper in eight steps; ground truth is never read.

1  read the drives                                       bags/drives.py
2  find loop closures, and measure their offsets         keyframes/closures.py, offsets.py
3  train the SFA hierarchy (section 2)                   sfa/network_training.py
4  slow features of all images (section 2.2)             sfa/image_features.py
5  cut the odometry into segments (section 3.1)          metric/segments.py
6  the certified drive, and the map of its features      metric/pose_graph.py, learning.py
7  learn it again, from maps turned by its headings      mapping/turned_maps.py
8  keyframes, and the model for section 5                mapping/keyframe_map.py, place_model.py

Steps 2 and 7 and the keyframes go beyond the paper; without closures, step 6 is its section 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sfa_localization.bags.drives import image_folder, read_drives
from sfa_localization.camera.learned_lens import LearnedLens
from sfa_localization.camera.panorama import repeated_pixels
from sfa_localization.data.geometry import Array
from sfa_localization.data.run import Run
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.motion import TURN_RADIUS_M
from sfa_localization.mapping.driven_ground import DrivenGround
from sfa_localization.mapping.drives import Maps, compare_with_map, learn_map, rig_of, with_points
from sfa_localization.mapping.keyframe_map import learn_keyframes
from sfa_localization.mapping.learning import MetricResult, learn_metric, with_turned
from sfa_localization.metric.segments import Segments
from sfa_localization.motion.check import MotionCheck
from sfa_localization.place_model import PlaceModel
from sfa_localization.sfa.checkpoint import Checkpoint
from sfa_localization.sfa.image_features import ImageFeatures, features_of_runs
from sfa_localization.sfa.network import Network
from sfa_localization.training_input import STEPS as STEPS
from sfa_localization.training_input import Recipe as Recipe
from sfa_localization.training_input import (
    TrainingInput,
    compared,
    train_hierarchy,
    with_lens,
)


@dataclass(frozen=True, slots=True)
class Trained:
    """The model and the intermediate results of its training, for reports.

    `features` (N, K) are those of all images, drive after drive; `metric` belongs to the model's
    map; `checks` hold the comparison of the sources of motion of each drive; `lens` is what they
    show of the camera, None for panoramas.
    """

    model: PlaceModel
    runs: tuple[Run, ...]
    features: Array
    segments: Segments
    metric: MetricResult
    checks: tuple[MotionCheck, ...] = ()
    lens: LearnedLens | None = None


@one_core()
def train(
    bags: Sequence[Path],
    output: Path,
    recipe: Recipe | None = None,
    *,
    progress: bool = False,
    resume: bool = False,
    strict: bool = False,
    force: bool = False,
) -> Trained:
    """Learn a place model from bags and write it to `output`.

    First, images, odometry and gyroscope are compared: a contradiction is an error, or with `force`
    a warning. An interrupted training leaves a checkpoint beside the output; `resume` continues
    from it and gives the same bytes (the engine mdp starts again, and so does a training of other
    bags or parameters, with a warning). Raises BagError, ConfigError,
    DataError or ModelError; then no model is written.
    """
    recipe = recipe or Recipe()
    output = Path(output)
    cache = image_folder(output)
    recipe, lens = with_lens(bags, recipe, progress)
    runs = read_drives(bags, cache, recipe, progress, strict=strict)  # step 1
    runs, checks = compared(runs, recipe, force)
    camera = (recipe.panorama, recipe.camera, recipe.lens, recipe.surround)
    settings = (recipe.network, recipe.architecture, *camera)
    checkpoint = Checkpoint.beside(output, settings, runs)
    if not resume:
        checkpoint.remove()
    given = TrainingInput.of(runs, recipe, progress, lens)  # step 2
    network = train_hierarchy(given, checkpoint)  # step 3
    trained = _learn(network, given, strict)  # steps 4 to 8
    compare_with_map(checks, given.drives, trained.metric)
    trained.model.save(output)
    checkpoint.remove()
    return replace(trained, checks=checks, lens=lens)


def learn_place(
    network: Network, runs: Sequence[Run], recipe: Recipe, strict: bool = False
) -> Trained:
    """Steps 4 to 8 for a trained network.

    Raises DataError; with `strict` also for a single route, which otherwise is a warning.
    """
    return _learn(network, TrainingInput.of(runs, recipe), strict)


def _maps(given: TrainingInput, images: ImageFeatures, strict: bool) -> tuple[Segments, Maps]:
    """Steps 5 to 7; measured points repeat them in the frame of the points."""
    config = given.recipe.metric
    seed = given.recipe.network.seed
    sign = -1.0 if given.panorama.clockwise else 1.0

    def turned(segments: Segments, first: MetricResult) -> Maps:
        return first, *with_turned(images.spectra, segments, first, sign, config, seed)

    def again(segments: Segments) -> Maps:
        return turned(segments, learn_metric(images.slow, segments, config, seed))

    given.say(6, 'cut the odometry, and learn the map')
    segments, first = learn_map(given.drives, images.slow, config, seed, strict)
    given.say(7, 'learn the map again, from turned maps')
    return with_points(given.drives, segments, turned(segments, first), again)


def _learn(network: Network, given: TrainingInput, strict: bool) -> Trained:
    with given.bar(4, 'compute the slow features of all images') as bar:
        images = features_of_runs(network, given.runs, bar.update)
    segments, (first, turned, result) = _maps(given, images, strict)
    given.say(8, 'choose keyframes, and check the map')
    sphere = given.recipe.panorama.sphere
    keyframe_map = learn_keyframes(given.views, segments, result, sphere, TURN_RADIUS_M)
    result = replace(result, forecast=result.forecast.improved(keyframe_map.improvement))
    points = segments.points.quality(result.points) if segments.points else {}
    origin = given.runs[-1].origin
    quality: dict[str, Any] = {
        'features_used': first.map.features,
        'turned': turned is not None,
        'delta': network.deltas[-1].tolist(),
        'rank': [*map(list, network.ranks)],
        **points,
        **({'origin': origin} if origin else {}),
        'segments': len(segments),
        **images.quality,
        **result.quality,
        **keyframe_map.quality,
    }
    rig = rig_of(given.drives, segments)
    drive = np.repeat([s.run for s in segments], [len(s.images) for s in segments])
    model = PlaceModel(
        network,
        result.map,
        given.panorama,
        keyframe_map.keyframes,
        DrivenGround.of(rig.centers(result.poses), drive, result.forecast.local),
        turned,
        quality,
        keyframe_map.correlation,
        rig,
        repeated=None if given.seen is None else repeated_pixels(given.seen),
        lean=tuple(given.lean.tolist()) if given.lean.any() else (),
        lens=replace(given.recipe, panorama=given.panorama).unwrapper.lens,
        surround=given.recipe.surround,
    )
    return Trained(model, given.runs, images.slow, segments, result)
