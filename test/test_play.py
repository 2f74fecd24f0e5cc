# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Replay: pace and keys alone, then whole bags through real subscribers."""

import math
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_formats import (
    COUNTS,
    IMAGES,
    Message,
    drive,
    image,
    stamp,
    write_database,
    write_ros1,
    write_rosbags,
    write_version,
)
from ros_domains import free_domain

from sfa_localization.commands.pace import Keyboard, Pace, PlayConfig
from sfa_localization.data.errors import BagError

ROOT = Path(__file__).parents[1]

DEADLINE_S = 60.0
DOMAIN = free_domain()
FAST = PlayConfig(rate=20.0, wait=20.0)


@pytest.fixture(scope='session')
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    """Return the drive that is replayed."""
    return drive(tmp_path_factory.mktemp('drive'))


def until(condition: Callable[[], bool]):
    """Wait for a condition, with a deadline."""
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, 'deadline'
        time.sleep(0.005)


# The pace.


def test_the_pace_follows_the_clock_at_its_rate_and_stands_still_while_paused():
    now = [100.0]
    pace = Pace(5_000_000_000, 2.0, lambda: now[0])
    assert pace.delay(7_000_000_000) == 1.0
    now[0] += 0.25
    assert pace.time_ns == 5_500_000_000
    assert pace.delay(7_000_000_000) == 0.75
    pace.scale(0.5)
    assert pace.delay(7_000_000_000) == 1.5
    pace.toggle_pause()
    now[0] += 50.0
    assert pace.time_ns == 5_500_000_000 and pace.delay(0) == math.inf
    pace.jump(6_000_000_000)
    pace.toggle_pause()
    now[0] += 1.0
    assert pace.time_ns == 7_000_000_000


# The keys.


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """Return the user's side of a terminal, and the program's."""
    user, program = pty.openpty()
    yield user, program
    os.close(user)
    os.close(program)


def test_the_terminal_is_left_as_it_was(terminal):
    _, program = terminal
    before = termios.tcgetattr(program)
    with pytest.raises(KeyboardInterrupt), Keyboard(program):
        assert termios.tcgetattr(program) != before
        raise KeyboardInterrupt
    assert termios.tcgetattr(program) == before


# Through ROS.

