# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Several cameras live: what describes them, the panorama of their images, and faulty ones."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import camera, fisheye, picture, pinhole, smooth, speckled
from scipy.spatial.transform import Rotation

from sfa_localization.camera import surround
from sfa_localization.camera.calibration_files import calibration_text
from sfa_localization.camera.panorama import panorama_rays
from sfa_localization.camera.sectors import optical_pose
from sfa_localization.camera.settings import PanoramaConfig, SurroundConfig
from sfa_localization.config import load_settings
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.sphere import rotation

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_bench import FRAMES, standing, until
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String

from sfa_localization.data.messages import read_stamp
from sfa_localization.data.transforms import TransformTree
from sfa_localization.nodes import discovery, surround_input
from sfa_localization.nodes.conversions import to_compressed, to_image, to_odometry
from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.lifecycle import latched_qos
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.place_model import PlaceModel

pytestmark = pytest.mark.ros
PANORAMA = PanoramaConfig(width=120, height=12)
SMALL = {'width': 120, 'height': 12}
START_NS, STEP_NS = 12_000_000_000, 100_000_000
YAWS = {'front': 0.0, 'left': 90.0, 'rear': 180.0, 'right': 270.0}


def info_of(lens):
    is_fisheye = lens.camera_model == 'fisheye'
    k = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
    model = 'equidistant' if is_fisheye else 'plumb_bob'
    size = {'width': lens.image_width, 'height': lens.image_height}
    return CameraInfo(distortion_model=model, k=k, d=[0.0] * (4 if is_fisheye else 5), **size)


def poses(yaws):
    """The parameter camera_poses of cameras in one place."""
    return [number for yaw in yaws for number in (0.0, 0.0, 0.5, 0.0, 0.0, yaw)]


class Rig:
    """Cameras that look around, their node, and what it publishes."""

    def __init__(self, bench, yaws=None, lens=None, node=None, step_rad=0.01, **parameters):
        self.bench, self.yaws = bench, yaws or YAWS
        self.lens, self.step_rad = lens or pinhole(), step_rad
        self.cameras = {name: camera(name, yaw, lens, 0.0) for name, yaw in self.yaws.items()}
        self.number, self.skew_ns = 0, dict.fromkeys(self.yaws, 0)
        given = {'cameras': [*self.yaws], 'camera_poses': poses(self.yaws.values())}
        given = {name: value for name, value in (SMALL | given | parameters).items() if value}
        self.node = node or bench.run(OmnicamNode, **given)
        self.heard = bench.listen(Image, 'panorama')
        self.troubles = bench.listen(String, 'panorama/troubles', latched_qos())

    def describe(self, *names):
        """Publish camera_info until all of these are taken."""
        for name in names or self.yaws:
            info, topic = info_of(self.lens), f'{name}/camera_info'
            used = self.node.monitors[topic]
            assert self.bench.publish_until(topic, info, lambda u=used: u.used)

    def send(self, without=(), make=None):
        """The images of the next time, of all cameras but some; waits until each is taken."""
        self.number += 1
        stamp_ns = START_NS + self.number * STEP_NS
        for name in self.yaws:
            if name in without:
                continue
            taken_ns = stamp_ns + self.skew_ns[name]
            image = picture(self.cameras[name], heading=self.turn_at(taken_ns))
            image = make(name, image) if make else image
            sent = to_image(image, taken_ns, f'{name}_optical_frame')
            monitor = self.node.monitors[f'{name}/image_raw']
            before = monitor.received
            self.bench.publish(f'{name}/image_raw', sent)
            assert until(lambda m=monitor, b=before: m.received > b)
        return stamp_ns

    def turn_at(self, stamp_ns):
        """By which angle the world is turned at a stamp, rad."""
        return self.step_rad * (stamp_ns - START_NS) / STEP_NS

    def health(self):
        return self.node.health()

    def next(self, **options):
        """Send until a panorama of images sent now is heard: itself, (H, W, 3), and its stamp."""
        first_ns = START_NS + (self.number + 1) * STEP_NS

        def is_new():
            return bool(self.heard) and read_stamp(self.heard[-1].header.stamp) >= first_ns

        for _ in range(20):
            stamp_ns = self.send(**options)
            if until(is_new, 0.3):
                break
        assert is_new()
        return pixels(self.heard[-1]), read_stamp(self.heard[-1].header.stamp), stamp_ns


def pixels(message):
    """The image (H, W, 3) of a message."""
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)


def scene(rays, turn):
    """What the cameras see along rays (H, W, 3) of a robot that is turned, (H, W, 3)."""
    return smooth(rays.reshape(-1, 3) @ rotation(0.0, 0.0, turn).T).reshape(rays.shape)


