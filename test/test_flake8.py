# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The linter that ROS 2 packages are checked with, where it is installed."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_flake8():
    linter = pytest.importorskip('ament_flake8.main')
    paths = [str(ROOT / name) for name in ('sfa_localization', 'test', 'setup.py')]
    code, errors = linter.main_with_errors(argv=['--config', str(ROOT / 'setup.cfg'), *paths])
    assert code == 0, '\n'.join(errors)
