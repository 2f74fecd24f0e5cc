# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The sample drives, taught and localized in through DDS."""

from nav_msgs.msg import Odometry
from page_tables import ROOT
from rclpy.serialization import deserialize_message
from ros_bench import SEEN, until
from sensor_msgs.msg import CompressedImage, Imu

from sfa_localization.bags.reader import Bag
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode
from sfa_localization.nodes.teach_node import TeachNode

KINDS = {'/odom': Odometry, '/imu': Imu, '/panorama_raw/compressed': CompressedImage}
SAMPLE = ROOT / 'bags/sample'
TEST = ROOT / 'bags/sample_test'


def records(path, *topics):
    """Topic, type, bytes and time of the messages of a bag."""
    with Bag(path) as bag:
        assert bag.problems == []
        return [
            (topic.name, topic.kind, bytes(data), at_ns)
            for topic, at_ns, data in bag.recording.messages(topics or [*bag.topics])
        ]


def start_teaching(bench, model):
    """teach_node, which looks as often as it can."""
    return bench.run(TeachNode, output=str(model), share=1.0, localize=True)


def start_chain(bench, model):
    """The three nodes, which wait for a model."""
    images = ['--ros-args', '-r', 'image_raw/compressed:=/panorama_raw/compressed']
    waiting = {'autostart': False}
    given = {'image_transport': 'compressed', 'model': str(model), **waiting}
    return [
        bench.run(OmnicamNode, options={'cli_args': images}, **given),
        bench.run(SfaNode, model=str(model), **waiting),
        bench.run(EkfNode, **waiting),
    ]


def as_sent(topic, data):
    """The topic and the message of a record, as a camera publishes its panoramas."""
    topic = '/panorama_raw/compressed' if topic.startswith('/panorama') else topic
    return topic, deserialize_message(data, KINDS[topic])


def driver(bench, counted):
    """Sends recorded messages through DDS, as fast as they are counted."""
    create = bench.node.create_publisher
    topics = {topic: create(kind, topic, 1000) for topic, kind in KINDS.items()}
    assert until(lambda: all(each.get_subscription_count() for each in topics.values()))

    def drive(messages):
        before = counted()
        for number, (recorded, _, data, _) in enumerate(messages, before + 1):
            topic, message = as_sent(recorded, data)
            topics[topic].publish(message)
            assert until(lambda: counted() > number - 40)  # noqa: B023
        assert until(lambda: counted() == before + len(messages))

    return drive


def passed_on(bench, chain):
    """Sends the messages of the test drive, and yields each when it came through the chain."""
    sent = {each.topic_name: each for each in bench.node.publishers}
    omnicam, sfa, ekf = (node.monitors for node in chain)
    through = {
        '/odom': [ekf['odom']],
        '/panorama_raw/compressed': [omnicam['image_raw/compressed'], sfa['panorama'], ekf[SEEN]],
    }
    for recorded, _, data, _ in records(TEST, '/odom', '/panorama/compressed'):
        topic, message = as_sent(recorded, data)
        due = [monitor.received + 1 for monitor in through[topic]]
        sent[topic].publish(message)
        assert until(lambda: [each.received for each in through[topic]] == due)  # noqa: B023
        yield message
