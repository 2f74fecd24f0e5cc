# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Two robots in one domain: two whole chains, in namespaces, with one parameter file."""

import json

import numpy as np
import pytest
from picture_readers import SIZE, PictureReader, panorama

from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from ros_bench import until
from std_msgs.msg import String
from transform_buffer import AsText

from sfa_localization.data.messages import read_planar
from sfa_localization.nodes import ekf_node
from sfa_localization.nodes.conversions import to_image, to_odometry
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode

pytestmark = pytest.mark.ros
START_NS = 1_700_000_000_000_000_000
PLACES = {'robot1': (3.0, 4.0, 0.5), 'robot2': (20.0, 11.0, -1.0)}
PARAMETERS = f"""
/**/omnicam_node:
  ros__parameters: {{camera_model: panorama, width: {SIZE.width}, height: {SIZE.height}}}
/**:
  ros__parameters: {{model: model.npz}}
/robot1/ekf_node:
  ros__parameters: {{lost_std: 1.5}}
robot2:
  ekf_node:
    ros__parameters: {{lost_std: 1.8}}
"""


@pytest.fixture
def robots(bench, tmp_path, monkeypatch):
    """Return the nodes of each robot."""
    monkeypatch.setattr(PlaceModel, 'load', staticmethod(lambda path: PictureReader()))
    monkeypatch.setattr(ekf_node, 'TFMessage', AsText)
    path = tmp_path / 'robots.yaml'
    path.write_text(PARAMETERS)
    arguments = ['--ros-args', '--params-file', str(path), '-r', '/tf:=tf']
    return {
        name: [
            bench.run(kind, options={'namespace': name, 'cli_args': arguments})
            for kind in (OmnicamNode, SfaNode, EkfNode)
        ]
        for name in PLACES
    }


def drive(bench, done):
    """Send both robots' images and odometry in turns, until something is so."""
    frames, spread, zero = ('odom', 'base_link'), np.eye(2) * 1e-4, np.zeros(3)
    for step in range(1, 1200):
        stamp_ns = START_NS + step * 50_000_000
        standing = to_odometry(zero, np.eye(3), zero[:2], spread, stamp_ns, frames)
        for name, place in PLACES.items():
            bench.publish(f'/{name}/odom', standing)
            image = to_image(panorama(place, seed=step), stamp_ns, 'omnicam')
            bench.publish(f'/{name}/image_raw', image)
        if until(done, 0.05):
            return True
    return False


def test_two_robots_side_by_side_locate_themselves_apart(bench, robots):
    """Images and odometry alternate in one domain; no message of one reaches the other."""
    fused = {name: bench.listen(Odometry, f'/{name}/ekf/odometry') for name in PLACES}
    moved = {name: bench.listen(String, f'/{name}/tf') for name in PLACES}
    told = bench.listen(DiagnosticArray, '/diagnostics')

    def located():
        return all(
            moved[name] and fused[name] and np.allclose(pose_of(fused[name][-1]), place, atol=0.1)
            for name, place in PLACES.items()
        )

    assert drive(bench, located)
    limits = {name: nodes[2].get_parameter('lost_std').value for name, nodes in robots.items()}
    assert limits == {'robot1': 1.5, 'robot2': 1.8}, 'each has its own section of the file'
    for name, place in PLACES.items():
        # The odometry stands at its origin: the transform is the place in the map.
        sent = [pose[:2] for message in [*moved[name]] for _, pose in json.loads(message.data)]
        assert np.allclose(sent, place[:2], atol=0.5)
    assert bench.node.count_publishers('/tf') == 0
    monitors = [m for nodes in robots.values() for node in nodes for m in node.monitors.values()]
    assert not any('internal error' in reason for m in monitors for reason in m.refused)
    for k, topic in ((2, 'odom'), (0, 'image_raw')):
        one, other = (nodes[k].monitors[topic].received for nodes in robots.values())
        assert abs(one - other) <= 3, 'one robot hears the other'
    statuses = {s.name: {v.key for v in s.values} for m in [*told] for s in m.status}
    nodes = 'omnicam_node', 'sfa_node', 'ekf_node'
    assert set(statuses) == {f'{name}/{node}: status' for name in PLACES for node in nodes}
    assert '/robot1/odom: received' in statuses['robot1/ekf_node: status']
    assert '/robot2/panorama: received' in statuses['robot2/sfa_node: status']


def pose_of(message):
    return read_planar(message.pose.pose.position, message.pose.pose.orientation)
