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

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
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


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_with_exit_code_0(bench, start, number):
    process = start('ekf_node')
    assert running(bench)
    process.send_signal(number)
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, told
    assert 'Traceback' not in told


def test_a_signal_while_unconfigured_too(bench, start):
    process = start('ekf_node', 'autostart:=false')
    assert until(lambda: 'ekf_node' in bench.node.get_node_names())
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0 and 'Traceback' not in told


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


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
@pytest.mark.parametrize('moment', MOMENTS)
def test_a_signal_at_any_moment_ends_with_exit_code_0(start, moment, name):
    process = start('ekf_node', before=SEND.format(name) + MOMENTS[moment])
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, told
    assert 'Traceback' not in told and 'internal error' not in told and 'refused' not in told


@pytest.mark.parametrize(('node', 'parameter', 'why'), [
    ('sfa_node', 'model:=/nowhere/model.npz', '/nowhere/model.npz'),
    ('sfa_node', 'novelty_limit:=-1.0', 'novelty_limit'),
    ('ekf_node', 'speed_std:=x', 'speed_std'),
    ('ekf_node', 'speed_std:=-3', 'speed_std'),
    ('ekf_node', 'speed_std:=.nan', 'speed_std'),
    ('ekf_node', 'degraded_std:=50.0', 'degraded_std'),
])  # fmt: skip
def test_a_wrong_parameter_ends_the_node_with_its_name(start, node, parameter, why):
    process = start(node, parameter)
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 1
    assert why in told and 'Traceback' not in told


FILES = {
    'indented.yaml': 'ekf_node:\n ros__parameters:\n   speed_std: 1.0\n  gate: 2.0\n',
    'keyless.yaml': 'ekf_node:\n  speed_std: 1.0\n',
}


@pytest.mark.parametrize(('arguments', 'why'), [
    (['--params-file', 'indented.yaml'], 'near line 4'),
    (['--params-file', 'keyless.yaml'], 'before ros__parameters at line 2'),
    (['--params-file', 'missing.yaml'], "missing.yaml'. Error: Error opening YAML file"),
    (['-r', 'odom'], "remap rule: '-r odom'"),
    (['-p', 'speed_std'], "override rule: '-p speed_std'"),
    (['--nonsense'], '--nonsense'),
    (['--', '--lost_std', '2'], 'unknown arguments --lost_std 2: give parameters as --ros-args -p'),
    (['-p', 'model:=\udcff'], r'not UTF-8: model:=\udcff'),
])  # fmt: skip
def test_what_ros_cannot_read_ends_the_node_with_its_reason(start, tmp_path, arguments, why):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    folder = f'{tmp_path}/'
    arguments = [folder + word if word.endswith('.yaml') else word for word in arguments]
    process = start('ekf_node', arguments=arguments)
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 1
    assert why in told and 'Traceback' not in told


def test_a_node_that_dies_later_has_another_exit_code_than_one_that_cannot_start(start):
    """Only then a launch starts it again."""
    died = 'from rclpy.executors import SingleThreadedExecutor as E\nE.spin = lambda self: 1 / 0'
    process = start('ekf_node', before=died)
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == DIED and 'ZeroDivisionError' in told


@pytest.mark.parametrize(('key', 'ignored'), [
    ('ekf_node', True), ('/robot2/ekf_node', True), ('/**/ekf_node', False), ('robot1', False),
    ('/**', False), ('sfa_node', False), ('/**/efk_node', True), ('/**/ekfnode', True),
    ('ekf_filter_node', False),
])  # fmt: skip
def test_a_section_for_another_namespace_or_a_misspelt_one_is_warned_of(
    start, tmp_path, key, ignored
):
    path = tmp_path / 'robot.yaml'
    section = {'ros__parameters': {'autostart': False}}
    document = {key: {'ekf_node': section} if key == 'robot1' else section}
    path.write_text(yaml.safe_dump(document))
    arguments = ['--params-file', str(path), '-r', '__ns:=/robot1']
    before = SEND.format('SIGINT') + MOMENTS['made']
    process = start('ekf_node', arguments=arguments, before=before)
    _, told = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, told
    warned = f'{path}: nothing of {key} is used: this node is /robot1/ekf_node'
    assert (warned in told) == ignored and ('/**/ekf_node:' in told) == ignored


def test_an_impossible_transition_does_not_end_the_node(bench, start):
    process = start('ekf_node')
    assert running(bench)
    client = bench.node.create_client(ChangeState, 'ekf_node/change_state')
    assert client.wait_for_service(DEADLINE_S)
    wrong = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    client.call_async(wrong)
    right = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    answer = client.call_async(right)
    assert until(answer.done) and answer.result().success
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0
