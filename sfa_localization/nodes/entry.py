# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes' executables: signals are handled before the slow imports begin."""

from __future__ import annotations

import importlib
import sys

from sfa_localization.nodes import signals
from sfa_localization.nodes.help import NODES, asks_for_help, node_help


def omnicam_node() -> int:
    """Run the omnicam node; the exit code."""
    return _run('omnicam_node')


def sfa_node() -> int:
    """Run the sfa node; the exit code."""
    return _run('sfa_node')


def ekf_node() -> int:
    """Run the ekf node; the exit code."""
    return _run('ekf_node')


def _run(name: str) -> int:
    if asks_for_help(sys.argv[1:]):
        sys.stdout.write(node_help(name, NODES[name]))
        return 0
    signals.end_at_once()
    return int(importlib.import_module(f'sfa_localization.nodes.{name}').main())
