# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ekf_node and sfa_node as processes: signals, bad parameters and arguments, exit codes."""

import signal
import subprocess
from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy')

from ros_bench import DEADLINE_S, start_process, until
from std_msgs.msg import String

from sfa_localization.nodes.entry import CANNOT_START, DIED
from sfa_localization.nodes.lifecycle import latched_qos

pytestmark = pytest.mark.ros
START = Path(__file__).parents[1] / 'resource/start'
RUN = 'import sys; from sfa_localization.nodes import entry; sys.exit(entry.{}())'


@pytest.fixture
def start():
    """Start a node's process; all are ended with the test."""
    processes = []

    def begin(node, *arguments, before=None):
        """Its start script; or the same in Python, after other code."""
        script = [START / node] if before is None else ['-c', f'{before}\n{RUN.format(node)}']
        words = ['--ros-args', *arguments] if arguments else []
        process = start_process(*script, *words, stderr=subprocess.PIPE, text=True)
        processes.append(process)
        return process

    yield begin
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


def ended(process):
    """Wait until a process ends, perhaps beside others: its exit code, and what it printed."""
    _, text = process.communicate(timeout=3 * DEADLINE_S)
    return process.returncode, text


def test_a_signal_ends_the_node_with_exit_code_0(bench, start):
    """Active by SIGINT, unconfigured by SIGTERM."""
    heard, active = [], start('ekf_node')
    unconfigured = start('ekf_node', '-p', 'autostart:=false', '-r', '__node:=other')
    bench.node.create_subscription(String, 'ekf/state', heard.append, latched_qos())
    assert until(lambda: heard and 'other' in bench.node.get_node_names())
    for process, number in ((active, signal.SIGINT), (unconfigured, signal.SIGTERM)):
        process.send_signal(number)
        code, text = ended(process)
        assert code == 0 and 'Traceback' not in text, text


# Code that runs before the node's: at some moment the process sends itself a signal.
SEND = """
import os, signal, sys
def send(wait_for=None):
    os.kill(os.getpid(), signal.{})
    while wait_for is not None and wait_for.context.ok():
        pass
"""
IN_NODE = """
from sfa_localization.nodes.ekf_node import EkfNode
works = EkfNode.{0}
EkfNode.{0} = lambda self: (send(self), works(self))[1]
"""
MOMENTS = {
    'importing': """
class Finder:
    @staticmethod
    def find_spec(name, *_):
        if name == 'rclpy':
            send()
sys.meta_path.insert(0, Finder)
""",
    'starting': IN_NODE.format('setup'),
    'made': IN_NODE.format('start'),
    'publishing': IN_NODE.format('health'),
    'ending': """
from sfa_localization.nodes.ekf_node import EkfNode
started, destroy = EkfNode.started, EkfNode.destroy_node
EkfNode.started = lambda self: (started(self), send())
EkfNode.destroy_node = lambda self: (send(), destroy(self), send())
""",
    'leaving': """
from sfa_localization.nodes.ekf_node import EkfNode
EkfNode.started = lambda self: send()
leave = sys.exit
sys.exit = lambda code: (send(), leave(code))
""",
}


def test_a_signal_at_any_moment_ends_with_exit_code_0(start):
    started = {m: start('ekf_node', before=SEND.format('SIGTERM') + MOMENTS[m]) for m in MOMENTS}
    for moment, process in started.items():
        code, text = ended(process)
        assert code == 0, (moment, text)
        assert not [w for w in ('Traceback', 'internal error', 'refused') if w in text], moment


def test_a_start_script_ends_at_ctrl_c_before_its_slow_imports(start):
    """As soon as it handles signals; before, it is Python that starts."""
    process = start('sfa_node')
    status = Path(f'/proc/{process.pid}/status')
    handled = 1 << (signal.SIGTERM - 1)

    def caught():
        (line,) = (line for line in status.read_text().splitlines() if line.startswith('SigCgt'))
        return int(line.split()[1], 16) & handled

    assert until(caught)
    process.send_signal(signal.SIGINT)
    assert ended(process) == (0, '')


WRONG = [
    ('sfa_node', ['-p', 'model:=/nowhere/model.npz'], '/nowhere/model.npz'),
    ('ekf_node', ['-p', 'speed_std:=.nan'], 'speed_std'),
    ('ekf_node', ['--params-file', 'keyless.yaml'], 'before ros__parameters at line 2'),
    ('ekf_node', ['--lost_std', '2'], "ROS cannot use its arguments: ['--lost_std', '2']"),
]


def test_a_wrong_parameter_ends_the_node_with_its_name(start, tmp_path):
    """And a file or argument that ROS cannot read with the reason."""
    (tmp_path / 'keyless.yaml').write_text('ekf_node:\n  speed_std: 1.0\n')
    started = []
    for node, words, why in WRONG:
        words = [f'{tmp_path}/{word}' if word.endswith('.yaml') else word for word in words]
        started.append((start(node, *words), why))
    for process, why in started:
        code, text = ended(process)
        assert code == CANNOT_START and why in text and 'Traceback' not in text, (why, text)


def test_a_node_that_dies_later_has_another_exit_code_than_one_that_cannot_start(start):
    """Only then a launch starts it again."""
    died = 'from rclpy.executors import SingleThreadedExecutor as E\nE.spin = lambda self: 1 / 0'
    code, text = ended(start('ekf_node', before=died))
    assert code == DIED and 'ZeroDivisionError' in text


def test_a_misspelt_section_is_warned_of(start, tmp_path):
    """Which sections are: test_config_file.py."""
    path = tmp_path / 'parameters.yaml'
    path.write_text(yaml.safe_dump({'/**/efk_node': {'ros__parameters': {'autostart': False}}}))
    words = ['--params-file', str(path), '-r', '__ns:=/robot1']
    code, text = ended(start('ekf_node', *words, before=SEND.format('SIGINT') + MOMENTS['made']))
    warned = f'{path}: nothing of /**/efk_node is used: this node is /robot1/ekf_node; write'
    assert code == 0 and warned in text, text
