# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Two robots in one domain: two whole chains, in namespaces, with one parameter file."""

import json

import numpy as np
import pytest
from picture_readers import SIZE, PictureReader, panorama
from ros_domains import free_domain

from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from ros_bench import Bench, until  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from sfa_localization.data.messages import read_planar  # noqa: E402
from sfa_localization.nodes import ekf_node  # noqa: E402
from sfa_localization.nodes.conversions import to_image, to_odometry  # noqa: E402
from sfa_localization.nodes.ekf_node import EkfNode  # noqa: E402
from sfa_localization.nodes.omnicam_node import OmnicamNode  # noqa: E402
from sfa_localization.nodes.sfa_node import SfaNode  # noqa: E402

DOMAIN = free_domain()

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


class Broadcast(String):
    """Stands in for tf2_msgs, which the wheels of ROS lack: the transforms travel as text."""

    def __new__(cls, transforms):
        moves = [(t.transform.translation.x, t.transform.translation.y) for t in transforms]
        return serialize_message(String(data=json.dumps(moves)))


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(PlaceModel, 'load', staticmethod(lambda path: PictureReader()))
    monkeypatch.setattr(ekf_node, 'TFMessage', Broadcast)
    made = Bench(DOMAIN)
    yield made
    made.close()


@pytest.fixture
def robots(bench, tmp_path):
    """Return the nodes of each robot."""
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


def standing(stamp_ns):
    frames, spread = ('odom', 'base_link'), np.eye(2) * 1e-4
    return to_odometry(np.zeros(3), np.eye(3), np.zeros(2), spread, stamp_ns, frames)


def drive(bench, done):
    """Send both robots' images and odometry in turns, until something is so."""
    for step in range(1, 400):
        stamp_ns = START_NS + step * 50_000_000
        for name, place in PLACES.items():
            bench.publish(f'/{name}/odom', standing(stamp_ns))
            image = to_image(panorama(place, seed=step), stamp_ns, 'omnicam')
            bench.publish(f'/{name}/image_raw', image)
        if until(done, 0.05):
            return True
    return False


def test_two_robots_side_by_side_locate_themselves_apart(bench, robots):
    """Images and odometry alternate in one domain; no message of one reaches the other."""
    fused = {name: bench.listen(Odometry, f'/{name}/ekf/odometry') for name in PLACES}
    moved = {name: bench.listen(String, f'/{name}/tf') for name in PLACES}

    def located():
        for name, place in PLACES.items():
            if not fused[name] or not moved[name]:
                return False
            pose = fused[name][-1].pose.pose
            if not np.allclose(read_planar(pose.position, pose.orientation), place, atol=0.1):
                return False
        return True

    assert drive(bench, located)
    for name, place in PLACES.items():
        # The odometry stands at its origin: the transform is the place in the map.
        sent = [moves for message in list(moved[name]) for moves in json.loads(message.data)]
        assert np.allclose(sent, place[:2], atol=0.5)
    assert bench.node.count_publishers('/tf') == 0
    monitors = [m for nodes in robots.values() for node in nodes for m in node.monitors.values()]
    assert not any('internal error' in reason for m in monitors for reason in m.refused)
    odometries, images = (
        {name: nodes[k].monitor(topic).received for name, nodes in robots.items()}
        for k, topic in ((2, 'odom'), (0, 'image_raw'))
    )
    for counts in (odometries, images):
        assert abs(counts['robot1'] - counts['robot2']) <= 3, 'one robot hears the other'


def test_diagnostics_show_which_robot_and_which_topic(bench, robots):
    heard = bench.listen(DiagnosticArray, '/diagnostics')

    def statuses():
        return {s.name: {v.key for v in s.values} for m in list(heard) for s in m.status}

    expected = {
        f'{name}/{node.get_name()}: status' for name, nodes in robots.items() for node in nodes
    }
    assert drive(bench, lambda: expected <= set(statuses()))
    assert set(statuses()) == expected
    keys = statuses()
    assert '/robot1/odom: received' in keys['robot1/ekf_node: status']
    assert '/robot2/panorama: received' in keys['robot2/sfa_node: status']


def test_each_robot_gets_its_own_parameters_of_one_file(robots):
    values = {name: nodes[2].get_parameter('lost_std').value for name, nodes in robots.items()}
    assert values == {'robot1': 1.5, 'robot2': 1.8}
    assert all(nodes[0].get_parameter('width').value == SIZE.width for nodes in robots.values())
