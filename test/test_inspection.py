# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Reports of `inspect`: contents, problems, the camera, and whether the drive suffices."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest
from cylinder_worlds import PICTURES, Spheres, recipe, run_in, wander
from real_cameras import STEP_DEG, desk_mirror, ordinary, street

from sfa_localization.bags.drives import ReadingRecipe
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera import kinds
from sfa_localization.camera.leveling import tilted
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.cli import main
from sfa_localization.inspection import (
    SAMPLES,
    InspectionConfig,
    covered_share,
    directions,
    headings_differ,
    hull_area,
    inspect,
    lacks_of_drives,
    path_length,
)
from sfa_localization.mapping.drive_check import ROUTE

START = 1_700_000_000_000_000_000
STEP = 200_000_000
ENOUGH = InspectionConfig(min_pictures=150)


def star(share):
    """Cross a square of 8 m in all directions."""
    return 4 * np.sin(2 * np.pi * np.array([5 * share + 0.06, 7 * share]))


def circle(share):
    return 8 * np.cos(6.28 * share), 8 * np.sin(6.28 * share)


def eight(share):
    return 8 * np.sin(6.28 * share), 8 * np.sin(12.56 * share)


def cross(share):
    """Along x and back to the middle, then along y to both sides; it turns within 3 m."""
    driven = np.linspace(0, 98, 981)
    headings = np.interp(
        driven, [30, 33, 48, 51, 66, 69], np.pi * np.array([0, 1, 1, 0.5, 0.5, 1.5])
    )
    path = np.cumsum(np.exp(1j * headings)) * 0.1
    at = np.interp(share * driven[-1], driven, path)
    return at.real, at.imag


def write(
    path, route=star, pictures=400, shape=(8, 60), brightness=120, until=1.0, speed=1.0, body=()
):
    """Record a drive along a route with a picture every 0.2 s, which turns with the robot."""
    rng = np.random.default_rng(0)
    around = rng.integers(0, 2 * brightness + 1, (shape[0], 360, 3), np.uint8)
    with BagWriter(path) as bag:
        for index in range(pictures):
            at, share = START + index * STEP, index / pictures
            moved = np.subtract(route(share + 1e-4), route(share))
            heading = np.arctan2(moved[1], moved[0])
            turned = np.roll(around, round(np.degrees(heading)), axis=1)
            view = turned if shape[1] > 4 * shape[0] else turned[:, :90]
            picture = cv2.resize(view, shape[::-1], interpolation=cv2.INTER_AREA)
            picture[0] = rng.integers(0, 2 * brightness + 1, (shape[1], 3), np.uint8)
            for top, left, right, color in body:
                picture[top:, left:right] = color
            bag.image('/panorama', at, picture, 'camera')
            if share <= until:
                bag.odometry('/odom', at, (*route(share), heading), (speed, 0.0), (0.0, 0.0))
    return path


def write_each(path, count=20, picture=None, image_at=None, odometry_at=None):
    """Record a robot that stands; functions of the index give pictures and stamps other than so."""
    with BagWriter(path) as bag:
        for index in range(count):
            at = START + index * STEP
            image = picture(index) if picture else np.full((8, 60, 3), index, np.uint8)
            bag.image('/panorama', image_at(index, at) if image_at else at, image, 'camera')
            at = odometry_at(index, at) if odometry_at else at
            bag.odometry('/odom', at, (0, 0, 0), (0, 0), (0, 0))
    return path


def test_a_good_drive_is_enough(tmp_path):
    report = inspect(write(tmp_path / 'bag'), config=ENOUGH)
    assert report.lacks == [] and report.problems == []
    told = report.as_dict()
    assert told['enough_to_train_on'] is True
    assert told['topics']['/panorama'] == {
        'type': 'sensor_msgs/msg/Image', 'count': 400, 'recorded': 400, 'first_stamp_ns': START,
        'last_stamp_ns': START + 399 * STEP, 'rate_hz': 5.0, 'largest_gap_s': 0.2, 'problems': [],
    }  # fmt: skip
    assert told['facts']['images'] == '60x8, panorama: 7.5 times as wide as high'
    assert 'stood' not in told['facts'] and len(report.samples) == SAMPLES
    assert 'enough to train on' in report.as_text() and 'not enough' not in report.as_text()


