# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A camera beside the axle is learned with the map, and poses are those of base_link."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cylinder_worlds import Spheres
from metric_worlds import drive, meander, mixtures, straight
from numpy.testing import assert_allclose
from places import aligned_errors, as_complex, distances
from rosbags.typesys import Stores

from sfa_localization.bags.decoding import typestore
from sfa_localization.bags.drives import read_drives
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.static_transforms import lever_arm
from sfa_localization.bags.writer import BagWriter, blank
from sfa_localization.camera.panorama import filled, repeated_pixels
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.geometry import wrap_angle
from sfa_localization.data.rig import CAMERA_STD_M, UNKNOWN_YAW_STD, Quantity, Rig
from sfa_localization.keyframes.closures import Textures
from sfa_localization.keyframes.hidden import seen_in
from sfa_localization.keyframes.texture import quantized, texture
from sfa_localization.keyframes.turning import lever_square
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.mount import Mount
from sfa_localization.metric.pose_graph import Graph, graph_poses
from sfa_localization.metric.segments import cut_track, join
from sfa_localization.metric.stack import Stack
from sfa_localization.motion.dead_reckoning import OdometryTrack
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.training_input import Recipe, TrainingInput

CONFIG = SegmentConfig()
PANORAMA = PanoramaConfig(width=240, height=24)
LEVER = 0.3 - 0.2j
RIG = Rig(Quantity(0.3, 0.0), Quantity(-0.2, 0.0))


def camera_poses(poses, lever=LEVER, yaw=0.0):
    moved = lever * np.exp(1j * poses[:, 2])
    return np.column_stack([poses[:, 0] + moved.real, poses[:, 1] + moved.imag, poses[:, 2] + yaw])


