# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""sfa_node on real messages, with a model that reads its answer off the picture."""

import dataclasses
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from picture_readers import DROVE, SIZE, PictureReader, panorama

from sfa_localization.camera.settings import LensCalibration
from sfa_localization.camera.watch import EXPLAINED_WARNING, FROZEN_IMAGES
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.fusion.camera_clock import NEAR_NS
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.observer import UNKNOWN_VARIANCE
from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    TransformStamped,
)
from nav_msgs.msg import OccupancyGrid
from rclpy.parameter import Parameter
from ros_bench import until
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from sfa_localization.data.messages import read_planar, read_stamp
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes.lifecycle import latched_qos
from sfa_localization.nodes.sfa_node import SfaNode

pytestmark = pytest.mark.ros
PLACE, CORRELATION = (3.0, 4.0, 0.25), ErrorCorrelation(0.25, 1.5)


@dataclasses.dataclass
class ShiftedReader(PictureReader):
    """Reads poses off pictures, and shifts them by `shift` m."""

    shift: float = 0.0
    error_correlation: ErrorCorrelation = CORRELATION

    def locate(self, image):
        seen = super().locate(image)
        return replace(seen, pose=seen.pose + np.array([self.shift, 0, 0]))


@pytest.fixture
def models(monkeypatch):
    made, load = {'a.npz': ShiftedReader(), 'b.npz': ShiftedReader(shift=100.0)}, PlaceModel.load
    either = staticmethod(lambda path: made.get(str(path)) or load(path))
    monkeypatch.setattr(PlaceModel, 'load', either)
    return made


def declared(**changes):
    return convert.to_info(replace(SIZE, **changes))


def message(seed=1, stamp_ns=5_000_000_001, explained=0.9, image=None):
    image = panorama(PLACE, seed, explained) if image is None else image
    return convert.to_image(image, stamp_ns, 'omnicam')


def test_all_outputs_carry_the_pictures_stamp_and_the_frame_of_the_map(bench, models):
    node = bench.run(SfaNode, model='a.npz', map_frame='garden', silence_timeout=0.2)
    told = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: told and 'waiting for images' in told[-1].status[0].message)
    slow = bench.listen(Float64MultiArray, 'sfa/slow_features')
    features = bench.listen(PoseStamped, 'sfa/slow_feature_pose')
    poses = bench.listen(PoseStamped, 'sfa/pose')
    uncertain = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    turned = bench.listen(QuaternionStamped, 'sfa/turned')
    bench.publish('panorama', message())
    assert until(lambda: slow and features and poses and uncertain)
    assert list(slow[0].data) == pytest.approx(PLACE, abs=1e-3), 'as the reader says'
    position = features[0].pose.position
    assert [position.x, position.y, position.z] == list(slow[0].data)
    assert features[0].header.frame_id == 'slow_feature_space'
    for pose, stamped in ((poses[0].pose, poses[0]), (uncertain[0].pose.pose, uncertain[0])):
        assert read_stamp(stamped.header.stamp) == 5_000_000_001
        assert stamped.header.frame_id == 'garden'
        assert read_planar(pose.position, pose.orientation) == pytest.approx(PLACE, abs=1e-3)
    assert np.allclose(convert.read_pose(uncertain[0])[2], np.diag([0.02, 0.03, 0.002]))
    bench.publish('panorama', message(seed=2, explained=EXPLAINED_WARNING - 0.05))
    assert until(lambda: 'unlike' in node.health()[1])
    told_of = node.health()[2]
    assert told_of['explained'] == '35 %', 'of the last image'
    assert told_of['slow feature errors'].endswith(' times as in training')
    sun = panorama(PLACE, 4)
    sun[:, 16:24] = 255
    bench.publish('panorama', message(image=sun))
    assert until(lambda: node.health()[1] == 'light drowns 45 degrees of the view')
    bench.publish('panorama', message(seed=3, stamp_ns=5_000_000_001 + NEAR_NS))
    assert until(lambda: len(turned) == 2), 'those between are not used'
    assert read_stamp(turned[1].header.stamp) == 5_000_000_001 + NEAR_NS
    assert until(lambda: 'no image on /panorama for' in told[-1].status[0].message)


