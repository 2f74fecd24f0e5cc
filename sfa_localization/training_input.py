# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The input of a training: recipe, compared sources of motion, drives with loop closures."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sfa_localization.bags.drives import ReadingRecipe
from sfa_localization.bags.lens_drive import lens_of
from sfa_localization.bags.surround_drive import with_cameras, yaws_of
from sfa_localization.camera import body, lens_report
from sfa_localization.camera.kinds import require_single_view
from sfa_localization.camera.learned_lens import PLACE_STD_M, LearnedLens
from sfa_localization.camera.leveling import MaskedPanoramas, leaning
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.turns import headings, turns_and_textures
from sfa_localization.data.errors import CameraError, DataError
from sfa_localization.data.events import DELAY_LIMIT_NS
from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.progress import announce, progress_bar
from sfa_localization.data.run import Run
from sfa_localization.data.sphere import Sphere
from sfa_localization.data.statistics import evenly
from sfa_localization.fusion.camera_clock import camera_clock
from sfa_localization.fusion.inputs import OpenLoop
from sfa_localization.keyframes.closures import Textures, find_closures, views_of
from sfa_localization.keyframes.hidden import seen_in
from sfa_localization.keyframes.leveling import camera_lean, leveled_runs, upright_run
from sfa_localization.keyframes.texture import channels
from sfa_localization.mapping.drives import Drive, Drives
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.points import points_of
from sfa_localization.motion.check import MotionCheck, check_motion
from sfa_localization.motion.dead_reckoning import OdometryTrack
from sfa_localization.motion.odometry_errors import same_scale
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.motion.truth import timed_points
from sfa_localization.sfa import mdp_engine
from sfa_localization.sfa.checkpoint import Checkpoint
from sfa_localization.sfa.network import Architecture, Network, standard_architecture
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.sfa.settings import NetworkConfig
from sfa_localization.sfa.zero_time_edges import edges_between

logger = logging.getLogger(__name__)
R = TypeVar('R', bound=ReadingRecipe)

FEWEST_SEEN = 0.7
"""Share of the view: with a quarter hidden one image errs by 0.13 m, with a half by 0.5 m."""
STEPS = 8
"""Number of steps of a training; training.py lists them."""


@dataclass(frozen=True, slots=True)
class Recipe(ReadingRecipe):
    """All settings that decide what is learned from a bag.

    `architecture` replaces the standard network for the size of the panoramas.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    segments: SegmentConfig = field(default_factory=SegmentConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)
    architecture: Architecture | None = None


@dataclass(frozen=True, slots=True)
class TrainingInput:
    """Drives with camera clocks and loop closures, the `views` that show them, and the recipe.

    The camera has `seen` some pixels (H, W) only, or all: None. It leans by roll and pitch (2,)
    rad.
    """

    drives: Drives
    views: Textures
    recipe: Recipe
    seen: Mask | None
    lean: Array
    progress: bool = False

    @classmethod
    def of(
        cls,
        runs: Sequence[Run],
        recipe: Recipe,
        progress: bool = False,
        lens: LearnedLens | None = None,
    ) -> TrainingInput:
        """Step 2: level the images, find loop closures, and with them calibrate the odometry."""
        sphere = recipe.panorama.sphere
        runs = without_hidden(runs, sphere)
        seen = runs[0].seen
        lean = camera_lean(runs, sphere)
        if lean.any():
            logger.warning('%s', leaning(*lean))
        runs = [upright_run(run, lean, sphere) for run in runs]
        total = sum(len(run.panoramas) for run in runs)
        with progress_bar(titled(2, 'level the images'), visible=progress) as bar:
            runs = leveled_runs(runs, sphere, bar.update)
        with progress_bar(titled(2, 'find loop closures'), total, visible=progress) as bar:
            views = views_of(runs, bar.update)
        if runs[0].seen is not None:
            views = replace(views, seen=seen_in(runs[0].seen, *views.textures.shape[1:]))
        closures = find_closures(views, recipe.panorama.clockwise)
        runs = same_scale(runs, closures)
        points = points_of(runs, recipe.metric.points)
        items = tuple(map(drive_of, runs))
        mount = mount_of(runs, recipe.metric.camera_xy, lens)
        drives = Drives(items, closures, recipe.segments, points=points, mount=mount)
        drives = drives.measured(views, sphere)
        return cls(drives, views, recipe, seen, lean, progress)

    @property
    def runs(self) -> tuple[Run, ...]:
        """The run of each drive."""
        return tuple(drive.run for drive in self.drives.items)

    @property
    def panorama(self) -> PanoramaConfig:
        """The recipe's panorama, in the size of the recorded images."""
        height, width, _ = self.runs[0].panoramas.shape
        return replace(self.recipe.panorama, height=height, width=width)

    @property
    def architecture(self) -> Architecture:
        """The recipe's network, or the standard network for the size of the panoramas."""
        size = self.panorama.height, self.panorama.width
        normalization = self.recipe.network.normalization
        return self.recipe.architecture or standard_architecture(size, normalization)

    @property
    def sequences(self) -> list[ImageSequence]:
        """Training data of the network: the images of each drive, and pairs at loop closures."""
        rotations = self.architecture.rotations
        clockwise = self.recipe.panorama.clockwise
        sequences = [ImageSequence.of(run) for run in self.runs]
        images = [run.panoramas for run in self.runs]
        return sequences + edges_between(images, self.drives.closures, rotations, clockwise)

    def say(self, step: int, text: str) -> None:
        """Announce a step that has no bar."""
        announce(titled(step, text), visible=self.progress)

    def bar(self, step: int, text: str) -> Any:
        """A progress bar for a step through all images."""
        images = sum(len(run.panoramas) for run in self.runs)
        return progress_bar(titled(step, text), images, visible=self.progress)


