# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn on the job: images of later drives become keyframes of a model, without ground truth.

A drive is replayed and smoothed. Where the robot was LOCALISED and its smoothed pose is certain, an
image that the keyframes recognize less well than each other shows a place between them, or in
another light or season: it becomes a keyframe with the smoothed pose. Network, map and
first keyframes stay.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.progress import progress_bar
from sfa_localization.data.run import Panoramas, Run
from sfa_localization.data.statistics import evenly
from sfa_localization.data.threads import one_core
from sfa_localization.fusion.camera_clock import camera_clock
from sfa_localization.fusion.replay import Track
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.fusion.smoother import Smoother
from sfa_localization.fusion.status import Level
from sfa_localization.keyframes.keyframes import Keyframes, encoded, parts_of
from sfa_localization.keyframes.texture import quantized, texture
from sfa_localization.keyframes.training import fit_among
from sfa_localization.localizer import Localizer, Observation
from sfa_localization.place_model import PlaceModel

MOST_ADDED = 1000
"""Keyframes beside those of the training: half as many, 2 MB."""
MOST_OF_DRIVE = MOST_ADDED // 4
"""Keyframes added from one drive, so that several lights and seasons find room."""
CERTAIN_M, CERTAIN_RAD = 0.15, 0.03
"""Largest standard deviations of a smoothed pose that a keyframe may have: those of the error of
one image in a trained place, so that an added keyframe is about as well placed as a first one."""
_APART_M, _COARSER = 0.2, 1.2
"""Two images of one drive in a cell of so many meters show the same; where there are too many, by
this factor larger cells are tried."""
_CONTRADICTS = 11.3
"""Squared Mahalanobis distance of a pose that 1 of 100 right ones exceeds."""
_RARELY, _SAMPLE = 0.05, 200
"""Share of keyframes that are unlike all others, and how many keyframes it is taken from."""
_GAP_NS = 500_000_000
"""A smoothed pose farther in time from odometry is a guess."""


