# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Measured points give a map its place, heading and scale, and say which of them are wrong."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import (
    PICTURES,
    PLACE_SIZE,
    SMALL_RECIPE,
    Spheres,
    panorama_config,
    run_in,
    wander,
)
from filter_drives import FilterDrive
from metric_worlds import drive, exact_features, grid, mixtures, stand, straight, turn
from numpy.testing import assert_allclose
from places import as_complex, distances, lengths
from rosbags.typesys import Stores

from sfa_localization.bags.decoding import typestore
from sfa_localization.bags.writer import BagWriter, blank
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import RigidTransform, align, relative
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import PanoramaArray, Points, Run
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.keyframes.closures import Closures
from sfa_localization.localizer import Localizer
from sfa_localization.mapping.drives import Drive, Drives, learn_map, with_points
from sfa_localization.mapping.learning import learn_metric
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.measured_points import MeasuredPoints, Settled, settle
from sfa_localization.metric.points import points_of, read_points, stops
from sfa_localization.metric.stack import Stack
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.reports.summary import summary
from sfa_localization.reports.training import write_training_report
from sfa_localization.training import train

STD = 0.01
CORNERS = np.array([-6 - 7j, 6 + 7j, -6 + 7j, 6 - 7j, 0.5 + 0.5j])
CONFIG = MetricConfig(metric_map='monomials', slow_features=5)
WHEELS = 1.02
"""Wheels count so many meters of one."""


def points(places):
    """Points at places (K,), known to STD."""
    return Points.of([(f'point {k}', k, complex(at), STD, 0j) for k, at in enumerate(places)])


def settled(measured, places, std=0.02):
    """What points say of a map that puts them at places, each as well as `std` says."""
    count = len(places)
    beside = MeasuredPoints(
        points(measured), np.arange(count), np.zeros(count, complex), Settled(None)
    )
    return settle(beside, np.asarray(places), std**2 * np.eye(count, dtype=complex))


def counted(places, seed=0, std=0.02):
    """Places as a drive puts them, in its own frame and the meters of its wheels."""
    rng = np.random.default_rng(seed)
    error = std * (rng.standard_normal(len(places)) + 1j * rng.standard_normal(len(places)))
    return WHEELS * np.exp(0.8j) * places + 3 - 2j + error


def test_points_apart_give_heading_and_scale_as_well_as_they_say():
    for measured in (CORNERS, CORNERS[:2], np.array([-6, 0, 7])):  # these are on a line
        results = [settled(measured, counted(measured, seed)) for seed in range(50)]
        assert all(result.used.all() and result.turned for result in results)
        errors = [(result.scale * WHEELS - 1) / result.scale_std for result in results]
        assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3


@pytest.mark.parametrize('wrong', range(5))
def test_a_wrong_point_of_five_is_an_outlier(wrong):
    for seed in range(20):
        measured = CORNERS + 2.0 * np.exp(1j * seed) * (np.arange(5) == wrong)
        result = settled(measured, counted(CORNERS, seed))
        assert result.used.tolist() == [k != wrong for k in range(5)]
        assert result.scale * WHEELS == pytest.approx(1.0, abs=4 * result.scale_std)


def test_points_at_the_same_place_fix_the_place_only():
    for measured in (CORNERS[:1], CORNERS[[0, 0]], np.array([0.0, 0.02])):
        result = settled(measured, counted(measured))
        assert result.used.all() and not result.turned and result.scale == 1.0


def test_points_that_cannot_be_of_the_drive_are_an_error_that_says_why():
    with pytest.raises(DataError, match='exchange x and y'):
        settled(CORNERS.conj() * 1j, counted(CORNERS))
    with pytest.raises(DataError, match='are they in meters'):
        settled(3.28 * CORNERS, counted(CORNERS))
    marks = np.array([0, 7 + 1j, 9 + 6j, 2 + 8j, -3 + 4j])
    with pytest.raises(DataError, match='numbered as inspect'):
        settled(np.roll(marks, 1), counted(marks))
    nowhere = MeasuredPoints(points(CORNERS), np.full(5, -1), np.zeros(5, complex), Settled(None))
    with pytest.raises(DataError, match='are their stamps those of the bags'):
        settle(nowhere, counted(CORNERS), np.eye(5, dtype=complex))


