# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The package as its users run it: `ros2 run`, launch, param, lifecycle and bag, and tf2.

Skipped where there is no `ros2`, and where it does not find the package: source the workspace.
"""

import contextlib
import math
import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy')
if shutil.which('ros2') is None:
    pytest.skip('there is no ros2 command', allow_module_level=True)
from ament_index_python.packages import PackageNotFoundError, get_package_prefix

try:
    get_package_prefix('sfa_localization')
except PackageNotFoundError:
    pytest.skip('ros2 does not find sfa_localization', allow_module_level=True)

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.time import Time
from ros_bench import DOMAIN, until
from std_msgs.msg import String

from sfa_localization.data.geometry import compose
from sfa_localization.data.messages import read_planar, read_stamp, read_yaw
from sfa_localization.nodes.conversions import to_pose_with_covariance
from sfa_localization.nodes.lifecycle import latched_qos

pytestmark = [pytest.mark.ros, pytest.mark.slow]
ROOT = Path(__file__).parents[1]
DRIVE, MODEL_DRIVE = ROOT / 'bags' / 'sample_test', ROOT / 'bags' / 'sample'
COMMAND_S = 60
"""A command of ros2 imports for seconds, and more on a busy machine."""
DIRECT = ['--no-daemon', '--spin-time', '5']
"""Without the daemon of ros2, which would outlive the tests; nodes are found in that time."""
ENVIRONMENT = {**os.environ, 'ROS_DOMAIN_ID': str(DOMAIN), 'PYTHONUNBUFFERED': '1'}


def ros2(*words, refused=False, timeout_s=COMMAND_S):
    """Run `ros2 ...` to its end: its output; only what is `refused` may fail."""
    done = subprocess.run(
        ['ros2', *map(str, words)], env=ENVIRONMENT, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=timeout_s,
    )  # fmt: skip
    assert refused or done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope='module')
def model(tmp_path_factory):
    """A model of the first sample drive."""
    path = tmp_path_factory.mktemp('model') / 'model.npz'
    words = 'run', 'sfa_localization', 'train', MODEL_DRIVE, '--output', path
    ros2(*words, timeout_s=1200)
    return path


@pytest.fixture
def start(tmp_path):
    """Start `ros2 ...` as in a terminal of its own: Ctrl-C reaches the whole of it."""
    running = []

    def begin(*words):
        log = tmp_path / f'{len(running)}.log'
        with open(log, 'w') as output:
            process = subprocess.Popen(
                ['ros2', *map(str, words)], env=ENVIRONMENT, stdin=subprocess.DEVNULL,
                stdout=output, stderr=subprocess.STDOUT, start_new_session=True, cwd=ROOT,
            )  # fmt: skip
        process.log = log
        running.append(process)
        return process

    yield begin
    for process in running:
        for number in (signal.SIGINT, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):  # it and its children have ended
                os.killpg(process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(15)


def interrupted(process):
    """End it by Ctrl-C; its exit code and what it printed."""
    os.killpg(process.pid, signal.SIGINT)
    return process.wait(COMMAND_S), process.log.read_text()


def states(bench, namespace=''):
    """What ekf_node says of its state from now on; waits until it has said so once."""
    heard = []
    bench.node.create_subscription(String, f'{namespace}/ekf/state', heard.append, latched_qos())
    assert until(lambda: heard, COMMAND_S), 'ekf_node does not start'
    return heard


def planar(pose):
    return np.array(read_planar(pose.position, pose.orientation))


def played(start, path, *words):
    """A bag is played to its end."""
    player = start('bag', 'play', path, '--disable-keyboard-controls', *words)
    assert player.wait(3 * COMMAND_S) == 0, player.log.read_text()


def launch(start, *arguments):
    return start('launch', 'sfa_localization', 'localization.launch.py', *arguments)


def test_a_node_of_ros2_run_obeys_the_command_line_and_ends_at_ctrl_c(bench, start, tmp_path):
    """Its life cycle and parameters; a dump of them can be read back."""
    first = start('run', 'sfa_localization', 'ekf_node', '--ros-args', '-p', 'lost_std:=1.25')
    assert states(bench)[0].data.startswith('UNINITIALISED')
    assert ros2('lifecycle', 'get', '/ekf_node', *DIRECT).startswith('active')
    for transition, state in (('deactivate', 'inactive'), ('activate', 'active')):
        ros2('lifecycle', 'set', '/ekf_node', transition, *DIRECT)
        assert ros2('lifecycle', 'get', '/ekf_node', *DIRECT).startswith(state)
    for name, value in (('lost_std', '1.5'), ('speed_std', '1')):
        assert 'successful' in ros2('param', 'set', '/ekf_node', name, value, *DIRECT)
    ros2('param', 'set', '/ekf_node', 'lost_std', '-1.5', *DIRECT, refused=True)
    dumped = ros2('param', 'dump', '/ekf_node', *DIRECT)
    values = yaml.safe_load(dumped)['/ekf_node']['ros__parameters']
    assert values['lost_std'] == 1.5 and values['initial_pose'] == []
    code, told = interrupted(first)
    assert code == 0 and 'Traceback' not in told, told
    assert until(lambda: 'ekf_node' not in bench.node.get_node_names())
    path = tmp_path / 'dumped.yaml'
    path.write_text(dumped)
    start('run', 'sfa_localization', 'ekf_node', '--ros-args', '--params-file', path)
    states(bench)
    assert yaml.safe_load(ros2('param', 'dump', '/ekf_node', *DIRECT)) == yaml.safe_load(dumped)
    assert 'double array' in ros2('param', 'describe', '/ekf_node', 'initial_pose', *DIRECT)


class Corrector:
    """Publishes poses beside the odometry now and then, so that map -> odom jumps."""

    def __init__(self, bench):
        self.odometry, self.fused = {}, {}
        self._publisher = bench.node.create_publisher(
            PoseWithCovarianceStamped, 'sfa/pose_with_covariance', 10
        )
        bench.node.create_subscription(Odometry, 'odom', self._hear, 1000)
        bench.node.create_subscription(Odometry, 'ekf/odometry', self._fuse, 1000)

    def _hear(self, message):
        stamp_ns = read_stamp(message.header.stamp)
        self.odometry[stamp_ns] = planar(message.pose.pose)
        if len(self.odometry) % 20 == 0:
            side = 0.3 if len(self.odometry) % 40 else -0.3
            seen = self.odometry[stamp_ns] + [side, 0.0, 0.0]
            spread = np.diag([0.04, 0.04, 0.01])
            self._publisher.publish(to_pose_with_covariance(seen, spread, stamp_ns, 'map'))

    def _fuse(self, message):
        self.fused[read_stamp(message.header.stamp)] = planar(message.pose.pose)


def test_a_lookup_of_tf2_during_bag_play_is_ekf_odometry(bench, start):
    tf2_ros = pytest.importorskip('tf2_ros')
    buffer = tf2_ros.Buffer(cache_time=Duration(seconds=100))
    tf2_ros.TransformListener(buffer, bench.node, spin_thread=False)
    start('run', 'sfa_localization', 'ekf_node', '--ros-args', '-p', 'initial_pose:=[0.0,0.0,0.0]')
    states(bench)
    corrector = Corrector(bench)
    played(start, DRIVE, '--topics', '/odom', '--rate', '2')
    assert until(lambda: len(corrector.fused) > 700), 'ekf_node did not follow the bag'
    map_to_odom, errors = [], []
    for stamp_ns, fused in sorted(corrector.fused.items())[:-1]:
        t = buffer.lookup_transform('map', 'odom', Time(nanoseconds=stamp_ns)).transform
        map_to_odom.append([t.translation.x, t.translation.y, read_yaw(t.rotation)])
        if stamp_ns in corrector.odometry:
            errors.append(compose(map_to_odom[-1], corrector.odometry[stamp_ns]) - fused)
    assert len(errors) > 600
    assert np.hypot(*np.array(errors).T[:2]).max() < 1e-3
    assert max(abs(math.remainder(error[2], 2 * math.pi)) for error in errors) < 1e-3
    assert np.ptp(map_to_odom, axis=0)[0] > 0.05, 'nothing was corrected'


def test_the_launched_chain_follows_a_bag_in_a_namespace(bench, start, model):
    chain = launch(start, f'model:={model}', 'namespace:=robot1', 'image_transport:=compressed')
    heard = states(bench, '/robot1')
    nodes = ros2('node', 'list', *DIRECT).split()
    assert {f'/robot1/{name}_node' for name in ('omnicam', 'sfa', 'ekf')} <= set(nodes)
    assert until(lambda: bench.node.count_publishers('/robot1/tf') == 1)
    assert bench.node.count_publishers('/tf') == 0
    assert until(lambda: bench.node.count_subscribers('/robot1/image_raw/compressed'), COMMAND_S)
    images = '/panorama/compressed:=/robot1/image_raw/compressed'
    played(start, DRIVE, '--remap', '/odom:=/robot1/odom', images)
    assert any(state.data.startswith('LOCALISED') for state in heard)
    _, told = interrupted(chain)
    assert 'process has died' not in told and 'Traceback' not in told


def test_the_replay_of_the_readme_becomes_localised(bench, start, model):
    """Its two lines, as they are typed in a clone of the repository."""
    lines = (ROOT / 'README.md').read_text('utf-8').splitlines()
    (k,) = (k for k, line in enumerate(lines) if line.startswith('ros2 bag play'))
    typed = [line.replace('$PWD/model.npz', str(model)).split() for line in lines[k - 1 : k + 1]]
    chain = start(*typed[0][1:])
    heard = states(bench)
    assert until(lambda: bench.node.count_subscribers('/panorama/compressed'), COMMAND_S)
    assert typed[1][:3] == ['ros2', 'bag', 'play']
    played(start, *typed[1][3:])
    assert any(state.data.startswith('LOCALISED') for state in heard)
    assert 'omnicam_node' not in bench.node.get_node_names()
    interrupted(chain)


def test_a_camera_that_static_transforms_have_elsewhere_is_named_by_the_state(bench, start, model):
    frames = '--frame-id', 'base_link', '--child-frame-id', 'camera'
    start('run', 'tf2_ros', 'static_transform_publisher', '--x', '1.0', '--y', '0.5', *frames)
    chain = launch(start, f'model:={model}', 'image_transport:=compressed')
    heard = states(bench)
    assert until(lambda: bench.node.count_subscribers('/image_raw/compressed'), COMMAND_S)
    played(start, DRIVE, '--remap', '/panorama/compressed:=/image_raw/compressed')
    moved = '/tf_static has the camera 1.00 m ahead and 0.50 m left of base_link'
    assert any(moved in state.data for state in heard), heard[-1].data
    interrupted(chain)


@pytest.mark.parametrize(('argument', 'reasons'), [
    ('config:=/none.yaml', ['config:=/none.yaml: there is no such parameter file']),
    ('params_file:=/none.yaml', ['params_file:=/none.yaml: there is no such parameter file']),
    ('image_transport:=raw', ['none.npz: no such file', 'cannot start']),
])  # fmt: skip
def test_a_launch_without_its_parameter_file_or_model_ends_with_1(start, argument, reasons):
    chain = launch(start, 'model:=/none.npz', argument)
    assert chain.wait(COMMAND_S) == 1
    assert all(reason in chain.log.read_text() for reason in reasons)


@pytest.mark.parametrize('respawn', ['true', 'false'])
def test_a_node_that_dies_is_started_again_unless_asked(bench, start, model, respawn):
    chain = launch(start, f'model:={model}', f'respawn:={respawn}', 'autostart:=True')
    heard = states(bench)

    def printed(text):
        return chain.log.read_text().count(text)

    assert until(lambda: printed('[sfa_node]: active') == 1, COMMAND_S)
    (number,) = re.findall(r'\[sfa_node-\d+\]: process started with pid \[(\d+)',
                           chain.log.read_text())  # fmt: skip
    os.kill(int(number), signal.SIGKILL)
    assert until(lambda: printed('exit code -9') == 1, COMMAND_S)
    if respawn == 'true':
        assert until(lambda: printed('[sfa_node]: active') == 2, COMMAND_S)
        return
    # The middleware misses a process that was killed only some time later.
    gone = 'nobody publishes on /sfa/pose_with_covariance'
    assert until(lambda: gone in heard[-1].data, COMMAND_S)
    assert printed('[sfa_node]: active') == 1