def train_hierarchy(given: TrainingInput, checkpoint: Checkpoint) -> Network:
    """Step 3, section 2 of the paper; continues from a checkpoint if there is one."""
    architecture = given.architecture
    sequences = given.sequences
    start = checkpoint.read(architecture)
    seed = given.recipe.network.seed
    passes = 2 * len(architecture.layers)
    done = start.stages if start else 0
    title = titled(3, f'learn slow features in {passes} passes')
    images = sum(len(sequence.panoramas) for sequence in sequences)
    with progress_bar(title, images * passes, initial=images * done, visible=given.progress) as bar:
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
    """The title of a step, with its number."""
    return f'{text} (step {step} of {STEPS})'


def with_lens(
    bags: Sequence[Path], recipe: R, progress: bool = False
) -> tuple[R, LearnedLens | None]:
    """The recipe with the lens, and the elevations, that the first bag to show them shows.

    A described lens stays, and is compared with that of the drive. Raises BagError, and CameraError
    where no bag shows the lens of images that are no panoramas. Several cameras around the robot
    have the lenses of their camera_info, and yaws that the drive corrects.
    """
    around = with_cameras(bags[0], recipe)
    if around.surround:
        yaws = yaws_of(bags[0], around, progress)
        for text in yaws.sentences('/tf_static says, which is taken into account'):
            logger.warning('%s: %s', bags[0], text)
        return replace(around, surround=yaws.corrected(around.surround)), None
    lens = None
    problems = list[CameraError]()
    for bag in bags:
        try:
            lens = lens_of(bag, recipe, progress)
            break
        except CameraError as error:
            problems.append(error)
    if recipe.camera.is_described:
        told = recipe.unwrapper.calibration, recipe.camera.name
        for text in [] if lens is None else lens_report.contradictions(lens, *told):
            logger.warning('%s', text)
        return recipe, lens
    if lens is None and problems:
        raise CameraError(f'{problems[0]}; or describe the camera by calibration_file')
    if lens is None:
        return recipe, None
    logger.info('%s', lens_report.sentence(lens))
    for text in lens_report.advice(lens):
        logger.warning('%s', text)
    panorama = lens_report.fitting_panorama(recipe.panorama, lens.sees)
    return replace(recipe, lens=lens.calibration, panorama=panorama), lens


