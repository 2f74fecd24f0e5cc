# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The command line ``sfa_localization COMMAND``: one module of commands/ for each command."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from sfa_localization import __version__
from sfa_localization.data.errors import LocalizationError, NodeError
from sfa_localization.nodes import entry
from sfa_localization.nodes.process import EXECUTABLES

COMMANDS = {
    'simulate': 'Record a bag with a simulated robot in a simulated garden.',
    'train': 'Learn a place model from bags of images and odometry; ground truth is never read.',
    'evaluate': 'Compare a model, alone and fused with odometry, with the ground truth of a drive.',
    'play': 'Replay a bag through ROS, with the types, QoS and pace of the recording.',
    'fleet': 'Train, update and evaluate the models of many gardens, each in its own process.',
    'inspect': 'Report the contents and defects of bags, and whether they are enough to train on.',
    'map': 'Write where the robot drove in training as a map for Nav2.',
    'calibrate': 'Detect the mirror in images, or read a calibration file; write parameters.',
    'filter': 'Fuse a log of odometry and positions, without ROS, as the live filter would.',
    'tune': "Find the filter's noise parameters from bags; write them into a parameter file.",
    'config': 'Write the parameter file of nodes and trainer: every parameter, explained.',
    'demo': 'Simulate, train, run the three nodes live, and print their errors (about 5 minutes).',
}
LONGEST_ERROR = 4000
"""Longest error message, in characters; the middle of a longer one is left out."""
OPTIONAL = {
    'trimesh': 'trimesh embreex',
    'embreex': 'trimesh embreex',
    'mdp': 'MDP==3.6',
    'mcap': 'mcap',
    'distributed': 'dask distributed',
    'threadpoolctl': 'threadpoolctl, or: sudo apt install python3-threadpoolctl',
    'rclpy': '"ros-jazzy-rclpy[fastrtps]" ros-jazzy-common-interfaces, or source ROS 2',
}
"""Packages that only some commands need, and what pip installs for them."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run what this executable, or the first argument, is named after; return the exit code."""
    _prepare_streams()
    if argv is None:
        called = Path(sys.argv[0]).stem
        argv = [called] * (called in {*COMMANDS, *EXECUTABLES}) + sys.argv[1:]
    words = list(argv)
    name = words[0] if words else ''
    for number in (signal.SIGTERM, signal.SIGHUP) if name not in EXECUTABLES else ():
        if signal.getsignal(number) != signal.SIG_IGN:  # as after nohup
            signal.signal(number, signal.default_int_handler)  # like Ctrl-C, to clean up
    return guarded(lambda: _run(name, words))


def _run(name: str, words: Sequence[str]) -> int:
    """Run a node, which parses its ROS arguments itself, or a command; return the exit code."""
    if name in EXECUTABLES:
        return entry.run(name, words)
    if name not in COMMANDS:
        _overview().parse_args(words)  # prints help, version or error, and exits
        return 2
    arguments = command_parser(name).parse_intermixed_args(words[1:])
    return int(arguments.run(arguments))


def _prepare_streams() -> None:
    """Open closed streams; escape names of files that are not UTF-8, as \\udcff."""
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), 'w'))
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')


def _flush() -> None:
    """Flush standard output. Raises BrokenPipeError or LocalizationError."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        raise LocalizationError(f'standard output: cannot be written: {error.strerror}') from None


def command_parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of one command; only its module is imported."""
    command = importlib.import_module(f'sfa_localization.commands.{name}')
    texts = COMMANDS[name], f'writes: {command.WRITES}', f'examples:\n{command.EXAMPLES}'
    parser = argparse.ArgumentParser(
        prog=f'sfa_localization {name}',
        description='\n\n'.join(texts),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_arguments(parser)
    parser.set_defaults(run=command.run)
    return parser


def _overview() -> argparse.ArgumentParser:
    """Return the parser of --help, --version and wrong commands."""
    parser = argparse.ArgumentParser(
        prog='sfa_localization',
        description='Localization from one omnidirectional camera, learned without ground truth.',
    )
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, summary in {**COMMANDS, **EXECUTABLES}.items():
        commands.add_parser(name, help=summary)
    return parser


def guarded(run: Callable[[], int]) -> int:
    """Return the exit code of `run`; print an expected error and return 1, after Ctrl-C 130."""
    try:
        try:
            return run()
        finally:  # also after argparse has printed help
            _flush()
    except BrokenPipeError:  # the reader, such as head, has closed the pipe
        return 0
    except LocalizationError as error:
        reason = str(error)
        if not isinstance(error, NodeError):  # which quotes lines; names of files are escaped
            reason = ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in reason)
    except ModuleNotFoundError as error:
        package = (error.name or '').partition('.')[0]
        if package not in OPTIONAL:
            raise
        reason = f'{package} is not installed; this needs it: pip install {OPTIONAL[package]}'
    except (OSError, MemoryError) as error:
        # A full disk, for example, or too many open files.
        reason = ' '.join(str(error).split()) or 'not enough memory'
    except (KeyboardInterrupt, ImportError) as error:
        # KeyboardInterrupt is the cause if the import of a C++ library was interrupted.
        if isinstance(cause := error.__cause__ or error, KeyboardInterrupt):
            print('interrupted', *cause.args, sep=': ', file=sys.stderr)
            return 130
        if 'failed to map segment' not in str(error):  # of a library, for lack of memory
            raise
        reason = 'not enough memory'
    if len(reason) > LONGEST_ERROR:
        reason = f'{reason[: LONGEST_ERROR // 2]} ... {reason[-LONGEST_ERROR // 2 :]}'
    print(f'error: {reason}', file=sys.stderr)
    return 1
