# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes: started in any order, played at any pace, fed faster than they compute."""

import contextlib
import itertools
import math
import threading
import time

import numpy as np
import pytest
from picture_readers import SIZE, PictureReader, panorama
from ros_domains import free_domain

from sfa_localization.place_model import PlaceModel

DOMAIN = free_domain()

START_NS = 1_700_000_000_000_000_000

pytest.importorskip('rclpy')

from filter_drives import Drive  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from ros_bench import DEADLINE_S, Bench, listeners, until  # noqa: E402
from sensor_msgs.msg import Image  # noqa: E402
from std_msgs.msg import Empty, String  # noqa: E402

from sfa_localization.data.messages import read_stamp  # noqa: E402
from sfa_localization.nodes.conversions import (  # noqa: E402
    to_image,
    to_odometry,
    to_pose_with_covariance,
)
from sfa_localization.nodes.ekf_node import EkfNode  # noqa: E402
from sfa_localization.nodes.lifecycle import latched_qos  # noqa: E402
from sfa_localization.nodes.omnicam_node import OmnicamNode  # noqa: E402
from sfa_localization.nodes.sfa_node import SfaNode  # noqa: E402

ros = pytest.mark.ros
SEEN = 'sfa/pose_with_covariance'
NODES = {
    'omnicam': (OmnicamNode, {
        'camera_model': 'panorama', 'width': SIZE.width, 'height': SIZE.height,
    }),
    'sfa': (SfaNode, {'model': 'model.npz'}),
    'ekf': (EkfNode, {}),
}  # fmt: skip


class Held(PictureReader):
    """A model that can be held up."""

    def __init__(self):
        super().__init__()
        self.free, self.entered = threading.Event(), threading.Event()

    def locate(self, image):
        self.entered.set()
        assert self.free.wait(DEADLINE_S)
        return super().locate(image)


@pytest.fixture
def model(monkeypatch):
    made = Held()
    made.free.set()
    monkeypatch.setattr(PlaceModel, 'load', staticmethod(lambda path: made))
    return made


@pytest.fixture
def bench():
    made = Bench(DOMAIN)
    yield made
    made.close()


def picture(number, stamp_ns):
    return to_image(panorama((7.0, 3.0, 0.25), seed=number), stamp_ns, 'omnicam')


def standing(stamp_ns):
    frames = ('odom', 'base_link')
    return to_odometry(np.zeros(3), np.eye(3), np.zeros(2), np.eye(2) * 1e-4, stamp_ns, frames)


@ros
@pytest.mark.parametrize('order', itertools.permutations(NODES), ids='-'.join)
def test_the_nodes_start_in_any_order(bench, model, order):
    """With pictures and odometry on their way already, and again after each start."""
    reliable = QoSProfile(depth=100)
    pictures = bench.node.create_publisher(Image, 'image_raw', reliable)
    wheels = bench.node.create_publisher(Odometry, 'odom', reliable)
    states, poses = [], []
    bench.node.create_subscription(String, 'ekf/state', states.append, latched_qos())
    bench.node.create_subscription(PoseWithCovarianceStamped, 'ekf/pose', poses.append, 100)
    sent = itertools.count()

    def send():
        number = next(sent)
        stamp_ns = START_NS + number * 20_000_000
        wheels.publish(standing(stamp_ns))
        pictures.publish(picture(number, stamp_ns))

    for name in order:
        for _ in range(3):
            send()
        kind, parameters = NODES[name]
        bench.run(kind, **parameters)

    def placed():
        send()
        # The robot stands: driving would confirm where the images put it.
        return poses and states and states[-1].data.startswith('DEGRADED: placed, confirmed')

    assert until(placed), states
    position = poses[-1].pose.pose.position
    assert (position.x, position.y) == pytest.approx((7, 3), abs=0.05)


# Pace.

NOISY = {'position_std': 0.1, 'yaw_std': 0.03, 'v_std': 0.02, 'omega_std': 0.01}


def replay(bench, drive, events, together):
    """Play to a new ekf_node, waiting after every `together` messages; its filter and outputs."""
    node = bench.run(EkfNode, initial_pose=[0.0, 0.0, 0.0])
    heard = []
    listener = bench.node.create_subscription(Odometry, 'ekf/odometry', heard.append, 1000)
    assert until(lambda: bench.node.count_publishers('ekf/odometry') == 1)
    assert until(lambda: listeners(node, 'ekf/odometry') == 1)
    counts = node.monitor('odom'), node.monitor(SEEN)
    sent = [0, 0]
    for number, (stamp_ns, kind, index) in enumerate(events, 1):
        bench.publish(*message(drive, stamp_ns, kind, index))
        sent[kind] += 1
        if number % together == 0 or number == len(events):
            assert until(lambda: [count.received for count in counts] == sent), sent
    assert until(lambda: len(heard) == sent[0])
    bench.node.destroy_subscription(listener)
    bench.end(node)
    state = node.filter.state
    for topic in ('odom', SEEN):
        bench.forget(topic)
    return state, heard


