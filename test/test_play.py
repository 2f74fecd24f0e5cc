# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bag is replayed through real subscribers."""

import os
import signal
import subprocess
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from bag_formats import COUNTS, IMAGES, image, stamp, write_database, write_ros1, write_rosbags

from sfa_localization.data.errors import BagError

pytest.importorskip('rclpy')

from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from ros_bench import DEADLINE_S, DOMAIN, start_process, until
from rosbags.interfaces import QosDurability, QosReliability
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, Imu

from sfa_localization.commands import bag_player
from sfa_localization.commands.bag_player import SETTLED_S, play, qos_profile
from sfa_localization.commands.play import PlayConfig
from sfa_localization.data.messages import read_stamp

pytestmark = pytest.mark.ros
FAST, HURRIED = PlayConfig(rate=20.0, wait=20.0), PlayConfig(rate=50.0, wait=0.0)
TOPICS = {'/image_raw': Image, '/imu': Imu, '/odom': Odometry}


@pytest.fixture
def path(tmp_path, messages):
    """The bag that is replayed."""
    return write_rosbags(tmp_path / 'bag', messages, storage='mcap')


@pytest.fixture
def hear(bench, monkeypatch):
    """Subscribe to topics in the domain that is played to: what is heard of each."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))

    def subscribe(topics):
        heard = {topic: [] for topic in topics}
        for topic, kind in topics.items():
            bench.node.create_subscription(kind, topic, heard[topic].append, 500)
        return heard

    return subscribe


def test_quality_of_service_suits_the_recorded():
    def offered(reliable, latched, depth=5):
        reliability = QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT
        durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
        return SimpleNamespace(reliability=reliability, durability=durability, depth=depth)

    weak, reliable = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
    volatile, latched = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
    plain, strong, lasting = offered(False, False), offered(True, False, 50), offered(True, True)
    for recorded, expected in (
        ([], (reliable, volatile, 10)), ([plain], (weak, volatile, 10)),
        ([lasting], (reliable, latched, 100)), ([plain, strong], (reliable, volatile, 50)),
        ([strong, lasting], (reliable, volatile, 50)),
    ):  # fmt: skip
        profile = qos_profile(recorded)
        assert (profile.reliability, profile.durability, profile.depth) == expected


def test_every_message_arrives_as_recorded(hear, path):
    heard = hear(TOPICS)
    assert play(path, FAST) == COUNTS
    assert until(lambda: all(len(heard[topic]) == COUNTS[topic] for topic in TOPICS))
    stamps = [read_stamp(message.header.stamp) for message in heard['/image_raw']]
    assert stamps == [stamp(i) for i in range(IMAGES)]
    for index, message in enumerate(heard['/image_raw']):
        pixels = np.frombuffer(message.data, np.uint8).reshape(image(0).shape)
        assert np.array_equal(pixels, image(index))
        assert (message.encoding, message.header.frame_id) == ('bgr8', 'camera')
    np.testing.assert_allclose(heard['/imu'][7].angular_velocity.z, 0.014)


def test_clock_and_messages_keep_the_pace_of_the_recording(hear, path, messages, monkeypatch):
    monkeypatch.setattr(bag_player, 'CLOCK_PERIOD_S', 0.005)  # the bag is short
    heard = hear({**TOPICS, '/clock': Clock})
    seconds = (messages[-1].receive_ns - messages[0].receive_ns) * 1e-9
    start = time.monotonic()
    play(path, PlayConfig(rate=2.0, wait=20.0), clock=True)
    assert time.monotonic() - start >= seconds / 2
    assert until(lambda: len(heard['/clock']) > 2)
    times = [read_stamp(message.clock) for message in heard['/clock']]
    assert times == sorted(times)
    assert messages[0].receive_ns <= times[0] and times[-1] <= messages[-1].receive_ns + 10**9


def test_topics_are_chosen_and_what_cannot_be_played_is_named(hear, path, tmp_path, messages):
    """Types that are not installed are skipped."""
    hear({})
    assert play(path, HURRIED, topics=['/imu']) == {'/imu': COUNTS['/imu']}
    with pytest.raises(BagError, match=r'has no topic /x; --topics can be: /ground_truth, /image'):
        play(path, FAST, topics=['/x'])
    for other in ('nowhere_msgs/msg/Imu', 'sensor_msgs/msg/Nothing'):
        kinds, file = {'sensor_msgs/msg/Imu': other}, tmp_path / other / 'a.db3'
        write_database(file, messages, kind=lambda name, k=kinds: k.get(name, name))
        played = play(file, HURRIED)
        assert '/imu' not in played and played['/odom'] == COUNTS['/odom']
    write_database(tmp_path / 'b.db3', messages, kind=lambda name: 'nowhere_msgs/msg/Any')
    write_ros1(tmp_path / 'c.bag', messages)
    for name, why in {'b.db3': '/imu: type nowhere_msgs/msg/Any', 'c.bag': 'to ROS 2'}.items():
        with pytest.raises(BagError, match=f'no topic can be played .*{why}'):
            play(tmp_path / name, HURRIED)


def test_a_late_subscriber_of_images_misses_none(hear, path):
    """The subscriber of odometry was there long before: nodes start one after another."""
    hear({'/odom': Odometry})
    thread = threading.Thread(target=play, args=(path, FAST))
    thread.start()
    thread.join(3 * SETTLED_S)
    late = hear({'/image_raw': Image})['/image_raw']
    thread.join(DEADLINE_S)
    assert until(lambda: len(late) == IMAGES)


def test_a_signal_ends_it_cleanly(hear, path):
    """Also of a bag whose name is not UTF-8."""
    heard, odd = hear(TOPICS), path.rename(path.parent / os.fsdecode(b'\xff'))
    words = '-m', 'sfa_localization', 'play', odd, '--loop', '--rate=9'
    process = start_process(*words, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert until(lambda: len(heard['/imu']) > 1.5 * COUNTS['/imu'])
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
        process.wait()
    assert 'Traceback' not in errors and errors.endswith('interrupted\n')
    assert process.returncode == 130
