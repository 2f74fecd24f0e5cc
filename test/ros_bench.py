# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A bench for nodes under test: its own context and domain, an executor in a thread, deadlines.

And the nodes as processes in the same domain, and the messages of a drive.
"""

import contextlib
import gc
import json
import os
import subprocess
import sys
import threading
import time
from unittest import mock

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from ros_domains import free_domain
from std_msgs.msg import String

from sfa_localization.data.messages import read_planar, read_stamp
from sfa_localization.nodes import lifecycle
from sfa_localization.nodes.conversions import to_odometry, to_pose_with_covariance

DOMAIN = free_domain()
SEEN, FRAMES = 'sfa/pose_with_covariance', ('odom', 'base_link')
DEADLINE_S = 60.0  # passed only where something is wrong: busy machines take their time


def until(condition, deadline_s=DEADLINE_S):
    """Wait for a condition, at most until the deadline; returns whether it came true."""
    end = time.monotonic() + deadline_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)
    return bool(condition())


def listeners(node, topic):
    """How many subscriptions a node's publisher of a topic is connected to."""
    resolved = node.resolve_topic_name(topic)
    made = [each for each in node.publishers if each.topic_name == resolved]
    return sum(each.get_subscription_count() for each in made)


def start_process(*words, **options):
    """A process of this interpreter, in the domain of the bench."""
    environment = {
        **os.environ,
        'ROS_DOMAIN_ID': str(DOMAIN),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'OMP_NUM_THREADS': '1',
        'PYTHONPATH': os.pathsep.join(sys.path),
    }
    return subprocess.Popen([sys.executable, *map(str, words)], env=environment, **options)


def end_node(node):
    """End a node as `run_nodes` does."""
    node.teardown()
    node.destroy_node()


def standing(stamp_ns):
    """Odometry of a robot that stands."""
    return to_odometry(np.zeros(3), np.eye(3), np.zeros(2), np.eye(2) * 1e-4, stamp_ns, FRAMES)


class AsText(String):
    """Stands in for tf2_msgs, which the wheels of ROS lack: [stamp, pose] of transforms as text."""

    def __new__(cls, transforms):
        sent = [
            (read_stamp(t.header.stamp), read_planar(t.transform.translation, t.transform.rotation))
            for t in transforms
        ]
        return serialize_message(String(data=json.dumps(sent)))


def message_of(drive, kind, index):
    """Topic and message of an event of a FilterDrive, as ekf_node receives it."""
    if kind:
        stamp_ns = int(drive.stamps_ns[drive.pictures[index]])
        seen = drive.seen[index], drive.covariance(heading=True)
        return SEEN, to_pose_with_covariance(*seen, stamp_ns, 'map')
    twist = drive.read[index], np.diag(drive.variances())
    pose, stamp_ns = (drive.reckoned[index], np.eye(3)), int(drive.stamps_ns[index])
    return 'odom', to_odometry(*pose, *twist, stamp_ns, FRAMES)


def play(bench, node, drive, events=None, together=1):
    """Send events of a FilterDrive to ekf_node, waiting after every `together` until they are
    received: one at a time, the order between the topics is then the drive's.
    """
    events = drive.events() if events is None else events
    inputs = node.monitors['odom'], node.monitors[SEEN]
    due = [monitor.received for monitor in inputs]
    for number, (_, kind, index) in enumerate(events, 1):
        bench.publish(*message_of(drive, kind, index))
        due[kind] += 1
        if number % together == 0 or number == len(events):
            assert until(lambda: [monitor.received for monitor in inputs] == due), due
    return events


class Spinner(SingleThreadedExecutor):
    """Spins in a thread of its own, and ends that first: rclpy destroys what it may wait for."""

    def __init__(self, context):
        super().__init__(context=context)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        with contextlib.suppress(ExternalShutdownException):
            while not self._over.is_set():
                self.spin_once()

    def shutdown(self, timeout_sec=DEADLINE_S):
        self.create_task(self._over.set)
        self._thread.join(timeout_sec)
        return super().shutdown(timeout_sec)


class Bench:
    """Runs nodes, publishes to them and records what they publish."""

    def __init__(self, domain_id=DOMAIN):
        self.context = rclpy.Context()
        rclpy.init(
            context=self.context,
            domain_id=domain_id,
            signal_handler_options=rclpy.signals.SignalHandlerOptions.NO,
        )
        self.executor = Spinner(self.context)
        self.node = rclpy.create_node('bench', context=self.context)
        self.nodes, self.heard, self._publishers = [], {}, {}
        self.executor.add_node(self.node)

    def run(self, kind, start=True, *, options=None, **overrides):
        values = [Parameter(name, value=value) for name, value in overrides.items()]
        node = kind(context=self.context, parameter_overrides=values, **(options or {}))
        self.nodes.append(node)
        if start:
            with mock.patch.object(lifecycle, 'DIAGNOSTICS_PERIOD_S', 0.1):  # quicker tests
                assert node.start(), node.failure
        self.executor.add_node(node)
        return node

    def end(self, node):
        """End a node between two callbacks, as its own process would."""
        self.executor.remove_node(node)
        self.nodes.remove(node)
        self.do(end_node, node)

    def do(self, call, *arguments):
        """Call between two callbacks: the executor must not wait for what this destroys."""
        assert until(self.executor.create_task(call, *arguments).done)

    def listen(self, kind, topic, qos=None):
        heard = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, topic, heard.append, qos or QoSProfile(depth=1000))
        assert until(lambda: self.node.count_publishers(topic) > 0), f'nobody publishes {topic}'
        return heard

    def publish(self, topic, message, qos=None):
        if topic not in self._publishers:
            publisher = self.node.create_publisher(type(message), topic, qos or 1000)
            self._publishers[topic] = publisher
            assert until(lambda: publisher.get_subscription_count() > 0), f'nobody hears {topic}'
            # The subscription knows the publisher a moment later; best effort, it would miss one.
            time.sleep(0.1)
        self._publishers[topic].publish(message)

    def forget(self, topic):
        """Publish on it no more; a node that is configured again is waited for again."""
        self.do(self.node.destroy_publisher, self._publishers.pop(topic))

    def publish_until(self, topic, message, condition):
        """Again and again: what is best effort may be lost."""
        self.publish(topic, message)
        return until(lambda: until(condition, 0.1) or self.publish(topic, message))

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(DEADLINE_S), f'no service {name}'
        future = client.call_async(request)
        assert until(future.done)
        return future.result()

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            end_node(node)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self.nodes.clear()
        gc.collect()  # rclpy's state machines keep nodes, which must not end while others start
