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

from sfa_localization.nodes.process import NODES, SIGNALS


def run(name: str, words: Sequence[str] | None = None) -> int:
    """Run a node with the words of the command line, or print its help; return the exit code."""
    words = list(sys.argv if words is None else words)
    if {'-h', '--help'} & set(words[1:]):
        sys.stdout.write(node_help(name))
        return 0
    for number in SIGNALS:  # until ROS handles them there is nothing to clean up
        signal.signal(number, lambda *_: os._exit(0))
    module = importlib.import_module(f'sfa_localization.nodes.{name}')
    lifecycle = importlib.import_module('sfa_localization.nodes.lifecycle')
    return int(lifecycle.run_node(getattr(module, name.title().replace('_', '')), words))


omnicam_node, sfa_node, ekf_node = (partial(run, name) for name in NODES)


def node_help(name: str) -> str:
    """Usage, and each parameter with its default."""
    from sfa_localization.config import render

    head = rf'^/\*\*/{name}:\n  ros__parameters:\n'
    (section,) = re.findall(rf'{head}((?: .*\n)*)', render(), re.MULTILINE)
    parameters = textwrap.indent(textwrap.dedent(section), '  ')
    return (
        f'{NODES[name]}\n\nusage: {name} [--ros-args [-p NAME:=VALUE] [-r TOPIC:=OTHER] '
        f'[--params-file FILE]]\n\nIt runs until SIGINT or SIGTERM, and writes no file unless a '
        f'parameter names one.\n\nparameters:\n{parameters}'
    )
