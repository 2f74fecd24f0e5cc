# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The command line: one thin function per command, over the use cases of the other modules."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sfa_localization import __version__
from sfa_localization.config import PanoramaConfig, Settings, SimulationConfig
from sfa_localization.errors import LocalizationError

S = TypeVar('S', bound=Settings)


@dataclass(frozen=True)
class Command:
    """A command: its name, one line of help, its arguments, and what runs it."""

    name: str
    summary: str
    example: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def _add_settings(
    parser: argparse.ArgumentParser, group: type[Settings], names: Sequence[str] = ()
) -> None:
    """Add an option --some-name for each named setting of the group (none named: for all)."""
    for item in dataclasses.fields(group):
        if names and item.name not in names:
            continue
        unit = f' ({item.metadata["unit"]})' if item.metadata['unit'] else ''
        parser.add_argument(
            f'--{item.name.replace("_", "-")}',
            type=_by_x if isinstance(item.default, tuple) else type(item.default),
            choices=item.metadata['choices'] or None,
            default=argparse.SUPPRESS,
            help=f'{item.metadata["doc"]}{unit} [{_shown(item.default)}]',
        )


def _by_x(text: str) -> tuple[float, ...]:
    """Numbers joined by x, as in 16x18."""
    try:
        return tuple(float(part) for part in text.split('x'))
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r} is not like 16x18') from None


def _shown(default: object) -> str:
    return 'x'.join(f'{part:g}' for part in default) if isinstance(default, tuple) else str(default)


def _settings(group: type[S], arguments: argparse.Namespace) -> S:
    """The group with the settings that were given on the command line."""
    names = {item.name for item in dataclasses.fields(group)}
    given = {name: value for name, value in vars(arguments).items() if name in names}
    return group.from_mapping(given, 'command line')


def _configure_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('out', type=Path, metavar='OUT_BAG', help='folder of the bag to write')
    parser.add_argument('--size', type=_by_x, help='columns x rows of --images panorama [600x60]')
    parser.add_argument(
        '--compressed',
        action='store_const',
        dest='compression',
        const='jpeg',
        default=argparse.SUPPRESS,
        help='short for --compression jpeg',
    )
    _add_settings(parser, SimulationConfig)


def _simulate(arguments: argparse.Namespace) -> int:
    from sfa_localization.simulation import simulate

    config = _settings(SimulationConfig, arguments)
    panorama = PanoramaConfig()
    if arguments.size is not None:
        size = dict(zip(('width', 'height'), map(int, arguments.size), strict=False))
        panorama = PanoramaConfig.from_mapping(size, '--size')
    drive = simulate(config, arguments.out, panorama, progress=True)
    seconds = (drive.truth.stamps_ns[-1] - drive.truth.stamps_ns[0]) * 1e-9
    print(f'{arguments.out}: {len(drive.image_stamps_ns)} pictures in {seconds:.0f} s')
    return 0


SIMULATE = Command(
    'simulate',
    'Record a bag with a simulated robot in a simulated garden.',
    '  simulate bags/coverage --trajectory coverage --seed 1\n'
    '  simulate bags/test --trajectory test --seed 2 --compressed\n'
    '  simulate bags/tiny --area 8x8 --length 30 --images panorama --size 300x30',
    _configure_simulate,
    _simulate,
)


COMMANDS: list[Command] = [SIMULATE]


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