HALF_M = 6.0  # of the garden

# With a map.


@functools.cache
def world():
    """A drive in a garden: its odometry, features, true poses at the images."""
    run = drive(
        grid(2 * HALF_M, 1.2, 9), (-HALF_M, -5.0, 0.0), yaw_noise=0.02, speed_noise=0.05, bias=0.001
    )
    poses, twists = run.odometry.poses * [WHEELS, WHEELS, 1], run.odometry.twists * [WHEELS, 1]
    odometry = replace(run.odometry, poses=poses, twists=twists)
    noise = 0.02 * np.random.default_rng(1).standard_normal((len(run.poses), 5))
    return odometry, run, exact_features(run.poses) + noise


def measured_at(rows, wrong=None):
    """Points at images of the world, in its owner's coordinates, and one 2 m beside."""
    _, run, _ = world()
    rng = np.random.default_rng(7)
    places = run.poses[rows, 0] + 1j * run.poses[rows, 1]
    places = places + STD * (rng.standard_normal(len(rows)) + 1j * rng.standard_normal(len(rows)))
    places[[] if wrong is None else [wrong]] += 2.0
    stamps = run.stamps_ns[rows].tolist()
    return Points.of(
        [(f'point {k}', stamps[k], at, STD, 0j) for k, at in enumerate(places.tolist())]
    )


def drive_of(run, odometry):
    images = PanoramaArray(run.stamps_ns, np.zeros((len(run.stamps_ns), 1, 1, 3), np.uint8))
    return Drive(Run('drive', images, odometry), run.poses[:, 2].tolist())


def test_points_of_an_antenna_are_placed_beside_base_link():
    """At stamps between images, in turns too."""
    odometry, run, _ = world()
    antenna = -0.4 + 0.3j
    stamps = run.stamps_ns[5:-5:40] + 60_000_000
    poses = odometry.trajectory.at(stamps)
    places = (as_complex(poses) + antenna * np.exp(1j * poses[:, 2])).tolist()
    rows = zip(stamps.tolist(), places, strict=True)
    given = Points.of([('fix', *row, STD, antenna) for row in rows])
    drives = [(odometry, run.stamps_ns)]
    measured = MeasuredPoints.of(given, drives, np.arange(len(run.poses)))
    near = odometry.trajectory.at(run.stamps_ns[measured.images])
    beside = as_complex(near) + measured.offset * np.exp(1j * near[:, 2])
    assert_allclose(beside, places, atol=1e-9)


@functools.cache
def learned(rows=(), wrong=None):
    """Segments and the map of the world by points at some images, and by offsets."""
    odometry, run, features = world()
    item = drive_of(run, odometry)
    given = measured_at(list(rows), wrong) if rows else None
    drives = Drives((item,), Closures.none(), SegmentConfig(yaw_source='odometry'), points=given)
    offsets = mixtures(Stack.of(drives.cut()), run.poses, noise_m=0.02)
    return in_coordinates(replace(drives, offsets=offsets), features)


def in_coordinates(drives, features):
    """Segments and the map, without turned maps."""

    def again(segments):
        result = learn_metric(features, segments, CONFIG)
        return result, None, result

    segments, first = learn_map(drives, features, CONFIG)
    segments, maps = with_points(drives, segments, (first, None, first), again)
    return segments, maps[-1]


def errors(rows=(), wrong=None):
    """Mean errors (m) in the owner's coordinates, and by the best similarity; its scale."""
    _, result = learned(rows, wrong)
    images, places = result.images, result.poses[:, :2]
    true = as_complex(world()[1].poses[images])
    places = as_complex(places)
    frame = np.column_stack([places, np.ones(len(places))])
    best = np.linalg.lstsq(frame, true, rcond=None)[0]
    return np.abs(places - true).mean(), np.abs(frame @ best - true).mean(), abs(best[0])


def corners():
    """Images at the ends of the garden, and one amid it."""
    places = world()[1].poses[:, :2]
    ends = [int(np.argmax(places @ way)) for way in ([1, 1], [-1, -1], [1, -1], [-1, 1])]
    return (*ends, int(np.argmin(lengths(places))))