@pytest.mark.parametrize(('options', 'reason'), [
    ({'pictures': 149}, '149 images with odometry are few'),
    ({'route': cross}, 'driven along 2 of 6 directions'),
    ({'route': eight}, 'of the area lie within 1 m of an image'),
    ({'route': lambda share: (0.0, 0.0), 'speed': 0.0}, 'the robot did not move'),
    ({'shape': (48, 64)}, 'the images do not show all directions'),
    ({'brightness': 4}, 'the images are dark'),
    ({'until': 0.5}, '199 of 400 images have no odometry nearby'),
    ({'pictures': 160}, 'm apart: drive slower'),
])  # fmt: skip
def test_it_gives_the_reason_why_a_drive_is_not_enough(options, reason, tmp_path):
    report = inspect(write(tmp_path / 'bag', **options), config=ENOUGH)
    assert reason in ' '.join(report.lacks), report.lacks
    assert f'not enough to train on: {report.lacks[0]}' in report.as_text()


def test_odometry_that_starts_again_at_zero_drives_no_further(tmp_path):
    def again(share):
        return 30 * (share % 0.5), 0.0

    report = inspect(write(tmp_path / 'bag', route=again, speed=0.375))
    assert path_length(report.places) == pytest.approx(30, abs=0.2)


def test_a_camera_that_is_described_may_look_like_any_other(tmp_path):
    bag, text = write(tmp_path / 'bag', shape=(48, 64)), 'do not show all directions'
    described = ReadingRecipe(camera=CameraConfig(camera_model='panorama'))
    assert text in ' '.join(inspect(bag).lacks)
    assert text not in ' '.join(inspect(bag, recipe=described).lacks)


def test_findings_are_printed_before_a_report_that_cannot_be_written_is_an_error(tmp_path, capsys):
    bag = write(tmp_path / 'bag', pictures=150)
    (tmp_path / 'file').write_text('no folder')
    assert main(['inspect', str(bag), '--report', str(tmp_path / 'file' / 'report')]) == 1
    told = capsys.readouterr()
    assert '/odom (Odometry): 150 messages' in told.out and 'report' in told.err


def test_the_exit_code_tells_a_drive_that_is_not_enough_from_one_that_cannot_be_read(tmp_path):
    bag = str(write(tmp_path / 'bag'))
    codes = [
        main(['inspect', *words])
        for words in ([bag], [bag, '--min-pictures', '9999'], [str(tmp_path / 'none')])
    ]
    assert codes == [0, 3, 1]


