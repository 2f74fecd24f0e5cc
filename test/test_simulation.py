# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator: geometry of its pictures, routes, errors of sensors, light, season, bags."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from places import distances, lengths
from rosbags.interfaces import QosDurability
from scipy.spatial.transform import Rotation

from sfa_localization.bags.decoding import decode
from sfa_localization.bags.reader import Bag
from sfa_localization.camera.calibration_files import calibration_of_info
from sfa_localization.camera.lenses import make_camera, turned_camera
from sfa_localization.camera.leveling import tilted
from sfa_localization.camera.panorama import Unwrapper, panorama_rays
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.geometry import compose, relative, wrap_angle
from sfa_localization.data.messages import read_stamp
from sfa_localization.data.run import integrate
from sfa_localization.simulation import drive as drives
from sfa_localization.simulation.cameras import simulated_cameras
from sfa_localization.simulation.drive import START_NS, drive, lights, render_images, simulate
from sfa_localization.simulation.garden import Garden, panel, rounded
from sfa_localization.simulation.rendering import Dome, Light, Scene, panorama_view, raw_view
from sfa_localization.simulation.routes import CLEARANCE_M, Lawn
from sfa_localization.simulation.seasons import SEASONS
from sfa_localization.simulation.settings import SimulationConfig

pytestmark = pytest.mark.usefixtures('gardens')
TINY = SimulationConfig(area=(8.0, 8.0), length=20.0, images='panorama', images_every=0.4)
SMALL = PanoramaConfig(width=300, height=30)
EXACT = dict.fromkeys(('scale_error', 'slip', 'speed_noise', 'gyro_bias', 'gyro_noise'), 0.0)


@pytest.fixture(scope='module')
def tiny():
    return Garden(1, TINY)


@pytest.fixture(scope='module')
def garden():
    return Garden(1)


def psnr(one, other):
    return 10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2))


def panorama_of(garden, pose, panorama):
    """The noiseless panorama from a pose."""
    return rounded(garden.image(pose, panorama_view(panorama)))


def odometry_errors(garden, config):
    """Errors (N, 3) of the odometry from the true start on, wherever its own frame lies."""
    recorded = drive(garden, config)
    poses = recorded.odometry.poses
    return compose(garden.dock, relative(poses[0], poses)) - recorded.truth.poses


def test_a_box_appears_where_it_stands():
    """A wall 2 m wide, 1 m high at 4 m to the left of a robot looking along +x."""
    wall = panel([-1, 4, 0], [2, 0, 0], [0, 0, 1], 1.0, 'plain', (1.0, 1.0, 1.0))
    scene = Scene([wall], np.array([0, -1, 0.0]), np.random.default_rng(0))
    dome = Dome.build(np.radians(np.arange(19.5, -20, -1)), 360)
    dark, bright = (
        scene.look(np.array([0, 0, 0.45]), 0.0, dome, Light(sun=sun)) for sun in (0.0, 1.0)
    )
    rows, columns = np.nonzero((bright != dark).any(-1))
    azimuth, elevation, half = -(columns + 0.5 - 180), 19.5 - rows, np.degrees(np.arctan2(1, 4))
    assert (azimuth.min(), azimuth.max()) == pytest.approx((90 - half, 90 + half), abs=1)
    ends = np.degrees(np.arctan2([-0.45, 0.55], 4))
    assert (elevation.min(), elevation.max()) == pytest.approx(ends, abs=1)


def test_turning_shifts_columns(tiny):
    """A robot that turns counter-clockwise sees a thing ahead move clockwise: columns grow."""
    pose = np.array([0.5, -1.0, 0.4])
    ahead = panorama_of(tiny, pose, SMALL).astype(int)
    turned = panorama_of(tiny, pose + np.array([0, 0, np.pi / 3]), SMALL).astype(int)
    assert np.mean(np.abs(turned - np.roll(ahead, 50, axis=1)) <= 1) > 0.995
    mirrored = panorama_of(tiny, pose, replace(SMALL, clockwise=False))
    assert np.array_equal(ahead[:, ::-1], mirrored)