@dataclass(frozen=True, slots=True)
class Additions:
    """What a drive adds: `textures` (N, rows, columns) int8 at `poses` (N, 3) in the map."""

    textures: NDArray[np.int8]
    poses: Array

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, slots=True)
class Updated:
    """The model after all drives, and how many images each of them added, by name of the bag."""

    model: PlaceModel
    added: tuple[tuple[str, int], ...]

    def sentence(self) -> str:
        """What was added, in one line."""
        if not any(count for _, count in self.added):
            return (
                'no image of these drives is both new and certain of its place: '
                'the model stays as it is'
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
    """Add what is new on the drives in bags, one after the other, and write the model to `output`.

    Raises BagError, DataError or ModelError; then no model is written.
    """
    recipe, added = as_live(recipe or ReadingRecipe(), model.panorama), []
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
    """The images of a drive that are worth keeping, MOST_OF_DRIVE at most.

    Raises DataError where the robot is never LOCALISED, and ModelError for images of another size.
    """
    config = config or FilterConfig()
    # Images that are weak are those to learn; whether their places are certain shows afterwards.
    config = replace(config, degraded_std=config.lost_std)
    localizer = Localizer(model, config, watch, Smoother)
    seen, sure = [], []
    with progress_bar(f'replay {run.name}', len(run.panoramas), visible=progress) as bar:
        for _, observation, _ in localizer.replay(run):
            if observation is not None:
                seen.append(observation)
                sure.append(localizer.status.level is Level.LOCALISED)
                bar.update()
    if not any(sure):
        raise DataError(
            f'{run.name}: the robot is never LOCALISED on this drive, so that the places of its '
            'images are unknown: train anew, with the bags of the first training and this one'
        )
    assert isinstance(localizer.filter, Smoother)
    poses, certain = _smoothed(localizer.filter, model, run)
    known = familiar_part(model)
    novel = np.array([not one.problem and one.explained < known for one in seen], bool)
    agree = np.array([_agrees(one, pose) for one, pose in zip(seen, poses, strict=True)], bool)
    chosen = np.flatnonzero(np.array(sure, bool) & certain & novel & agree)
    chosen = chosen[_spread(poses[chosen])]
    tilts = np.reshape([one.tilt for one in seen], (-1, 2))
    level = LeveledPanoramas(run.panoramas, tilts, model.keyframes.sphere)
    return Additions(_textures(level, chosen), model.rig.camera(poses[chosen]))


def familiar_part(model: PlaceModel) -> float:
    """The part of itself that 19 of 20 keyframes of the training have explained by the others."""
    keyframes, first = model.keyframes, model.keyframes.first
    explained = list[float]()
    for row in np.flatnonzero(first)[evenly(int(first.sum()), _SAMPLE)].tolist():
        fit = fit_among(keyframes, row, first & (np.arange(len(first)) != row))
        explained.append(fit.explained if fit else 0.0)
    return float(np.quantile(explained, _RARELY))


def _smoothed(smoother: Smoother, model: PlaceModel, run: Run) -> tuple[Array, NDArray[np.bool_]]:
    """Smoothed poses (N, 3) where the images were taken, and which of them are certain (N,)."""
    smoothed = Track.of(smoother.smoothed())
    track, spreads, at = smoothed.poses, smoothed.covariances, smoothed.poses.stamps_ns
    stamps = run.panoramas.stamps_ns
    clock = camera_clock(run.odometry, stamps, headings(run.panoramas))
    delay_ns = clock.delay_ns if clock.known else round(model.rig.camera_delay.value * 1e9)
    taken = stamps - delay_ns
    place_std = np.sqrt(np.linalg.eigvalsh(spreads[:, :2, :2])[:, 1])
    sharp = (place_std <= CERTAIN_M) & (spreads[:, 2, 2] <= CERTAIN_RAD**2)
    after = np.clip(np.searchsorted(at, taken), 0, len(at) - 1)
    both = sharp[after] & sharp[np.maximum(after - 1, 0)]
    return track.at(taken), both & track.covers(taken, _GAP_NS)


def _agrees(observation: Observation, pose: Array) -> bool:
    """Whether an image's own pose does not contradict the smoothed one (3,), of which then nobody
    could say which is right.
    """
    apart = observation.pose - pose
    apart[2] = wrap_angle(apart[2])
    return float(apart @ np.linalg.solve(observation.covariance, apart)) <= _CONTRADICTS


def _spread(poses: Array) -> NDArray[np.int64]:
    """At most MOST_OF_DRIVE of N images, by poses (N, 3): of each cell of a grid the first."""
    cell_m = _APART_M
    while True:
        cells = np.floor(poses[:, :2] / cell_m)
        first = np.unique(cells, axis=0, return_index=True)[1]
        if len(first) <= MOST_OF_DRIVE:
            return np.sort(first)
        cell_m *= _COARSER


def _textures(images: Panoramas, chosen: NDArray[np.int64]) -> NDArray[np.int8]:
    """Textures (M, rows, columns) of the chosen images (M,)."""
    if not len(chosen):
        return np.zeros((0, 0, 0), np.int8)
    read = (images.read(i, i + 1)[0] for i in chosen.tolist())
    return quantized(np.stack([texture(image) for image in read]))


def extended(model: PlaceModel, new: Additions, name: str) -> PlaceModel:
    """The model with the keyframes that drive `name` adds; itself where there are none.

    Of added keyframes the older ones near the new ones give way beyond MOST_ADDED.
    """
    if not len(new):
        return model
    old, rows = model.keyframes, _kept(model.keyframes, new.poses)
    values, _ = encoded(parts_of(new.textures, new.poses, old.sphere), old.step)
    keyframes = replace(
        old,
        values=np.concatenate([old.values[rows], values]),
        poses=np.concatenate([old.poses[rows], new.poses]),
        drives=np.append(old.drives[rows], np.full(len(new), old.drives.max() + 1, np.int32)),
    )
    updates: list[Any] = [*model.quality.get('updates', ()), {'bag': name, 'images': len(new)}]
    quality = {**model.quality, 'updates': updates}
    return replace(model, keyframes=keyframes, quality=quality)


def _kept(old: Keyframes, new: Array) -> NDArray[np.int64]:
    """Which keyframes (K,) stay beside new ones at poses (M, 3): all those of the training.

    Of twice as many as have to go, the oldest added ones, the nearest to new ones go.
    """
    added = np.flatnonzero(~old.first)
    surplus = max(len(added) + len(new) - MOST_ADDED, 0)
    oldest = added[np.argsort(old.drives[added], kind='stable')][: 2 * surplus]
    apart = cKDTree(new[:, :2]).query(old.poses[oldest, :2])[0]
    going = oldest[np.argsort(apart, kind='stable')[:surplus]]
    return np.asarray(np.delete(np.arange(len(old.poses)), going), np.int64)
