# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The processes of the demo: outputs are recorded, and a failing node is reported.

Stand-in nodes fail in every way; the real ones run in test_readme_commands.py.
"""

import dataclasses
import os
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from sfa_localization.data.errors import NodeError

pytest.importorskip('rclpy')
from sfa_localization.commands import live_nodes

pytestmark = pytest.mark.ros
TIMEOUTS = live_nodes.Timeouts(start_s=20.0, silence_s=4.0, settle_s=0.3, stop_s=3.0)

STAND_IN = """
import math, sys, time
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Image
from std_msgs.msg import String

role, behaviour = sys.argv[1:3]
if behaviour == 'fail':
    sys.exit('stand-in: no model')
rclpy.init()
node = rclpy.create_node(role)
kinds = {'omnicam_node': (Image, 'panorama'), 'ekf_node': (Odometry, 'ekf/odometry'),
         'sfa_node': (PoseWithCovarianceStamped, 'sfa/pose_with_covariance')}
kind, topic = kinds[role]
publisher = node.create_publisher(kind, topic, 100)
pose = (PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
wanted = {'omnicam_node': [], 'sfa_node': [(Image, 'panorama')],
          'ekf_node': [(Odometry, '/odom'), pose]}
subscriptions = [node.create_subscription(k, t, lambda m: None, 10) for k, t in wanted[role]]
listeners = {'omnicam_node': 2, 'sfa_node': 2, 'ekf_node': 1}  # the next node, and the recorder
states = node.create_publisher(String, 'ekf/state', 10)
sent = 0

def publish():
    global sent
    if role == 'ekf_node':
        states.publish(String(data='LOCALISED'))
    if publisher.get_subscription_count() < listeners[role]:
        return
    sent += 1
    message = kind()
    message.header.stamp.sec = sent
    if kind is not Image:
        message.pose.pose.position.x = float(sent)
        message.pose.pose.orientation.z = math.sin(0.25)
        message.pose.pose.orientation.w = math.cos(0.25)
        message.pose.covariance[35] = math.pi ** 2 / 3 if role == 'sfa_node' else 0.1
    if behaviour == 'invalid':
        message.pose.pose.position.x = math.nan
    if behaviour == 'die' and sent == 3:
        sys.exit(7)
    publisher.publish(message)

if behaviour != 'silent':
    node.create_timer(0.05, publish)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
rclpy.try_shutdown()
"""


def programs(tmp_path: Path, player_s: float = 4.0, **behaviours: str) -> dict[str, list[str]]:
    script = tmp_path / 'stand_in.py'
    script.write_text(STAND_IN)
    chain = {
        name: [sys.executable, str(script), name, behaviours.get(name, 'work')]
        for name in live_nodes.NODES
    }
    return {**chain, 'play': [sys.executable, '-c', f'import time; time.sleep({player_s})']}


@pytest.fixture(autouse=True)
def nothing_is_left():
    """No process and no environment variable of the chain is left after a test."""
    before, variables = set(psutil.Process().children(recursive=True)), ros_variables()
    yield
    assert set(psutil.Process().children(recursive=True)) <= before
    assert ros_variables() == variables


def ros_variables() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith('ROS_')}


def test_chain_records_what_the_nodes_publish(tmp_path):
    chain = programs(tmp_path, player_s=1.0)
    # The recording ends when the nodes stop publishing after the replay.
    script = Path(chain['sfa_node'][1])
    script.write_text(STAND_IN.replace('sent += 1', 'sent += 1\n    if sent > 40: return'))
    patient = dataclasses.replace(TIMEOUTS, silence_s=20.0)
    ended: list[str] = []
    live = live_nodes.run_live(chain, tmp_path / 'logs', patient, ended.append)
    assert ended == ['LOCALISED']
    assert set(live) == {'sfa', 'ekf'}
    for trajectory in live.values():
        assert len(trajectory) > 5
        assert np.all(np.diff(trajectory.stamps_ns) > 0)
        seconds = trajectory.stamps_ns / 1e9
        np.testing.assert_allclose(trajectory.poses[:, :2], np.stack([seconds, 0 * seconds], 1))
    np.testing.assert_allclose(live['ekf'].poses[:, 2], 0.5)
    assert np.isnan(live['sfa'].poses[:, 2]).all(), 'a heading of unknown variance is unknown'


def test_a_node_that_cannot_start_is_named(tmp_path):
    chain = programs(tmp_path, sfa_node='fail')
    with pytest.raises(NodeError, match=r'(?s)^sfa_node ended \(exit code 1\).*no model'):
        live_nodes.run_live(chain, tmp_path / 'logs', TIMEOUTS)


def test_a_silent_node_is_named(tmp_path):
    chain = programs(tmp_path, sfa_node='silent')
    with pytest.raises(NodeError, match='sfa_node is silent: 0 messages on sfa'):
        live_nodes.run_live(chain, tmp_path / 'logs', TIMEOUTS)


def test_a_node_that_dies_during_the_replay_is_named(tmp_path):
    with pytest.raises(NodeError, match=r'ekf_node ended \(exit code 7\)'):
        live_nodes.run_live(programs(tmp_path, ekf_node='die'), tmp_path / 'logs', TIMEOUTS)


def test_a_node_that_publishes_invalid_messages_is_named(tmp_path):
    with pytest.raises(NodeError, match='sfa_node: invalid message on sfa/pose_with_covariance'):
        live_nodes.run_live(programs(tmp_path, sfa_node='invalid'), tmp_path / 'logs', TIMEOUTS)


def test_a_player_that_fails_is_named(tmp_path):
    chain = {**programs(tmp_path), 'play': [sys.executable, '-c', 'raise SystemExit("no bag")']}
    with pytest.raises(NodeError, match=r'(?s)play ended.*no bag'):
        live_nodes.run_live(chain, tmp_path / 'logs', TIMEOUTS)