def message(drive, stamp_ns, kind, index):
    if kind:
        spread = np.diag([0.04, 0.04, 0.0025])
        return SEEN, to_pose_with_covariance(drive.seen[index], spread, stamp_ns, 'map')
    spread, frames = np.diag(drive.variances()), ('odom', 'base_link')
    return 'odom', to_odometry(
        drive.reckoned[index], np.eye(3), drive.read[index], spread, stamp_ns, frames
    )


@ros
def test_a_replay_gives_the_same_messages_and_any_pace_the_same_estimate(bench):
    drive = Drive(seconds=3, **NOISY)
    slow, told = replay(bench, drive, drive.events(), 1)
    again, told_again = replay(bench, drive, drive.events(), 1)
    assert told == told_again
    # A fast playback: the topics overtake each other, here by up to 10 messages.
    burst, _ = replay(bench, drive, shuffled(drive), 10)
    for other in (again, burst):
        assert other.stamp_ns == slow.stamp_ns
        assert other.mean.tobytes() == slow.mean.tobytes()
        assert other.covariance.tobytes() == slow.covariance.tobytes()


def shuffled(drive):
    """By tens: all pictures first, or all odometry first, in turns; the start stays the start."""
    events = drive.events()
    order = events[:10]
    for at in range(10, len(events), 10):
        sign = 1 if at % 20 else -1
        order += sorted(events[at : at + 10], key=lambda e, s=sign: (s * e[1], e[0]))
    return order


# Overload.


@ros
def test_of_panoramas_that_come_too_fast_the_newest_is_located(bench, model):
    node = bench.run(SfaNode, model='model.npz')
    heard = bench.listen(PoseWithCovarianceStamped, SEEN)
    model.entered.clear()
    model.free.clear()
    bench.publish('panorama', picture(0, START_NS))
    assert model.entered.wait(DEADLINE_S)
    for number in range(1, 30):
        bench.publish('panorama', picture(number, START_NS + number))
    model.free.set()
    assert until(lambda: heard and read_stamp(heard[-1].header.stamp) == START_NS + 29)
    assert len(heard) <= 3, 'those in between were dropped'
    assert node.monitor('panorama').received == len(heard)


@ros
def test_of_odometry_that_comes_too_fast_the_newest_is_used(bench):
    node = bench.run(EkfNode, initial_pose=[0.0, 0.0, 0.0])
    bench.publish('odom', standing(START_NS))
    assert until(lambda: node.monitor('odom').used == 1)
    with held_up(bench):
        for number in range(1, 400):
            bench.publish('odom', standing(START_NS + number * 20_000_000))
    last = START_NS + 399 * 20_000_000
    assert until(lambda: node.filter.state.stamp_ns == last)
    assert node.monitor('odom').received <= 102, 'older ones were dropped'
    assert math.isfinite(node.filter.state.position_std)


def test_odometry_that_piled_up_is_fused_at_once_and_said_to_be_behind(bench):
    node = bench.run(EkfNode, initial_pose=[0.0, 0.0, 0.0], silence_timeout=1.0)
    seen, states = bench.listen(Odometry, 'ekf/odometry'), bench.listen(String, 'ekf/state')
    bench.publish('odom', standing(START_NS))
    assert until(lambda: len(seen) == 1)
    with held_up(bench):
        for number in range(1, 91):
            bench.publish('odom', standing(START_NS + number * 20_000_000))
        time.sleep(1.2)
    last = START_NS + 90 * 20_000_000
    assert until(lambda: node.filter.state.stamp_ns == last)
    assert until(lambda: any('behind by 1.' in state.data for state in states))
    assert 'LOST' not in {state.data.partition(':')[0] for state in states}
    assert node.monitor('odom').used == 91 and len(seen) < 10
    bench.publish('odom', standing(last + 20_000_000))
    assert until(lambda: 'behind' not in states[-1].data)


@contextlib.contextmanager
def held_up(bench):
    """The executor's thread does nothing meanwhile."""
    entered, free = threading.Event(), threading.Event()

    def wait(_):
        entered.set()
        free.wait(DEADLINE_S)

    bench.node.create_subscription(Empty, 'hold', wait, 1)
    bench.publish('hold', Empty())
    assert entered.wait(DEADLINE_S)
    try:
        yield
    finally:
        free.set()
