# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's results: complete them one after the other, and write their tables."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sfa_localization.reports.figures import save_text
from sfa_localization.training import Recipe
from study.comparisons import FEATURES, VARIANTS, ablations, baselines
from study.paper import experiment
from study.paper_report import Cells, ablations_table, baselines_table, paper_table
from study.results import Progress, Results, StudyConfig, settings_of
from study.sites import ROUTES, Site, SitePlan

NAMES = ('simulator', 'robot', 'baselines', 'ablations')


def table(name: str, cells: Cells) -> str:
    """The table of a result."""
    if name in ROUTES:
        return paper_table(name, cells)
    if name == 'baselines':
        return baselines_table([cell for cell in cells if cell['features'] in FEATURES])
    return ablations_table([c for variant in VARIANTS for c in cells if c['variant'] == variant])


@dataclass(frozen=True, slots=True)
class Work:
    """The folder of the paper's results, and what they are made with; baselines perhaps on `bags`
    and the drive `test`.
    """

    out: Path
    config: StudyConfig
    plan: SitePlan
    progress: Progress
    bags: tuple[Path, ...] = ()
    test: Path | None = None

    def announce(self, names: Sequence[str]) -> None:
        """Announce the duration of these results."""
        minutes = 0
        for name in names:
            seeds = self.config.seeds if name in ROUTES else 1
            minutes += seeds * self.plan.minutes[name]
        kept = 'what is finished is kept, and not made again'
        self.progress.say(f'this takes about {minutes} minutes on two cores; {kept}')

    def reproduced(self, name: str) -> str:
        """Complete a result; write and return its table. Raises LocalizationError."""
        config, plan = self.config, self.plan
        settings = settings_of(config.world, config.seed, plan.area, plan.panorama)
        files = [f'{name}.json' for name in NAMES]
        results = Results.opened(self.out / f'{name}.json', settings, files)
        if name in ROUTES:
            self._experiments(name, results)
        elif name == 'baselines':
            self._baselines(results)
        else:
            ablations(self._site('simulator', 0), results, f'garden {config.world}')
        text = table(name, results.cells)
        save_text(self.out / f'{name}.md', text)
        self.progress.say(f'see {self.out / f"{name}.md"}')
        return text

    def _site(self, experiment_name: str, number: int) -> Site:
        world, seed = self.config.world + number, self.config.seed + number
        return Site.simulated(self.out, experiment_name, world, seed, self.plan, self.progress)

    def _experiments(self, name: str, results: Results) -> None:
        """Figures are those of the first seed."""
        for number in range(self.config.seeds):
            seed = self.config.seed + number
            if results.find(seed=seed) is None:
                figures = None if number else self.out
                experiment(self._site(name, number), results, name, seed, figures)

    def _baselines(self, results: Results) -> None:
        if self.test is not None:
            paths = [str(path) for path in (*self.bags, self.test)]
            folder = self.out / f'bags_{zlib.crc32(" ".join(paths).encode()):08x}'
            folder.mkdir(exist_ok=True)
            site = Site(folder, self.bags, self.test, Recipe(), self.progress)
            baselines(site, results, f'bags of {self.test.resolve().parent.name}')
            return
        baselines(self._site('simulator', 0), results, f'garden {self.config.world}')
