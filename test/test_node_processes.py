# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""ekf_node and sfa_node as processes: signals, bad parameters and arguments, exit codes."""

import re
import signal
import subprocess

import pytest
import yaml

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters
from ros_bench import DEADLINE_S, start_process
from rosgraph_msgs.msg import Clock

from sfa_localization.nodes.process import CANNOT_START, DIED

pytestmark = pytest.mark.ros
IMPORT = 'import sys; from sfa_localization.nodes import entry'


@pytest.fixture
def start():
    """Start a node's process; all are ended with the test."""
    processes = []

    def begin(node, *arguments, before=''):
        """What its executable runs, after other code."""
        code = f'{before}\n{IMPORT}; sys.exit(entry.{node}())'
        words = '-c', code, '--ros-args', *arguments
        process = start_process(*words, stderr=subprocess.PIPE, text=True)
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


def test_what_rclpy_cannot_handle_itself_ends_nothing(bench, start):
    """An unknown type, a negative clock, a transition that does not fit, which Kilted answers."""
    answers, process = [], start('ekf_node', '-p', 'use_sim_time:=true')
    for kind, service, request in (
        (ChangeState, 'change_state', ChangeState.Request(transition=Transition(id=1))),
        (SetParameters, 'set_parameters', SetParameters.Request(parameters=[
            ParameterMessage(name='rate_std', value=ParameterValue(type=77))])),
    ):  # fmt: skip
        client = bench.node.create_client(kind, f'ekf_node/{service}')
        assert client.wait_for_service(DEADLINE_S)
        answers.append(client.call_async(request))
    told = bench.listen(DiagnosticArray, '/diagnostics')

    def reasons():
        return [v.key for m in told[-1:] for v in m.status[0].values if 'rclpy: refused' in v.key]

    def handled():
        return len(reasons()) + sum(answer.done() for answer in answers) == 3

    assert bench.publish_until('/clock', Clock(clock=Time(sec=-1)), handled)
    assert not any(answer.result().success for answer in answers if answer.done())
    state = bench.call(GetState, 'ekf_node/get_state', GetState.Request()).current_state
    assert state.label == 'active'
    process.send_signal(signal.SIGINT)
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


WRONG = [
    ('sfa_node', ['-p', 'model:=/nowhere/model.npz'], '/nowhere/model.npz'),
    ('ekf_node', ['-p', 'speed_std:=.nan'], 'speed_std'),
    ('ekf_node', ['-p', 'use_sim_time:=3'], "'use_sim_time'"),
    ('ekf_node', ['-p', 'qos_overrides./odom.subscription.reliability:=x'], 'QoS override'),
    ('ekf_node', ['--params-file', 'keyless.yaml'], 'before ros__parameters at line 2'),
    ('ekf_node', ['--lost_std', '2'], "ROS cannot use its arguments: ['--lost_std', '2']"),
]
IN_TURN = """
for words in {!r}:
    sys.stderr.write(f'\\n== {{entry.run(words[0], words)}}\\n')
"""


def test_a_wrong_parameter_ends_the_node_with_its_name(start, tmp_path, monkeypatch):
    """And a file or argument that ROS cannot read with the reason."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'keyless.yaml').write_text('ekf_node:\n  speed_std: 1.0\n')
    before = IMPORT + IN_TURN.format([[node, '--ros-args', *words] for node, words, _ in WRONG])
    _, text = ended(start('ekf_node', '--help', before=before))
    outputs = re.split(r'\n== (\d)\n', text)
    assert outputs[1::2] == [str(CANNOT_START)] * len(WRONG) and 'Traceback' not in text, text
    for (_, _, why), output in zip(WRONG, outputs[::2], strict=False):
        assert why in output, text


def test_a_node_that_dies_later_has_another_exit_code_than_one_that_cannot_start(start):
    """Only then a launch starts it again."""
    dies = 'from rclpy.executors import SingleThreadedExecutor as E; E.spin_once = lambda *_: 1 / 0'
    code, text = ended(start('ekf_node', before=dies))
    assert code == DIED and 'ZeroDivisionError' in text


def test_all_nodes_run_in_one_process_or_none(bench, start, tmp_path):
    code, text = ended(start('localization', '-p', f'model:={tmp_path}/none.npz'))
    assert code == CANNOT_START and 'none.npz: no such file' in text


def test_misspelt_sections_and_parameters_are_warned_of(start, tmp_path):
    """Parameters of other nodes are not: ROS gives a section `/**` to all."""
    path = tmp_path / 'parameters.yaml'
    sections = {'/**/efk_node': {'autostart': False}, '/**': {'zzz': 1, 'width': 300}}
    path.write_text(yaml.safe_dump({k: {'ros__parameters': v} for k, v in sections.items()}))
    words = ['--params-file', str(path), '-p', 'set_initial_pose:=true', '-p', 'rate_std:=0.03']
    before = SEND.format('SIGINT') + MOMENTS['made']
    code, text = ended(start('ekf_node', *words, '-r', '__ns:=/robot1', before=before))
    assert code == 0 and text.count('unknown parameter') == 2, text
    for warning in (
        f'{path}: nothing of /**/efk_node is used: this node is /robot1/ekf_node; write',
        "unknown parameter 'set_initial_pose'; did you mean 'initial_pose'?",
        "unknown parameter 'zzz'",
    ):
        assert warning in text, text