rclpy = pytest.importorskip('rclpy')
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from ros_bench import Spinner  # noqa: E402
from rosbags.interfaces import (  # noqa: E402
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Image, Imu  # noqa: E402

from sfa_localization.bags.reader import Bag  # noqa: E402
from sfa_localization.commands import bag_player  # noqa: E402
from sfa_localization.commands.bag_player import (  # noqa: E402
    SETTLED_S,
    Player,
    message_class,
    play,
    qos_profile,
)

NO_TIME = QosTime(9223372036, 854775807)
ROS = pytest.mark.ros


def offered(**changes: Any) -> Qos:
    fields = {
        'history': QosHistory.KEEP_LAST,
        'depth': 5,
        'reliability': QosReliability.BEST_EFFORT,
        'durability': QosDurability.VOLATILE,
        'deadline': NO_TIME,
        'lifespan': NO_TIME,
        'liveliness': QosLiveliness.AUTOMATIC,
        'liveliness_lease_duration': NO_TIME,
        'avoid_ros_namespace_conventions': False,
    }
    return Qos(**{**fields, **changes})


STRONG = offered(reliability=QosReliability.RELIABLE, depth=50)
LATCHED = offered(reliability=QosReliability.RELIABLE, durability=QosDurability.TRANSIENT_LOCAL)


@ROS
def test_quality_of_service_suits_the_recorded():
    weak, reliable = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
    volatile, latched = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
    for recorded, expected in (
        ([], (reliable, volatile, 10)), ([offered()], (weak, volatile, 10)),
        ([STRONG], (reliable, volatile, 50)), ([LATCHED], (reliable, latched, 100)),
        ([offered(), STRONG], (reliable, volatile, 50)),
        ([STRONG, LATCHED], (reliable, volatile, 50)),
    ):  # fmt: skip
        profile = qos_profile(recorded)
        assert (profile.reliability, profile.durability, profile.depth) == expected
    profile = qos_profile([offered(deadline=QosTime(2, 500_000_000))])
    assert profile.deadline.nanoseconds == 2_500_000_000
    assert qos_profile([offered()]).deadline == QoSProfile(depth=1).deadline


@ROS
def test_types_are_found_where_installed_and_nothing_else_is_imported(tmp_path, monkeypatch):
    """Neither packages of other kinds, nor anything from the folder of a bag."""
    assert message_class('sensor_msgs/msg/Imu') is Imu
    for kind in ('sensor_msgs/msg/Nothing', 'nowhere_msgs/msg/Imu', '', '/msg/',
                 'antigravity/msg/X', 'this/msg/X', 'sensor_msgs/msg/_imu'):  # fmt: skip
        assert message_class(kind) is None
    assert not {'antigravity', 'this'} & set(sys.modules)
    package = tmp_path / 'evil_msgs' / 'msg'
    package.mkdir(parents=True)
    for file in (package / '__init__.py', package.parent / '__init__.py'):
        file.write_text('raise AssertionError("code of the folder ran")')
    monkeypatch.chdir(tmp_path)
    for place in ('', '.', str(tmp_path)):
        with monkeypatch.context() as patch:
            patch.syspath_prepend(place)
            assert message_class('evil_msgs/msg/Imu') is None
            assert message_class('sensor_msgs/msg/Imu') is Imu


@pytest.fixture
def context(tmp_path, monkeypatch) -> Iterator[Any]:
    """Return an initialized context."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    context = rclpy.Context()
    options = rclpy.signals.SignalHandlerOptions.NO
    rclpy.init(context=context, domain_id=DOMAIN, signal_handler_options=options)
    yield context
    rclpy.try_shutdown(context=context)


class Listener:
    """Subscribes and keeps all messages, spinning in a thread."""

    def __init__(self, context, topics: dict[str, Any]):
        self.node = rclpy.create_node('listener', context=context)
        self.heard: dict[str, list[Any]] = {topic: [] for topic in topics}
        for topic, kind in topics.items():
            self.node.create_subscription(kind, topic, self.heard[topic].append, 500)
        self._executor = Spinner(context)
        self._executor.add_node(self.node)

    def __enter__(self) -> 'Listener':
        return self

    def __exit__(self, *error: object):
        self._executor.shutdown()
        self.node.destroy_node()

    def stamps(self, topic: str) -> list[int]:
        times = [message.header.stamp for message in self.heard[topic]]
        return [time.sec * 10**9 + time.nanosec for time in times]


def reliable(messages, path: Path) -> Path:
    return write_rosbags(path, messages, storage='mcap')


TOPICS = {'/image_raw': Image, '/imu': Imu}


@ROS
@pytest.mark.parametrize('ros1', [False, True])
def test_every_message_arrives_as_recorded(ros1, context, tmp_path, messages):
    path = tmp_path / 'bag'
    path = write_ros1(path / 'a.bag', messages) if ros1 else reliable(messages, path)
    with Listener(context, TOPICS) as listener:
        played = play(path, config=FAST, context=context, wait_for=list(TOPICS))
        until(lambda: len(listener.heard['/image_raw']) == IMAGES)
        until(lambda: len(listener.heard['/imu']) == COUNTS['/imu'])
    assert played.messages == COUNTS and played.skipped == {}
    assert listener.stamps('/image_raw') == [stamp(i) for i in range(IMAGES)]
    for index, message in enumerate(listener.heard['/image_raw']):
        pixels = np.frombuffer(message.data, np.uint8).reshape(image(0).shape)
        assert np.array_equal(pixels, image(index))
        assert (message.encoding, message.header.frame_id) == ('bgr8', 'camera')
    np.testing.assert_allclose(listener.heard['/imu'][7].angular_velocity.z, 0.014)


@ROS
def test_the_clock_runs_through_the_bag(context, tmp_path, messages, monkeypatch):
    config = PlayConfig(rate=2.0, wait=20.0)
    monkeypatch.setattr(bag_player, 'CLOCK_RATE_HZ', 200.0)  # the bag is short
    with Listener(context, {**TOPICS, '/clock': Clock}) as listener:
        path = reliable(messages, tmp_path / 'bag')
        play(path, config=config, context=context, clock=True, wait_for=['/imu'])
        until(lambda: len(listener.heard['/clock']) > 2)
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in listener.heard['/clock']]
    assert times == sorted(times)
    assert messages[0].receive_ns <= times[0] and times[-1] <= messages[-1].receive_ns + 10**9


@ROS
def test_offset_and_topics_are_chosen(context, tmp_path, messages, monkeypatch):
    """What cannot be played is named before any wait for subscribers."""
    path, config = reliable(messages, tmp_path / 'bag'), PlayConfig(rate=50.0, wait=0.2)
    late = PlayConfig(rate=50.0, start_offset=0.55, wait=0.0)
    assert play(path, config=late, context=context).messages['/image_raw'] == IMAGES - 6
    played = play(path, config=config, context=context, topics=['/imu'])
    assert played.messages == {'/imu': COUNTS['/imu']}
    monkeypatch.setattr(bag_player.Player, 'wait_for_subscribers', lambda *_: pytest.fail('waits'))
    with pytest.raises(BagError, match=r'has no topic /x; --topics can be: /ground_truth, /image'):
        play(path, config=config, context=context, topics=['/x'])
    with pytest.raises(BagError, match=r'nothing to play after 1e\+06 s'):
        play(path, config=PlayConfig(start_offset=1e6), context=context)


@ROS
def test_types_that_are_not_installed_are_named_and_skipped(context, tmp_path, messages):
    kind = {'sensor_msgs/msg/Imu': 'nowhere_msgs/msg/Imu'}
    write_database(tmp_path / 'a.db3', messages, kind=lambda name: kind.get(name, name))
    config = PlayConfig(rate=50.0, wait=0.0)
    played = play(tmp_path / 'a.db3', config=config, context=context)
    assert played.skipped == {'/imu': 'type nowhere_msgs/msg/Imu is not installed'}
    assert played.messages['/odom'] == COUNTS['/odom']
    write_database(tmp_path / 'b.db3', messages, kind=lambda name: 'nowhere_msgs/msg/Any')
    with pytest.raises(BagError, match='no topic can be played'):
        play(tmp_path / 'b.db3', config=config, context=context)


@ROS
def test_a_late_subscriber_of_images_misses_none(context, tmp_path, messages):
    """The subscriber of odometry was there long before: nodes start one after another."""
    path, played = reliable(messages, tmp_path / 'bag'), []
    with Listener(context, {'/odom': Odometry}):
        thread = threading.Thread(
            target=lambda: played.append(play(path, config=FAST, context=context))
        )
        thread.start()
        thread.join(3 * SETTLED_S)
        with Listener(context, {'/image_raw': Image}) as late:
            thread.join(DEADLINE_S)
            until(lambda: len(late.heard['/image_raw']) == IMAGES)
    assert played[0].messages['/image_raw'] == IMAGES


@ROS
def test_a_loop_ends_when_ros_does(context, tmp_path, messages):
    path, played = reliable(messages, tmp_path / 'bag'), []
    config = PlayConfig(rate=100.0, wait=20.0)
    with Listener(context, TOPICS) as listener:
        thread = threading.Thread(
            target=lambda: played.append(
                play(path, config=config, loop=True, context=context, wait_for=list(TOPICS))
            )
        )
        thread.start()
        until(lambda: len(listener.heard['/imu']) > 2.5 * COUNTS['/imu'])
    rclpy.try_shutdown(context=context)
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert played[0].messages['/imu'] > 2.5 * COUNTS['/imu']


@ROS
def test_pause_and_step_from_the_keyboard(context, tmp_path, messages, terminal):
    user, program = terminal
    node = rclpy.create_node('player', context=context)
    path = write_version(tmp_path / 'bag', messages, 5)
    with Bag(path) as bag, Keyboard(program) as keyboard:
        player = Player(node, bag, PlayConfig(rate=1.0), keyboard)
        player.pace.toggle_pause()
        thread = threading.Thread(target=player.play)
        thread.start()
        for count in range(1, 4):
            os.write(user, b's' if count % 2 else b'\x1b[C')
            until(lambda count=count: player.played.messages.total() == count)
        assert player.pace.time_ns == messages[2].receive_ns
        os.write(user, b'\x1b[A')
        until(lambda: player.pace.rate > 1.05)
        assert player.played.messages.total() == 3
        os.write(user, b' ')
        until(lambda: player.played.messages.total() == len(messages))
        thread.join(DEADLINE_S)
    assert not thread.is_alive()
    node.destroy_node()


@ROS
@pytest.mark.parametrize(('number', 'code'), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_signals_end_it_cleanly(number, code, context, tmp_path, messages):
    path = reliable(messages, tmp_path / 'bag')
    command = [sys.executable, '-m', 'sfa_localization', 'play', str(path), '--loop', '--rate=9']
    command += ['--wait-for', *TOPICS]
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(DOMAIN)}
    with Listener(context, TOPICS) as listener:
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            until(lambda: len(listener.heard['/imu']) > 1)
            process.send_signal(number)
            _, errors = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()
            process.wait()
    assert 'Traceback' not in errors
    assert process.returncode == code, errors


@ROS
@pytest.mark.parametrize('step', ['Node', 'message_class'])
def test_a_shutdown_while_it_starts_ends_it(step, context, tmp_path, messages, monkeypatch):
    def shut_down(*args: Any, **how: Any) -> Any:
        rclpy.try_shutdown(context=context)
        return original(*args, **how)

    path, original = write_version(tmp_path / 'bag', messages, 5), getattr(bag_player, step)
    monkeypatch.setattr(bag_player, step, shut_down)
    assert not play(path, context=context).messages


@ROS
def test_a_bag_may_have_a_name_that_is_not_utf8(tmp_path, messages):
    path = write_version(tmp_path / '\udcff', messages, 5)
    command = [sys.executable, '-m', 'sfa_localization', 'play', str(path), '--wait=0', '--rate=99']
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S)
    assert (result.returncode, result.stderr) == (0, '')
    assert result.stdout.count(' messages\n') == len(COUNTS)


def test_a_command_in_a_downloaded_folder_runs_none_of_its_code(tmp_path):
    for name in ('yaml', 'argparse', 'numpy', 'rosbags'):
        (tmp_path / f'{name}.py').write_text('raise AssertionError("code of the folder ran")')
    result = subprocess.run(
        [sys.executable, '-m', 'sfa_localization', 'inspect', 'nothing'],
        cwd=tmp_path, env={**os.environ, 'PYTHONPATH': str(ROOT)}, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert result.returncode == 1
    assert result.stderr == 'error: nothing: no such bag; check the path\n'