def lanes(apart, side):
    """Poses along lanes over a square, and straight back over all of them."""
    across = np.repeat(np.arange(0, side + 1e-9, apart), 2)
    order = np.arange(len(across))
    ends = np.append(across + 1j * side * (order // 2 % 2 != order % 2), [0.3j, side + 0.9j * side])
    along = np.interp(np.linspace(0, len(ends) - 1, 600), np.arange(len(ends)), ends)
    return np.column_stack([along.real, along.imag, np.zeros(600)])


@pytest.mark.parametrize(('lane', 'lacks'), [((6, 12), []), ((30, 30), ['of the area lie within'])])
def test_drives_in_frames_of_their_own_lack_what_no_arrangement_of_them_gives(lane, lacks):
    config, drive = InspectionConfig(min_pictures=1000), lanes(*lane)
    few, sparse, *_ = lacks_of_drives([drive], config)
    assert few.startswith('600 images') and 'of the area lie within' in sparse
    together = list(lacks_of_drives([drive, drive + 1.0], config))
    assert len(together) == len(lacks)
    assert all(map(str.__contains__, together, lacks))


def test_several_bags_are_judged_together(tmp_path, capsys):
    bags = [str(write(tmp_path / name, pictures=200 + k)) for k, name in enumerate('ab')]
    dark = [str(write(tmp_path / n, pictures=300 + k, brightness=4)) for k, n in enumerate('cd')]
    told = tmp_path / 'told.json'
    for words, code, verdict in (
        (bags, 0, 'together: enough to train on'),
        ([*bags, '--min-pictures', '402'], 3, 'together not enough: 401 images with odometry are'),
        ([*dark, '--json', str(told)], 3, f'together not enough: {dark[0]}, {dark[1]}: the images'),
        ([bags[0], bags[0]], 3, f'{bags[0]} and {bags[0]} are the same drive'),
    ):
        spacing = ['--max-spacing', '2.0']
        assert main(['inspect', *words, *spacing]) == code
        assert verdict in capsys.readouterr().out
    together = json.loads(told.read_text())['together']
    assert together['enough_to_train_on'] is False and len(together['lacks']) == 1


@pytest.mark.parametrize('route', [lambda share: (30 * share, 0.0), circle])
def test_a_single_route_is_enough_for_a_model_of_the_route(route, tmp_path):
    report = inspect(write(tmp_path / 'bag', route=route), config=ENOUGH)
    assert report.lacks == [] and ROUTE in report.notes


STRIPES = np.random.default_rng(5).integers(0, 256, (12, 1, 3), np.uint8)


@pytest.mark.parametrize(('parts', 'said'), [
    ([(0, 20, 40, STRIPES)], ': the view from 294 to 66 degrees'),
    ([(0, 0, 10, 90), (0, 50, 60, 90)], ': the view from 114 to 246 degrees'),
    ([(0, 0, 6, 0), (0, 30, 34, STRIPES)], ': the view from 120 to 204 degrees'),
    ([(0, 0, 6, 0), (0, 30, 34, STRIPES)], ': the view from 330 to 6 degrees'),
    ([(6, 10, 25, 40)], ': the lower 50% of the view from 24 to 126 degrees'),
    ([], ''),
])  # fmt: skip
def test_what_stays_the_same_while_the_robot_turns_is_the_robot(parts, said, tmp_path):
    """Its azimuths are named with a column more on both sides, of 6 degrees here; beside a black
    part the contrast of two more columns is that of the edge.
    """
    report = inspect(write(tmp_path / 'bag', shape=(12, 60), body=parts), config=ENOUGH)
    text = report.as_text()
    assert said in text and ('shows the robot' in text) == bool(said)


def test_of_a_robot_that_hardly_turns_nothing_is_said(tmp_path):
    """Then all that is far away stays the same."""
    route = {'route': lambda share: (30 * share, 2 * share), 'body': [(0, 20, 40, STRIPES)]}
    report = inspect(write(tmp_path / 'bag', shape=(12, 60), **route), config=ENOUGH)
    assert 'shows the robot' not in report.as_text()


def test_only_places_that_are_seen_again_in_other_headings_show_where_the_camera_sits():
    angle = np.linspace(0, 4 * np.pi, 400)
    loop = np.column_stack([4 * np.cos(angle), 4 * np.sin(angle), angle + np.pi / 2])
    assert not headings_differ(loop)
    back = np.column_stack([loop[:200, :2][::-1], loop[:200, 2][::-1] + np.pi])
    assert headings_differ(np.concatenate([loop[:200], back]))
    turning = np.column_stack([np.zeros((200, 2)), angle[:200]])
    assert not headings_differ(turning)
    assert headings_differ(np.concatenate([loop[:200], turning + np.array([4.0, 0.0, 0.0])]))


def test_pauses_sizes_repeated_images_and_faulty_messages_are_problems(tmp_path):
    def late(index, at):
        return at + (10**10 if index > 9 else 0)

    path = write_each(
        tmp_path / 'bag',
        picture=lambda index: np.full((8, 60 if index % 5 else 80, 3), index // 2, np.uint8),
        image_at=late,
        odometry_at=lambda index, at: 0 if index == 3 else late(index, at),
    )
    problems = {topic.name: topic.problems for topic in inspect(path).topics}
    assert problems['/odom'] == ['1 of 20 messages: zero or negative stamp', 'pause of 10.2 s']
    pause, sizes, repeated = problems['/panorama']
    assert (pause, sizes) == ('pause of 10.2 s', 'images of several sizes: 80x8, 60x8')
    assert repeated.endswith('of 20 images repeat the one before')
    (file,) = path.glob('*.mcap')
    shutil.copy(file, path / 'bag_1.mcap')
    assert 'bag_1.mcap is in the folder, but not in metadata.yaml' in inspect(path).problems[0]


def test_what_is_missing_or_cannot_be_read_is_named(tmp_path, capsys):
    def never(index, at):
        return 0

    for stamps, missing in (
        ({'image_at': never}, 'images'), ({'odometry_at': never}, 'odometry'),
        ({'image_at': never, 'odometry_at': never}, 'images and no odometry'),
    ):  # fmt: skip
        path = write_each(tmp_path / missing, 5, **stamps)
        assert inspect(path).lacks == [f'no {missing} could be read']
    with BagWriter(tmp_path / 'bag') as bag:
        bag.odometry('/odom', START, (0, 0, 0), (0, 0), (0, 0))
    assert 'has no' in inspect(tmp_path / 'bag').lacks[0]
    assert main(['inspect', str(tmp_path / 'odometry'), '--json', str(tmp_path / 'told.json')]) == 1
    topics = json.loads((tmp_path / 'told.json').read_text())['bags'][0]['topics']
    assert (topics['/odom']['count'], topics['/odom']['recorded']) == (0, 5)
    assert '5 of 5 messages: zero or negative stamp' in capsys.readouterr().out


def test_the_ground_tilts_the_camera_by_as_much_as_pairs_of_images_show(tmp_path):
    run = run_in(Spheres.about(1), wander(PICTURES, 2, hz=4.0), recipe().panorama)
    tilts = np.radians(4.0) * np.random.default_rng(0).normal(size=(PICTURES, 2))
    for name, factor, least, most in (('flat', 0.0, 0.0, 1.0), ('uneven', 1.0, 2.0, 5.0)):
        with BagWriter(tmp_path / name) as bag:
            for k, image in enumerate(run.panoramas.read(0, PICTURES)):
                at = int(run.odometry.stamps_ns[k])
                picture = tilted(image, factor * tilts[k], recipe().panorama.sphere)
                bag.image('/panorama', at, picture, 'camera')
                bag.odometry('/odom', at, run.odometry.poses[k], run.odometry.twists[k], (0, 0))
        told = inspect(tmp_path / name).facts['ground']
        (degrees,) = re.fullmatch(r'tilts the camera by at least ([\d.]+) degrees', told).groups()
        assert least <= float(degrees) <= most


def test_length_area_directions_and_coverage_of_a_square():
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]])
    square = np.stack([np.interp(np.linspace(0, 4, 801), range(5), axis) for axis in corners.T], 1)
    assert path_length(square) == pytest.approx(16.0)
    assert hull_area(square) == pytest.approx(16.0)
    assert directions(square) == 2 and directions(np.array([[0, 0], [5, 0], [0, 0]])) == 1
    assert hull_area(square[:2]) == 0.0 and covered_share(square[:2], 1.0) == 0.0
    # All but the inner 2 m x 2 m.
    assert covered_share(square, 1.0) == pytest.approx(1 - 4 / 16, abs=0.03)


