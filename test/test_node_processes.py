# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ekf_node and sfa_node as processes: signals, bad parameters, wrong requests."""

import os
import signal
import subprocess
import sys

import pytest
import yaml
from ros_domains import free_domain

pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from ros_bench import DEADLINE_S, Bench, until  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from sfa_localization.nodes.lifecycle import latched_qos  # noqa: E402
from sfa_localization.nodes.signals import DIED  # noqa: E402

DOMAIN = free_domain()


@pytest.fixture
def bench():
    made = Bench(DOMAIN)
    yield made
    made.close()


@pytest.fixture
def start(tmp_path):
    """Start a node's process; all are ended with the test."""
    processes = []

    def begin(node, *parameters, arguments=(), before=''):
        arguments = [*arguments, *(part for text in parameters for part in ('-p', text))]
        code = f'{before}\nimport sys; from sfa_localization.nodes import entry\n'
        code += f'sys.exit(entry.{node}())'
        environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(DOMAIN),
            'ROS_LOG_DIR': str(tmp_path),
            'OMP_NUM_THREADS': '1',
        }
        command = [sys.executable, '-c', code]
        if arguments:
            command += ['--ros-args', *arguments]
        processes.append(
            subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        )
        return processes[-1]

    yield begin
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


def running(bench):
    heard = []
    bench.node.create_subscription(String, 'ekf/state', heard.append, latched_qos())
    return until(lambda: heard)


def ended(process):
    """Wait until a process ends: its exit code, and what it printed."""
    _, text = process.communicate(timeout=DEADLINE_S)
    return process.returncode, text


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_with_exit_code_0(bench, start, number):
    """Active and unconfigured."""
    active, unconfigured = start('ekf_node'), start('ekf_node', 'autostart:=false',
                                                    arguments=['-r', '__node:=other'])  # fmt: skip
    assert running(bench)
    assert until(lambda: 'other' in bench.node.get_node_names())
    for process in (active, unconfigured):
        process.send_signal(number)
        code, text = ended(process)
        assert code == 0 and 'Traceback' not in text, text


# Code that runs before the node's: at some moment the process sends itself a signal.
SEND = 'import os, signal, sys\ndef send(): os.kill(os.getpid(), signal.{})\n'
MOMENTS = {
    'importing': """
class Finder:
    @staticmethod
    def find_spec(name, *_):
        if name == 'rclpy':
            send()
sys.meta_path.insert(0, Finder)
""",
    'initialising': """
import rclpy
init = rclpy.init
def late(**options):
    send()
    init(**options)
rclpy.init = late
""",
    'starting': """
from sfa_localization.nodes.ekf_node import EkfNode
setup = EkfNode.setup
def signalled(self):
    send()
    while self.context.ok():
        pass
    setup(self)
EkfNode.setup = signalled
""",
    'made': """
from sfa_localization.nodes.ekf_node import EkfNode
def signalled(self):
    send()
    while self.context.ok():
        pass
    return False
EkfNode.start = signalled
""",
    'publishing': """
from sfa_localization.nodes.ekf_node import EkfNode
health = EkfNode.health
def signalled(self):
    send()
    while self.context.ok():
        pass
    return health(self)
EkfNode.health = signalled
""",
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
    started = {m: start('ekf_node', before=SEND.format('SIGINT') + MOMENTS[m]) for m in MOMENTS}
    for m in ('initialising', 'starting'):
        started[f'{m}, SIGTERM'] = start('ekf_node', before=SEND.format('SIGTERM') + MOMENTS[m])
    for moment, process in started.items():
        code, text = ended(process)
        assert code == 0, (moment, text)
        assert not [w for w in ('Traceback', 'internal error', 'refused') if w in text], moment


WRONG = [
    ('sfa_node', ['model:=/nowhere/model.npz'], '/nowhere/model.npz'),
    ('sfa_node', ['novelty_limit:=-1.0'], 'novelty_limit'),
    ('ekf_node', ['speed_std:=.nan'], 'speed_std'),
    ('ekf_node', ['degraded_std:=50.0'], 'degraded_std'),
]


def test_a_wrong_parameter_ends_the_node_with_its_name(start):
    started = [(start(node, *parameters), why) for node, parameters, why in WRONG]
    for process, why in started:
        code, text = ended(process)
        assert code == 1 and why in text and 'Traceback' not in text, (why, text)


FILES = {
    'indented.yaml': 'ekf_node:\n ros__parameters:\n   speed_std: 1.0\n  gate: 2.0\n',
    'keyless.yaml': 'ekf_node:\n  speed_std: 1.0\n',
}
UNREADABLE = [
    (['--params-file', 'indented.yaml'], 'near line 4'),
    (['--params-file', 'keyless.yaml'], 'before ros__parameters at line 2'),
    (['--params-file', 'missing.yaml'], "missing.yaml'. Error: Error opening YAML file"),
    (['-r', 'odom'], "remap rule: '-r odom'"),
    (['--', '--lost_std', '2'], 'unknown arguments --lost_std 2: give parameters as --ros-args -p'),
    (['-p', 'model:=\udcff'], r'not UTF-8: model:=\udcff'),
]


def test_what_ros_cannot_read_ends_the_node_with_its_reason(start, tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    started = []
    for words, why in UNREADABLE:
        words = [f'{tmp_path}/{word}' if word.endswith('.yaml') else word for word in words]
        started.append((start('ekf_node', arguments=words), why))
    for process, why in started:
        code, text = ended(process)
        assert code == 1 and why in text and 'Traceback' not in text, (why, text)


def test_a_node_that_dies_later_has_another_exit_code_than_one_that_cannot_start(start):
    """Only then a launch starts it again."""
    died = 'from rclpy.executors import SingleThreadedExecutor as E\nE.spin = lambda self: 1 / 0'
    code, text = ended(start('ekf_node', before=died))
    assert code == DIED and 'ZeroDivisionError' in text


SECTIONS = {
    '/robot2/ekf_node': True, '/**/ekf_node': False, 'robot1': False, '/**/efk_node': True,
    'ekf_filter_node': False,
}  # fmt: skip
"""Whether the node `/robot1/ekf_node` warns of this section of its file."""


def test_a_section_for_another_namespace_or_a_misspelt_one_is_warned_of(start, tmp_path):
    started = []
    for k, (key, ignored) in enumerate(SECTIONS.items()):
        path, section = tmp_path / f'{k}.yaml', {'ros__parameters': {'autostart': False}}
        path.write_text(
            yaml.safe_dump({key: {'ekf_node': section} if key == 'robot1' else section})
        )
        words = ['--params-file', str(path), '-r', '__ns:=/robot1']
        before = SEND.format('SIGINT') + MOMENTS['made']
        started.append((path, key, ignored, start('ekf_node', arguments=words, before=before)))
    for path, key, ignored, process in started:
        code, text = ended(process)
        assert code == 0, text
        warned = f'{path}: nothing of {key} is used: this node is /robot1/ekf_node'
        assert (warned in text) == ignored and ('/**/ekf_node:' in text) == ignored