def closeness(panorama, turn, config=PANORAMA):
    """The mean difference, gray levels, between a panorama and what the cameras look at."""
    return np.abs(panorama - scene(panorama_rays(config), turn)).mean()


@pytest.mark.parametrize(('yaws', 'lens'), [
    (YAWS, pinhole()),
    ({'front': 0.0, 'rear': 180.0}, fisheye()),
])  # fmt: skip
def test_one_panorama_of_lenses_by_camera_info_and_places_by_a_parameter(bench, yaws, lens):
    """It has the mean stamp; before all are described images are refused, with the remedy."""
    rig = Rig(bench, yaws, lens)
    last = [*yaws][-1]
    rig.describe(*[*yaws][:-1])
    rig.send()
    refused = rig.node.monitors['front/image_raw'].refused
    assert until(lambda: refused)
    (reason,) = refused
    assert reason == f'no camera_info of {last}: publish it, or set camera_files'
    rig.describe(last)
    rig.skew_ns['front'] = 8_000_000
    panorama, stamp_ns, sent_ns = rig.next()
    assert closeness(panorama, rig.turn_at(stamp_ns)) < 3
    assert closeness(panorama, rig.turn_at(stamp_ns) + 0.3) > 6
    mean_ns = 8_000_000 // len(yaws)
    assert (stamp_ns - mean_ns) % STEP_NS == START_NS % STEP_NS and stamp_ns <= sent_ns + mean_ns
    assert rig.heard[-1].header.frame_id == 'omnicam'
    level, text, values = rig.health()
    assert (level, text) == (DiagnosticStatus.OK, 'running')
    assert values['panorama visible [%]'] == '100' and values['camera front'] == 'used'


def test_lenses_of_files_beside_the_parameter_file(bench, tmp_path):
    (tmp_path / 'lens.yaml').write_text(calibration_text(pinhole()))
    file = tmp_path / 'parameters.yaml'
    listed = ', '.join(YAWS), ', '.join(['lens.yaml'] * 4), poses(YAWS.values())
    file.write_text('omnicam_node: {{ros__parameters: {{cameras: [{}], camera_files: [{}], '
                    'camera_poses: {}}}}}'.format(*listed))  # fmt: skip
    words = ['--ros-args', '--params-file', str(file)]
    node = bench.run(OmnicamNode, False, options={'cli_args': words}, **SMALL)
    node.find_files(words)
    assert node.start(), node.failure
    assert load_settings(file, 'omnicam_node', SurroundConfig).camera_files == (
        str(tmp_path / 'lens.yaml'),
    ) * 4  # fmt: skip
    rig = Rig(bench, node=node)
    panorama, stamp_ns, _ = rig.next()
    assert closeness(panorama, rig.turn_at(stamp_ns)) < 3


