# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write the parameter file."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfa_localization.commands import options
from sfa_localization.config import render, write_config

WRITES = 'the parameter file, or standard output'
EXAMPLES = '  config\n  config --output localization.yaml'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the output file."""
    parser.add_argument('--output', type=Path, help='file to write; default: standard output')


def run(arguments: argparse.Namespace) -> int:
    """Write or print every parameter with its default."""
    if arguments.output:
        options.require_new(arguments.output)
        write_config(arguments.output)
    else:
        print(render(), end='')
    return 0
