# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages through the Localizer, as they arrive."""

from types import SimpleNamespace

from robustness.faults import Picture, Restart
from robustness.judged import output
from robustness.recorded import model
from sfa_localization.camera.encodings import read_compressed
from sfa_localization.data.errors import MessageError
from sfa_localization.localizer import Localizer, Observer


class Robot:
    """Hears messages, and notes what it makes of each of the odometry."""

    def __init__(self, start_ns):
        self.localizer = Localizer(model())
        self.outputs, self.start_ns = [], start_ns
        self.down = set()

    def hear(self, message):
        """Take the next message."""
        if isinstance(message.content, Restart):
            self.restart(message.content)
        elif isinstance(message.content, Picture):
            self.see(message)
        elif 'ekf_node' not in self.down:
            self.drive(message)

    def see(self, message):
        """Locate and fuse a picture, where nodes are up and it can be decoded."""
        if self.down:
            return
        try:
            image = decoded(message.content)
        except MessageError:
            return
        self.localizer.add_panorama(message.stamp_ns, image)

    def drive(self, message):
        """Take odometry, and note the estimate."""
        wheels, localizer = message.content, self.localizer
        state = localizer.add_odometry(
            message.stamp_ns, *wheels.twist, wheels.variances, wheels.pose
        )
        # Odometry that is rejected gives no output: whoever listens has the last one.
        state = state or localizer.state
        if state is not None:
            self.outputs.append(output(
                (message.at_ns - self.start_ns) * 1e-9, localizer.status,
                state.pose, state.pose_covariance, message.true,
            ))  # fmt: skip

    def restart(self, event):
        """A node ends, or begins anew without memory."""
        if not event.up:
            self.down.add(event.node)
            return
        self.down.discard(event.node)
        if event.node == 'sfa_node':
            self.localizer.observer = Observer(model())
        if event.node == 'ekf_node':
            self.localizer.filter = Localizer(model()).filter


def decoded(picture):
    """The image of a picture. Raises MessageError."""
    if picture.jpeg is None:
        return picture.image
    image = read_compressed(SimpleNamespace(data=picture.jpeg, format='jpeg'))
    if image.shape[:2] != (model().panorama.height, model().panorama.width):
        raise MessageError('another size')
    return image


def replayed(messages, start_ns):
    """Outputs of a robot that hears messages in this order."""
    robot = Robot(start_ns)
    for message in messages:
        robot.hear(message)
    return robot.outputs
