# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""For all tests: ROS stays on this machine, checks messages, logs elsewhere; one core is used."""

import os
import signal
import tempfile

import pytest
from robustness.readme import robustness_table

# Before rclpy is imported by any test; a user's own choice stands.
_LOGS = tempfile.TemporaryDirectory(prefix='sfa_localization_ros_log_')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
os.environ.setdefault('ROS_LOG_DIR', _LOGS.name)
# Small products on many cores of a busy machine wait for each other.
os.environ.setdefault('OMP_NUM_THREADS', '1')
# Background jobs ignore Ctrl-C or a hang-up, and so would every process that the tests start.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)


def pytest_collection_modifyitems(items):
    """Mark the tests that README.md names."""
    named = {test for tests in robustness_table().values() for test in tests}
    for item in items:
        if (item.path.name, getattr(item, 'originalname', item.name)) in named:
            item.add_marker(pytest.mark.robustness)
