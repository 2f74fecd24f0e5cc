# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages through the three nodes, as fast as they follow; nodes end and come back on the way.

Each message is sent when the one before has had its effect. Seconds are those of the drive, so
timeouts by the wall clock have no part in this.
"""

import time

import cv2
import numpy as np
from ros_bench import Bench, listeners, until

from robustness.faults import NODES
from robustness.judged import output
from robustness.messages import Reading, Restart
from robustness.recorded import model_path, to_truth
from sfa_localization.data.messages import read_stamp, read_yaw
from sfa_localization.nodes.conversions import to_odometry, to_stamp
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode
from sfa_localization.place_model import PlaceModel

from nav_msgs.msg import Odometry  # isort: skip
from sensor_msgs.msg import CompressedImage  # isort: skip
from ros_domains import free_domain

SEEN, ODOM, PANORAMA = 'sfa/pose_with_covariance', 'odom', 'panorama'
RAW = 'image_raw/compressed'
KINDS = dict(zip(NODES, (OmnicamNode, SfaNode, EkfNode), strict=True))
DOMAIN = free_domain()
"""Of ROS, for these nodes alone."""
PATIENCE_S = 3.0
"""What takes longer was lost on its way, or is not answered: no message needs a tenth of it."""
_POLL_S = 2e-4
_PLANAR = (0, 1, 5)


class Chain:
    """The three nodes, and what is said to them and heard from them."""

    def __init__(self, domain, start_ns):
        self.bench, self.start_ns = Bench(domain), start_ns
        size = PlaceModel.load(model_path()).panorama
        self.parameters = {
            'omnicam_node': {
                'camera_model': 'panorama', 'image_transport': 'compressed',
                'width': size.width, 'height': size.height,
            },
            'sfa_node': {'model': str(model_path())},
            'ekf_node': {},
        }  # fmt: skip
        self.nodes, self.outputs, self.last = {}, [], None
        make = self.bench.node.create_publisher
        self.pictures, self.wheels = make(CompressedImage, RAW, 10), make(Odometry, ODOM, 1000)
        for name in NODES:
            self.start(name)
        self.bench.node.create_subscription(Odometry, 'ekf/odometry', self.hear, 1000)
        assert until(lambda: listeners(self.nodes['ekf_node'], 'ekf/odometry') == 1)

    def hear(self, message):
        self.last = message

    def start(self, name):
        """Start a node, and wait until it is connected to the others that run."""
        self.nodes[name] = self.bench.run(KINDS[name], **self.parameters[name])
        if len(self.nodes) == len(NODES):
            assert until(self.connected)

    def end(self, name):
        """End a node without a word to the others."""
        node = self.nodes.pop(name)
        self.last = None if name == 'ekf_node' else self.last
        self.bench.end(node)

    def connected(self):
        """Whether what one sends reaches the next, also the latched correlation of errors."""
        ekf = self.nodes['ekf_node']
        return (
            self.pictures.get_subscription_count() == self.wheels.get_subscription_count() == 1
            and listeners(self.nodes['omnicam_node'], PANORAMA) == 1
            and listeners(self.nodes['sfa_node'], SEEN) == 1
            and listeners(self.nodes['sfa_node'], 'sfa/turned') == 1
            and ekf.monitors['sfa/rig'].used > 0
        )

    def take(self, message):
        """Send a message, and wait for its effect."""
        if isinstance(message.content, Restart):
            (self.start if message.content.up else self.end)(message.content.node)
        elif isinstance(message.content, Reading):
            self.drive(message)
        elif len(self.nodes) == len(NODES):
            self.see(message)

    def see(self, message):
        """Send a picture down the chain, as far as it gets."""
        steps = [(self.nodes['omnicam_node'], RAW), (self.nodes['sfa_node'], PANORAMA)]
        before = [done(*step) for step in (*steps, (self.nodes['ekf_node'], SEEN))]
        self.pictures.publish(picture_message(message))
        for (node, topic), (used, handled) in zip(steps, before, strict=False):
            if not self.wait(lambda n=node, t=topic, h=handled: done(n, t)[1] > h):
                return
            if node is steps[0][0] and done(node, topic)[0] == used:
                return
        self.wait(lambda: done(self.nodes['ekf_node'], SEEN)[1] > before[2][1])

    def drive(self, message):
        """Send odometry, and note the answer."""
        ekf, wheels = self.nodes.get('ekf_node'), message.content
        if ekf is None:
            return
        used, handled = done(ekf, ODOM)
        self.wheels.publish(to_odometry(
            wheels.pose, np.eye(3) * 1e-4, wheels.twist, np.diag(wheels.variances),
            message.stamp_ns, ('odom', 'base_link'),
        ))  # fmt: skip
        if not self.wait(lambda: done(ekf, ODOM)[1] > handled):
            return
        if done(ekf, ODOM)[0] > used and ekf.filter.state is not None:
            self.wait(lambda: self.last and read_stamp(self.last.header.stamp) == message.stamp_ns)
        self.note(message, ekf)

    def note(self, message, ekf):
        """Compare what was heard last with the truth."""
        if self.last is None:
            return
        pose, covariance = self.last.pose.pose, np.reshape(self.last.pose.covariance, (6, 6))
        place = [pose.position.x, pose.position.y, read_yaw(pose.orientation)]
        second = (message.at_ns - self.start_ns) * 1e-9
        spread = covariance[np.ix_(_PLANAR, _PLANAR)]
        status = ekf.status()
        self.outputs.append(output(second, status, place, spread, message.true, to_truth()))

    def wait(self, condition):
        """Wait for a moment: whether it happens."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > end:
                return False
            time.sleep(_POLL_S)
        return True


def done(node, topic):
    """Messages that a node has used, and all that it has finished."""
    monitor = node.monitors[topic]
    return monitor.used, monitor.used + sum(dict(monitor.refused).values())


def picture_message(message):
    """A picture without loss, or the JPEG that it is."""
    data, form = message.content.jpeg, 'jpeg'
    if data is None:
        data, form = cv2.imencode('.png', message.content.image)[1].tobytes(), 'png'
    made = CompressedImage(format=form)
    made.header.stamp, made.header.frame_id = to_stamp(message.stamp_ns), 'omnicam'
    made.data = data
    return made


def played(messages, start_ns, domain=DOMAIN):
    """Outputs of the nodes that hear messages in this order."""
    return heard(Chain, messages, start_ns, domain).outputs


def heard(kind, messages, start_ns, domain=DOMAIN):
    """A chain of this kind after these messages, ended."""
    to_truth()  # computed once, and not while nodes wait
    chain = kind(domain, start_ns)
    try:
        for message in messages:
            chain.take(message)
        return chain
    finally:
        chain.bench.close()
