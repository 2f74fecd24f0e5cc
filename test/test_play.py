# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag is replayed through real subscribers."""

import os
import signal
import subprocess
import sys
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

from sfa_localization.data.errors import BagError

rclpy = pytest.importorskip('rclpy')
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy  # noqa: E402
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

from sfa_localization.commands import bag_player  # noqa: E402
from sfa_localization.commands.bag_player import (  # noqa: E402
    SETTLED_S,
    message_class,
    play,
    qos_profile,
)
from sfa_localization.commands.play import PlayConfig  # noqa: E402

pytestmark = pytest.mark.ros
ROOT = Path(__file__).parents[1]
DEADLINE_S = 60.0
DOMAIN = free_domain()
FAST = PlayConfig(rate=20.0, wait=20.0)
NO_TIME = QosTime(9223372036, 854775807)
TOPICS = {'/image_raw': Image, '/imu': Imu, '/odom': Odometry}


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


def offered(reliability, durability, depth=5) -> Qos:
    times = (NO_TIME, NO_TIME, QosLiveliness.AUTOMATIC, NO_TIME)
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, *times, False)


def test_quality_of_service_suits_the_recorded():
    weak, reliable = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
    volatile, latched = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
    plain = offered(QosReliability.BEST_EFFORT, QosDurability.VOLATILE)
    strong = offered(QosReliability.RELIABLE, QosDurability.VOLATILE, 50)
    lasting = offered(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    for recorded, expected in (
        ([], (reliable, volatile, 10)), ([plain], (weak, volatile, 10)),
        ([strong], (reliable, volatile, 50)), ([lasting], (reliable, latched, 100)),
        ([plain, strong], (reliable, volatile, 50)), ([strong, lasting], (reliable, volatile, 50)),
    ):  # fmt: skip
        profile = qos_profile(recorded)
        assert (profile.reliability, profile.durability, profile.depth) == expected


def test_types_are_found_where_installed():
    assert message_class('sensor_msgs/msg/Imu') is Imu
    for kind in ('sensor_msgs/msg/Nothing', 'nowhere_msgs/msg/Imu', '', '/msg/', 'a b/msg/C'):
        assert message_class(kind) is None


@pytest.fixture
def context(tmp_path, monkeypatch) -> Iterator[Any]:
    """Return an initialized context."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
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


def test_every_message_arrives_as_recorded(context, tmp_path, messages):
    path = reliable(messages, tmp_path / 'bag')
    with Listener(context, TOPICS) as listener:
        played = play(path, FAST)
        until(lambda: len(listener.heard['/image_raw']) == IMAGES)
        until(lambda: len(listener.heard['/imu']) == COUNTS['/imu'])
    assert played == COUNTS
    assert listener.stamps('/image_raw') == [stamp(i) for i in range(IMAGES)]
    for index, message in enumerate(listener.heard['/image_raw']):
        pixels = np.frombuffer(message.data, np.uint8).reshape(image(0).shape)
        assert np.array_equal(pixels, image(index))
        assert (message.encoding, message.header.frame_id) == ('bgr8', 'camera')
    np.testing.assert_allclose(listener.heard['/imu'][7].angular_velocity.z, 0.014)


def test_the_clock_runs_through_the_bag(context, tmp_path, messages, monkeypatch):
    monkeypatch.setattr(bag_player, 'CLOCK_PERIOD_S', 0.005)  # the bag is short
    with Listener(context, {**TOPICS, '/clock': Clock}) as listener:
        path = reliable(messages, tmp_path / 'bag')
        play(path, PlayConfig(rate=2.0, wait=20.0), clock=True)
        until(lambda: len(listener.heard['/clock']) > 2)
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in listener.heard['/clock']]
    assert times == sorted(times)
    assert messages[0].receive_ns <= times[0] and times[-1] <= messages[-1].receive_ns + 10**9


def test_messages_come_at_the_pace_of_the_recording(context, tmp_path, messages):
    path, times = reliable(messages, tmp_path / 'bag'), []
    for rate in (1.0, 4.0):
        start = time.monotonic()
        play(path, PlayConfig(rate=rate, wait=0.0))
        times.append(time.monotonic() - start)
    seconds = (messages[-1].receive_ns - messages[0].receive_ns) * 1e-9
    assert times[0] >= seconds and times[1] >= seconds / 4


def test_topics_are_chosen(context, tmp_path, messages):
    """What cannot be played is named before any wait for subscribers."""
    path, config = reliable(messages, tmp_path / 'bag'), PlayConfig(rate=50.0, wait=0.2)
    assert play(path, config, topics=['/imu']) == {'/imu': COUNTS['/imu']}
    start = time.monotonic()
    with pytest.raises(BagError, match=r'has no topic /x; --topics can be: /ground_truth, /image'):
        play(path, FAST, topics=['/x'])
    assert time.monotonic() - start < FAST.wait / 2


def test_types_that_are_not_installed_are_skipped(context, tmp_path, messages):
    kind = {'sensor_msgs/msg/Imu': 'nowhere_msgs/msg/Imu'}
    write_database(tmp_path / 'a.db3', messages, kind=lambda name: kind.get(name, name))
    config = PlayConfig(rate=50.0, wait=0.0)
    played = play(tmp_path / 'a.db3', config)
    assert '/imu' not in played and played['/odom'] == COUNTS['/odom']
    write_database(tmp_path / 'b.db3', messages, kind=lambda name: 'nowhere_msgs/msg/Any')
    with pytest.raises(BagError, match=r'no topic can be played .*/imu: type nowhere_msgs/msg/Any'):
        play(tmp_path / 'b.db3', config)
    path = write_ros1(tmp_path / 'a.bag', messages)
    with pytest.raises(BagError, match=r'no topic can be played .*convert it to ROS 2'):
        play(path, config)


def test_a_late_subscriber_of_images_misses_none(context, tmp_path, messages):
    """The subscriber of odometry was there long before: nodes start one after another."""
    path, played = reliable(messages, tmp_path / 'bag'), []
    with Listener(context, {'/odom': Odometry}):
        thread = threading.Thread(target=lambda: played.append(play(path, FAST)))
        thread.start()
        thread.join(3 * SETTLED_S)
        with Listener(context, {'/image_raw': Image}) as late:
            thread.join(DEADLINE_S)
            until(lambda: len(late.heard['/image_raw']) == IMAGES)
    assert played[0]['/image_raw'] == IMAGES


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_cleanly(number, context, tmp_path, messages):
    path = reliable(messages, tmp_path / 'bag')
    command = [sys.executable, '-m', 'sfa_localization', 'play', str(path), '--loop', '--rate=9']
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(DOMAIN)}
    with Listener(context, TOPICS) as listener:
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            until(lambda: len(listener.heard['/imu']) > 1.5 * COUNTS['/imu'])
            process.send_signal(number)
            _, errors = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()
            process.wait()
    assert 'Traceback' not in errors and errors.endswith('interrupted\n')
    assert process.returncode == 130


def test_a_bag_may_have_a_name_that_is_not_utf8(tmp_path, messages):
    path = write_version(tmp_path / '\udcff', messages, 5)
    command = [sys.executable, '-m', 'sfa_localization', 'play', str(path), '--wait=0', '--rate=99']
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S)
    assert (result.returncode, result.stderr) == (0, '')
    assert result.stdout.count(' messages\n') == len(COUNTS)