def drawn(shape, *discs, hole=None):
    """Random pictures, black outside the discs (row, column, radius), and gray in the hole."""
    rng, (rows, columns) = np.random.default_rng(1), np.mgrid[: shape[0], : shape[1]]
    within = [np.hypot(rows - row, columns - column) < radius for row, column, radius in discs]
    for small in rng.integers(40, 255, (6, 12, 12, 3), np.uint8):
        picture = cv2.resize(small, shape[::-1], interpolation=cv2.INTER_CUBIC)
        if within:
            picture[~np.logical_or.reduce(within)] = 0
        if hole:
            picture[np.hypot(rows - hole[0], columns - hole[1]) < hole[2]] = 90
        yield picture


def test_the_kind_of_a_camera_is_guessed_from_its_images():
    """A wide strip, a picture that closes on itself, and circles; real and drawn."""
    narrow, square = (240, 320), (240, 240)
    for pictures, kind in (
        (drawn((60, 600)), kinds.PANORAMA), (drawn((200, 400)), kinds.ORDINARY),
        (street(6), kinds.EQUIRECTANGULAR), (street(1), kinds.EQUIRECTANGULAR),
        ((picture[60:240] for picture in street(6)), kinds.PANORAMA),
        ((picture[:, :400] for picture in street(6)), kinds.ORDINARY),
        (ordinary(6, size=narrow), kinds.ORDINARY),
        (drawn(narrow, (120, 160, 115)), kinds.FISHEYE),
        (drawn(square, (120, 120, 115), hole=(120, 120, 25)), kinds.MIRROR),
        (drawn((200, 400), (100, 100, 95), (100, 300, 95)), kinds.DUAL_FISHEYE),
    ):  # fmt: skip
        assert kinds.guess_geometry(list(pictures))[0] == kind


