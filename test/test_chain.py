# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Chains of nodes: two robots in one domain; and the same poses live, in `Localizer`, offline."""

import json

import numpy as np
import pytest
from picture_readers import SIZE, PictureReader, Recording, load_pictures, panorama

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.events import ODOMETRY
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import evaluate, fit_transform, moved
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.localizer import Localizer

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from ros_bench import SEEN, AsText, message_of, standing, until
from std_msgs.msg import String

from sfa_localization.data.messages import read_planar, read_stamp
from sfa_localization.nodes import ekf_node
from sfa_localization.nodes.composition import chain
from sfa_localization.nodes.conversions import to_image
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode

pytestmark = pytest.mark.ros
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(autouse=True)
def reader(monkeypatch):
    """Every model reads the pose off the picture."""
    load_pictures(monkeypatch)


def pose_of(message):
    pose = message.pose.pose if isinstance(message, Odometry) else message.pose
    return read_planar(pose.position, pose.orientation)


PLACES = {'robot1': (3.0, 4.0, 0.5), 'robot2': (20.0, 11.0, -1.0)}
PARAMETERS = f"""
/**/omnicam_node:
  ros__parameters: {{camera_model: panorama, width: {SIZE.width}, height: {SIZE.height}}}
/**/sfa_node:
  ros__parameters: {{model: model.npz}}
/robot1/ekf_node:
  ros__parameters: {{lost_std: 1.5}}
robot2:
  ekf_node:
    ros__parameters: {{lost_std: 1.8}}
"""


def drive(bench, done):
    """Send both robots' images and odometry in turns, until something is so."""
    for step in range(1, 1200):
        stamp_ns = START_NS + step * 50_000_000
        for name, place in PLACES.items():
            bench.publish(f'/{name}/odom', standing(stamp_ns))
            image = to_image(panorama(place, seed=step), stamp_ns, 'omnicam')
            bench.publish(f'/{name}/image_raw', image)
        if until(done, 0.05):
            return True
    return False


def test_two_robots_side_by_side_locate_themselves(bench, tmp_path, monkeypatch):
    """Images and odometry alternate in one domain; no message of one reaches the other."""
    monkeypatch.setattr(ekf_node, 'TFMessage', AsText)
    path = tmp_path / 'robots.yaml'
    path.write_text(PARAMETERS)
    words = ['--ros-args', '--params-file', str(path), '-r', '/tf:=tf']
    robots = {
        name: [
            bench.run(kind, options={'namespace': name, 'cli_args': words})
            for kind in (OmnicamNode, SfaNode, EkfNode)
        ]
        for name in PLACES
    }
    fused = {name: bench.listen(Odometry, f'/{name}/ekf/odometry') for name in PLACES}
    sent = {name: bench.listen(String, f'/{name}/tf') for name in PLACES}
    told = bench.listen(DiagnosticArray, '/diagnostics')

    def located():
        return all(
            sent[name] and fused[name] and np.allclose(pose_of(fused[name][-1]), place, atol=0.1)
            for name, place in PLACES.items()
        )

    assert drive(bench, located)
    limits = {name: nodes[2].get_parameter('lost_std').value for name, nodes in robots.items()}
    assert limits == {'robot1': 1.5, 'robot2': 1.8}, 'each has its own section of the file'
    for name, place in PLACES.items():
        # The odometry stands at its origin: the transform is the place in the map.
        poses = [pose[:2] for message in [*sent[name]] for _, pose in json.loads(message.data)]
        assert np.allclose(poses, place[:2], atol=0.5)
    assert bench.node.count_publishers('/tf') == 0
    for k, topic in ((2, 'odom'), (0, 'image_raw')):
        received = [nodes[k].monitors[topic].received for nodes in robots.values()]
        assert np.ptp(received) <= 3, 'one robot hears the other'
    statuses = {s.name: {v.key for v in s.values} for m in [*told] for s in m.status}
    nodes = 'omnicam_node', 'sfa_node', 'ekf_node'
    assert set(statuses) == {f'{name}/{node}: status' for name in PLACES for node in nodes}
    assert '/robot2/panorama: received' in statuses['robot2/sfa_node: status']


WATCH, FILTER = {'least_explained': 0.3}, {'measurement_factor': 2.0}
"""Settings of sfa_node and ekf_node that differ from the defaults, and matter here."""


def trajectory(messages):
    stamps_ns = [read_stamp(m.header.stamp) for m in messages]
    return Trajectory(np.array(stamps_ns, np.int64), np.array([pose_of(m) for m in messages]))


