# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `rig`: a camera that sits ahead of the axle, and a robot on uneven ground.

Each garden has its drives. Bags, models and cells that are finished are used again when the command
is repeated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from page_tables import markdown

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import Array
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.evaluation import evaluate
from sfa_localization.metric.settings import MetricConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation.drive import SimulatedDrive, drive, record
from sfa_localization.simulation.garden import Garden
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train
from study.results import Cell, Progress, Results, StudyConfig, settings_of, usual_drift
from study.trials import scores_of

RESULTS = 'rig.json'
AREA, PANORAMA = (8.0, 8.0), (300, 30)
AHEAD = 0.3
"""Of the camera, m, from the axle: on many small robots."""
SLOPES = (0.0, 1.0, 2.0, 4.0)
"""Standard deviations of the slope of the ground, degrees."""

FORMS = {
    'ahead': '{:.2f}',
    'sfa': '{:.3f}',
    'sfa_nees': '{:.2f}',
    'ekf': '{:.3f}',
    'ekf_nees': '{:.2f}',
}
"""How the numbers of a cell are printed."""


@dataclass(frozen=True, slots=True)
class Case:
    """A model: the camera's place (m) ahead of the axle, and the one that the training is told, the
    slope (degrees) of the training drive, and the slopes of the test drives.
    """

    ahead: float = 0.0
    told: tuple[float, ...] = ()
    slope: float = 0.0
    tested: Sequence[float] = (0.0,)


ABOVE, UNEVEN = 'above the axle', 'trained at 2 degrees'
CASES = {
    ABOVE: Case(tested=SLOPES),
    '0.3 m ahead, measured': Case(AHEAD, (AHEAD, 0.0)),
    '0.3 m ahead, learned': Case(AHEAD),
    '0.3 m ahead, ignored': Case(AHEAD, (0.0, 0.0)),
    UNEVEN: Case(slope=2.0, tested=SLOPES),
}

QUICK_CASES = {'0.3 m ahead, learned': CASES['0.3 m ahead, learned']}


def camera_table(cells: Sequence[Cell]) -> str:
    """The places of the camera on flat ground: means over the gardens, as Markdown."""
    rows = []
    for name in CASES:
        same = [c for c in cells if c['case'] == name and c['slope'] == 0.0]
        if same and name != UNEVEN:
            rows.append([name, *(form.format(_mean(same, n)) for n, form in FORMS.items())])
    head = ['camera', 'place by the training (m):', 'one image (m):', 'squared error / variance:',
            'EKF (m):', 'squared error / variance:']  # fmt: skip
    return markdown(head, rows)


def ground_table(cells: Sequence[Cell]) -> str:
    """One image (m) / EKF (m) / inside, by the slopes of training and test, as Markdown."""
    rows = []
    for slope in SLOPES:
        same = [
            [c for c in cells if (c['case'], c['slope']) == (n, slope)] for n in (ABOVE, UNEVEN)
        ]
        texts = [_three(part) if part else '-' for part in same]
        rows.append([f'{slope:g} degrees' if slope else 'flat', *texts])
    return markdown(['one image / EKF (m) / inside', 'trained flat:', f'{UNEVEN}:'], rows)


def _three(cells: Sequence[Cell]) -> str:
    means = (_mean(cells, name) for name in ('sfa', 'ekf', 'ekf_within'))
    return '{:.3f} / {:.3f} / {:.0%}'.format(*means)


def _mean(cells: Sequence[Cell], name: str) -> float:
    return float(np.mean([cell[name] for cell in cells]))


class CameraAhead(SimulatedDrive):
    """A drive whose camera sits ahead of the axle; odometry and truth are of the axle."""

    @property
    def image_poses(self) -> Array:
        """Poses (M, 3) of the camera at the images, by the truth."""
        return Rig(camera_ahead=Quantity(AHEAD, 0.0)).camera(super().image_poses)


def judge_rigs(
    out: Path, config: StudyConfig, cases: Mapping[str, Case], progress: Progress
) -> list[Cell]:
    """Judge the cases in all gardens, with cells in the folder `out`. Returns the cells: `world`,
    `case`, `slope`, the learned place `ahead` (m), and what `scores_of` names.

    Raises LocalizationError, also for a folder with anything else.
    """
    settings = settings_of(config.world, config.seed, AREA, PANORAMA)
    results = Results.opened(out / RESULTS, settings)
    for number in range(config.seeds):
        world = config.world + number
        for name, case in cases.items():
            names = [{'world': world, 'case': name, 'slope': slope} for slope in case.tested]
            missing = [cell for cell in names if results.find(**cell) is None]
            if missing:
                garden = _Garden(out / f'garden_{world}', world, config.seed + number, progress)
                garden.judge(case, missing, results)
    return results.cells


@dataclass(frozen=True, slots=True)
class _Garden:
    """A garden with its bags and models in a folder."""

    folder: Path
    world: int
    seed: int
    progress: Progress

    def judge(self, case: Case, missing: Sequence[Cell], results: Results) -> None:
        """Train once, and add the missing cells."""
        training = self._bag('coverage', case.ahead, case.slope)
        model, transform = self._model(case, training), None
        for names in missing:
            self.progress.say(f'garden {self.world}, {names["case"]}, slope {names["slope"]:g}')
            bag = self._bag('test', case.ahead, names['slope'])
            align = () if transform else (training,)
            judged = evaluate(model, bag, align_bags=align, transform=transform)
            transform = judged.transform
            results.keep({**names, 'ahead': model.rig.lever.real, **scores_of(judged)})

    def _model(self, case: Case, training: Path) -> PlaceModel:
        told = ''.join(f'_{meters:g}' for meters in case.told)
        path = self.folder / f'{training.name}{told}.npz'
        if not path.exists():
            self.progress.say(f'garden {self.world}: train {path.name}')
            train([training], path, Recipe(metric=MetricConfig(camera_xy=case.told)), resume=True)
        return PlaceModel.load(path)

    def _bag(self, route: str, ahead: float, slope: float) -> Path:
        bag = self.folder / f'{route}_{ahead:g}_{slope:g}'
        if bag.exists():
            return bag
        self.progress.say(f'garden {self.world}: simulate {bag.name}')
        width, height = PANORAMA
        config = SimulationConfig(
            trajectory=route, world=self.world, seed=self.seed + (route == 'coverage'), area=AREA,
            test_drift=usual_drift(AREA), terrain=slope, images='panorama', compression='jpeg',
        )  # fmt: skip
        garden = Garden(config.world, config)
        driven = drive(garden, config)
        if ahead:
            driven = CameraAhead(
                driven.truth, driven.odometry, driven.yaw_rate, driven.image_stamps_ns
            )
        size = PanoramaConfig(width=width, height=height)
        record(driven, garden, config, bag, size, self.progress.shown)
        return bag
