# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What tests of the omnicam node share: the node, a peer that feeds and hears it, one thread."""

import array
import threading
import time
from unittest import mock

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from sfa_localization.nodes import lifecycle
from sfa_localization.nodes.omnicam_node import OmnicamNode

PATIENCE_S = 60.0
SMALL = {'width': 120, 'height': 12, 'camera_model': 'mirror'}
RELIABLE = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)


def image_message(picture, stamp=(12, 34), frame='camera', encoding='bgr8'):
    message = Image(encoding=encoding)
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.header.frame_id = frame
    message.height, message.width = picture.shape[:2]
    message.step = message.width * (picture.size // (message.height * message.width))
    message.data = array.array('B', picture.tobytes())
    return message


class Bench:
    """A node under test, a node that feeds and hears it, and one thread that spins both."""

    def __init__(self, context, **parameters):
        self.context = context
        overrides = [Parameter(name, value=value) for name, value in (SMALL | parameters).items()]
        self.node = OmnicamNode(context=context, parameter_overrides=overrides)
        self.peer = rclpy.create_node('peer', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        for node in (self.node, self.peer):
            self.executor.add_node(node)
        self.received = {}
        self.spinning = True
        self.thread = threading.Thread(target=self._spin, daemon=True)

    def _spin(self):
        while self.spinning:
            self.executor.spin_once(timeout_sec=0.02)

    def start(self):
        with mock.patch.object(lifecycle, 'DIAGNOSTICS_PERIOD_S', 0.1):  # quicker tests
            self.started = self.node.start()
        self.thread.start()
        return self

    def hear(self, topic, kind=Image):
        self.received[topic] = []
        return self.peer.create_subscription(kind, topic, self.received[topic].append, RELIABLE)

    def speak(self, topic='image_raw', kind=Image):
        publisher = self.peer.create_publisher(kind, topic, RELIABLE)
        self.wait(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def wait(self, condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, 'waited in vain'
            time.sleep(0.005)

    def wait_for(self, topic, count=1):
        self.wait(lambda: len(self.received[topic]) >= count)
        return self.received[topic][-1]

    def set(self, **values):
        changes = [Parameter(name, value=value) for name, value in values.items()]
        return self.node.set_parameters_atomically(changes)

    def close(self):
        self.spinning = False
        if self.thread.is_alive():
            self.thread.join(PATIENCE_S)
        self.executor.shutdown()
        for node in (self.node, self.peer):
            node.destroy_node()


def pixels(message):
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)


def send_until(bench, publisher, message, topic='panorama', more=1):
    """Send again until something is heard: the input is best effort."""
    goal = len(bench.received[topic]) + more
    deadline = time.monotonic() + PATIENCE_S
    while len(bench.received[topic]) < goal:
        assert time.monotonic() < deadline, 'waited in vain'
        publisher.publish(message)
        time.sleep(0.02)
    return bench.received[topic][-1]


def new_context(domain_id, arguments=()):
    context = rclpy.Context()
    rclpy.init(
        args=list(arguments),
        context=context,
        domain_id=domain_id,
        signal_handler_options=rclpy.signals.SignalHandlerOptions.NO,
    )
    return context
