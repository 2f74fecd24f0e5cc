# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the studies share: their settings, a folder of finished cells, drives and messages.

A result is a list of cells. Cells, bags and models that are finished are kept, and used again when
the command is repeated.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sfa_localization import __version__
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.files import write_json
from sfa_localization.data.settings import Settings, setting
from sfa_localization.simulation.drive import simulate
from sfa_localization.simulation.settings import SimulationConfig

BATCH = 64
"""Images in a batch."""
Cell = dict[str, Any]


@dataclass(frozen=True, slots=True)
class StudyConfig(Settings):
    """Which gardens and drives a study uses."""

    world: int = setting(1, 'garden, the first of --seeds', low=0, high=2**63 - 1)
    seed: int = setting(1, 'drives and sensor errors; of each drive another', low=0, high=2**62)
    seeds: int = setting(
        1, 'gardens of simulator, robot and rig, each with drives of its own',
        low=1, high=1000,
    )  # fmt: skip


@dataclass(slots=True)
class Results:
    """The finished cells of a result in a JSON file, beside the settings that they depend on."""

    file: Path
    settings: Mapping[str, Any]
    cells: list[Cell] = field(default_factory=list)

    @classmethod
    def opened(cls, file: Path, settings: Mapping[str, Any], beside: Sequence[str] = ()) -> Results:
        """The results in the folder of `file`, which is created.

        Raises LocalizationError if the folder holds anything else than this result and the files
        `beside` it with the same settings; then the folder is not changed.
        """
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            content = _content(file, beside, settings)
            same, cells = content['settings'] == settings, list(content['cells'])
        except OSError as error:
            reason = error.strerror or error
            raise LocalizationError(f'{file}: {reason}: choose another folder with --out') from None
        except (ValueError, LookupError, TypeError):
            raise LocalizationError(f'{file}: not of this command: name another --out') from None
        if not same:
            raise LocalizationError(
                f'{file.parent}: holds results of other settings: name another --out'
            )
        results = cls(file, settings, cells)
        results._write()
        return results

    def keep(self, cell: Cell) -> None:
        """Add a finished cell."""
        self.cells.append(cell)
        self._write()

    def _write(self) -> None:
        write_json(self.file, {'settings': self.settings, 'cells': self.cells})

    def find(self, **names: Any) -> Cell | None:
        """The cell with these names, if it is finished."""
        return next((c for c in self.cells if names.items() <= c.items()), None)


def _content(file: Path, beside: Sequence[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """The content of the file; without it, the settings of a file beside it, or the new ones."""
    kin = [file.with_name(name) for name in beside if file.with_name(name).exists()]
    if not file.exists() and not kin and not any(file.parent.iterdir()):
        return {'settings': settings, 'cells': []}
    source = kin[0] if kin and not file.exists() else file
    content = dict(json.loads(source.read_text(encoding='utf-8')))
    return content if source == file else {**content, 'cells': []}


def usual_drift(area: Sequence[float]) -> float:
    """Mean odometry error, m, of a test drive; it grows with the size of the garden."""
    usual = SimulationConfig()
    return usual.test_drift * math.sqrt(math.prod(area) / math.prod(usual.area))


def settings_of(
    world: int, seed: int, area: Sequence[float], panorama: Sequence[int]
) -> dict[str, Any]:
    """The settings that decide the results of a garden, as JSON."""
    return {
        'version': __version__,
        'world': world,
        'seed': seed,
        'area': list(area),
        'panorama': list(panorama),
    }


@dataclass(slots=True)
class Progress:
    """Messages and bars of long work, if `shown`."""

    shown: bool
    start: float = field(default_factory=time.monotonic)

    def say(self, step: str) -> None:
        """Print the next step, with the seconds since the start."""
        if self.shown:
            sys.stderr.write(f'[{time.monotonic() - self.start:4.0f} s] {step}\n')


def recorded(
    bag: Path, config: SimulationConfig, panorama: tuple[int, int], progress: Progress
) -> Path:
    """The bag of a simulated drive with panoramas of (width, height), simulated if missing."""
    if not bag.exists():
        progress.say(f'simulate {bag.name}')
        width, height = panorama
        simulate(config, bag, PanoramaConfig(width=width, height=height), progress=progress.shown)
    return bag
