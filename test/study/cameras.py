# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The study `cameras`: robots with several cameras around them, and what happens to one of these.

Each rig has its drives and its model. Bags, models and cells that are finished are used again when
the command is repeated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from page_tables import markdown
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.evaluation import evaluate
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train
from study.results import (
    Cell,
    Progress,
    Results,
    StudyConfig,
    recorded,
    settings_of,
    usual_drift,
)
from study.trials import scores_of

RESULTS = 'cameras.json'
AREA, PANORAMA = (8.0, 8.0), (600, 60)
"""Sides, m, and columns and rows of panoramas."""
FOUR = {'cameras': 4}
RIGS: dict[str, dict[str, Any]] = {
    'ideal panorama': {'images': 'panorama'},
    'four cameras': FOUR,
    'at 0.4 m': {**FOUR, 'camera_radius': 0.4},
    'exposures of 0.7 to 1.3': {**FOUR, 'camera_exposures': (0.7, 1.0, 1.3, 0.9)},
    'yaws wrong by up to 2 degrees': {**FOUR, 'camera_yaws': (2.0, -1.5, 1.0, -2.0)},
    "stamps up to 40 ms before and after the first camera's": {
        **FOUR,
        'camera_skew': (0.0, 40.0, -40.0, 20.0),
    },
    'two fisheyes of 190 degrees on two topics, at 0.1 m': {
        'cameras': 2,
        'camera_fov': 190.0,
        'camera_radius': 0.1,
    },
}
"""The rigs by their settings."""
QUICK_RIGS = {'two fisheyes': {'cameras': 2, 'camera_fov': 190.0, 'camera_size': (160.0, 160.0)}}
KNOCKED = 'four cameras, one turned by 10 degrees after training, which is named'
GONE = {
    'four cameras, the rear one gone for 10 of 32 s': (8.0, 18.0),
    'gone for good': (0.0, math.inf),
}
"""Between which seconds of the test the rear camera sends nothing."""


def judge_cameras(
    out: Path, config: StudyConfig, rigs: Mapping[str, dict[str, Any]], progress: Progress
) -> list[Cell]:
    """Judge the rigs in all gardens, with cells in the folder `out`. Returns the cells: `world`,
    `case`, and what `scores_of` names. Raises LocalizationError, also for a folder with anything
    else.
    """
    settings = settings_of(config.world, config.seed, AREA, PANORAMA)
    results = Results.opened(out / RESULTS, settings)
    for number in range(config.seeds):
        world = config.world + number
        base = SimulationConfig(
            world=world,
            seed=config.seed + number,
            area=AREA,
            compression='jpeg',
            odometry_rate=25.0,
            test_drift=usual_drift(AREA),
        )
        for place, (name, rig) in enumerate(rigs.items()):
            folder = out / f'garden_{world}' / f'rig_{place}'
            tests = [name, *GONE, KNOCKED] if rig == FOUR else [name]
            names = [{'world': world, 'case': test} for test in tests]
            missing = [cell for cell in names if results.find(**cell) is None]
            if missing:
                _judge(folder, replace(base, **rig), missing, results, progress)
    return results.cells


def _judge(
    folder: Path,
    config: SimulationConfig,
    missing: Sequence[Cell],
    results: Results,
    progress: Progress,
) -> None:
    """Train once, and add the missing cells."""
    training = recorded(folder / 'drive', config, PANORAMA, progress)
    progress.say(f'train {folder}')
    width, height = PANORAMA
    recipe = Recipe(panorama=PanoramaConfig(width=width, height=height))
    path = folder / 'model.npz'
    model = train([training], path, recipe, progress=progress.shown, resume=True).model
    test = replace(config, trajectory='test', seed=config.seed + 1)
    bag = recorded(folder / 'test', test, PANORAMA, progress)
    transform = None
    for names in missing:
        case = names['case']
        tested = bag
        if case == KNOCKED:
            knocked = replace(test, camera_yaws=(0.0, 10.0, 0.0, 0.0))
            tested = recorded(folder / 'knocked', knocked, PANORAMA, progress)
        if case in GONE:
            tested = without_rear(bag, folder / f'gone_{GONE[case][0]:g}', GONE[case])
        align = () if transform else (training,)
        judged = evaluate(model, tested, align_bags=align, transform=transform)
        transform = judged.transform
        results.keep({**names, **scores_of(judged)})


def without_rear(bag: Path, out: Path, gone_s: tuple[float, float]) -> Path:
    """The bag without the images of the rear camera between these seconds."""
    if out.exists():
        return out
    types = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as read, Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as written:
        connections = {
            c.topic: written.add_connection(c.topic, c.msgtype, typestore=types)
            for c in read.connections
        }
        for connection, stamp_ns, data in read.messages():
            after_s = (stamp_ns - read.start_time) * 1e-9
            if not connection.topic.startswith('/rear/image') or not (
                gone_s[0] <= after_s <= gone_s[1]
            ):
                written.write(connections[connection.topic], stamp_ns, data)
    return out


def table(cells: Sequence[Cell]) -> str:
    """The rigs: means over the gardens, as Markdown."""
    rows = []
    for case in dict.fromkeys(cell['case'] for cell in cells):
        same = [cell for cell in cells if cell['case'] == case]
        errors = [f'{np.mean([cell[name] for cell in same]):.3f}' for name in ('sfa', 'ekf')]
        rows.append([case, *errors])
    return markdown(['rig', 'one image (m):', 'EKF (m):'], rows)