def test_a_map_lies_in_the_coordinates_of_its_points():
    rows = corners()
    before, rest, _ = errors()
    assert before > 1.0
    for chosen, wrong in ((rows[:2], None), (rows, None), (rows, 2)):
        error, by_similarity, scale = errors(chosen, wrong)
        segments, result = learned(chosen, wrong)
        # Heading and scale are as good as points and drive are there.
        scale_std = segments.points.settled.scale_std
        assert error < 1.25 * max(by_similarity, rest) + scale_std * HALF_M
        assert abs(scale - 1.0) < 3 * scale_std
        assert result.graph.certificate.certified


def test_the_wrong_point_is_named_and_missed_by_what_it_is_wrong():
    segments, result = learned(corners(), 2)
    figures = segments.points.quality(result.points)['points']
    assert [point['used'] for point in figures] == [True, True, False, True, True]
    assert figures[2]['miss_m'] == pytest.approx(2.0, abs=0.1)
    assert max(point['miss_m'] for point in figures if point['used']) < 0.1
    (warning,) = segments.points.warnings(result.points)
    assert warning.startswith('point 2: ')


def test_a_single_point_moves_the_map_of_the_odometry():
    plain, (segments, result) = learned()[1], learned(corners()[:1])
    moved = result.poses[:, :2] - plain.poses[:, :2]
    assert np.abs(moved - moved.mean(0)).max() < 1e-2 < np.abs(moved.mean(0)).max()
    assert segments.points.quality(result.points)['points'][0]['miss_m'] < 1e-9
    assert segments.points.settled.scale == 1.0


def test_points_bend_a_route_straight():
    """Odometry that turns by more than it says leaves a route as bent; points do not."""
    legs = [straight(40), turn(np.pi / 2), straight(25), turn(np.pi / 2), straight(20)]
    run = drive(np.vstack(legs), yaw_noise=0.05, bias=0.001)
    features = exact_features(run.poses[:, :2] / 4)
    item = drive_of(run, run.odometry)
    rows, config = np.linspace(5, len(run.poses) - 6, 8).astype(int), SegmentConfig()
    given = Points.of([
        (str(k), int(run.stamps_ns[row]), complex(*run.poses[row, :2]), STD, 0j)
        for k, row in enumerate(rows.tolist())
    ])  # fmt: skip
    missed = []
    for measured in (None, given):
        drives = Drives((item,), Closures.none(), config, points=measured)
        _, result = in_coordinates(drives, features)
        places, true = result.poses[:, :2], run.poses[result.images, :2]
        places = align(places, true).apply(places) if measured is None else places
        missed.append(distances(places, true).mean())
    assert missed[1] < missed[0] / 3


# Files, topics and stops.


def standing():
    """Odometry that stands for 3 s at 0 m and at 4 m, and for 1 s at 2 m."""
    parts = stand(3), straight(2), stand(1), straight(2), turn(1.0), stand(3), straight(1)
    return drive(np.vstack(parts)).odometry


def test_stops_are_named_by_their_number(tmp_path):
    odometry, file = standing(), tmp_path / 'points.csv'
    seconds = (stops(odometry) - odometry.stamps_ns[0]) * 1e-9
    assert seconds == pytest.approx(
        np.array([[0.0, 3.0], [8.0 + 1 / 0.6, 11.0 + 1 / 0.6]]), abs=0.1
    )
    file.write_text('stamp_s,x_m,y_m,std_m\n# a mark\nstop, 2, 4.0, 1.5\n12.5, 3, -1, 0.05\n')
    read = read_points(file, [odometry])
    assert read.names == ('stop 2', 'point of 12.5 s')
    assert read.stamps_ns == pytest.approx([stops(odometry)[1].mean(), 12_500_000_000], abs=1)
    assert read.places.tolist() == [4 + 1.5j, 3 - 1j] and read.std.tolist() == [0.02, 0.05]