@pytest.mark.parametrize(('pictures', 'told', 'lack'), [
    (desk_mirror, 'mirror: a circle, and the camera itself in its middle', 'show the lens: drive'),
    (street, 'equirectangular: 2.0 times as wide as high', 'show the lens: drive 5 m, not 0.0'),
    (ordinary, 'ordinary camera: no circle', 'do not show all directions'),
])  # fmt: skip
def test_a_real_camera_is_named_and_what_its_lens_needs_to_be_learned(
    pictures, told, lack, tmp_path
):
    """A robot that turns on the spot, without driving, does not show it."""
    with BagWriter(tmp_path / 'bag') as bag:
        for index, picture in enumerate(pictures(8)):
            yaw = index * np.radians(STEP_DEG)
            bag.odometry('/odom', START + index * STEP, (0, 0, yaw), (0, 0), (0, 0))
            bag.image('/images', START + index * STEP, picture, 'camera', 'jpeg')
    report = inspect(tmp_path / 'bag')
    assert report.facts['images'].split(', ', 1)[1].startswith(told)
    assert lack in ' '.join(report.lacks), report.lacks


def test_the_command_writes_json_and_figures_whatever_the_name_of_a_bag(tmp_path, capsys):
    """Not UTF-8, and a formula for matplotlib; what was asked for comes before an error."""
    name = '\udcff a$x^$b'
    good, missing, report = write(tmp_path / name), tmp_path / 'missing', tmp_path / 'report'
    json_file = tmp_path / 'new' / 'bags.json'
    arguments = ['inspect', str(good), str(missing), '--json', str(json_file)]
    assert main([*arguments, '--report', str(report)]) == 1
    told = json.loads(json_file.read_text())['bags']
    assert [bag['path'] for bag in told] == [str(good), str(missing)]
    assert 'no such bag' in told[1]['error'] and told[1]['enough_to_train_on'] is False
    out, errors = capsys.readouterr()
    printed = name.replace('\udcff', '\\udcff')
    assert f'{tmp_path}/{printed}\n' in out and '/odom (Odometry): 400 messages, 5.0 Hz' in out
    assert errors.strip() == f'error: {missing}: no such bag; check the path'
    assert f'{printed} is enough' in (report / 'index.html').read_text()
    figures = [report / f'0_{name}_{what}.png' for what in ('pictures', 'path')]
    assert {*report.iterdir()} == {*figures, report / 'index.html'}
    for path in figures:
        assert cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR).std() > 5