def test_unwrapped_raw_images_equal_the_panorama(garden):
    pose = np.array([5.0, -6.0, 2.0])
    panorama, lens = panorama_of(garden, pose, PanoramaConfig()), LensCalibration()
    camera = make_camera(lens, (640, 640))
    raw = rounded(garden.image(pose, raw_view(camera.unproject, camera.size)))
    unwrapped = Unwrapper(CameraConfig(), PanoramaConfig(), lens)(raw)
    assert psnr(unwrapped, panorama) > 34 > 30 > psnr(np.roll(unwrapped, 3, axis=1), panorama)


def test_pictures_differ_by_place_world_light_and_noise(tiny):
    pose = tiny.dock
    here = panorama_of(tiny, pose, SMALL).astype(float)
    away = pose + np.array([0, 3.0, 0])
    for other in (panorama_of(tiny, away, SMALL), panorama_of(Garden(2, TINY), pose, SMALL)):
        assert np.abs(here - other).mean() > 8
    dimmed = tiny.image(pose, panorama_view(SMALL), Light(exposure=0.49))
    assert np.abs(dimmed / np.maximum(here, 20) - 0.7)[here > 60].max() < 0.02
    config = replace(TINY, illumination=0.0, length=3.0)
    recorded = drive(tiny, config)
    assert set(lights(recorded.image_stamps_ns, config)) == {Light()}
    strong = lights(recorded.image_stamps_ns, replace(config, illumination=1.0))
    assert np.ptp([light.sun for light in strong]) > 0.01
    noisy = next(iter(render_images(tiny, recorded, config, panorama_view(SMALL))))
    clean = panorama_of(tiny, recorded.image_poses[0], SMALL).astype(float)
    inside = (clean > 10) & (clean < 245)
    assert (noisy - clean)[inside].std() == pytest.approx(1.5, rel=0.06)


