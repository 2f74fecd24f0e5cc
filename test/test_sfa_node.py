# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""sfa_node on real messages, with a model that reads its answer off the picture."""

import dataclasses
import math

import numpy as np
import pytest
from cylinder_worlds import place
from picture_readers import AsLocated, InTwoSteps
from ros_domains import free_domain

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.camera.watch import FROZEN_IMAGES
from sfa_localization.data.array_files import read_arrays, write_arrays
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.errors import ModelError
from sfa_localization.localizer import UNKNOWN_VARIANCE
from sfa_localization.place_model import FORMAT, VERSION, Estimate, PlaceModel

DOMAIN = free_domain()

SIZE = PanoramaConfig(width=60, height=12)
KNOWN = ErrorCorrelation(0.25, 1.5)


def panorama(seed=0, level=120, spread=40):
    rng = np.random.default_rng(seed)
    noise = rng.normal(level, spread, (SIZE.height, SIZE.width, 3))
    return np.clip(noise, 0, 255).astype(np.uint8)


pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from ros_bench import Bench, until  # noqa: E402
from sensor_msgs.msg import CompressedImage, Image  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sfa_localization.data.messages import read_stamp, read_yaw  # noqa: E402
from sfa_localization.nodes.conversions import (  # noqa: E402
    read_error_correlation,
    read_pose,
    to_compressed,
    to_image,
    to_info,
)
from sfa_localization.nodes.lifecycle import latched_qos  # noqa: E402
from sfa_localization.nodes.sfa_node import NOVELTY_WARNING, SfaNode  # noqa: E402

pytestmark = pytest.mark.ros


@dataclasses.dataclass
class FakeModel(InTwoSteps):
    """Says that the position is the first pixel's blue and green; novelty is a thing to set."""

    heading: bool = True
    novelty: float = 0.5
    shift: float = 0.0
    panorama: PanoramaConfig = SIZE
    error_correlation: ErrorCorrelation = KNOWN
    camera_delay_s: float = 0.0

    def locate(self, image):
        yaw = 0.25 if self.heading else math.nan
        variance = 0.01 if self.heading else math.pi**2 / 3
        position = image[0, 0, :2].astype(float) + self.shift
        spread = np.diag([0.04, 0.09, variance])
        return Estimate(np.arange(1.0, 9.0), position, yaw, spread, self.novelty)

    def views(self, images):
        return [AsLocated(self.locate(image)) for image in images]


@pytest.fixture
def models(monkeypatch):
    made = {'a.npz': FakeModel(), 'b.npz': FakeModel(shift=100.0), 'blind.npz': FakeModel(False)}

    def load(path):
        if str(path) not in made:
            raise ModelError(f'{path}: no such file; train it with the train command')
        return made[str(path)]

    monkeypatch.setattr(PlaceModel, 'load', staticmethod(load))
    return made


@pytest.fixture
def bench():
    made = Bench(DOMAIN)
    yield made
    made.close()


def message(seed=1, stamp_ns=5_000_000_001, image=None):
    return to_image(panorama(seed) if image is None else image, stamp_ns, 'omnicam')


