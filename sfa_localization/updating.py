# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Extend a model by images of later drives, without ground truth.

A drive is replayed and smoothed. An image becomes a keyframe, at its smoothed pose, if the robot
was LOCALISED, the smoothed pose is certain, and the keyframes explain the image less well than they
explain each other: it shows a new viewpoint, another light or another season. Network, map and the
keyframes of the training stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sfa_localization.bags.drives import ReadingRecipe, as_live, image_folder, read_drive
from sfa_localization.camera.leveling import LeveledPanoramas
from sfa_localization.camera.settings import WatchConfig
from sfa_localization.camera.turns import headings
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import Array, Mask, wrap_angle
from sfa_localization.data.progress import progress_over
from sfa_localization.data.run import PanoramaArray, Panoramas, Run
from sfa_localization.data.statistics import evenly
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.camera_clock import camera_clock
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.replay import FilterTrack, replay
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother
from sfa_localization.fusion.status import Level
from sfa_localization.keyframes.keyframes import Keyframes, encoded
from sfa_localization.keyframes.texture import quantized, texture
from sfa_localization.keyframes.training import fit_among
from sfa_localization.localizer import filter_of
from sfa_localization.observer import Observation, Observer
from sfa_localization.place_model import PlaceModel

MOST_ADDED = 1000
"""Keyframes added in all, beside some 2,000 of the training: 2 MB."""
MOST_OF_DRIVE = MOST_ADDED // 4
"""Keyframes added from a drive, so that several lights and seasons have room."""
CERTAIN_M = 0.15
CERTAIN_RAD = 0.03
"""Largest standard deviations of the smoothed pose of a new keyframe: about the errors of a single
image, so that new keyframes are as accurate as those of the training."""
_CELL_M = 0.2
_CELL_GROWTH = 1.2
"""Size of the cells of which each gives a keyframe, and its growth until there are few enough."""
_GATE = 11.3
"""Squared Mahalanobis distance that a right pose exceeds in 1 of 100 cases."""
_QUANTILE = 0.05
_SAMPLE = 200
"""Quantile of how well keyframes are explained, and how many keyframes are sampled for it."""
_GAP_NS = 500_000_000
"""Longest pause of the odometry in which a smoothed pose is used."""


@dataclass(frozen=True, slots=True)
class Additions:
    """New keyframes: `textures` (N, rows, columns) int8 at `poses` (N, 3) in the map."""

    textures: NDArray[np.int8]
    poses: Array

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, slots=True)
class Updated:
    """The extended model, and the number of images that each bag added to it, by name."""

    model: PlaceModel
    added: tuple[tuple[str, int], ...]

    @property
    def keyframes(self) -> list[tuple[str, Array]]:
        """The poses (K, 3) of the keyframes of the training, and of each update, by its bag."""
        keyframes = self.model.keyframes
        named = [('training', keyframes.poses[keyframes.first])]
        for number, update in enumerate(self.model.quality.get('updates', ())):
            added = keyframes.lights == keyframes.trained + number
            named.append((update['bag'], keyframes.poses[added]))
        return named

    def sentence(self) -> str:
        """The number of added keyframes, in a sentence."""
        if not any(count for _, count in self.added):
            return (
                'no image of these drives is new and has a certain pose: the model stays as it is'
            )
        counts = ', '.join(f'{count} images of {name}' for name, count in self.added)
        total = len(self.model.keyframes.poses)
        return f'added as keyframes: {counts}; the model has {total} keyframes now'


@one_core()
def update(
    model: PlaceModel,
    bags: Sequence[Path],
    output: Path,
    recipe: ReadingRecipe | None = None,
    *,
    config: FilterConfig | None = None,
    watch: WatchConfig | None = None,
    progress: bool = False,
    strict: bool = False,
) -> Updated:
    """Add new images of the bags, one bag after the other, and write the model to `output`.

    Raises BagError, DataError or ModelError; then no model is written.
    """
    recipe = as_live(recipe or ReadingRecipe(), model.panorama, model.lens, model.surround)
    added = []
    cache = image_folder(Path(output))
    for bag in bags:
        run = read_drive(bag, cache, recipe, progress, strict=strict)
        new = new_views(model, run, config, watch, progress=progress)
        model = extended(model, new, Path(bag).name)
        added.append((Path(bag).name, len(new)))
    model.save(Path(output))
    return Updated(model, tuple(added))


def new_views(
    model: PlaceModel,
    run: Run,
    config: FilterConfig | None = None,
    watch: WatchConfig | None = None,
    *,
    progress: bool = False,
) -> Additions:
    """The new keyframes of a drive, MOST_OF_DRIVE at most.

    Raises DataError if the robot is never LOCALISED, and ModelError for images of another size.
    """
    config = config or FilterConfig()
    # Weakly recognized images are those to learn; the smoother decides if their poses are certain.
    smoother = filter_of(model, replace(config, degraded_std=config.lost_std), Smoother)
    images = Observer(model, watch).observe_run(run)
    images = progress_over(images, f'replay {run.name}', len(run.panoramas), visible=progress)
    observations, localised = _replayed(smoother, run, images)
    assert isinstance(smoother, Smoother)
    poses, certain = _smoothed(smoother, model, run)
    usual = usual_explained(model)
    novel = np.array([not image.problem and image.explained < usual for image in observations])
    agree = np.array([_agrees(*pair) for pair in zip(observations, poses, strict=True)])
    chosen = np.flatnonzero(localised & certain & novel & agree)
    chosen = chosen[_spread(poses[chosen])]
    tilts = np.reshape([image.tilt for image in observations], (-1, 2))
    textures = _textures(model, run.panoramas, chosen, tilts[chosen])
    return Additions(textures, model.rig.camera(poses[chosen]))


