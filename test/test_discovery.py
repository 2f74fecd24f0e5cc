# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs that are named otherwise are found by their type, where there is no choice to make."""

import numpy as np
import pytest
from picture_readers import load_pictures

pytest.importorskip('rclpy')

from nav_msgs.msg import Odometry
from ros_bench import standing, until
from sensor_msgs.msg import CompressedImage, Image, Imu

from sfa_localization.nodes import discovery, lifecycle
from sfa_localization.nodes.conversions import to_compressed, to_image
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode

pytestmark = pytest.mark.ros
STAMP_NS = 10**9


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(discovery, 'PATIENCE_S', 0.0)


@pytest.mark.parametrize(('topic', 'given'), [
    ('/cam/image_raw', ''), ('/mine', '/mine'), ('/mine', '/mine/compressed'),
])  # fmt: skip
def test_images_of_another_transport_are_taken(bench, topic, given):
    """Many cameras publish compressed images only."""
    words = ['--ros-args', '-r', f'image_raw:={given}'] if given else []
    node = bench.run(OmnicamNode, options={'cli_args': words})
    heard = bench.listen(Image, 'panorama')
    message = to_compressed(np.full((60, 600, 3), 90, np.uint8), STAMP_NS, 'camera', 90)
    assert bench.publish_until(f'{topic}/compressed', message, lambda: heard)
    assert node.full_name('image_raw') == f'{topic}/compressed'


def test_depth_is_no_image(bench):
    node = bench.run(OmnicamNode)
    announce(bench, node, CompressedImage, '/cam/depth/compressedDepth')
    assert not takes_another(node, 'image_raw')


def test_the_only_imu_is_taken(bench):
    node = bench.run(OmnicamNode, level_by_imu=True)
    announce(bench, node, Imu, '/imu')
    assert until(lambda: node.full_name('imu/data') == '/imu')


def test_another_node_that_publishes_the_same_is_named(bench, monkeypatch):
    monkeypatch.setattr(lifecycle, 'TWIN_S', 0.0)
    first = bench.run(EkfNode)
    assert first.twin == ''
    second = bench.run(EkfNode)
    for node in (first, second):
        assert until(lambda n=node: 'another node of this name publishes on' in n.twin)
        assert node.twin in node.status().reasons and node.twin in node.health()[1]
    bench.end(second)
    assert until(lambda: first.twin == '')


def announce(bench, node, kind, *names):
    """Publishers of these topics, which the node knows of."""
    for name in names:
        bench.node.create_publisher(kind, name, 10)
    assert until(lambda: all(node.count_publishers(name) for name in names))


def takes_another(node, topic):
    node.discovery.look()
    return node.full_name(topic) != node.resolve_topic_name(topic)


def test_inputs_of_another_name_are_taken(bench):
    node = bench.run(EkfNode)
    used = node.monitors['odom']
    assert bench.publish_until('/wheel_odometry', standing(STAMP_NS), lambda: used.received)
    assert node.full_name('odom') == '/wheel_odometry', 'diagnostics name the topic that is used'
    announce(bench, node, Odometry, '/odom')
    assert until(lambda: node.full_name('odom') == '/odom'), 'its own name comes first'
    node = bench.run(OmnicamNode)
    heard = bench.listen(Image, 'panorama')
    message = to_image(np.full((60, 600, 3), 90, np.uint8), STAMP_NS, 'camera')
    assert bench.publish_until('/camera/image', message, lambda: heard)
    assert node.full_name('image_raw') == '/camera/image'


@pytest.mark.parametrize(('others', 'rule'), [
    (['/a', '/b'], ''), (['/a', '/odom'], ''), (['/a'], 'odom:=/mine'),
    (['/robot2/wheels'], '__ns:=/robot1'),
])  # fmt: skip
def test_where_there_is_a_choice_it_is_not_made(bench, others, rule):
    """Nor where the topic has been heard."""
    node = bench.run(EkfNode, options={'cli_args': ['--ros-args', '-r', rule] if rule else []})
    announce(bench, node, Odometry, *others)
    assert not takes_another(node, 'odom')


def test_a_topic_that_has_been_heard_is_kept(bench):
    node = bench.run(EkfNode)
    node.monitors['odom'].receive()
    announce(bench, node, Odometry, '/wheels')
    assert not takes_another(node, 'odom')


IMAGES = 'image:=NAME or panorama:=NAME'
OTHER_NAME = ['--ros-args', '-r', 'ekf/odometry:=/fused', '-r', '__ns:=/robot1']


@pytest.mark.parametrize(('kind', 'other', 'topics', 'arguments'), [
    # The driver is in the namespace, or its topic alone, because a bridge has none.
    (EkfNode, {'namespace': '/robot1'}, ['/robot1/wheels'], 'odom:=NAME'),
    (EkfNode, {'namespace': '/robot1'}, ['/robot1/ekf/odometry'], ''),
    (EkfNode, {'cli_args': OTHER_NAME}, ['/fused'], ''),
    (OmnicamNode, {'namespace': '/robot1'}, ['/robot1/panorama'], IMAGES),
    # Played from a bag of another namespace.
    (OmnicamNode, None, ['/robot1/panorama'], IMAGES),
])  # fmt: skip
def test_the_output_of_another_localizer_is_no_sensor(bench, kind, other, topics, arguments):
    if other:
        bench.run(kind, options=other)
    node = bench.run(kind)
    message, topic = (Odometry, 'odom') if kind is EkfNode else (Image, 'image_raw')
    if topics == ['/fused']:
        assert until(lambda: node.count_publishers('/fused'))
    else:
        announce(bench, node, message, *topics)
    assert not takes_another(node, topic)
    hint = node.discovery.hint
    if not arguments:
        assert hint == '', 'nor is it offered as one'
        return
    assert all(name in hint for name in topics) and hint.endswith(f': {arguments}')
    assert 'ekf/odometry' not in hint


def test_without_images_the_diagnostics_name_those_that_there_are(bench, monkeypatch):
    """Of both types: another `image_transport` may be all that is wrong."""
    load_pictures(monkeypatch)
    both = ((Image, '/a'), (Image, '/b'), (CompressedImage, '/c'), (CompressedImage, '/d'))
    for kind, name in both:
        bench.node.create_publisher(kind, name, 10)
    bench.node.create_subscription(Image, 'panorama', lambda _: None, 1)
    words = [f'/{name} (sensor_msgs/msg/Image)' for name in 'ab']
    words += [f'/{name} (sensor_msgs/msg/CompressedImage)' for name in 'cd']
    camera = {'silence_timeout': 0.05, 'image_transport': 'compressed'}
    for kind, settings in ((SfaNode, {'model': 'a.npz'}), (OmnicamNode, camera)):
        node = bench.run(kind, **settings)
        assert until(lambda n=node: all(word in n.health()[1] for word in words)), node.health()