def test_what_the_model_knows_of_its_errors_reaches_those_who_come_later(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    heard = bench.listen(Float64MultiArray, 'sfa/error_correlation', latched_qos())
    assert until(lambda: heard)
    assert heard[0].layout.dim[0].label == 'share, distance_m'
    assert read_error_correlation(heard[0]) == KNOWN
    models['b.npz'].error_correlation = ErrorCorrelation(0.5, 3.0)
    node.set_parameters([Parameter('model', value='b.npz')])
    assert until(lambda: len(heard) == 2)
    assert read_error_correlation(heard[1]) == ErrorCorrelation(0.5, 3.0)


def test_all_outputs_carry_the_pictures_stamp(bench, models):
    bench.run(SfaNode, model='a.npz')
    slow = bench.listen(Float64MultiArray, 'sfa/slow_features')
    features = bench.listen(PoseStamped, 'sfa/slow_feature_pose')
    poses = bench.listen(PoseStamped, 'sfa/pose')
    uncertain = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    sent = panorama(1)
    bench.publish('panorama', message(image=sent))
    assert until(lambda: slow and features and poses and uncertain)
    assert list(slow[0].data) == list(range(1, 9))
    p = features[0].pose.position
    assert (p.x, p.y, p.z) == (1, 2, 3)
    assert features[0].header.frame_id == 'slow_feature_space'
    for pose, stamped in ((poses[0].pose, poses[0]), (uncertain[0].pose.pose, uncertain[0])):
        assert read_stamp(stamped.header.stamp) == 5_000_000_001
        assert stamped.header.frame_id == 'map'
        assert (pose.position.x, pose.position.y) == (sent[0, 0, 0], sent[0, 0, 1])
        assert read_yaw(pose.orientation) == pytest.approx(0.25)
    _, _, covariance = read_pose(uncertain[0])
    assert np.allclose(covariance, np.diag([0.04, 0.09, 0.01]))


def test_without_heading_the_yaw_variance_is_large(bench, models):
    bench.run(SfaNode, model='blind.npz')
    heard = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    bench.publish('panorama', message())
    assert until(lambda: heard)
    _, pose, covariance = read_pose(heard[0])
    assert pose[2] == 0 and covariance[2, 2] == pytest.approx(math.pi**2 / 3)


def test_compressed_panoramas_are_taken_too(bench, models):
    bench.run(SfaNode, model='a.npz', image_transport='compressed')
    heard = bench.listen(PoseStamped, 'sfa/pose')
    bench.publish('panorama/compressed', to_compressed(panorama(), 7, 'omnicam', 90))
    assert until(lambda: heard) and read_stamp(heard[0].header.stamp) == 7


def bad_pictures():
    flat = np.full((SIZE.height, SIZE.width, 3), 90, np.uint8)
    return {
        'dark': np.zeros_like(flat),
        'covered': flat,
    }


@pytest.mark.parametrize('kind', ['dark', 'covered', 'frozen', 'foreign'])
def test_an_unusable_image_gives_no_pose_and_is_reported(bench, models, kind):
    node = bench.run(SfaNode, model='a.npz')
    poses = bench.listen(PoseStamped, 'sfa/pose')
    heard = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    told = bench.listen(DiagnosticArray, '/diagnostics')
    models['a.npz'].novelty = 9.0 if kind == 'foreign' else 0.5
    image = bad_pictures().get(kind, panorama(5))
    for k in range(FROZEN_IMAGES):
        bench.publish('panorama', message(image=image, stamp_ns=100 + k))
        assert until(lambda n=k: len(heard) == n + 1)
    covariance = np.reshape(heard[-1].pose.covariance, (6, 6))
    assert covariance[0, 0] == covariance[1, 1] == UNKNOWN_VARIANCE
    assert len(poses) == (1 if kind == 'frozen' else 0)
    assert until(lambda: told and told[-1].status[0].level != b'\x00')
    models['a.npz'].novelty = 0.5
    bench.publish('panorama', message(seed=77, stamp_ns=200))
    assert until(lambda: poses and read_stamp(poses[-1].header.stamp) == 200)
    refused = node.monitor('panorama').refused
    assert sum(refused.values()) == FROZEN_IMAGES - (kind == 'frozen')


def test_panoramas_of_another_size_are_rejected_with_the_remedy(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    bench.publish('panorama', message(image=np.zeros((20, 100, 3), np.uint8)))
    assert until(lambda: node.monitor('panorama').refused)
    reason = next(iter(node.monitor('panorama').refused))
    assert '100x20' in reason and '60x12' in reason and 'omnicam_node' in reason
    heard = bench.listen(PoseStamped, 'sfa/pose')
    bench.publish('panorama', message())
    assert until(lambda: heard)


def malformed():
    def changed(**fields):
        made = message()
        for name, value in fields.items():
            setattr(made, name, value)
        return made

    stampless, impossible = message(), message()
    stampless.header.stamp.sec = stampless.header.stamp.nanosec = 0
    impossible.header.stamp.nanosec = 3_000_000_000
    return [
        Image(), stampless, impossible, changed(encoding='nonsense'), changed(step=1),
        changed(height=0), changed(width=0), changed(height=4_000_000_000),
        changed(data=b''), changed(data=bytes(5)), changed(encoding='mono8', step=1),
    ]  # fmt: skip


def test_malformed_images_are_counted_and_end_nothing(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    heard = bench.listen(PoseStamped, 'sfa/pose')
    for count, broken in enumerate(malformed(), 1):
        bench.publish('panorama', broken)
        assert until(lambda n=count: sum(node.monitor('panorama').refused.values()) == n)
    assert not heard
    assert not [why for why in node.monitor('panorama').refused if 'internal' in why]
    bench.publish('panorama', message())
    assert until(lambda: heard)


def test_malformed_compressed_images_too(bench, models):
    node = bench.run(SfaNode, model='a.npz', image_transport='compressed')
    for count, data in enumerate((b'', b'no picture', bytes(100)), 1):
        broken = CompressedImage(format='jpeg', data=data)
        broken.header.stamp.sec = 1
        bench.publish('panorama/compressed', broken)
        topic = node.monitor('panorama/compressed')
        assert until(lambda n=count, t=topic: sum(t.refused.values()) == n)


def test_an_estimate_that_is_not_finite_is_never_published(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    models['a.npz'].shift = math.nan
    heard = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    bench.publish('panorama', message())
    assert until(lambda: node.monitor('panorama').refused and heard)
    _, pose, covariance = read_pose(heard[0])
    assert np.array_equal(pose, np.zeros(3)) and covariance[0, 0] == UNKNOWN_VARIANCE
    assert 'no finite estimate' in next(iter(node.monitor('panorama').refused))


def test_the_model_changes_while_running_and_a_bad_one_is_refused(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    heard = bench.listen(PoseStamped, 'sfa/pose')
    assert node.set_parameters([Parameter('model', value='b.npz')])[0].successful
    bench.publish('panorama', message(seed=1))
    assert until(lambda: heard) and heard[0].pose.position.x >= 100
    refused = node.set_parameters([Parameter('model', value='none.npz')])[0]
    assert not refused.successful and 'none.npz' in refused.reason
    assert node.get_parameter('model').value == 'b.npz'
    bench.publish('panorama', message(seed=2))
    assert until(lambda: len(heard) == 2) and heard[1].pose.position.x >= 100
    models['b.npz'] = FakeModel(shift=500.0)
    assert bench.call(Trigger, 'sfa_node/reload_model', Trigger.Request()).success
    bench.publish('panorama', message(seed=3))
    assert until(lambda: len(heard) == 3) and heard[2].pose.position.x >= 500
    del models['b.npz']
    answer = bench.call(Trigger, 'sfa_node/reload_model', Trigger.Request())
    assert not answer.success and 'b.npz' in answer.message


@pytest.mark.parametrize(('model', 'why'), [('', 'is empty'), ('none.npz', 'no such file')])
def test_a_missing_model_is_named_with_the_remedy(bench, models, model, why):
    node = bench.run(SfaNode, start=False, model=model)
    assert not node.start()
    assert why in node.failure and 'train' in node.failure


def test_waiting_for_images_is_reported(bench, models):
    bench.run(SfaNode, model='a.npz', silence_timeout=0.2)
    told = bench.listen(DiagnosticArray, '/diagnostics')
    assert until(lambda: told and 'waiting for images' in told[-1].status[0].message)
    bench.publish('panorama', message())
    assert until(lambda: 'no image on /panorama for' in told[-1].status[0].message)


# What the node says is what it does, in any state.


@pytest.mark.parametrize('state', ['unconfigured', 'inactive', 'active'])
def test_a_model_is_checked_in_every_state_and_the_one_reported_is_in_use(bench, models, state):
    node = bench.run(SfaNode, start=False, model='a.npz')
    if state != 'unconfigured':
        node.trigger_configure()
    if state == 'active':
        node.trigger_activate()
    refused = node.set_parameters([Parameter('model', value='none.npz')])[0]
    assert not refused.successful and 'none.npz' in refused.reason
    assert node.get_parameter('model').value == 'a.npz'
    assert node.set_parameters([Parameter('model', value='b.npz')])[0].successful
    if state == 'unconfigured':
        node.trigger_configure()
    if state != 'active':
        node.trigger_activate()
    told = bench.listen(DiagnosticArray, '/diagnostics')
    heard = bench.listen(PoseStamped, 'sfa/pose')
    bench.publish('panorama', message())
    assert until(lambda: heard) and heard[0].pose.position.x >= 100
    assert until(lambda: told)
    assert {v.key: v.value for v in told[-1].status[0].values}['model'] == 'b.npz'


def test_a_hostile_model_is_refused_live_and_ends_nothing(bench, tmp_path):
    whole, bad = tmp_path / 'whole.npz', tmp_path / 'bad.npz'
    place().model.save(whole)
    arrays = read_arrays(whole, FORMAT, VERSION, '')
    broken = {**arrays, 'compass/features': arrays['compass/features'][:, :3]}
    write_arrays(bad, broken)
    node = bench.run(SfaNode, model=str(whole))
    for path, reason in ((bad, 'is damaged'), (300 * 'x', 'no such'), ('/dev/zero', 'no regular')):
        refused = node.set_parameters([Parameter('model', value=str(path))])[0]
        assert not refused.successful and reason in refused.reason
    whole.write_bytes(bad.read_bytes())
    answer = bench.call(Trigger, 'sfa_node/reload_model', Trigger.Request())
    assert not answer.success and 'is damaged' in answer.message
    assert node.get_parameter('model').value == str(whole)
    assert node._observer.model.compass.features.shape[1] > 3, 'the old model is in use'


def declare(bench, **changes):
    info = to_info(dataclasses.replace(SIZE, **changes))
    bench.publish('panorama/info', info, latched_qos())


@pytest.mark.parametrize('changes', [
    {'elevation_min': -20.0}, {'elevation_max': 30.0}, {'clockwise': False},
])  # fmt: skip
def test_panoramas_declared_to_show_something_else_are_rejected(bench, models, changes):
    node = bench.run(SfaNode, model='a.npz')
    told = bench.listen(DiagnosticArray, '/diagnostics')
    heard = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    declare(bench, **changes)
    assert until(lambda: node.monitor('panorama/info').used == 1)
    bench.publish('panorama', message())
    assert until(lambda: node.monitor('panorama').refused)
    ((name, value),) = changes.items()
    reason = next(iter(node.monitor('panorama').refused))
    assert f'{name} {value} instead of {getattr(SIZE, name)}' in reason and 'omnicam' in reason
    assert until(
        lambda: any(
            m.status[0].level == DiagnosticStatus.ERROR and name in m.status[0].message
            for m in told
        )
    )
    assert not heard
    declare(bench)
    assert until(lambda: node.monitor('panorama/info').used == 2)
    bench.publish('panorama', message())
    assert until(lambda: heard)


def test_a_declaration_made_before_activation_counts(bench, models):
    node = bench.run(SfaNode, start=False, model='a.npz')
    node.trigger_configure()
    declare(bench, clockwise=False)
    assert until(lambda: node.monitor('panorama/info').used == 1)
    node.trigger_activate()
    bench.publish('panorama', message())
    assert until(lambda: node.monitor('panorama').refused)


def test_that_nobody_declares_the_panorama_is_said_once(bench, models, monkeypatch):
    bench.run(SfaNode, model='a.npz')
    heard = bench.listen(PoseStamped, 'sfa/pose')
    said = []
    logger = type('Logger', (), {'info': lambda _, text, **k: said.append(text)})()
    monkeypatch.setattr(SfaNode, 'get_logger', lambda _: logger)
    for count in (1, 2, 3):
        bench.publish('panorama', message(seed=count))
        assert until(lambda n=count: len(heard) == n)
    assert len(said) == 1 and 'nobody publishes' in said[0] and '-12 to 24 deg' in said[0]


def test_a_declaration_that_cannot_be_read_is_counted(bench, models):
    node = bench.run(SfaNode, model='a.npz')
    bench.publish('panorama/info', String(data='{"widht": 5}'), latched_qos())
    assert until(lambda: node.monitor('panorama/info').refused)
    heard = bench.listen(PoseStamped, 'sfa/pose')
    bench.publish('panorama', message())
    assert until(lambda: heard)


def test_the_map_frame_is_a_parameter_and_novelty_is_warned_of(bench, models):
    node = bench.run(SfaNode, model='a.npz', map_frame='garden')
    features = bench.listen(PoseStamped, 'sfa/slow_feature_pose')
    poses = bench.listen(PoseStamped, 'sfa/pose')
    uncertain = bench.listen(PoseWithCovarianceStamped, 'sfa/pose_with_covariance')
    models['a.npz'].novelty = NOVELTY_WARNING + 0.1
    bench.publish('panorama', message())
    assert until(lambda: features and poses and uncertain)
    assert features[0].header.frame_id == 'slow_feature_space'
    assert poses[0].header.frame_id == uncertain[0].header.frame_id == 'garden'
    assert until(lambda: 'unlike' in node.health()[1])
    assert node.health()[2]['unlike by light'] == '0 %'
    models['a.npz'].novelty = NOVELTY_WARNING - 0.1
    bench.publish('panorama', message(seed=2))
    assert until(lambda: node.health()[1] == 'locating')
