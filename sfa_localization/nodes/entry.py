# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes' executables: signals are handled before the slow imports begin."""

from __future__ import annotations

import importlib
import sys
from functools import partial

from sfa_localization.nodes import signals
from sfa_localization.nodes.help import NODES, asks_for_help, node_help


def run(name: str) -> int:
    """Run a node; the exit code."""
    if asks_for_help(sys.argv[1:]):
        sys.stdout.write(node_help(name, NODES[name]))
        return 0
    signals.end_at_once()
    return int(importlib.import_module(f'sfa_localization.nodes.{name}').main())


omnicam_node, sfa_node, ekf_node = (partial(run, name) for name in NODES)
