# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Programs are started, watched and stopped, whatever they or their starter do.

Stand-ins of the nodes fail in every way; the real ones run in test_readme_commands.py.
"""

import os
import signal
import subprocess
import sys
from unittest import mock

import numpy as np
import psutil
import pytest

from sfa_localization.data.errors import NodeError

pytest.importorskip('rclpy')
from ros_bench import DEADLINE_S, until

from sfa_localization.commands import live_nodes
from sfa_localization.commands.live_nodes import Processes

pytestmark = pytest.mark.ros
WAIT = 'import time; print("ready", flush=True); time.sleep(60)'
STUBBORN = 'import signal; [signal.signal(s, signal.SIG_IGN) for s in (2, 15)]; ' + WAIT


def python(code):
    return [sys.executable, '-c', code]


def ready(processes, name):
    return until(lambda: 'ready' in processes.log(name).read_text())


def children():
    return psutil.Process().children(recursive=True)


@pytest.fixture(autouse=True)
def no_process_remains(monkeypatch):
    """No process remains after a test; timeouts are short, and the environment is restored."""
    for name, seconds in {'SETTLE_S': 0.3, 'STOP_S': 5.0}.items():
        monkeypatch.setattr(live_nodes, name, seconds)
    with mock.patch.dict(os.environ):
        yield
    assert children() == []


def test_all_have_ended_afterwards_also_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), Processes(tmp_path / 'logs', 0.5) as processes:
        for name, code in {'obedient': WAIT, 'stubborn': STUBBORN}.items():
            processes.start(name, python(code))
            assert ready(processes, name)
        processes.require_alive(['obedient', 'stubborn'])
        assert len(children()) == 2
        raise ZeroDivisionError


def test_a_dead_program_is_named_with_its_last_words(tmp_path):
    code = 'import sys; [print("line", i) for i in range(9)]; sys.exit("no model")'
    with Processes(tmp_path, 5.0) as processes:
        processes.start('sfa_node', python(code))
        with pytest.raises(NodeError) as caught:
            until(lambda: processes.require_alive(['sfa_node']))
        processes.start('player', python('print("done")'))
        assert until(lambda: processes.ended('player'))
        processes.start('killed', python(WAIT))
        assert ready(processes, 'killed')
        children()[-1].kill()
        with pytest.raises(NodeError, match='SIGKILL'):
            until(lambda: processes.ended('killed'))
    text = str(caught.value)
    assert 'sfa_node ended (exit code 1)' in text
    assert 'line 8' in text and 'no model' in text and 'line 3' not in text


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_no_process_remains_when_the_command_is_told_to_end(tmp_path, number):
    code = f"""
import time
from pathlib import Path
from sfa_localization import cli
from sfa_localization.commands import config
from sfa_localization.commands.live_nodes import Processes

def run(arguments):
    with Processes(Path({str(tmp_path)!r}), 5.0) as processes:
        processes.start('node', {python(WAIT)!r})
        while 'ready' not in processes.log('node').read_text():
            time.sleep(0.01)
        print('started', flush=True)
        time.sleep(60)

config.run = run
raise SystemExit(cli.main(['config']))
"""
    starter = subprocess.Popen(
        python(code), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert starter.stdout.readline() == 'started\n'
        (node,) = psutil.Process(starter.pid).children()
        starter.send_signal(number)
        _, errors = starter.communicate(timeout=DEADLINE_S)
    finally:
        starter.kill()
    assert (starter.returncode, errors) == (130, 'interrupted\n')
    assert not node.is_running()


STAND_IN = """
import math, sys, time
role, behavior = sys.argv[1:3]
if behavior == 'fail':
    sys.exit('stand-in: no model, no bag')
if role == 'play':
    time.sleep(2.0)
    sys.exit(0)
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped as Pose
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Image
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node(role)
SEEN = (Pose, 'sfa/pose_with_covariance')
(kind, topic), wanted, listeners = {  # which are the next node, and the recorder
    'omnicam_node': ((Image, 'panorama'), [], 1),
    'sfa_node': (SEEN, [(Image, 'panorama')], 2),
    'ekf_node': ((Odometry, 'ekf/odometry'), [(Odometry, '/odom'), SEEN], 1),
}[role]
publisher = node.create_publisher(kind, topic, 100)
subscriptions = [node.create_subscription(*each, lambda m: None, 10) for each in wanted]
states = node.create_publisher(String, 'ekf/state', 10)
sent = 0

def publish():
    global sent
    if role == 'ekf_node':
        states.publish(String(data='LOCALISED'))
    if publisher.get_subscription_count() < listeners or sent >= 60:
        return
    sent += 1
    message = kind()
    message.header.stamp.sec = sent
    if kind is not Image:
        message.pose.pose.position.x = float(sent)
        message.pose.pose.orientation.z = math.sin(0.25)
        message.pose.pose.orientation.w = math.cos(0.25)
        message.pose.covariance[35] = math.pi ** 2 / 3 if role == 'sfa_node' else 0.1
    if behavior == 'die' and sent == 3:
        sys.exit(7)
    publisher.publish(message)

if behavior != 'silent':
    node.create_timer(0.05, publish)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
rclpy.try_shutdown()
"""


def programs(tmp_path, **behaviors):
    script = tmp_path / 'stand_in.py'
    script.write_text(STAND_IN)
    roles = (*live_nodes.NODES, 'play')
    return {name: [sys.executable, str(script), name, behaviors.get(name, '')] for name in roles}


def test_chain_records_what_the_nodes_publish(tmp_path):
    """Until they publish no more after the replay."""
    live = live_nodes.run_live(programs(tmp_path), tmp_path / 'logs')
    assert live.state == 'LOCALISED'
    for trajectory in (live.sfa, live.ekf):
        assert len(trajectory) > 5 and np.all(np.diff(trajectory.stamps_ns) > 0)
        seconds = trajectory.stamps_ns / 1e9
        np.testing.assert_allclose(trajectory.poses[:, :2], np.stack([seconds, 0 * seconds], 1))
    np.testing.assert_allclose(live.ekf.poses[:, 2], 0.5)
    assert np.isnan(live.sfa.poses[:, 2]).all(), 'a heading of unknown variance is unknown'


@pytest.mark.parametrize(('node', 'behavior', 'named'), [
    ('sfa_node', 'fail', r'(?s)^sfa_node ended \(exit code 1\).*no model'),
    ('sfa_node', 'silent', 'sfa_node is silent: nothing on sfa'),
    ('ekf_node', 'die', r'ekf_node ended \(exit code 7\)'),
    ('play', 'fail', r'(?s)play ended.*no bag'),
])  # fmt: skip
def test_a_program_that_fails_is_named(tmp_path, node, behavior, named):
    with pytest.raises(NodeError, match=named):
        live_nodes.run_live(programs(tmp_path, **{node: behavior}), tmp_path / 'logs')
