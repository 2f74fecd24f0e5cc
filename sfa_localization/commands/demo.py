# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run the whole chain on a simulated garden, and print its errors."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from sfa_localization.commands.options import add_settings, settings
from sfa_localization.data.settings import Settings, setting

WRITES = 'in its folder two bags, model.npz, report/ with figures, results.json, logs/'
EXAMPLES = '  demo\n  demo --world 2 --out demo_of_world_2'


@dataclass(frozen=True, slots=True)
class DemoConfig(Settings):
    """The demonstration: which garden and drives, and the speed of the replay."""

    world: int = setting(1, 'garden', low=0, high=2**63 - 1)
    seed: int = setting(1, 'drives and sensor errors', low=0, high=2**63 - 1)
    rate: float = setting(1.0, 'speed of the replay', unit='x real time', low=0.1, high=20.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the folder and the settings of the demonstration."""
    parser.add_argument(
        '--out', type=Path, default=Path('demo'), metavar='DIR', help='folder to write [demo]'
    )
    add_settings(parser, DemoConfig)


def run(arguments: argparse.Namespace) -> int:
    """Run the demonstration; print the errors."""
    from sfa_localization.commands.demonstration import demonstrate
    from sfa_localization.reports.evaluation import heading_table, table

    result = demonstrate(arguments.out, settings(DemoConfig, arguments), progress=True)
    print(table(result.scores), heading_table(result.scores), sep='\n\n')
    return 0
