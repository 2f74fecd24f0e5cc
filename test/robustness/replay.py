# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Messages through the Localizer, as they arrive."""

import numpy as np

from robustness.judged import output
from robustness.messages import Picture, Reading, Restart
from robustness.recorded import model, to_truth
from sfa_localization.camera.encodings import decode_compressed
from sfa_localization.data.errors import CameraError, ModelError
from sfa_localization.localizer import Localizer
from sfa_localization.observer import Observation, Observer


class Robot:
    """Hears messages, and notes what it makes of each of the odometry."""

    def __init__(self, start_ns, model, transform):
        self.start_ns, self.model, self.transform = start_ns, model, transform
        self.localizer = Localizer(model)
        self.outputs, self.down = [], set()

    def hear(self, message):
        """Take the next message."""
        if isinstance(message.content, Restart):
            self.restart(message.content)
        elif isinstance(message.content, Picture):
            self.see(message)
        elif not isinstance(message.content, Reading):
            self.fuse(message, message.content)
        elif 'ekf_node' not in self.down:
            self.drive(message)

    def see(self, message):
        """Locate and fuse a picture, where nodes are up and it can be decoded."""
        picture = message.content
        if self.down:
            return
        try:
            image = picture.image
            if picture.jpeg is not None:
                image = decode_compressed(picture.jpeg)
            seen = self.localizer.observer.observe(message.stamp_ns, image)
        except (CameraError, ModelError):
            return
        self.fuse(message, seen)

    def fuse(self, message, seen):
        """Take what an image shows."""
        features, at = np.zeros(1), message.stamp_ns
        self.localizer.add_observation(
            Observation(seen.pose, seen.covariance, features, stamp_ns=at, turned=seen.turned)
        )

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
                state.pose, state.pose_covariance, message.true, self.transform,
            ))  # fmt: skip

    def restart(self, event):
        """A node ends, or begins anew without memory."""
        if not event.up:
            self.down.add(event.node)
            return
        self.down.discard(event.node)
        if event.node == 'sfa_node':
            self.localizer.observer = Observer(self.model)
        if event.node == 'ekf_node':
            self.localizer.filter = Localizer(self.model).filter


def replayed(messages, start_ns, place=None, transform=None):
    """Outputs of a robot that hears messages in this order; its model is that of the sample, and
    the transform leads to the truth there.
    """
    robot = Robot(start_ns, place or model(), transform or to_truth())
    for message in messages:
        robot.hear(message)
    return robot.outputs
