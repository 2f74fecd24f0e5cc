# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Programs are started, watched and stopped, whatever they or their starter do.

Stand-ins of the nodes fail in every way; the real ones run in test_readme_commands.py.
"""

import itertools
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
from geometry_msgs.msg import PoseWithCovarianceStamped as Pose
from nav_msgs.msg import Odometry
from ros_bench import DEADLINE_S, FRAMES, SEEN, Bench, until
from sensor_msgs.msg import Image
from std_msgs.msg import String

from sfa_localization.commands import live_nodes
from sfa_localization.commands.live_nodes import Processes
from sfa_localization.nodes.conversions import to_odometry, to_pose_with_covariance

pytestmark = pytest.mark.ros
WAIT = 'import time; print("ready", flush=True); time.sleep(60)'
STUBBORN = 'import signal; [signal.signal(s, signal.SIG_IGN) for s in (2, 15)]; ' + WAIT


def python(code):
    return [sys.executable, '-c', code]


def ready(processes, name):
    return until(lambda: 'ready' in processes.log(name).read_text())


def children():
    """The processes of the tests, without that which multiprocessing keeps until the end."""
    every = psutil.Process().children(recursive=True)
    return [child for child in every if 'resource_tracker' not in ' '.join(child.cmdline())]


@pytest.fixture(autouse=True)
def no_process_remains(monkeypatch):
    """No process remains after a test; timeouts are short, and the environment is restored."""
    monkeypatch.setattr(live_nodes, 'SETTLE_S', 0.3)
    monkeypatch.setattr(live_nodes, 'STOP_S', 2.0)
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


FIRST_NS = 10**9


@pytest.fixture
def robot():
    """What the nodes subscribe to and publish, in the domain of `run_live`; a function that starts
    to publish the poses and the state of these nodes.
    """
    bench = Bench(1 + os.getpid() % live_nodes.LARGEST_DOMAIN)
    node, sent = bench.node, itertools.count(1)
    for kind, topic in ((Odometry, 'odom'), (Image, 'panorama'), (Pose, SEEN)):
        node.create_subscription(kind, topic, lambda _: None, 10)
    topics = ((Pose, SEEN), (Odometry, 'ekf/odometry'), (String, 'ekf/state'))
    sfa, ekf, states = (node.create_publisher(*topic, 100) for topic in topics)

    def send(names):
        number = next(sent)
        pose, unknown = ([number, 0.0, 0.5], number * FIRST_NS), np.diag([0.1, 0.1, np.pi**2 / 3])
        if 'sfa_node' in names:
            sfa.publish(to_pose_with_covariance(pose[0], unknown, pose[1], 'map'))
        if 'ekf_node' in names:
            ekf.publish(to_odometry(pose[0], np.eye(3), [0, 0], np.eye(2), pose[1], FRAMES))
            states.publish(String(data='LOCALISED'))

    yield lambda *names: node.create_timer(0.05, lambda: send(names))
    bench.close()


def run(tmp_path, **other):
    """Run stand-ins of the programs, which wait, or play for a second, or do something else."""
    codes = {**dict.fromkeys(live_nodes.NODES, WAIT), 'play': 'import time; time.sleep(1)', **other}
    programs = {name: python(code) for name, code in codes.items()}
    return live_nodes.run_live(programs, tmp_path / 'logs')


def test_what_the_nodes_publish_is_recorded(tmp_path, robot):
    robot('sfa_node', 'ekf_node')
    live = run(tmp_path)
    assert live.state == 'LOCALISED'
    for trajectory in (live.sfa, live.ekf):
        assert len(trajectory) > 5 and np.all(np.diff(trajectory.stamps_ns) > 0)
        np.testing.assert_allclose(trajectory.poses[:, 0], trajectory.stamps_ns / FIRST_NS)
    np.testing.assert_allclose(live.ekf.poses[:, 2], 0.5)
    assert np.isnan(live.sfa.poses[:, 2]).all(), 'a heading of unknown variance is unknown'


LAST = 'import sys; [print("line", i) for i in range(9)]; sys.exit("no model")'


@pytest.mark.parametrize(('node', 'code', 'named'), [
    ('sfa_node', LAST, r'(?s)^sfa_node ended \(exit code 1\).*line 8.*no model'),
    ('sfa_node', WAIT, 'sfa_node is silent: nothing on sfa'),
    ('ekf_node', 'import os, time; time.sleep(1); os.kill(os.getpid(), 9)', 'ekf_node .*SIGKILL'),
    ('play', 'raise SystemExit("no bag")', r'(?s)play ended.*no bag'),
])  # fmt: skip
def test_a_program_that_fails_is_named_with_its_last_words(tmp_path, robot, node, code, named):
    robot('ekf_node')
    with pytest.raises(NodeError, match=named) as caught:
        run(tmp_path, **{node: code})
    assert 'line 3' not in str(caught.value)
