# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What all steps of a training share: settings, and drives with clocks and loop closures."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sfa_localization.bags.drives import ReadingRecipe
from sfa_localization.camera.kinds import require_single_view
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.turns import headings, turns_and_textures
from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.progress import announce, progress_bar
from sfa_localization.data.run import Run
from sfa_localization.fusion.camera_clock import camera_clock
from sfa_localization.keyframes.closures import Views, find_closures, views_of
from sfa_localization.keyframes.leveling import leveled_runs
from sfa_localization.metric.drives import Drive, Drives
from sfa_localization.metric.motion_check import MotionCheck, check_drives
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.odometry_errors import same_scale
from sfa_localization.metric.points import points_of
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.sfa import mdp_engine
from sfa_localization.sfa.checkpoint import Checkpoint
from sfa_localization.sfa.network import Architecture, Network, standard_architecture
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.sfa.settings import NetworkConfig
from sfa_localization.sfa.zero_time_edges import edges_between

logger = logging.getLogger(__name__)

STEPS = 8
"""Of a training, see training.py."""


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
class TrainingInput:
    """Drives with clocks and loop closures, the `views` that these are found by, and settings."""

    drives: Drives
    views: Views
    recipe: Recipe
    progress: bool = False

    @classmethod
    def of(cls, runs: Sequence[Run], recipe: Recipe, progress: bool = False) -> TrainingInput:
        """Step 2: what images show before anything is learned, also in different lights."""
        total = sum(len(run.panoramas) for run in runs)
        with progress_bar(titled(2, 'level the images'), visible=progress) as bar:
            runs = leveled_runs(runs, recipe.panorama.sphere, bar.update)
        with progress_bar(titled(2, 'find loop closures'), total, visible=progress) as bar:
            views = views_of(runs, bar.update)
        closures = find_closures(views, recipe.panorama.clockwise)
        runs = same_scale(runs, closures)
        points = points_of(runs, recipe.metric.anchors)
        by_tf = [run.camera for run in runs if run.camera is not None]
        measured = complex(*recipe.metric.camera_xy) if recipe.metric.camera_xy else None
        mount = Mount.at(by_tf[0] if by_tf and measured is None else measured)
        items = tuple(map(drive_of, runs))
        drives = Drives(items, closures, recipe.segments, points=points, mount=mount)
        drives = drives.measured(views, recipe.panorama.sphere)
        return cls(drives, views, recipe, progress)

    @property
    def runs(self) -> tuple[Run, ...]:
        """One for each drive."""
        return tuple(drive.run for drive in self.drives.items)

    @property
    def panorama(self) -> PanoramaConfig:
        """The recipe's, in the size of the recorded ones."""
        height, width, _ = self.runs[0].panoramas.shape
        return replace(self.recipe.panorama, height=height, width=width)

    @property
    def architecture(self) -> Architecture:
        """The recipe's, or the standard one for the panoramas."""
        size = self.panorama.height, self.panorama.width
        normalization = self.recipe.network.normalization
        return self.recipe.architecture or standard_architecture(size, normalization)

    @property
    def sequences(self) -> list[ImageSequence]:
        """What the network is trained on: the drives, and the loop closures between them."""
        rotations, clockwise = self.architecture.rotations, self.recipe.panorama.clockwise
        own = [ImageSequence.of(run) for run in self.runs]
        drives = [run.panoramas for run in self.runs]
        return own + edges_between(drives, self.drives.closures, rotations, clockwise)

    def say(self, step: int, text: str) -> None:
        """Announce a step."""
        announce(titled(step, text), visible=self.progress)

    def bar(self, step: int, text: str) -> Any:
        """The progress of a step through all images."""
        images = sum(len(one.panoramas) for one in self.runs)
        return progress_bar(titled(step, text), images, visible=self.progress)


def train_hierarchy(given: TrainingInput, checkpoint: Checkpoint) -> Network:
    """Step 3, section 2 of the paper; from the checkpoint where there is one."""
    architecture, sequences = given.architecture, given.sequences
    start, seed = checkpoint.read(architecture), given.recipe.network.seed
    passes, done = 2 * len(architecture.layers), start.stages if start else 0
    title = titled(3, f'learn slow features in {passes} passes')
    images = sum(len(one.panoramas) for one in sequences)
    total, before = images * passes, images * done
    with progress_bar(title, total, initial=before, visible=given.progress) as bar:
        if given.recipe.network.engine == 'mdp':
            return mdp_engine.train_network(architecture, sequences, seed, on_shard=bar.update)
        return train_network(
            architecture,
            sequences,
            seed,
            start=start,
            on_stage=checkpoint.write,
            on_shard=bar.update,
        )


def titled(step: int, text: str) -> str:
    """What a step does, with its number."""
    return f'{text} (step {step} of {STEPS})'


def compared(
    runs: Sequence[Run], recipe: Recipe, force: bool = False
) -> tuple[tuple[Run, ...], tuple[MotionCheck, ...]]:
    """The drives with corrected sources of motion, and what these tell of each other.

    Raises CameraError or DataError for what cannot be right, of which `force` only warns.
    """
    if not force:
        require_single_view(runs)
    shown = [turns_and_textures(run.panoramas, recipe.panorama.clockwise) for run in runs]
    seen, textures = zip(*shown, strict=True)
    found, checks = check_drives(runs, seen, force, textures)
    if recipe.segments.yaw_source == 'gyro':  # that is asked for, also where others contradict it
        found = tuple(
            replace(one, yaw_rate=one.yaw_rate or run.yaw_rate)
            for one, run in zip(found, runs, strict=True)
        )
    return found, checks


def drive_of(run: Run) -> Drive:
    """A run with the clock of its camera; warns of a delay that the filter cannot compensate."""
    seen = list(headings(run.panoramas))
    clock = camera_clock(run.odometry, run.panoramas.stamps_ns, seen)
    if abs(clock.delay_ns) > DELAY_LIMIT_NS:
        logger.warning(
            '%s: the stamps of images and odometry are %.2f s apart: the filter compensates half '
            'a second only; synchronize both clocks', run.name, abs(clock.delay_s),
        )  # fmt: skip
    return Drive(run, seen, clock.delay_ns if clock.known else None)
