# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes' executables: signals are handled before the slow imports begin."""

from __future__ import annotations

import importlib

from sfa_localization.nodes import signals


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
    signals.end_at_once()
    return int(importlib.import_module(f'sfa_localization.nodes.{name}').main())