def live(bench, recording):
    """Return what sfa_node and ekf_node publish: poses of pictures, and of the filter."""
    sfa = bench.run(SfaNode, model='reader.npz', **WATCH)
    ekf = bench.run(EkfNode, **FILTER)
    seen, fused = bench.listen(PoseStamped, 'sfa/pose'), bench.listen(Odometry, 'ekf/odometry')
    # The latched record of the robot is there before the first picture.
    assert until(lambda: ekf.monitors['sfa/rig'].used == 1)
    inputs = [sfa.monitors['panorama'], ekf.monitors[SEEN], ekf.monitors['odom']]
    for stamp_ns, kind, index in recording.events():
        is_image = kind != ODOMETRY
        if is_image:
            picture = recording.pictures[index]
            topic, message = 'panorama', to_image(picture, stamp_ns, 'omnicam')
        else:
            topic, message = message_of(recording.drive, 0, recording.kept[index])
        due = is_image, is_image and message.width == SIZE.width, not is_image
        counts = [m.received + is_due for m, is_due in zip(inputs, due, strict=True)]
        bench.publish(topic, message)
        assert until(lambda c=counts: [m.received for m in inputs] == c)
    last = int(recording.drive.stamps_ns[-1])
    assert until(lambda: fused and read_stamp(fused[-1].header.stamp) == last)
    return trajectory(seen), trajectory(fused)


def same(a, b):
    assert np.array_equal(a.stamps_ns, b.stamps_ns)
    assert np.allclose(a.poses[:, :2], b.poses[:, :2], rtol=0, atol=1e-9)
    assert np.allclose(np.exp(1j * a.poses[:, 2]), np.exp(1j * b.poses[:, 2]), atol=1e-9)


def test_live_nodes_localizer_and_evaluate_give_the_same_poses(bench, tmp_path):
    """Also of what is skipped; test_evaluation.py counts it."""
    recording = Recording()
    seen, fused = live(bench, recording)
    config, watch = FilterConfig(**FILTER), WatchConfig(**WATCH)

    # Without ROS, message by message.
    localizer = Localizer(PictureReader(), config, watch)
    stamps, poses = [], []
    for stamp_ns, kind, index in recording.events():
        if kind == ODOMETRY:
            i = recording.kept[index]
            told = recording.drive.variances(), recording.drive.reckoned[i]
            state = localizer.add_odometry(stamp_ns, *recording.drive.read[i], *told)
            if state is not None:
                stamps.append(stamp_ns)
                poses.append(state.pose)
        elif recording.pictures[index].shape[1] == SIZE.width:
            localizer.add_panorama(stamp_ns, recording.pictures[index])
    same(fused, Trajectory(np.array(stamps), np.array(poses)))

    # From the bag, in batches; the map is laid on the truth.
    bag = recording.write(tmp_path / 'drive')
    judged = evaluate(PictureReader(), bag, config=config, watch=watch)
    to_truth = fit_transform((judged.truth, seen))
    same(moved(seen, to_truth), judged.estimates['sfa'])
    same(moved(fused, to_truth), judged.estimates['ekf'])
    assert judged.scores['ekf']['p95'] < 0.3


def published(bench, recording, space, nodes):
    """Return what nodes of a namespace publish from the images of a camera."""
    omnicam, sfa, ekf = nodes
    seen = bench.listen(PoseStamped, f'{space}/sfa/pose')
    fused = bench.listen(Odometry, f'{space}/ekf/odometry')
    assert until(lambda: ekf.monitors['sfa/rig'].used == 1)
    inputs = [omnicam.monitors['image_raw'], sfa.monitors['panorama'], ekf.monitors[SEEN]]
    for stamp_ns, kind, index in recording.events():
        monitors = inputs
        if kind == ODOMETRY:
            monitors = [ekf.monitors['odom']]
            topic, message = message_of(recording.drive, 0, recording.kept[index])
        else:
            topic, message = 'image_raw', to_image(recording.pictures[index], stamp_ns, 'omnicam')
        counts = [monitor.received + 1 for monitor in monitors]
        bench.publish(f'{space}/{topic}', message)
        assert until(lambda m=monitors, c=counts: [one.received for one in m] == c)
    last = int(recording.drive.stamps_ns[-1])
    assert until(lambda: fused and read_stamp(fused[-1].header.stamp) == last)
    return trajectory(seen), trajectory(fused)


def test_nodes_of_one_process_publish_the_same_and_hand_panoramas_over(bench, tmp_path):
    (tmp_path / 'own.yaml').write_text(PARAMETERS)
    words = ['--ros-args', '--params-file', str(tmp_path / 'own.yaml')]
    recording, results = Recording(), []
    for space in ('/apart', '/together'):
        options = {'namespace': space, 'cli_args': words}
        kinds = [OmnicamNode, SfaNode, EkfNode]
        if space == '/together':
            made = chain(context=bench.context, **options)
            kinds = [lambda node=node, **_: node for node in made]
        nodes = [bench.run(kind, options=options) for kind in kinds]
        results.append(published(bench, recording, space, nodes))
        count = bench.node.count_subscribers(f'{space}/panorama')
        assert count == (space == '/apart'), 'no message of a panorama is made'
    for apart, together in zip(*results, strict=True):
        assert np.array_equal(apart.stamps_ns, together.stamps_ns)
        assert np.array_equal(apart.poses, together.poses)