def _replayed(
    fused: PoseFilter, run: Run, images: Iterable[Observation]
) -> tuple[list[Observation], Mask]:
    """The N images of a drive, and a mask (N,) of those after which the robot was LOCALISED.

    Raises DataError if it never was.
    """
    observations = list[Observation]()
    localised = list[bool]()
    for _, observation, _ in replay(fused, run.odometry, run.panoramas.stamps_ns, images):
        if observation is not None:
            observations.append(observation)
            localised.append(fused.status.level is Level.LOCALISED)
    if not any(localised):
        raise DataError(
            f'{run.name}: the robot is never LOCALISED on this drive, so the places of its images '
            'are unknown: train anew, with the bags of the first training and this one'
        )
    return observations, np.array(localised)


def usual_explained(model: PlaceModel) -> float:
    """The part of a keyframe that the others explain; 19 of 20 of the training exceed it."""
    keyframes = model.keyframes
    first = model.keyframes.first
    explained = list[float]()
    for row in np.flatnonzero(first)[evenly(int(first.sum()), _SAMPLE)].tolist():
        fit = fit_among(keyframes, row, first & (np.arange(len(first)) != row))
        explained.append(fit.explained if fit else 0.0)
    return float(np.quantile(explained, _QUANTILE))


def _smoothed(smoother: Smoother, model: PlaceModel, run: Run) -> tuple[Array, Mask]:
    """Smoothed poses (N, 3) of the images, and a mask (N,) of those that are certain."""
    smoothed = FilterTrack.of(smoother.smoothed())
    track = smoothed.poses
    covariances = smoothed.covariances
    stamps = run.panoramas.stamps_ns
    clock = camera_clock(run.odometry, stamps, headings(run.panoramas))
    delay_ns = clock.delay_ns if clock.is_estimated else round(model.rig.camera_delay.value * 1e9)
    taken = stamps - delay_ns
    position_std = np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1])
    certain = (position_std <= CERTAIN_M) & (covariances[:, 2, 2] <= CERTAIN_RAD**2)
    after = np.clip(np.searchsorted(track.stamps_ns, taken), 0, len(track) - 1)
    certain = certain[after] & certain[np.maximum(after - 1, 0)]
    return track.at(taken), certain & track.covers(taken, _GAP_NS)


def _agrees(observation: Observation, pose: Array) -> bool:
    """Whether the pose of an image agrees with the smoothed pose (3,)."""
    innovation = observation.pose - pose
    innovation[2] = wrap_angle(innovation[2])
    return float(innovation @ np.linalg.solve(observation.covariance, innovation)) <= _GATE


def _spread(poses: Array) -> NDArray[np.int64]:
    """Rows of at most MOST_OF_DRIVE of the poses (N, 3): the first in each cell of a grid."""
    cell_m = _CELL_M
    while True:
        cells = np.floor(poses[:, :2] / cell_m)
        first = np.unique(cells, axis=0, return_index=True)[1]
        if len(first) <= MOST_OF_DRIVE:
            return np.sort(first)
        cell_m *= _CELL_GROWTH


def _textures(
    model: PlaceModel, images: Panoramas, chosen: NDArray[np.int64], tilts: Array
) -> NDArray[np.int8]:
    """Textures (M, rows, columns) of the chosen images (M,), leveled by their tilts (M, 2)."""
    if not len(chosen):
        return np.zeros((0, 0, 0), np.int8)
    read = np.concatenate([model.prepared(images.read(i, i + 1)) for i in chosen.tolist()])
    prepared = PanoramaArray(images.stamps_ns[chosen], read)
    leveled = LeveledPanoramas.of(prepared, tilts, model.keyframes.sphere)
    return quantized(np.stack([texture(image) for image in leveled.read(0, len(chosen))]))


def extended(model: PlaceModel, new: Additions, name: str) -> PlaceModel:
    """The model with the new keyframes of drive `name`; the same model if there are none.

    Beyond MOST_ADDED, older added keyframes near the new ones are removed.
    """
    if not len(new):
        return model
    old = model.keyframes
    rows = _kept(model.keyframes, new.poses)
    values, _ = encoded(new.textures, new.poses, old.sphere, old.seen, old)
    keyframes = replace(
        old,
        values=np.concatenate([old.values[rows], values]),
        poses=np.concatenate([old.poses[rows], new.poses]),
        lights=np.append(old.lights[rows], np.full(len(new), old.lights.max() + 1, np.int32)),
    )
    updates: list[Any] = [*model.quality.get('updates', ()), {'bag': name, 'images': len(new)}]
    quality = {**model.quality, 'updates': updates}
    return replace(model, keyframes=keyframes, quality=quality)


def _kept(old: Keyframes, new: Array) -> NDArray[np.int64]:
    """Rows (K,) of the keyframes that stay beside new ones at poses (M, 3).

    Those of the training stay. For a surplus of n, of the 2n oldest added ones go the n nearest to
    the new ones.
    """
    added = np.flatnonzero(~old.first)
    surplus = max(len(added) + len(new) - MOST_ADDED, 0)
    oldest = added[np.argsort(old.lights[added], kind='stable')][: 2 * surplus]
    distance_m, _ = cKDTree(new[:, :2]).query(old.poses[oldest, :2])
    removed = oldest[np.argsort(distance_m, kind='stable')[:surplus]]
    return np.asarray(np.delete(np.arange(len(old.poses)), removed), np.int64)