def compared(
    runs: Sequence[Run], recipe: Recipe, force: bool = False
) -> tuple[tuple[Run, ...], tuple[MotionCheck, ...]]:
    """The drives with corrected sources of motion, and the comparison of these sources.

    Raises CameraError or DataError for contradictions; with `force` they are warnings.
    """
    if not force:
        require_single_view(runs)
    corrected, checks = zip(*(_compared(run, recipe, force) for run in runs), strict=True)
    return corrected, checks


def _compared(run: Run, recipe: Recipe, force: bool) -> tuple[Run, MotionCheck]:
    """A drive as its own comparison corrects it: its measured points, too, by the odometry."""
    turns, textures = turns_and_textures(run.panoramas, recipe.panorama.clockwise)
    commands = OpenLoop.of(run.odometry.twists).repeats
    stamps_ns = run.panoramas.stamps_ns
    images = (stamps_ns, turns)
    views = (stamps_ns, textures)
    check = check_motion(run.odometry, images, run.yaw_rate, views=views, commands=commands)
    _warn(run, [*check.corrected, *check.notes, *(check.wrong if force else [])])
    if check.wrong and not force:
        raise DataError(f'{run.name}: {"; ".join(check.wrong)} (train --force goes on)')
    corrected = check.run(run)
    if recipe.segments.yaw_source == 'gyro':  # on request also a gyroscope that was rejected
        corrected = replace(corrected, yaw_rate=corrected.yaw_rate or run.yaw_rate)
    if run.points is not None:
        track = OdometryTrack.of(corrected.odometry, SegmentConfig(), corrected.yaw_rate)
        points, texts = timed_points(run.points, track, commands)
        _warn(run, texts)
        check.corrected.extend(texts)
        corrected = replace(corrected, points=points)
    return corrected, check


def _warn(run: Run, texts: Sequence[str]) -> None:
    for text in texts:
        logger.warning('%s: %s', run.name, text)


def without_hidden(runs: Sequence[Run], sphere: Sphere) -> list[Run]:
    """The runs without what hides the view of any: masks, and the robot itself."""
    masks = [run.seen for run in runs if run.seen is not None]
    for run in runs:
        chosen = evenly(len(run.panoramas), body.IMAGES)
        textures = views_of([run], chosen=chosen).textures
        yaw = run.odometry.trajectory.at(run.panoramas.stamps_ns[chosen])[:, 2]
        robot = body.robot_in_view(textures[:, channels(textures.shape[1])[0]], yaw)
        if robot.any():
            _warn(run, body.sentences(robot, sphere))
            masks.append(body.seen_mask(robot, run.panoramas.shape[:2]))
    if not masks:
        return list(runs)
    seen = np.logical_and.reduce(masks)
    if seen.mean() < FEWEST_SEEN:
        logger.warning('%.0f %% of the view is hidden: move the camera', 100 * (1 - seen.mean()))
    return [
        replace(run, panoramas=MaskedPanoramas.of(run.panoramas, seen), seen=seen) for run in runs
    ]


def mount_of(runs: Sequence[Run], camera_xy: Sequence[float], lens: LearnedLens | None) -> Mount:
    """Where the camera sits: as given by `camera_xy`, m, or by tf, and as its lens shows it."""
    lever_arm = next((run.camera for run in runs if run.camera is not None), None)  # by tf
    if camera_xy:
        lever_arm = complex(*camera_xy)
    return replace(Mount.at(lever_arm), tracked=(lens.place, PLACE_STD_M) if lens else None)


def drive_of(run: Run) -> Drive:
    """A run with its camera delay; warns of a delay that the filter cannot compensate."""
    turns = list(headings(run.panoramas))
    clock = camera_clock(run.odometry, run.panoramas.stamps_ns, turns)
    if abs(clock.delay_ns) > DELAY_LIMIT_NS:
        logger.warning(
            '%s: the stamps of images and odometry are %.2f s apart: the filter compensates half '
            'a second only; synchronize both clocks', run.name, abs(clock.delay_s),
        )  # fmt: skip
    return Drive(run, turns, clock.delay_ns if clock.is_estimated else None)
