# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The docstring linter that ROS 2 packages are checked with, where it is installed."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Settled differently here: where the first line starts, its mood and capitals, raw docstrings.
OURS = ['D213', 'D301', 'D401', 'D402', 'D403']


def test_pep257():
    linter = pytest.importorskip('ament_pep257.main')
    paths = [str(ROOT / name) for name in ('sfa_localization', 'test', 'setup.py')]
    assert linter.main(argv=[*paths, '--add-ignore', *OURS]) == 0
