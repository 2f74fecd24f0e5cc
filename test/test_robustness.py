# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three nodes: started in any order, played at any pace, fed faster than they compute; and what
judges the troubles of recorded drives.
"""

import itertools
import json
import math
import re
import threading
import time

import numpy as np
import pytest
from filter_drives import NOISY, START_NS, FilterDrive
from picture_readers import SIZE, PictureReader, panorama
from robustness import troubles
from robustness.__main__ import tell_troubles

from sfa_localization.bags.drives import read_drive
from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from ros_bench import DEADLINE_S, SEEN, listeners, play, standing, until
from sensor_msgs.msg import Image
from std_msgs.msg import String

from sfa_localization.data.messages import read_stamp
from sfa_localization.nodes.conversions import to_image
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.lifecycle import latched_qos
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode

pytestmark = pytest.mark.ros
AT_ORIGIN = [0.0, 0.0, 0.0]
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


def picture(number, stamp_ns):
    return to_image(panorama((7.0, 3.0, 0.25), seed=number), stamp_ns, 'omnicam')


@pytest.mark.parametrize('order', [('omnicam', 'sfa', 'ekf'), ('ekf', 'sfa', 'omnicam')])
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


def replay(bench, drive, events, together):
    """Play to a new ekf_node, waiting after every `together` messages; its filter and outputs."""
    node, heard = bench.run(EkfNode, initial_pose=AT_ORIGIN), []
    listener = bench.node.create_subscription(Odometry, 'ekf/odometry', heard.append, 1000)
    assert until(lambda: bench.node.count_publishers('ekf/odometry') == 1)
    assert until(lambda: listeners(node, 'ekf/odometry') == 1)
    play(bench, node, drive, events, together)
    assert until(lambda: len(heard) == len(drive.stamps_ns))
    bench.do(bench.node.destroy_subscription, listener)
    bench.end(node)
    for topic in ('odom', SEEN):
        bench.forget(topic)
    return node.filter.state, heard


def test_a_replay_gives_the_same_messages_and_any_pace_the_same_estimate(bench):
    drive = FilterDrive(seconds=2, **NOISY)
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
    assert node.monitors['panorama'].received == len(heard)


def test_of_odometry_that_comes_too_fast_the_newest_is_used_and_said_to_be_behind(bench):
    node = bench.run(EkfNode, initial_pose=AT_ORIGIN, silence_timeout=1.0)
    seen, states = bench.listen(Odometry, 'ekf/odometry'), bench.listen(String, 'ekf/state')
    bench.publish('odom', standing(START_NS))
    assert until(lambda: len(seen) == 1)
    entered, free = threading.Event(), threading.Event()
    bench.executor.create_task(lambda: (entered.set(), free.wait(DEADLINE_S)))
    assert entered.wait(DEADLINE_S)
    for number in range(1, 400):
        bench.publish('odom', standing(START_NS + number * 2_000_000))
    time.sleep(1.2)
    free.set()
    last = START_NS + 399 * 2_000_000
    assert until(lambda: node.filter.state.stamp_ns == last)
    assert until(lambda: any('DEGRADED: behind by ' in state.data for state in states))
    assert node.filter.waited_s > 1.0, 'what comes late shows no clock'
    assert 'LOST' not in {state.data.partition(':')[0] for state in states}
    odometry = node.monitors['odom']
    assert 90 < odometry.used <= odometry.received <= 102, 'older ones were dropped'
    assert len(seen) < 10 and math.isfinite(node.filter.state.position_std)
    bench.publish('odom', standing(last + 20_000_000))
    assert until(lambda: 'behind' not in states[-1].data)


NAMED = 'warning: truth: 3 of 40 poses are zero: left out'
RIGHT_M = 0.055, 0.055


def answer(monkeypatch, means_m, said, code=0, **stated):
    """Commands answer so of a trouble of the truth; a list that grows by each that is run."""
    commands = []

    def run(*command):
        commands.append(command)
        if command[0] == 'evaluate' and not code:
            errors = {key: {'mean': e} for key, e in zip(('sfa', 'ekf'), means_m, strict=True)}
            command[-1].write_text(json.dumps(errors))
        return code, said

    stated = {'errors_m': RIGHT_M, 'says': 'truth: .* zero', 'trains': False} | stated
    monkeypatch.setattr(troubles, 'TROUBLES', {'zeros': troubles.Trouble(dict, **stated)})
    monkeypatch.setattr(troubles, 'alter', lambda source, target, *_, **__: target.mkdir())
    monkeypatch.setattr(troubles, 'run', run)
    return commands


@pytest.mark.parametrize(
    ('wanted_m', 'errors_m', 'said', 'right'),
    [
        (RIGHT_M, (0.05, 0.05), NAMED, True),
        (RIGHT_M, (0.05, 0.06), NAMED, False),
        (RIGHT_M, (0.06, 0.05), NAMED, False),
        (RIGHT_M, (0.05, math.nan), NAMED, False),
        (RIGHT_M, (0.05, 0.05), 'warning: truth', False),
        (RIGHT_M, (0.05, 0.05), '', False),
        (RIGHT_M, None, NAMED, False),
        (None, None, NAMED, True),
        (None, None, 'error: of another reason', False),
        (None, (0.01, 0.01), NAMED, False),
    ],
)
def test_a_trouble_that_is_not_named_or_errs_too_much_is_told_as_wrong(
    monkeypatch, capsys, wanted_m, errors_m, said, right
):
    """Where a refusal is right, an estimate is wrong, however good."""
    answer(monkeypatch, errors_m, f'  {said}\n', code=errors_m is None, errors_m=wanted_m)
    assert tell_troubles(['zeros']) is not right
    (line,) = capsys.readouterr().out.splitlines()
    assert ('<- WRONG' in line) is not right and ('refused' in line) == (errors_m is None)
    assert said in line


def test_the_model_of_the_untouched_drive_judges_troubles_of_the_truth_alone(monkeypatch, tmp_path):
    commands = answer(monkeypatch, (0.04, 0.05), NAMED)
    assert [*troubles.table(tmp_path)] == [('zeros', '0.040 / 0.050', NAMED, True)]
    (train, source, *_, model), (evaluate, used, test, *options) = commands
    assert (train, evaluate, used) == ('train', 'evaluate', model)
    assert source == troubles.TRAINING == options[options.index('--align') + 1]
    assert test.parent.parent == tmp_path
    # A sensor's trouble is in the training too; a refusal ends it.
    commands = answer(monkeypatch, None, NAMED, code=1, trains=True, options=('--every', '2'))
    (tmp_path / 'sensor').mkdir()
    ((*_, right),) = troubles.table(tmp_path / 'sensor')
    ((train, training, *options),) = commands
    assert not right and training.is_dir() and options[-2:] == ['--every', '2']


def test_a_bag_with_a_trouble_differs_in_nothing_else(tmp_path):
    def later(message, _):
        troubles.restamp(message, troubles.stamp_of(message) + 10**9 + 1)

    changes = {troubles.TRUTH: later, troubles.IMU: lambda m, _: []}
    troubles.alter(troubles.TEST, tmp_path / 'bag', changes)
    before, after = (
        read_drive(bag, tmp_path / name, want_truth=True)
        for name, bag in (('before', troubles.TEST), ('after', tmp_path / 'bag'))
    )
    assert np.array_equal(after.odometry.poses, before.odometry.poses)
    assert np.array_equal(after.panoramas.stamps_ns, before.panoramas.stamps_ns)
    assert after.yaw_rate is None
    late_ns = after.ground_truth.stamps_ns - before.ground_truth.stamps_ns
    assert np.all(late_ns == 10**9 + 1)


def test_every_trouble_states_what_is_right():
    for stated in troubles.TROUBLES.values():
        assert re.compile(stated.says).pattern
        assert stated.errors_m is None or min(stated.errors_m) > 0.042
