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
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.simulation.drive import SimulatedDrive, drive, record
from sfa_localization.simulation.garden import Garden
from sfa_localization.training import Recipe
from study.results import Cell, Progress, Results, StudyConfig
from study.sites import SMALL_PANORAMA, SmallGarden
from study.trials import scores_of

RESULTS = 'rig.json'
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


def table(cells: Sequence[Cell]) -> str:
    """The places of the camera on flat ground: means over the gardens, as Markdown."""
    rows = []
    for name in CASES:
        same = [c for c in cells if c['case'] == name and c['slope'] == 0.0]
        if same and name != UNEVEN:
            texts = (form.format(_mean(same, n)) for n, form in FORMS.items())
            rows.append([name, *(text.replace('-0.00', '0.00') for text in texts)])
    head = [
        'camera',
        'place by the training (m):',
        'one image (m):',
        'ratio:',
        'EKF (m):',
        'ratio:',
    ]
    return markdown(head, rows)


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
    results = SmallGarden.results(out / RESULTS, config)
    for number in range(config.seeds):
        world, seed = config.world + number, config.seed + number
        garden = SmallGarden(out / f'garden_{world}', world, seed, progress)
        for name, case in cases.items():
            names = [{'world': world, 'case': name, 'slope': slope} for slope in case.tested]
            missing = [cell for cell in names if results.find(**cell) is None]
            if missing:
                _judge(garden, case, missing, results)
    return results.cells


def _judge(garden: SmallGarden, case: Case, missing: Sequence[Cell], results: Results) -> None:
    """Train once, and add the missing cells."""
    training = _bag(garden, 'coverage', case.ahead, case.slope)
    told = ''.join(f'_{meters:g}' for meters in case.told)
    recipe = Recipe(metric=MetricConfig(camera_xy=case.told))
    model, transform = garden.model(f'{training.name}{told}', training, recipe), None
    for names in missing:
        garden.progress.say(f'garden {garden.world}, {names["case"]}, slope {names["slope"]:g}')
        bag = _bag(garden, 'test', case.ahead, names['slope'])
        align = () if transform else (training,)
        judged = evaluate(model, bag, align_bags=align, transform=transform)
        transform = judged.transform
        results.keep({**names, 'ahead': model.rig.lever.real, **scores_of(judged)})


def _bag(garden: SmallGarden, route: str, ahead: float, slope: float) -> Path:
    """The bag of a drive, simulated if it is missing."""
    name, number = f'{route}_{ahead:g}_{slope:g}', int(route == 'coverage')
    if not ahead or (garden.folder / name).exists():
        return garden.drive(name, number, trajectory=route, terrain=slope)
    garden.progress.say(f'simulate {name}')
    config = garden.config(number, trajectory=route, terrain=slope)
    world = Garden(config.world, config)
    driven = drive(world, config)
    driven = CameraAhead(driven.truth, driven.odometry, driven.yaw_rate, driven.image_stamps_ns)
    width, height = SMALL_PANORAMA
    record(driven, world, config, garden.folder / name, PanoramaConfig(width=width, height=height))
    return garden.folder / name
