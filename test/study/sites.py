# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Gardens of the paper's sizes, whose drives and models its results share; and a small one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sfa_localization.bags.drives import as_live, image_folder
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.run import Run
from sfa_localization.data.threads import one_core
from sfa_localization.place_model import PlaceModel
from sfa_localization.sfa.network import Network, standard_architecture
from sfa_localization.sfa.network_training import ImageSequence, train_network
from sfa_localization.simulation.drive import drive
from sfa_localization.simulation.garden import Garden
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, learn_place, train
from study.results import (
    Progress,
    Results,
    StudyConfig,
    recorded,
    settings_of,
    usual_drift,
)
from study.trials import Study


@dataclass(frozen=True, slots=True)
class SitePlan:
    """Size of the garden (m) and of the panoramas, images of the training drives, and minutes of
    each result and seed, as measured on two cores.
    """

    area: tuple[float, float]
    panorama: tuple[int, int]
    images: dict[str, int]
    minutes: dict[str, int]


FULL = SitePlan(
    (16.0, 18.0),
    (600, 60),
    {'coverage': 1773, 'lines': 862, 'mower': 1346},
    {'simulator': 4, 'robot': 3, 'baselines': 4, 'ablations': 30},
)
"""The sizes of section 4."""
QUICK = SitePlan(
    (8.0, 8.0),
    (300, 30),
    {'coverage': 400, 'lines': 300, 'mower': 600},
    {'simulator': 1, 'robot': 1, 'baselines': 2, 'ablations': 8},
)
ROUTES = {'simulator': ('coverage', 'lines'), 'robot': ('mower',)}
"""Training drives of the experiments: the network is trained on the first, and the map is aligned
with the truth on the last."""
SMALL_AREA, SMALL_PANORAMA = (8.0, 8.0), (300, 30)
"""Sides, m, and columns and rows of panoramas, of the studies of light, rig and year."""
# The count of images settles in three or four.
_TRIES = 30


@dataclass(frozen=True, slots=True)
class Site:
    """A garden or a real place: its training bags, its test bag, and its models."""

    folder: Path
    training: tuple[Path, ...]
    test: Path
    recipe: Recipe
    progress: Progress

    @classmethod
    def simulated(
        cls, out: Path, experiment: str, world: int, seed: int, plan: SitePlan, progress: Progress
    ) -> Site:
        """The garden `world` with drives of `seed`, below the folder `out`."""
        folder = out / f'garden_{world}_{seed}'
        base = SimulationConfig(
            world=world, seed=seed, area=plan.area, images='panorama', compression='jpeg'
        )
        bags = []
        for route in (*ROUTES[experiment], 'test'):
            config = replace(base, trajectory=route)
            if not (folder / route).exists():
                config = spaced(config, plan.images.get(route))
            bags.append(recorded(folder / route, config, plan.panorama, progress))
        width, height = plan.panorama
        recipe = as_live(Recipe(), PanoramaConfig(width=width, height=height))
        return cls(folder, tuple(bags[:-1]), bags[-1], recipe, progress)

    def study(self) -> Study:
        """The drives, read."""
        cache = image_folder(self.folder / 'images')
        return Study.read(self.training, self.test, cache, self.recipe)

    def model(self, study: Study) -> PlaceModel:
        """The model of all training drives, with the network of the first one."""
        path = self.folder / f'{"_".join(bag.name for bag in self.training)}.npz'
        if not path.exists():
            self.progress.say(f'train on {study.training[0].name}')
            network = network_of(study.training[:1], self.recipe)
            learned(network, study.training, self.recipe).save(path)
        return PlaceModel.load(path)


@dataclass(frozen=True, slots=True)
class SmallGarden:
    """A small garden, with bags and models in a folder."""

    folder: Path
    world: int
    seed: int
    progress: Progress

    @staticmethod
    def results(file: Path, config: StudyConfig) -> Results:
        """The finished cells in a file. Raises LocalizationError for those of other settings."""
        settings = settings_of(config.world, config.seed, SMALL_AREA, SMALL_PANORAMA)
        return Results.opened(file, settings)

    def config(self, number: int, **settings: Any) -> SimulationConfig:
        """The settings of drive `number`, with those of its route and light."""
        return SimulationConfig(
            world=self.world, seed=self.seed + number, area=SMALL_AREA,
            test_drift=usual_drift(SMALL_AREA), images='panorama', compression='jpeg', **settings,
        )  # fmt: skip

    def drive(self, name: str, number: int, **settings: Any) -> Path:
        """The bag of a drive, simulated if it is missing."""
        config = self.config(number, **settings)
        return recorded(self.folder / name, config, SMALL_PANORAMA, self.progress)

    def model(self, name: str, bag: Path, recipe: Recipe | None = None) -> PlaceModel:
        """The model of a drive, trained if it is missing."""
        path = self.folder / f'{name}.npz'
        if not path.exists():
            self.progress.say(f'train {path.name}')
            train([bag], path, recipe, progress=self.progress.shown, resume=True)
        return PlaceModel.load(path)


def network_of(runs: Sequence[Run], recipe: Recipe) -> Network:
    """The network of a recipe, trained on runs."""
    size = runs[0].panoramas.shape[:2]
    architecture = recipe.architecture or standard_architecture(size, recipe.network.normalization)
    return train_network(architecture, [ImageSequence.of(run) for run in runs], recipe.network.seed)


def learned(network: Network, runs: Sequence[Run], recipe: Recipe) -> PlaceModel:
    """The model that a recipe learns from a trained network and training drives."""
    with one_core():
        return learn_place(network, runs, recipe).model


def spaced(config: SimulationConfig, images: int | None) -> SimulationConfig:
    """The settings of a drive, with the distance of images that gives so many of them."""
    if images is None:
        return config
    garden = Garden(config.world, config)
    for _ in range(_TRIES):
        count = len(drive(garden, config).image_stamps_ns)
        if count == images:
            break
        config = replace(config, images_every=config.images_every * count / images)
    return config