def test_a_panorama_of_the_camera_itself_is_mounted_as_in_training(bench, models):
    """That of omnicam_node, which declares it, is so already."""
    lens = LensCalibration(camera_model='panorama', mirrored='no', mount_rpy=(0.0, 0.0, 90.0))
    models['a.npz'].lens = lens
    node = bench.run(SfaNode, model='a.npz')
    poses = bench.listen(PoseStamped, 'sfa/pose')
    turned = np.roll(panorama(PLACE, 1), SIZE.width // 4, axis=1)
    bench.publish('panorama', message(image=turned))
    assert until(lambda: len(poses) == 1)
    bench.publish('panorama/info', declared(), latched_qos())
    assert until(lambda: node.monitors['panorama/info'].used == 1)
    bench.publish('panorama', message(seed=2))
    assert until(lambda: len(poses) == 2)
    for pose in (poses[0].pose, poses[-1].pose):
        assert read_planar(pose.position, pose.orientation) == pytest.approx(PLACE, abs=1e-3)


def transform(parent, child, x, y, turn=1.0):
    link = TransformStamped(child_frame_id=child)
    link.header.frame_id = parent
    link.transform.translation.x, link.transform.translation.y = x, y
    link.transform.rotation.w = turn
    return link


def test_a_camera_that_static_transforms_have_elsewhere_is_named(bench, models):
    """Once its frame is known; by the frame of the robot that is a parameter."""
    rig = Rig(camera_ahead=Quantity(0.3, 0.01), camera_left=Quantity(-0.1, 0.01))
    models['a.npz'].rig = rig
    node = bench.run(SfaNode, model='a.npz', base_frame='robot')
    troubles = bench.listen(String, 'sfa/troubles', latched_qos())
    bench.publish('panorama', message())
    assert until(lambda: node.health()[1] == 'locating')
    for x_m, said in ((0.31, ''), (0.62, 'has the camera 0.62 m ahead and -0.10 m left of')):
        links = transform('robot', '/mast', 0.2, 0.0), transform('mast', 'omnicam', x_m - 0.2, -0.1)
        node.take('/tf_static', node._frames.add, SimpleNamespace(transforms=links))
        level, told, _ = node.health()
        assert said in told and (level == DiagnosticStatus.WARN) == bool(said)
    broken = SimpleNamespace(transforms=[transform('mast', 'omnicam', math.nan, 0.0)])
    node.take('/tf_static', node._frames.add, broken)
    assert 'was it moved?' in node.health()[1] and node.monitors['/tf_static'].used == 2
    bench.publish('panorama', message(seed=2))
    assert until(lambda: troubles and troubles[-1].data == node.health()[1])


def test_an_unusable_image_gives_no_pose_and_is_reported(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    poses = bench.listen(PoseStamped, 'sfa/pose')
    heard = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    told = bench.listen(DiagnosticArray, '/diagnostics')
    good, foreign = panorama(PLACE, 5), panorama(PLACE, 6, explained=0.1)
    unusable = [('dark', np.zeros_like(good)), ('unlike', foreign), ('no finite estimate', good)]
    unusable += [('frozen', panorama(PLACE, 7))] * FROZEN_IMAGES
    for count, (reason, image) in enumerate(unusable, 1):
        models['a.npz'].shift = math.nan if reason == 'no finite estimate' else 0.0
        bench.publish('panorama', message(image=image, stamp_ns=100 + count))
        assert until(lambda n=count: len(heard) == n)
        if count != 4:
            _, pose, covariance = convert.read_pose(heard[-1])
            assert covariance[0, 0] == covariance[1, 1] == UNKNOWN_VARIANCE, reason
            assert np.isfinite(pose).all()
    refused = node.monitors['panorama'].refused
    assert until(lambda: sum(refused.values()) == len(unusable) - 1)
    assert all((reason in ' '.join(refused)) for reason, _ in unusable)
    assert until(lambda: told and 'frozen' in told[-1].status[0].message)
    assert told[-1].status[0].level != DiagnosticStatus.OK
    bench.publish('panorama', message(seed=77, stamp_ns=200))
    assert until(lambda: poses and read_stamp(poses[-1].header.stamp) == 200)
    assert len(poses) == 2, 'and that of the first of equal images'


def test_panoramas_unlike_those_of_training_are_rejected_with_the_remedy(bench, models):
    """Of another size, or declared to show something else."""
    node = bench.run(SfaNode, model='a.npz')
    told = bench.listen(DiagnosticArray, '/diagnostics')
    heard = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    refused = node.monitors['panorama'].refused
    bench.publish('panorama', message(image=np.zeros((20, 100, 3), np.uint8)))
    assert until(lambda: len(refused) == 1)
    bench.publish('panorama/info', declared(clockwise=False), latched_qos())
    assert until(lambda: node.monitors['panorama/info'].used == 1)
    bench.publish('panorama', message(seed=1))
    assert until(lambda: len(refused) == 2)
    for words in ('100x20', '64x16', 'clockwise False instead of True', 'omnicam_node'):
        assert words in ' '.join(refused)
    assert until(lambda: 'clockwise' in told[-1].status[0].message)
    assert told[-1].status[0].level == DiagnosticStatus.ERROR and not heard
    bench.publish('panorama/info', declared(), latched_qos())
    assert until(lambda: node.monitors['panorama/info'].used == 2)
    bench.publish('panorama', message(seed=2))
    assert until(lambda: heard)


@pytest.mark.parametrize('transport', ['raw', 'compressed'])
def test_malformed_images_are_counted_and_end_nothing(bench, models, transport):
    """What is wrong with images is tested in test_pictures.py."""
    node = bench.run(SfaNode, model='a.npz', image_transport=transport)
    if transport == 'raw':
        topic, good, bad = 'panorama', message(), [Image(), message(stamp_ns=0)]
    else:
        topic, good = 'panorama/compressed', convert.to_compressed(panorama(PLACE), 7, 'map', 90)
        bad = [CompressedImage(), CompressedImage(header=good.header, data=b'no picture')]
    heard, refused = bench.listen(PoseStamped, 'sfa/pose'), node.monitors[topic].refused
    for count, broken in enumerate(bad, 1):
        bench.publish(topic, broken)
        assert until(lambda n=count: sum(refused.values()) == n)
    assert not heard and not [why for why in refused if 'internal' in why]
    bench.publish(topic, good)
    assert until(lambda: heard)


@pytest.mark.parametrize('state', ['unconfigured', 'inactive', 'active'])
def test_the_model_changes_in_every_state_and_a_bad_one_is_refused(bench, models, tmp_path, state):
    """The record of the robot reaches late subscribers, too."""
    models['b.npz'].error_correlation = ErrorCorrelation(0.5, 3.0)
    models['b.npz'].rig = Rig(wheel_scale=Quantity(1.02, 0.01))
    node = bench.run(SfaNode, start=state == 'active', model='a.npz')
    if state == 'inactive':
        node.trigger_configure()
    (tmp_path / 'damaged.npz').write_bytes(b'PK damaged')
    for path in (tmp_path / 'damaged.npz', 'none.npz', 300 * 'x'):
        refused = node.set_parameters([Parameter('model', value=str(path))])[0]
        assert not refused.successful and str(path) in refused.reason
    assert node.get_parameter('model').value == 'a.npz'
    assert node.set_parameters([Parameter('model', value='b.npz')])[0].successful
    if state == 'unconfigured':
        node.trigger_configure()
    if state != 'active':
        node.trigger_activate()
    heard, rigs = bench.listen(PoseStamped, 'sfa/pose'), []
    bench.node.create_subscription(String, 'sfa/rig', rigs.append, latched_qos())
    assert until(lambda: rigs)
    assert convert.read_rig(rigs[-1]) == (models['b.npz'].rig, ErrorCorrelation(0.5, 3.0))
    bench.publish('panorama', message())
    assert until(lambda: heard) and heard[0].pose.position.x >= 100
    assert node.health()[2]['model'] == 'b.npz'


def test_images_that_come_in_another_order_than_they_were_taken_are_named(bench, models):
    """One step back, as of a bag in a loop, is not; every second image is."""
    node = bench.run(SfaNode, model='a.npz')
    heard = bench.listen(PoseStamped, 'sfa/pose')

    def send(*order):
        for k in order:
            count = len(heard)
            bench.publish('panorama', message(seed=k, stamp_ns=k * 100_000_000))
            assert until(lambda before=count: len(heard) > before)

    send(*range(10, 30), *range(10, 14))
    assert node.health()[:2] == (DiagnosticStatus.OK, 'locating')
    send(*(k + swapped for k in range(30, 40, 2) for swapped in (1, 0)))
    level, text, _ = node.health()
    assert level == DiagnosticStatus.WARN
    assert text.startswith('6 of 34 images come after later ones: ')


def test_the_driven_ground_is_published_for_late_viewers(bench, models):
    bench.run(SfaNode, model='b.npz')
    grids, lines = [], []
    bench.node.create_subscription(OccupancyGrid, 'sfa/map', grids.append, latched_qos())
    bench.node.create_subscription(MarkerArray, 'sfa/map_paths', lines.append, latched_qos())
    assert until(lambda: grids and lines)
    info, cells = grids[-1].info, DROVE.cells(GroundConfig())
    values = np.reshape(grids[-1].data, (info.height, info.width))
    assert np.array_equal(values == 0, cells.driven) and set(values.ravel()) == {0, -1}
    assert [info.origin.position.x, info.origin.position.y] == cells.corner.tolist()
    (marker,) = lines[-1].markers
    assert [(p.x, p.y) for p in marker.points] == [(0.0, 1.0), (0.5, 1.0), (0.5, 1.0), (0.5, 1.5)]
    assert [(c.r, c.g) for c in marker.colors] == [(0.0, 1.0), (0.5, 0.5), (0.5, 0.5), (1.0, 0.0)]
    assert marker.header.frame_id == grids[-1].header.frame_id == 'map'


def test_the_model_is_read_again_when_asked(bench, models):
    bench.run(SfaNode, model='b.npz')
    heard = bench.listen(PoseStamped, 'sfa/pose')
    models['b.npz'] = ShiftedReader(shift=500.0)
    assert bench.call(Trigger, 'sfa_node/reload_model', Trigger.Request()).success
    bench.publish('panorama', message())
    assert until(lambda: heard) and heard[0].pose.position.x >= 500
    del models['b.npz']
    answer = bench.call(Trigger, 'sfa_node/reload_model', Trigger.Request())
    assert not answer.success and 'b.npz' in answer.message


def test_a_missing_model_is_named_with_the_remedy(bench, models):
    for model, why in (('', 'is empty'), ('none.npz', 'no such file')):
        node = bench.run(SfaNode, start=False, model=model)
        assert not node.start()
        assert why in node.failure and 'train' in node.failure
        bench.end(node)