@pytest.mark.parametrize(('line', 'said'), [
    ('stop, 3, 1, 1', 'stands 2 times'), ('stop, 0, 1, 1', 'no stop 0'),
    ('12.5, 1', 'is no point'), ('12.5, one, 2', 'is no point'), ('12.5, 1, 2, 0', 'is no point'),
    ('12.5, nan, 2', 'is no point'), ('# nothing', 'holds no points'),
    ('stop, 3, 1, 1\nstop, 1, O, 1', "line 2: 'stop, 1, O, 1' is no point"),
])  # fmt: skip
def test_a_line_that_is_no_point_is_an_error_that_names_it(tmp_path, line, said):
    file = tmp_path / 'points.csv'
    file.write_text(line)
    with pytest.raises(DataError, match=said):
        read_points(file, [standing()])


def test_a_point_of_no_drive_is_an_error_before_anything_is_learned(tmp_path):
    file = tmp_path / 'points.csv'
    file.write_text('Stop, 2, 4.0, 1.5\n12.5, 3, -1\n')
    run = drive(np.vstack([stand(3), straight(4), stand(3), straight(1)]))
    with pytest.raises(DataError, match=r'line 2: point of 12\.5 s: outside of the drives'):
        points_of([run], str(file))


def clicked(stamp_ns, place):
    """What RViz publishes for a click on the map."""
    message = blank(typestore(Stores.ROS2_JAZZY), 'geometry_msgs/msg/PointStamped')
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.header.frame_id, message.point.x, message.point.y = 'map', place.real, place.imag
    return message


def test_points_clicked_on_the_map_of_a_lidar_give_a_model_its_coordinates(tmp_path):
    """The demo of config/nav2.md; here the map counts from the equator."""
    run = run_in(Spheres.about(1), wander(PICTURES, 2, hz=4.0), panorama_config(PLACE_SIZE))
    odometry, images = run.odometry, run.panoramas.read(0, PICTURES)
    in_lidar_map = RigidTransform(452_020.0, 5_411_005.0, 2.5).apply(odometry.poses[:, :2])
    with BagWriter(tmp_path / 'drive') as bag:
        for k, stamp in enumerate(odometry.stamps_ns.tolist()):
            counted = odometry.poses[k] * [WHEELS, WHEELS, 1.0], odometry.twists[k] * [WHEELS, 1.0]
            bag.odometry('/odom', stamp, *counted, (1e-4, 1e-4))
            bag.image('/panorama', stamp, images[k], 'base_link')
            if k % 20 == 10:
                bag.message('/clicked_point', stamp, clicked(stamp, complex(*in_lidar_map[k])))
    topics = replace(SMALL_RECIPE.topics, points_topic='/clicked_point')
    trained = train([tmp_path / 'drive'], tmp_path / 'm.npz', replace(SMALL_RECIPE, topics=topics))
    model = PlaceModel.load(tmp_path / 'm.npz')
    positions = np.array([model.locate(image).position for image in images[::5]])
    assert distances(positions, in_lidar_map[::5]).mean() < 0.15
    scale = model.rig.wheel_scale
    assert scale.value * WHEELS == pytest.approx(1.0, abs=3 * scale.std)
    assert Localizer(model).filter.scale == scale.value
    assert 'wheels: 0.9' in summary(trained)
    write_training_report(tmp_path / 'report', trained)
    assert 'missed by' in (tmp_path / 'report' / 'index.html').read_text('utf-8')


def test_the_filter_drives_in_the_meters_of_the_model_from_when_it_is_told():
    """On the way, where the pose of odometry goes on without a jump."""
    trip = FilterDrive(seconds=10.0, scale=1 / WHEELS)
    fused = PoseFilter(FilterConfig(initial_pose=(0.0, 0.0, 0.0)))
    for k, stamp in enumerate(trip.stamps_ns.tolist()):
        if k == 200:
            before = fused.state.pose
            fused.expect(Rig(wheel_scale=Quantity(1 / WHEELS, 0.03)))
        fused.add_odometry(stamp, *trip.read[k], trip.variances(), trip.reckoned[k])
    moved, true = relative(before, fused.state.pose), relative(*trip.poses[[199, -1]])
    assert moved == pytest.approx(true, abs=1e-6)
