# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Entry points of the nodes: executables, --help, exit codes, and signals before ROS starts.

Imports nothing slow, and no ROS: a launch and its terminal may send SIGINT at any time.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import textwrap
from collections.abc import Sequence
from functools import partial

from sfa_localization.nodes.process import COMPOSED, EXECUTABLES, NODES, SIGNALS


def run(name: str, words: Sequence[str] | None = None) -> int:
    """Run a node with the words of the command line, or print its help; return the exit code."""
    words = list(sys.argv if words is None else words)
    if {'-h', '--help'} & set(words[1:]):
        sys.stdout.write(node_help(name))
        return 0
    for number in SIGNALS:  # until ROS handles them there is nothing to clean up
        signal.signal(number, lambda *_: os._exit(0))
    lifecycle = importlib.import_module('sfa_localization.nodes.lifecycle')
    if name == COMPOSED:
        composition = importlib.import_module('sfa_localization.nodes.composition')
        return int(lifecycle.run_nodes(composition.chain, words))
    module = importlib.import_module(f'sfa_localization.nodes.{name}')
    kind = getattr(module, name.title().replace('_', ''))
    return int(lifecycle.run_nodes(lambda: [kind()], words))


omnicam_node, sfa_node, ekf_node, localization, teach_node = (
    partial(run, name) for name in EXECUTABLES
)


def node_help(name: str) -> str:
    """Usage, and each parameter with its default."""
    from sfa_localization.config import render

    parameters = ''
    for node in [*NODES] if name == COMPOSED else [name]:
        head = rf'^/\*\*/{node}:\n  ros__parameters:\n'
        (section,) = re.findall(rf'{head}((?: .*\n)*)', render(), re.MULTILINE)
        parameters += f'  {node}:\n' if name == COMPOSED else ''
        parameters += textwrap.indent(textwrap.dedent(section), '  ')
    return (
        f'{EXECUTABLES[name]}\n\nusage: {name} [--ros-args [-p NAME:=VALUE] [-r TOPIC:=OTHER] '
        f'[--params-file FILE]]\n\nIt runs until SIGINT or SIGTERM, and writes no file unless a '
        f'parameter names one.\n\nparameters:\n{parameters}'
    )
