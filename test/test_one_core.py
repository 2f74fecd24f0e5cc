# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Live nodes, `Localizer` and `evaluate` give the same poses, whatever the images are like."""

import numpy as np
import pytest
from picture_readers import SIZE, PictureReader, Recording
from ros_domains import free_domain

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.data.events import ODOMETRY
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import evaluate, fit_transform, moved
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.localizer import Localizer
from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from ros_bench import Bench, until  # noqa: E402

from sfa_localization.data.messages import read_stamp, read_yaw  # noqa: E402
from sfa_localization.nodes.conversions import (  # noqa: E402
    to_image,
    to_odometry,
)
from sfa_localization.nodes.ekf_node import EkfNode  # noqa: E402
from sfa_localization.nodes.sfa_node import SfaNode  # noqa: E402

DOMAIN = free_domain()

SEEN = 'sfa/pose_with_covariance'
# Settings of sfa_node and ekf_node that are not the defaults, and matter here.
WATCH = {'least_explained': 0.3}
FILTER = {'measurement_factor': 2.0}


def message_of(recording, stamp_ns, kind, index):
    """Return topic and message of an event, as a robot sends it."""
    if kind != ODOMETRY:
        return 'panorama', to_image(recording.pictures[index], stamp_ns, 'omnicam')
    drive, i = recording.drive, recording.kept[index]
    spread, frames = np.diag(drive.variances()), ('odom', 'base_link')
    pose = drive.reckoned[i], np.eye(3)
    return 'odom', to_odometry(*pose, drive.read[i], spread, stamp_ns, frames)


def trajectory(messages):
    """Return the poses of Odometry or PoseStamped messages."""
    poses = [m.pose.pose if isinstance(m, Odometry) else m.pose for m in messages]
    return Trajectory(
        np.array([read_stamp(m.header.stamp) for m in messages], np.int64),
        np.array([[p.position.x, p.position.y, read_yaw(p.orientation)] for p in poses]),
    )


def live(recording, monkeypatch):
    """Return what sfa_node and ekf_node publish: poses of pictures, and of the filter."""
    monkeypatch.setattr(PlaceModel, 'load', staticmethod(lambda path: PictureReader()))
    bench = Bench(DOMAIN)
    try:
        sfa = bench.run(SfaNode, model='reader.npz', **WATCH)
        ekf = bench.run(EkfNode, **FILTER)
        assert until(lambda: ekf.monitor('sfa/rig').received == 1)
        seen, fused = bench.listen(PoseStamped, 'sfa/pose'), bench.listen(Odometry, 'ekf/odometry')
        # The latched record of the robot is there before the first picture.
        assert until(lambda: ekf.monitor('sfa/rig').used == 1)
        inputs = [(sfa, 'panorama'), (ekf, SEEN), (ekf, 'odom')]
        for event in recording.events():
            topic, message = message_of(recording, *event)
            shown = topic == 'panorama'
            due = shown, shown and message.width == SIZE.width, not shown
            counts = [n.monitor(t).received + one for (n, t), one in zip(inputs, due, strict=True)]
            bench.publish(topic, message)
            assert until(lambda c=counts: [n.monitor(t).received for n, t in inputs] == c)
        last = int(recording.drive.stamps_ns[-1])
        assert until(lambda: fused and read_stamp(fused[-1].header.stamp) == last)
        return trajectory(seen), trajectory(fused)
    finally:
        bench.close()


def same(one, other):
    assert np.array_equal(one.stamps_ns, other.stamps_ns)
    assert np.allclose(one.poses[:, :2], other.poses[:, :2], rtol=0, atol=1e-9)
    assert np.allclose(np.exp(1j * one.poses[:, 2]), np.exp(1j * other.poses[:, 2]), atol=1e-9)


def test_live_nodes_localizer_and_evaluate_give_the_same_poses(tmp_path, monkeypatch):
    recording = Recording()
    seen, fused = live(recording, monkeypatch)
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
    judged = evaluate(
        PictureReader(), recording.write(tmp_path / 'drive'), config=config, watch=watch
    )
    to_truth = fit_transform((judged.truth, seen))
    same(moved(seen, to_truth), judged.estimates['sfa'])
    same(moved(fused, to_truth), judged.estimates['ekf'])

    # The pictures were what they are meant to be, and the filter knew where it was.
    assert judged.counts['observations']['skipped'] == {
        'image is unlike all training images': 4,
        'image is dark': 2,
        'image is covered: it shows nothing': 1,
        'image repeats the one before': 3,
        'camera is frozen: it repeats its image': 6,
    }
    assert judged.scores['ekf']['p95'] < 0.3
