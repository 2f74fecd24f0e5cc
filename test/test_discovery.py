# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs that are named otherwise are found by their type, where there is no choice to make."""

import numpy as np
import pytest
from picture_readers import PictureReader
from ros_domains import free_domain

from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from nav_msgs.msg import Odometry  # noqa: E402
from ros_bench import Bench, until  # noqa: E402
from sensor_msgs.msg import CompressedImage, Image  # noqa: E402

from sfa_localization.nodes import discovery  # noqa: E402
from sfa_localization.nodes.conversions import to_image, to_odometry  # noqa: E402
from sfa_localization.nodes.ekf_node import EkfNode  # noqa: E402
from sfa_localization.nodes.omnicam_node import OmnicamNode  # noqa: E402
from sfa_localization.nodes.sfa_node import SfaNode  # noqa: E402

DOMAIN = free_domain()


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(discovery, 'PATIENCE_S', 0.0)
    made = Bench(DOMAIN)
    yield made
    made.close()


def driving(stamp_ns):
    return to_odometry(
        np.zeros(3), np.eye(3), (0.0, 0.0), np.eye(2), stamp_ns, ('odom', 'base_link')
    )


def heard(bench, node, topic, message, stamps=range(1, 400)):
    """Publish until the node has used something as its input `topic`."""
    publisher = bench.node.create_publisher(type(message(1)), topic, 10)
    moving = iter(stamps)

    def used():
        publisher.publish(message(next(moving) * 50_000_000))
        return bool(until(lambda: used_of(node), 0.1))

    return until(used)


def used_of(node):
    return sum(monitor.used for name, monitor in node.monitors.items() if 'timer' not in name)


def takes_another(node, topic):
    node._discovery.look()
    return node.shown(topic) != node.resolve_topic_name(topic)


def test_odometry_of_another_name_is_found(bench):
    node = bench.run(EkfNode)
    assert heard(bench, node, '/wheel_odometry', driving)
    assert node.shown('odom') == '/wheel_odometry', 'diagnostics name the topic that is used'
    bench.node.create_publisher(Odometry, '/odom', 10)
    assert until(lambda: node.shown('odom') == '/odom'), 'its own name comes first'


def test_images_of_another_name_are_found(bench):
    node = bench.run(OmnicamNode)
    bench.listen(Image, 'panorama')
    picture = np.full((60, 600, 3), 90, np.uint8)
    assert heard(bench, node, '/camera/image', lambda stamp: to_image(picture, stamp, 'camera'))


@pytest.mark.parametrize(
    ('others', 'arguments'),
    [
        (['/one', '/two'], []),
        (['/one', '/odom'], []),
        (['/one'], ['--ros-args', '-r', 'odom:=/mine']),
        (['/robot2/wheels'], ['--ros-args', '-r', '__ns:=/robot1']),
    ],
)
def test_where_there_is_a_choice_it_is_not_made(bench, others, arguments):
    publishers = [bench.node.create_publisher(Odometry, name, 10) for name in others]
    node = bench.run(EkfNode, options={'cli_args': arguments})
    assert until(lambda: all(node.count_publishers(name) for name in others))
    assert not takes_another(node, 'odom')
    assert len(publishers) == len(others)


@pytest.mark.parametrize(
    ('kind', 'robot', 'there', 'remedy'),
    [
        (OmnicamNode, '/robot1', ['/robot1/panorama'], 'image:=NAME or panorama:=NAME'),
        # The driver is in the namespace, or its topic alone, because a bridge has none.
        (EkfNode, '/robot1', ['/robot1/ekf/odometry', '/robot1/wheels'], 'odom:=NAME'),
        # Played from a bag, of another namespace, and of the node's own.
        (OmnicamNode, '', ['/panorama'], 'image:=NAME or panorama:=NAME'),
        (OmnicamNode, '', ['/robot1/panorama'], 'image:=NAME or panorama:=NAME'),
    ],
)
def test_the_output_of_another_localizer_is_no_sensor(bench, kind, robot, there, remedy):
    if robot:
        bench.run(kind, options={'namespace': robot})
    message = Odometry if kind is EkfNode else Image
    publishers = [bench.node.create_publisher(message, name, 10) for name in there]
    node = bench.run(kind)
    topic = 'odom' if kind is EkfNode else 'image_raw'
    assert until(lambda: takes_another(node, topic) or all(map(hint_of(node).count, there)))
    assert not takes_another(node, topic)
    assert remedy in hint_of(node) and '-r ' not in hint_of(node)
    assert len(publishers) == len(there)


def hint_of(node):
    return node._discovery.hint


@pytest.mark.parametrize(('kind', 'settings'), [
    (OmnicamNode, {'silence_timeout': 0.05, 'image_transport': 'compressed'}),
    (SfaNode, {'model': 'a.npz'}),
])  # fmt: skip
def test_without_images_the_diagnostics_name_those_that_there_are(
    bench, monkeypatch, kind, settings
):
    """Of both types: another `image_transport` may be all that is wrong."""
    monkeypatch.setattr(PlaceModel, 'load', staticmethod(lambda path: PictureReader()))
    there = {'/a': Image, '/b': Image, '/a/packed': CompressedImage, '/b/packed': CompressedImage}
    publishers = [bench.node.create_publisher(made, name, 1) for name, made in there.items()]
    node = bench.run(kind, **settings)
    bench.node.create_subscription(Image, 'panorama', lambda _: None, 1)
    words = [f'{name} (sensor_msgs/msg/{made.__name__})' for name, made in there.items()]
    assert until(lambda: all(word in node.health()[1] for word in words))
    assert len(publishers) == 4


def test_what_has_been_heard_stays(bench):
    bench.node.create_publisher(Odometry, '/wheels', 10)
    node = bench.run(EkfNode)
    assert until(lambda: node.count_publishers('/wheels'))
    node.monitor('odom').receive()
    assert not takes_another(node, 'odom')
