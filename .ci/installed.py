# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Check an installed workspace: files and executables are in the ament index, and nodes start."""

import shutil
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from ament_index_python import get_package_prefix, get_package_share_directory

import sfa_localization
from sfa_localization.cli import COMMANDS
from sfa_localization.nodes.process import EXECUTABLES as PROCESSES

NAME = 'sfa_localization'
SHARED = ('package.xml', 'config/localization.launch.py', 'config/localization.yaml')
EXECUTABLES = (NAME, *COMMANDS, *PROCESSES)


def missing() -> list[str]:
    """Return the shared files and executables that ROS 2 does not find."""
    prefix, share = Path(get_package_prefix(NAME)), Path(get_package_share_directory(NAME))
    expected = [share / name for name in SHARED]
    expected += [prefix / 'lib' / NAME / name for name in EXECUTABLES]
    return [str(path) for path in expected if not path.is_file()]


def starts(node: Path) -> bool:
    """Whether a node warns of a parameter that it does not have, and ends at SIGINT with code 0."""
    words = [node, '--ros-args', '-p', 'autostart:=false', '-p', 'nonsense:=1']
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        is_made = any("'nonsense'" in line for line in process.stderr)
        process.send_signal(signal.SIGINT)
        process.communicate()
    return is_made and process.returncode == 0


def main() -> int:
    """Print the problems, return the exit code."""
    prefix = Path(get_package_prefix(NAME))
    problems = [f'missing: {path}' for path in missing()]
    if prefix not in Path(sfa_localization.__file__).parents:
        problems.append(f'imported from elsewhere: {sfa_localization.__file__}')
    problems += [f'on the PATH: {path}' for path in map(shutil.which, COMMANDS) if path]
    folder = prefix / 'lib' / NAME
    for words in ([folder / 'train', '--help'], [folder / NAME, 'train', '--help']):
        if not problems and subprocess.run(words, stdout=subprocess.PIPE).returncode:
            problems.append(f'fails: {" ".join(map(str, words))}')
    if not problems:
        problems += [f'does not start: {node}' for node in PROCESSES if not starts(folder / node)]
    built = f'{prefix}, built with setuptools {version("setuptools")}'
    print('\n'.join(problems) or f'{built}: all files are there, and the nodes start')
    return bool(problems)


if __name__ == '__main__':
    sys.exit(main())
