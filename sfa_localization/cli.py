# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The command line: one thin function per command, over the use cases of the other modules."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sfa_localization import __version__
from sfa_localization.errors import LocalizationError


@dataclass(frozen=True)
class Command:
    """A command: its name, one line of help, its arguments, and what runs it."""

    name: str
    summary: str
    example: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


COMMANDS: list[Command] = []


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command named by the first argument; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='sfa_localization',
        description='Localization from one omnidirectional camera, learnt without ground truth.',
    )
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for command in COMMANDS:
        _prepare(commands.add_parser(command.name, help=command.summary, **_texts(command)), command)
    arguments = parser.parse_args(argv)
    return _guarded(arguments.run_command, arguments)


def executable() -> int:
    """Run the command that this executable is named after (console_scripts in setup.py)."""
    name = Path(sys.argv[0]).stem
    return _run_alone(next(command for command in COMMANDS if command.name == name))


def _run_alone(command: Command) -> int:
    """Run one command as an executable of its own."""
    parser = argparse.ArgumentParser(prog=command.name, **_texts(command))
    _prepare(parser, command)
    arguments = parser.parse_args()
    return _guarded(arguments.run_command, arguments)


def _texts(command: Command) -> dict[str, object]:
    return {
        'description': f'{command.summary}\n\nexamples:\n{command.example}',
        'formatter_class': argparse.RawDescriptionHelpFormatter,
    }


def _prepare(parser: argparse.ArgumentParser, command: Command) -> None:
    command.configure(parser)
    parser.set_defaults(run_command=command.run)


def _guarded(run: Callable[[argparse.Namespace], int], arguments: argparse.Namespace) -> int:
    """Turn expected errors into one line and exit code 1, Ctrl-C into 130."""
    try:
        return run(arguments)
    except LocalizationError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
