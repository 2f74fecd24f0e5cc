# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Some of the faults of test_faults.py through the three nodes; `make robustness` plays all."""

import math

import pytest

pytest.importorskip('rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from robustness.faults import FAULTS, NODES  # noqa: E402
from robustness.judged import judge  # noqa: E402
from robustness.live import played  # noqa: E402
from robustness.recorded import two_laps  # noqa: E402
from robustness.replay import replayed  # noqa: E402


def verdicts(name, *ways):
    drive, fault = two_laps(), FAULTS[name]
    messages = fault.messages(drive)
    return [judge(way(messages, drive.times_ns[0]), fault.ends_s) for way in ways]


@pytest.mark.parametrize('node', NODES)
def test_a_node_that_ends_and_comes_back_is_no_harm(node):
    """The others go on; only the filter's own end is one of the estimate, and driving two meters
    confirms where images put it then."""
    (verdict,) = verdicts(f'{node} restarted', played)
    assert verdict.false_s == 0.0
    assert verdict.recovered_s < (3.0 if node == 'ekf_node' else 1.0)
    assert verdict.max_m < 0.5


@pytest.mark.parametrize('name', ['images damaged', 'camera frozen, with noise'])
def test_the_nodes_do_with_a_fault_what_the_localizer_does(name):
    live, offline = verdicts(name, played, replayed)
    assert live.false_s == offline.false_s == 0.0
    assert live.mean_m == pytest.approx(offline.mean_m, abs=0.05)
    assert live.localised_s == pytest.approx(offline.localised_s, abs=2.0)
    assert math.isfinite(live.recovered_s)