def static(parent, frame, pose):
    """A static transform as a message has it."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    rotation, moved = (
        SimpleNamespace(x=x, y=y, z=z, w=w),
        dict(zip('xyz', pose[:3, 3], strict=True)),
    )
    transform = SimpleNamespace(translation=SimpleNamespace(**moved), rotation=rotation)
    header = SimpleNamespace(frame_id=parent)
    return SimpleNamespace(header=header, child_frame_id=frame, transform=transform)


def test_places_by_static_transforms(bench, monkeypatch):
    """Also over frames between, and from the frame that the odometry names."""
    sent, add = {}, TransformTree.add
    monkeypatch.setattr(surround_input, 'TFMessage', String)
    monkeypatch.setattr(TransformTree, 'add', lambda tree, text: add(tree, sent[text.data]))
    rig = Rig(bench, camera_poses=None)
    rig.describe()
    rig.send()
    refused = rig.node.monitors['rear/image_raw'].refused
    assert until(lambda: refused)
    names = ', '.join(YAWS)
    assert [*refused] == [
        f'no pose of {names} on /tf_static from base_link: publish it, or set camera_poses'
    ]
    mast = optical_pose((0.1, 0.0, 0.0), (0.0, 0.0, 90.0)) @ np.linalg.inv(np.eye(4))
    links = [static('robot', 'mast', mast)]
    for name, yaw in YAWS.items():
        pose = np.linalg.solve(mast, optical_pose((0.2, 0.0, 0.5), (0.0, 0.0, yaw)))
        links.append(static('mast', f'{name}_optical_frame', pose))
    sent['first'] = SimpleNamespace(transforms=links[:3])
    sent['second'] = SimpleNamespace(transforms=links[3:])
    qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for text in sent:
        bench.publish('/tf_static', String(data=text), qos)
    wheels = standing(START_NS)
    wheels.child_frame_id = 'robot'
    used = rig.node.monitors['odom']
    assert bench.publish_until('odom', wheels, lambda: used.used)
    panorama, stamp_ns, _ = rig.next()
    assert closeness(panorama, rig.turn_at(stamp_ns)) < 3
    places = [camera.place for camera in rig.node.around.surround.cameras]
    assert np.allclose(places, [(0.2, 0.0, 0.5)] * 4)


def test_images_of_different_times_are_moved_by_the_turn_between_them(bench):
    rig = Rig(bench, step_rad=0.2)
    rig.describe()
    for _ in range(6):  # that exposures are known
        rig.next()
    rig.skew_ns['front'] = 40_000_000
    panorama, stamp_ns, _ = rig.next()
    plain = closeness(panorama, rig.turn_at(stamp_ns))
    used = rig.node.monitors['odom']
    for number in range(40):
        turning = standing(START_NS + (rig.number + number) * STEP_NS // 2)
        turning.twist.twist.angular.z = 2.0
        before = used.received
        assert bench.publish_until('odom', turning, lambda b=before: used.received > b)
    panorama, stamp_ns, _ = rig.next()
    assert closeness(panorama, rig.turn_at(stamp_ns)) < 0.7 * plain


def test_a_camera_that_was_turned_since_training_is_named(bench):
    """By the poses of the odometry, while the robot turns."""
    rig = Rig(bench, step_rad=0.5)
    rig.describe()
    seen_by = {**rig.cameras, 'left': camera('left', 100.0, radius=0.0)}
    poses = rig.node.monitors['odom']
    for _ in range(30):
        stamp_ns = START_NS + (rig.number + 6) * STEP_NS
        heading = rig.turn_at(stamp_ns)
        received = poses.received + 1
        message = to_odometry(np.array([0, 0, heading]), np.eye(3), np.zeros(2), np.eye(2),
                              stamp_ns, FRAMES)  # fmt: skip
        assert bench.publish_until('odom', message, lambda r=received: poses.received >= r)
        rig.number += 5
        rig.send(make=lambda name, _, h=heading: picture(seen_by[name], speckled, h))
        if rig.troubles:
            break
    assert until(lambda: rig.health()[1].startswith('camera left looks '))
    assert rig.troubles[-1].data == rig.health()[1] and 'to the left' in rig.health()[1]


@pytest.mark.parametrize(('trouble', 'reason'), [
    ('black', 'image is dark'),
    ('frozen', 'camera is frozen: it repeats its image'),
    ('gone', 'it sends no images'),
])  # fmt: skip
def test_a_faulty_camera_is_hidden_and_named_until_it_is_back(bench, trouble, reason):
    """The panorama repeats what the others see; after some seconds the pose is doubted."""
    rig = Rig(bench)
    rig.describe()
    rig.next()
    filter_node = bench.run(EkfNode)
    still = picture(rig.cameras['rear'])

    def faulty(name, image):
        if name != 'rear' or trouble == 'gone':
            return image
        return 0 * image if trouble == 'black' else still

    without = ['rear'] if trouble == 'gone' else []
    named = f'camera rear: {reason}'
    for _ in range(60):
        rig.send(without, faulty)
        if until(lambda: rig.troubles and rig.troubles[-1].data == named, 0.05):
            break
    lasted_s = rig.number * STEP_NS * 1e-9
    assert lasted_s > surround.BRIDGED_S
    level, text, values = rig.health()
    assert (level, text) == (DiagnosticStatus.WARN, named) and values['camera rear'] == reason
    assert 70 < float(values['panorama visible [%]']) < 85
    last = pixels(rig.heard[-1])
    behind = np.r_[0:8, -8:0]
    assert np.abs(np.diff(last[6].astype(int), axis=0))[behind].max() < 30
    assert last.std() > 10 and last[:, behind].mean() > 40, 'no black sector'
    assert until(lambda: named in filter_node.status().reasons)
    for _ in range(20):
        rig.send()
        if until(lambda: rig.troubles[-1].data == '', 0.05):
            break
    assert until(lambda: named not in filter_node.status().reasons)
    assert rig.health()[1] == 'running'


def test_one_dark_image_of_a_camera_is_no_reason_to_doubt_the_pose(bench):
    rig = Rig(bench)
    rig.describe()
    rig.next()
    for _ in range(3):
        rig.send(make=lambda name, image: 0 * image if name == 'left' else image)
    assert until(lambda: rig.health()[1] == 'camera left: image is dark')
    for _ in range(3):
        rig.send()
    assert until(lambda: rig.health()[1] == 'running')
    assert rig.troubles == []


def test_an_image_of_another_camera_is_refused_and_the_others_go_on(bench):
    rig = Rig(bench)
    rig.describe()
    rig.next()
    count = len(rig.heard)
    for _ in range(8):
        rig.send(make=lambda name, image: image[:50] if name == 'left' else image)
    (reason,) = rig.node.monitors['left/image_raw'].refused
    assert reason.startswith('the image is 200 x 50 but the camera is calibrated for 200 x 120')
    assert until(lambda: len(rig.heard) >= count + 4)
    assert rig.health()[1] == 'camera left: it sends no images'


def test_images_are_compressed_where_only_these_are_published(bench, monkeypatch):
    """A topic of another camera is no substitute."""
    monkeypatch.setattr(discovery, 'PATIENCE_S', 0.0)
    yaws = {'front': 0.0, 'rear': 180.0}
    node = bench.run(OmnicamNode, cameras=[*yaws], camera_poses=poses(yaws.values()), **SMALL)
    bench.listen(Image, 'panorama')
    sent = to_compressed(picture(camera('front', 0.0, fisheye())), START_NS, 'x', 90)
    monitor = node.monitors['front/image_raw']
    assert bench.publish_until('/front/image_raw/compressed', sent, lambda: monitor.received)
    assert node.full_name('front/image_raw') == '/front/image_raw/compressed'
    for search in node.around._searches:
        search.look()
    assert node.full_name('rear/image_raw') == '/rear/image_raw'


def test_nobody_listens_nothing_is_received(bench):
    node = bench.run(OmnicamNode, cameras=[*YAWS], camera_poses=poses(YAWS.values()), **SMALL)
    assert node.health()[1].startswith('idle') and node.count_subscribers('rear/image_raw') == 0
    topics = 'rear/image_raw', 'rear/camera_info', 'odom'
    for _ in range(2):
        listener = bench.node.create_subscription(Image, 'panorama', lambda _: None, 1)
        assert until(lambda: all(map(node.count_subscribers, topics)))
        bench.do(bench.node.destroy_subscription, listener)
        assert until(lambda: not any(map(node.count_subscribers, topics)))


def test_sectors_are_hidden_while_it_runs(bench):
    rig = Rig(bench)
    rig.describe()
    rig.next()
    (done,) = rig.node.set_parameters([Parameter('blind_sectors', value=[-180.0, 180.0])])
    assert not done.successful and 'blind_sectors hide all' in done.reason
    (done,) = rig.node.set_parameters([Parameter('blind_sectors', value=[-30.0, 30.0])])
    assert done.successful
    panorama, _, _ = rig.next()
    assert np.array_equal(panorama[:, 55], panorama[:, 52]), 'repeated from the edge of the sector'
    assert until(lambda: rig.health()[2]['panorama visible [%]'] == '83')


def test_cameras_of_the_model_are_used(bench, trained, tmp_path):
    """Their names may be left out, and others are refused."""
    mounted = tuple(camera(name, yaw, radius=0.0) for name, yaw in YAWS.items())
    model, path = PlaceModel.load(trained.model), tmp_path / 'model.npz'
    replace(model, surround=mounted).save(path)
    node = bench.run(OmnicamNode, model=str(path))
    rig = Rig(bench, node=node)
    panorama, stamp_ns, _ = rig.next()
    assert closeness(panorama, rig.turn_at(stamp_ns), model.panorama) < 3
    other = bench.run(OmnicamNode, False, model=str(path), cameras=['front', 'back'])
    assert not other.start()
    assert other.failure == (
        'cameras: the model was trained on front, left, rear, right; name these, or none'
    )


@pytest.mark.parametrize(('parameters', 'why'), [
    ({'cameras': ['front']}, '1 cameras: give 2 to 8'),
    ({'cameras': ['front', 'front']}, 'two cameras have one name'),
    ({'camera_model': 'mirror'}, 'are for one camera, but there are several'),
    ({'source': 'video', 'source_path': 'x.mp4'}, 'are for one camera, but there are several'),
    ({'camera_files': ['/nowhere.yaml', '/nowhere.yaml']}, '/nowhere.yaml: No such file'),
])  # fmt: skip
def test_parameters_that_fit_no_cameras_are_refused(bench, parameters, why):
    node = bench.run(OmnicamNode, False, **{'cameras': ['front', 'rear'], **parameters})
    assert not node.start() and why in node.failure


@pytest.mark.parametrize(('parameters', 'why'), [
    ({'camera_poses': [0.0] * 7}, 'camera_poses: 7 numbers; give six for each camera'),
    ({'camera_files': ['a.yaml']}, 'camera_files: 1 for 2 cameras'),
    ({'cameras': [1.0, 2.0]}, 'is not a text'),
])  # fmt: skip
def test_lists_of_another_length_or_kind_are_refused(bench, parameters, why):
    with pytest.raises(ConfigError, match=why):
        bench.run(OmnicamNode, False, **{'cameras': ['front', 'rear'], **parameters})
