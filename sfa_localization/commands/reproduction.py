# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the results of `reproduce` share: a folder of finished cells, drives and messages.

A result is a list of cells. Cells, bags and models that are finished are kept, and used again when
the command is repeated.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sfa_localization import __version__
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import LocalizationError
from sfa_localization.evaluation import write_json
from sfa_localization.simulation.drive import simulate
from sfa_localization.simulation.settings import SimulationConfig

BATCH = 64
"""Images that are read together."""
Cell = dict[str, Any]


@dataclass(slots=True)
class Results:
    """The finished cells of a result in a JSON file, beside the settings that they depend on."""

    file: Path
    settings: Mapping[str, Any]
    cells: list[Cell] = field(default_factory=list)

    @classmethod
    def opened(cls, file: Path, settings: Mapping[str, Any], beside: Sequence[str] = ()) -> Results:
        """Those in a folder, which is created. Raises LocalizationError for a folder of anything
        else than this result, or those `beside` it (their files) with the same settings, and
        leaves it as it is.
        """
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            kin = [file.with_name(name) for name in beside if file.with_name(name).exists()]
            if not file.exists() and (kin or not any(file.parent.iterdir())):
                found = _read(kin[0]) if kin else {'settings': settings}
                write_json(file, {'settings': found['settings'], 'cells': []})
            found = _read(file)
            same, cells = found['settings'] == settings, list(found['cells'])
        except OSError as error:
            reason = error.strerror or error
            raise LocalizationError(f'{file}: {reason}: choose another folder with --out') from None
        except (ValueError, LookupError, TypeError):
            raise LocalizationError(f'{file}: not of this command: name another --out') from None
        if not same:
            other = 'holds results of other settings: name another --out'
            raise LocalizationError(f'{file.parent}: {other}')
        return cls(file, settings, cells)

    def keep(self, cell: Cell) -> None:
        """Add a finished cell."""
        self.cells.append(cell)
        write_json(self.file, {'settings': self.settings, 'cells': self.cells})

    def find(self, **names: Any) -> Cell | None:
        """The cell with these names, if it is finished."""
        return next((c for c in self.cells if names.items() <= c.items()), None)


def _read(file: Path) -> dict[str, Any]:
    return dict(json.loads(file.read_text(encoding='utf-8')))


def settings_of(
    world: int, seed: int, area: Sequence[float], panorama: Sequence[int]
) -> dict[str, Any]:
    """What decides the results of a garden, as JSON has it."""
    return {
        'version': __version__,
        'world': world,
        'seed': seed,
        'area': list(area),
        'panorama': list(panorama),
    }


@dataclass(slots=True)
class Progress:
    """Messages and bars of long work, where they are wanted."""

    shown: bool
    start: float = field(default_factory=time.monotonic)

    def say(self, step: str) -> None:
        """Name the next step, with the seconds since the start."""
        if self.shown:
            print(f'[{time.monotonic() - self.start:4.0f} s] {step}', file=sys.stderr)

    @property
    def bars(self) -> bool:
        return self.shown and sys.stderr.isatty()


def recorded(
    bag: Path, config: SimulationConfig, panorama: tuple[int, int], progress: Progress
) -> Path:
    """The bag of a simulated drive with panoramas of (width, height), made where it is missing."""
    if not bag.exists():
        progress.say(f'simulate {bag.name}')
        width, height = panorama
        simulate(config, bag, PanoramaConfig(width=width, height=height), progress=progress.bars)
    return bag