def test_uneven_ground_tilts_the_camera_by_place_and_heading(tiny):
    """The other way where the robot drives the other way, and a little anew in each image."""
    config, rng = replace(TINY, terrain=3.0), np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(-4, 4, (200, 2)), rng.uniform(-3, 3, 200)])
    there = np.degrees([drives.roll_and_pitch(pose, config, k) for k, pose in enumerate(poses)])
    back = np.degrees([drives.roll_and_pitch(np.add(p, [0, 0, np.pi]), config, 500) for p in poses])
    assert there.std(0) == pytest.approx([3.0, 3.0], rel=0.25)
    assert np.corrcoef(there.ravel(), back.ravel())[0, 1] < -0.9
    flat = panorama_of(tiny, tiny.dock, SMALL)
    for tilt in np.radians([[5.0, 0.0], [-2.0, 4.0]]):
        seen = tiny.image(np.append(tiny.dock, tilt), panorama_view(SMALL))
        expected = tilted(flat, tilt, SMALL.sphere)
        inner, off = slice(SMALL.height // 4, -SMALL.height // 4), np.abs(seen - flat).mean()
        assert np.abs(seen - expected)[inner].mean() < 0.5 * off


def test_drives_start_at_the_dock_keep_clear_and_take_pictures_as_asked(garden):
    """Nothing solid at hull height lies within the clearance, looking all around."""
    recorded = drive(garden, SimulationConfig(trajectory='test', seed=3))
    poses = recorded.truth.poses[::20]
    assert (np.abs(poses[:, :2]) <= garden.half + 0.02).all()
    solid = np.concatenate([shape.vertices[shape.faces] for shape in garden.shapes])
    solid = solid[((solid[..., 2] < 0.6) & (solid[..., 2] > 0.05)).any(1)].reshape(-1, 3)[:, :2]
    assert min(distances(solid, p[:2]).min() for p in poses) > CLEARANCE_M - 0.05
    assert np.allclose(poses[0], garden.dock) and recorded.truth.stamps_ns[0] == START_NS
    spacing = lengths(np.diff(recorded.image_poses, axis=0))
    turns = np.abs(wrap_angle(np.diff(recorded.image_poses[:, 2])))
    straight = spacing[(turns < 0.02) & (spacing < 0.5)]
    assert np.all(np.diff(recorded.image_stamps_ns) > 0)
    assert np.percentile(straight, [50, 99]) == pytest.approx(0.2, abs=1e-3)


def test_each_route_is_what_it_promises(garden):
    """Coverage reaches all in many directions, lines are long, the test curve smooth and closed."""
    poses = drive(garden, SimulationConfig(seed=2)).image_poses
    grid = np.stack(np.meshgrid(np.arange(-7, 8), np.arange(-8, 9)), -1).reshape(-1, 2)
    grid = grid[Lawn(garden.half, garden.obstacles).free(grid)]
    nearest = [distances(poses, point).min() for point in grid]
    assert max(nearest) < 2.0 and np.mean(nearest) < 0.5
    directions = np.histogram(poses[:, 2] % np.pi, bins=6, range=(0, np.pi))[0]
    assert directions.min() > 0.04 * len(poses) and 1400 < len(poses) < 1900
    poses = drive(garden, SimulationConfig(trajectory='lines', seed=4)).image_poses
    parts = np.split(poses, np.flatnonzero(lengths(np.diff(poses, axis=0)) > 0.4) + 1)
    assert len(parts) == 10
    for part in parts:
        assert distances(part[-1], part[0]) > 8.0 - 0.4
        assert np.ptp(np.unwrap(part[:, 2])) < 1e-6
    poses = drive(garden, SimulationConfig(trajectory='test', seed=7)).truth.poses
    assert distances(poses[-1], poses[0]) < 0.1
    x, y, turned = np.diff(poses, axis=0).T
    length = np.hypot(x, y)
    moving = length > 0.015
    assert (np.abs(wrap_angle(turned[moving])) / length[moving]).max() < 1 / 0.75
    assert 55 < length.sum() < 75


def test_odometry_drifts_like_the_papers_robot_or_as_drawn_or_not(garden):
    """0.31 m mean on every test curve, 1 to 3 m on coverage; over some seeds."""

    def drifts(**settings):
        configs = (SimulationConfig(seed=seed, **settings) for seed in range(4))
        return [lengths(odometry_errors(garden, c)).mean() for c in configs]

    assert drifts(trajectory='test') == pytest.approx([0.31] * 4, rel=0.05)
    covering, drawn = drifts(), drifts(trajectory='test', test_drift=0.0)
    assert 1.0 < np.mean(covering) < 3.0 and len(set(np.round(covering, 6))) == 4
    assert min(drawn) > 0.05 and max(drawn) < 1.5 and np.std(drawn) > 0.02
    exact = SimulationConfig(trajectory='test', seed=3, odometry_rate=10.0, **EXACT)
    off = odometry_errors(garden, exact)
    assert np.abs(off[:, :2]).max() < 1e-6 and np.abs(wrap_angle(off[:, 2])).max() < 1e-9
    recorded = drive(garden, exact)  # a twist is held since the last message
    summed = integrate(recorded.odometry.stamps_ns, recorded.odometry.twists, garden.dock)
    assert np.abs(relative(recorded.truth.poses, summed)).max() < 1e-3


def test_twist_variance_is_honest(garden):
    """Squared errors over their variances average to one, over seeds."""
    ratios = []
    for seed in range(20):
        config = SimulationConfig(trajectory='mower', seed=seed, odometry_rate=20.0)
        told, exact = (drive(garden, c).odometry for c in (config, replace(config, **EXACT)))
        moving = told.twists[:, 0] > 0.5
        ratios.append(((told.twists - exact.twists) ** 2 / told.variances)[moving].mean(0))
    assert np.mean(ratios, 0) == pytest.approx([1, 1], abs=0.2)


def test_light_and_season_change_plants_only_and_no_drive(tiny):
    leaves, first = [], drive(tiny, TINY)
    for season, light in zip(SEASONS, ('day', 'evening', 'overcast'), strict=True):
        config = replace(TINY, season=season, light=light)
        garden, changed = Garden(1, config), set()
        later = drive(garden, config)
        assert np.array_equal(later.image_poses, first.image_poses)
        assert np.array_equal(later.odometry.twists, first.odometry.twists)
        for before, after in zip(tiny.shapes, garden.shapes, strict=True):
            assert np.array_equal(before.vertices, after.vertices)
            if before.tint != after.tint or len(before.faces) != len(after.faces):
                changed.add(before.plant)
        plants = {'grass', 'crown', 'bush', 'bloom', 'hedge'}
        assert changed == (set() if season == 'summer' else plants)
        leaves.append(sum(len(s.faces) for s in garden.shapes if s.plant == 'crown'))
    assert leaves[0] > leaves[1] > 2 * leaves[2] > 0


FOUR = SimulationConfig(
    area=(8.0, 8.0), length=1.0, image_noise=0.0, illumination=0.0, cameras=4, camera_radius=0.0
)


def recorded_cameras(path):
    """Images of a bag by camera, with stamps, its lens, and rotation (3, 3) and place of its
    optical frame on base_link, as the messages hold them.
    """
    images, lenses, poses = {}, {}, {}
    with Bag(path) as bag:
        for topic, _, data in bag.messages({t for t in bag.topics if t[:3] not in ('/od', '/im')}):
            message, camera = decode(data, topic), topic.name.split('/')[1]
            if topic.name == '/tf_static':
                assert qos_is_latched(topic)
                for part in message.transforms:
                    t, q = part.transform.translation, part.transform.rotation
                    turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                    name = part.child_frame_id.removesuffix('_optical_frame')
                    poses[name] = turn, (t.x, t.y, t.z)
                    assert part.header.frame_id == 'base_link'
            elif topic.name.endswith('camera_info'):
                lenses[camera] = calibration_of_info(message)
            elif 'image' in topic.name:
                assert message.header.frame_id == f'{camera}_optical_frame'
                image = message.data.reshape(message.height, message.width, 3)
                images.setdefault(camera, []).append((read_stamp(message.header.stamp), image))
    return images, lenses, poses


def qos_is_latched(topic):
    return [offered.durability for offered in topic.qos] == [QosDurability.TRANSIENT_LOCAL]


def seen_by(image, lens, turn, rays):
    """What an image shows along rays (N, 3) in the robot's axes: colors (N, 3), NaN elsewhere."""
    pixels = turned_camera(lens, image.shape[:2], turn).project(rays)
    seen = np.isfinite(pixels[:, 0])
    columns, rows = np.rint(np.where(seen[:, None], pixels, 0)).astype(int).T
    return np.where(seen[:, None], image[rows, columns].astype(float), np.nan)


@pytest.mark.parametrize(
    ('settings', 'names'),
    [
        ({}, ('front', 'left', 'rear', 'right')),
        ({'cameras': 2, 'camera_fov': 190.0}, ('front', 'rear')),
        ({'cameras': 3, 'camera_fov': 140.0}, ('camera0', 'camera1', 'camera2')),
    ],
)
def test_cameras_in_one_place_show_the_panorama_along_their_recorded_axes(
    tmp_path, tiny, settings, names
):
    """Each pixel of the panorama is seen by a camera where its lens and /tf_static say, in the same
    color but for the size of pixels; and nowhere else.
    """
    config = replace(FOUR, images_every=3.0, images_every_turn=180.0, **settings)
    driven = simulate(config, tmp_path / 'bag')
    images, lenses, poses = recorded_cameras(tmp_path / 'bag')
    assert tuple(sorted(images)) == tuple(sorted(names))
    assert {len(each) for each in images.values()} == {len(driven.image_stamps_ns)}
    panorama = panorama_of(tiny, driven.image_poses[1], PanoramaConfig()).reshape(-1, 3)
    rays = panorama_rays(PanoramaConfig()).reshape(-1, 3)
    shown = np.stack([
        seen_by(images[name][1][1], lenses[name], poses[name][0], rays) for name in names
    ])  # fmt: skip
    ahead = rays[:, 0] > 0.9
    assert np.isfinite(shown[0, ahead]).all() and np.isnan(shown[0, rays[:, 0] < -0.9]).all()
    off = np.abs(np.nanmedian(shown, axis=0) - panorama).mean(-1)
    assert np.isfinite(off).all() and np.median(off) < 3
    turned = np.roll(panorama.reshape(60, 600, 3), 10, 1).reshape(-1, 3)
    assert np.median(off) < 0.3 * np.median(np.abs(turned - panorama).mean(-1))


def test_cameras_differ_by_place_exposure_and_time_as_asked(tmp_path, tiny):
    config = replace(
        FOUR,
        cameras=2,
        camera_radius=0.5,
        camera_size=(64.0, 48.0),
        camera_exposures=(1.0, 0.5),
        camera_skew=(0.0, 33.0),
    )
    driven = simulate(config, tmp_path / 'bag')
    images, _, poses = recorded_cameras(tmp_path / 'bag')
    places = {name: place for name, (_, place) in poses.items()}
    assert places['front'] == pytest.approx((0.5, 0.0, 0.45), abs=1e-9)
    assert places['rear'] == pytest.approx((-0.5, 0.0, 0.45), abs=1e-9)
    stamps = driven.image_stamps_ns
    assert [stamp for stamp, _ in images['front']] == stamps.tolist()
    assert [stamp for stamp, _ in images['rear']] == (stamps + 33_000_000).tolist()
    (_, front), (later, rear) = images['front'][1], images['rear'][1]
    ahead, behind = simulated_cameras(replace(config, camera_exposures=(), cameras=2))
    there = driven.truth.at(np.array([stamps[1], later]))
    expected = (
        tiny.image(compose(there[0], np.array([0.5, 0.0, 0.0])), ahead.view),
        tiny.image(compose(there[1], np.array([-0.5, 0.0, 0.0])), behind.view) / 2,
    )
    for image, picture in zip((front, rear), expected, strict=True):
        assert np.abs(image.astype(float) - rounded(picture)).mean() < 0.1


def test_a_camera_looks_further_left_than_its_pose_says_as_asked(tiny):
    config = replace(FOUR, cameras=2, camera_radius=0.0, camera_size=(64.0, 48.0))
    stated = simulated_cameras(config)
    true = simulated_cameras(replace(config, camera_yaws=(0.0, 10.0)))
    assert [camera.mounted for camera in true] == [camera.mounted for camera in stated]
    pose = np.array([1.0, 2.0, 0.3])
    left = pose + np.array([0.0, 0.0, np.radians(10.0)])
    assert_allclose(tiny.image(pose, true[1].view), tiny.image(left, stated[1].view), atol=0.5)
    assert_array_equal(tiny.image(pose, true[0].view), tiny.image(pose, stated[0].view))


@pytest.mark.parametrize(
    ('settings', 'text'),
    [
        ({'camera_skew': (0.0, 1.0)}, 'camera_skew: 2 numbers for 4 cameras'),
        ({'camera_yaws': (1.0,)}, 'camera_yaws: 1 numbers for 4 cameras'),
        ({'camera_exposures': (1.0,)}, 'camera_exposures: 1 numbers for 4 cameras'),
        ({'camera_size': (64.0,)}, 'camera_size: give columns x rows'),
        ({'images': 'panorama'}, 'leave it or cameras out'),
    ],
)
def test_settings_of_cameras_that_do_not_fit_are_named(tmp_path, settings, text):
    with pytest.raises(ConfigError, match=text):
        simulate(replace(FOUR, **settings), tmp_path / 'bag')
    assert not list(tmp_path.iterdir())


def test_uneven_ground_tilts_all_cameras_of_the_robot_alike(tiny):
    """The tilt is that of the robot, not of the ground below each camera."""
    config = replace(FOUR, terrain=5.0, camera_size=(64.0, 48.0), length=2.0)
    recorded = drive(tiny, config)
    (camera, *_), pose = simulated_cameras(config), recorded.image_poses[0]
    (image,) = islice(render_images(tiny, recorded, config, camera.view, 0.3j), 1)
    tilt = drives.roll_and_pitch(pose, config, 0)
    beside = compose(pose, np.array([0.0, 0.3, 0.0]))
    picture = rounded(tiny.image(np.append(beside, tilt), camera.view))
    assert np.abs(image.astype(float) - picture).mean() < 0.1


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_same_seeds_same_bytes(tmp_path, storage):
    config, written = replace(TINY, length=2.0, storage=storage), []
    for number, seed in enumerate((1, 1, 2)):
        bag = tmp_path / str(number) / 'bag'
        simulate(replace(config, seed=seed), bag, SMALL)
        written.append({file.name: file.read_bytes() for file in bag.iterdir()})
    assert written[0] == written[1] != written[2]