def world(twists, start, cameras, mount=None, aside=0.0, noise_m=0.02):
    """Segments of drives with offsets between images of cameras, and the poses of these."""
    mount, parts, starts, poses = mount or Mount(), [], [], []
    for number, camera in enumerate(cameras):
        beside = (start[0], start[1] + number * aside, start[2])
        run = drive(twists, beside, yaw_noise=0.02, seed=number)
        starts.append(sum(map(len, poses)))
        poses.append(camera(run.poses))
        track = replace(OdometryTrack.of(run.odometry, CONFIG), lever=mount.lever)
        parts.append(cut_track(track, run.stamps_ns, CONFIG))
    poses = np.concatenate(poses)
    segments = replace(join(parts, starts), mount=mount)
    offsets = mixtures(Stack.of(segments), poses, noise_m, count=600)
    yaws = np.repeat(mount.of(len(cameras)).yaw, len(poses) // len(cameras))
    return replace(segments, offsets=offsets.of_robot(yaws)), poses


def learned(twists, start, cameras, mount=None, aside=0.0):
    """The mount after some steps, each from segments of the one before."""
    for _ in range(3):
        segments, poses = world(twists, start, cameras, mount, aside)
        graph = Graph.of(segments)
        mount = graph.mount
    return mount, graph, poses


@pytest.mark.parametrize('lever', [LEVER, 0j, -0.6 + 0.1j])
def test_the_place_of_the_camera_is_learned_with_the_graph(lever):
    mount, graph, poses = learned(*meander(150.0), [lambda base: camera_poses(base, lever)])
    error, std = abs(mount.lever - lever), np.sqrt(np.diag(mount.uncertainty)[:2])
    assert error < 0.04 and error < 3 * np.hypot(*std) and np.all(std < 0.1)
    assert graph.certificate.certified
    places, truth = (p[graph.stack.images, :2] for p in (graph_poses(graph, len(poses)), poses))
    assert aligned_errors(places, truth).mean() < 0.06


def test_a_drive_that_turns_nowhere_shows_no_place_of_the_camera():
    """All images of a place are taken at one heading: any lever only moves the map."""
    mount, _, _ = learned(straight(12.0), (0.0, 0.0, 0.0), [camera_poses] * 4, aside=0.3)
    assert np.all(np.sqrt(np.diag(mount.uncertainty)[:2]) > CAMERA_STD_M / 2)
    assert abs(mount.lever) < 0.2


def test_a_camera_that_was_turned_between_two_drives_is_learned():
    turned = np.radians(45.0)
    cameras = [camera_poses, lambda base: camera_poses(base, yaw=turned)]
    mount, graph, _ = learned(*meander(120.0), cameras)
    assert mount.yaw[0] == 0.0 and mount.yaw[1] == pytest.approx(turned, abs=np.radians(1.0))
    assert abs(mount.lever - LEVER) < 0.03 and graph.certificate.certified
    assert mount.quantities['camera_yaw'].std == UNKNOWN_YAW_STD


def test_base_and_camera_are_inverse():
    rng = np.random.default_rng(0)
    poses = rng.uniform(-3, 3, (20, 3))
    rig = replace(RIG, camera_yaw=Quantity(0.4, 0.0))
    for pose, seen in zip(poses, rig.camera(poses), strict=True):
        back, _ = rig.base(seen, np.zeros((3, 3)), 0j)
        assert distances(back, pose) < 1e-9 and abs(wrap_angle(back[2] - pose[2])) < 1e-9
    mount = Mount(LEVER, (0.0, 0.4))
    assert_allclose(mount.base(camera_poses(poses, yaw=0.4), 1), poses)


@pytest.mark.parametrize('yaw_std', [0.05, 1.5])
def test_the_covariance_of_the_base_is_that_of_its_samples(yaw_std):
    rng = np.random.default_rng(0)
    pose, stds = np.array([1.0, 2.0, 0.7]), np.array([0.05, 0.1, yaw_std])
    drawn = pose + rng.normal(size=(200_000, 3)) * stds
    places = as_complex(drawn) - LEVER * np.exp(1j * drawn[:, 2])
    base, covariance = RIG.base(pose, np.diag(stds**2), 0j)
    assert abs(places.mean() - complex(*base[:2])) < 2e-3
    true = np.trace(np.cov(places.real, places.imag))
    assert np.trace(covariance[:2, :2]) == pytest.approx(true, rel=0.25)
    samples = np.column_stack([places.real, places.imag, drawn[:, 2]])
    if yaw_std == 0.05:
        assert_allclose(covariance, np.cov(samples.T), atol=2e-4)


def test_an_uncertain_lever_matters_where_the_robot_heads_elsewhere_than_in_training():
    unsure = Rig(Quantity(0.0, 0.3), Quantity(0.0, 0.3))
    pose, spread = np.array([0.0, 0.0, 1.0]), np.diag([0.01, 0.01, 1e-6])
    _, same = unsure.base(pose, spread, complex(np.exp(1j)))
    _, opposite = unsure.base(pose, spread, complex(-np.exp(1j)))
    assert same[0, 0] == pytest.approx(0.01, abs=1e-6)
    assert opposite[0, 0] == pytest.approx(0.01 + (2 * 0.3) ** 2, rel=1e-3)


def test_what_no_robot_has_is_refused_and_a_record_comes_back_as_it_was():
    for name, *wrong in (
        ('camera_ahead', np.nan, 0.1), ('camera_left', 9.0, 0.1), ('wheel_scale', 0.0, 0.01),
        ('camera_delay', 60.0, 0.01), ('turn_loss', 0.0, -1.0),
    ):  # fmt: skip
        with pytest.raises(DataError):
            Rig(**{name: Quantity(*wrong)})
    rig = replace(RIG, camera_delay=Quantity(0.12, 0.03))
    assert Rig.from_mapping(rig.to_mapping()) == rig
    for wrong in ({'camera_ahead': [1.0]}, {'unknown': [0.0, 0.0]}, {'camera_ahead': 'ab'}):
        with pytest.raises(DataError):
            Rig.from_mapping(wrong)


def static_bag(path, links, image_frame, base):
    """A bag of an image, an odometry message and static transforms: child, parent, place, turn."""
    odometry, image = message('nav_msgs/msg/Odometry'), message('sensor_msgs/msg/CompressedImage')
    odometry.child_frame_id, image.header.frame_id, image.format = base, image_frame, 'jpeg'
    static = message('tf2_msgs/msg/TFMessage')
    for child, parent, place, turn in links:
        link = message('geometry_msgs/msg/TransformStamped')
        link.header.frame_id, link.child_frame_id = parent, child
        shift, rotation = link.transform.translation, link.transform.rotation
        shift.x, shift.y, shift.z = place
        rotation.x, rotation.y, rotation.z, rotation.w = turn
        static.transforms.append(link)
    with BagWriter(path) as bag:
        for topic, content in (('/tf_static', static), ('/odom', odometry), ('/image', image)):
            bag.message(topic, 1_000_000_000, content)
    return path


def message(kind):
    return blank(typestore(Stores.ROS2_JAZZY), kind)


HALF = np.sqrt(0.5)
TO_THE_LEFT = (0.0, 0.0, HALF, HALF)
LINKS = [
    ('base_link', 'base_footprint', (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)),
    ('mast', 'base_link', (0.2, 0.0, 0.5), TO_THE_LEFT),
    ('camera', 'mast', (0.1, 0.05, 0.3), (1.0, 0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize(('links', 'frames', 'place'), [
    (LINKS, ('/camera', 'base_footprint'), 0.15 + 0.1j),  # the mast looks to the left
    (LINKS, ('camera', 'elsewhere'), None),
    ([('camera', 'camera', (1.0, 0.0, 0.0), TO_THE_LEFT)], ('camera', 'base_link'), None),
    ([('camera', 'base_link', (1.0, 0.0, 0.0), (0.0,) * 4)], ('camera', 'base_link'), None),
])  # fmt: skip
def test_static_transforms_say_where_the_camera_sits(tmp_path, links, frames, place):
    path = static_bag(tmp_path / 'bag', links, *frames)
    with Bag(path) as bag:
        lever = lever_arm(bag, '/image', '/odom')
    assert lever == (place if place is None else pytest.approx(place))


def test_a_measured_lever_arm_stays_and_is_named_where_images_contradict_it():
    wrong = Mount.at(-0.5 + 0j)
    mount, _, _ = learned(*meander(150.0), [camera_poses], wrong)
    assert abs(mount.lever + 0.5) < 0.1
    assert 'stated to be -0.50 m ahead' in mount.contradiction
    assert abs(mount.learned[0] - LEVER) < 0.1
    right, _, _ = learned(*meander(150.0), [camera_poses], Mount.at(LEVER))
    assert abs(right.lever - LEVER) < 0.02 and not right.contradiction


def test_images_that_change_in_turns_tell_a_lever_from_wheels_that_slip():
    """Links alone take slip for a lever; a camera that only turns shows that there is none."""
    segments, _ = world(*meander(150.0), [camera_poses])
    for square, std, lever in ((0.13, 0.01, LEVER), (0.0, 0.002, 0j)):
        mount = replace(Mount(), turning=Quantity(square, std))
        learned_lever = Graph.of(replace(segments, mount=mount)).mount.lever
        assert abs(learned_lever - lever) < 0.06, (square, learned_lever)


@pytest.mark.parametrize('hidden', [False, True])
@pytest.mark.parametrize('lever', [0j, 0.1 + 0j, 0.2 - 0.2j])
def test_images_change_in_turns_as_far_as_the_camera_moves(lever, hidden):
    """On the spot and on straight ways, among things around, of which the robot hides a sixth."""
    turns = np.linspace(0.0, 6.0, 61)
    spot = np.column_stack([np.zeros((61, 2)), turns])
    ahead = np.column_stack([np.linspace(0.0, 3.0, 31), np.zeros((31, 2))])
    base = np.concatenate([spot, ahead])
    images = Spheres.about(0).panoramas(camera_poses(base, lever), PANORAMA)
    view = np.ones(images.shape[1:3], bool)
    if hidden:
        view[:, : view.shape[1] // 6] = False
        images = filled(images, repeated_pixels(view))
    textures = np.concatenate([quantized(texture(image)[None]) for image in images])
    view = seen_in(view, *textures.shape[1:]) if hidden else None
    path = np.concatenate([np.zeros(61), 10.0 + np.linspace(0.0, 3.0, 31)])
    count = np.arange(len(base))
    views = Textures(textures, count, np.zeros_like(count), path, view)
    seen = lever_square(views, base[:, 2])
    if hidden:
        assert abs(seen.value - abs(lever) ** 2) < 0.05  # 3 to 11 if all were compared
    else:
        assert abs(np.sqrt(seen.value) - abs(lever)) < 0.05 + 0.5 * abs(lever)
    few = Textures(textures[:20], count[:20], np.zeros(20, int), path[:20])
    assert lever_square(few, base[:20, 2]) is None


@pytest.mark.slow
def test_a_place_that_is_set_is_kept_and_compared_with_the_images(tmp_path, caplog):
    """The camera of the sample is above the axle."""
    recipe = Recipe(metric=MetricConfig(camera_xy=(0.4, 0.0)))
    runs = read_drives([Path('bags/sample')], tmp_path, recipe)
    mount = TrainingInput.of(runs, recipe).drives.mount
    assert abs(mount.lever - 0.4) < 0.05 and 'check camera_xy' in caplog.text
    with pytest.raises(ConfigError, match='camera_xy'):
        MetricConfig(camera_xy=(0.4,))
