# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Reports of `inspect`: contents, problems, the camera, and whether the drive suffices."""

import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from real_cameras import desk_mirror, fisheye, ordinary, street

from sfa_localization.bags.files import ZSTD_MAGIC
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.kinds import (
    DUAL_FISHEYE,
    EQUIRECTANGULAR,
    FISHEYE,
    MIRROR,
    ORDINARY,
    PANORAMA,
    guess_geometry,
)
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.cli import main
from sfa_localization.inspection import (
    SAMPLES,
    InspectionConfig,
    covered_share,
    directions,
    hull_area,
    inspect,
    path_length,
    spacing,
)
from sfa_localization.metric.drive_check import ROUTE

START = 1_700_000_000_000_000_000
STEP = 200_000_000
ENOUGH = InspectionConfig(min_pictures=150)
Route = Callable[[float], tuple[float, float]]


def star(share: float) -> tuple[float, float]:
    """Cross a square of 8 m in all directions."""
    x, y = 4 * np.sin(2 * np.pi * np.array([5 * share + 0.06, 7 * share]))
    return float(x), float(y)


def circle(share: float) -> tuple[float, float]:
    return float(8 * np.cos(6.28 * share)), float(8 * np.sin(6.28 * share))


def eight(share: float) -> tuple[float, float]:
    return float(8 * np.sin(6.28 * share)), float(8 * np.sin(12.56 * share))


def cross(share: float) -> tuple[float, float]:
    """Along x and back to the middle, then along y to both sides."""
    stops = np.array([[-15, 0], [15, 0], [0.3, 0], [0.3, 15], [0.3, -15]], float)
    driven = np.cumsum([0, *np.abs(np.diff(stops, axis=0)).sum(1)])
    x, y = (np.interp(share * driven[-1], driven, axis) for axis in stops.T)
    return float(x), float(y)


def line(share: float) -> tuple[float, float]:
    return 30 * share, 0.0


def ahead(route: Route, share: float) -> float:
    """The heading along a route, rad."""
    moved = np.subtract(route(share + 1e-4), route(share))
    return float(np.arctan2(moved[1], moved[0]))


def write(
    path: Path,
    route: Route = star,
    pictures: int = 600,
    shape: tuple[int, int] = (8, 60),
    brightness: int = 120,
    odometry_until: float = 1.0,
    speed: float = 1.0,
) -> Path:
    """Record a drive along a route with a picture every 0.2 s, which turns with the robot."""
    rng = np.random.default_rng(0)
    around = rng.integers(0, 2 * brightness + 1, (shape[0], 360, 3), np.uint8)
    with BagWriter(path) as bag:
        for index in range(pictures):
            at, share = START + index * STEP, index / pictures
            turned = np.roll(around, round(np.degrees(ahead(route, share))), axis=1)
            view = turned if shape[1] > 4 * shape[0] else turned[:, :90]
            picture = cv2.resize(view, shape[::-1], interpolation=cv2.INTER_AREA)
            picture[0] = rng.integers(0, 2 * brightness + 1, (shape[1], 3), np.uint8)
            bag.image('/panorama', at, picture, 'camera')
            if share <= odometry_until:
                bag.odometry(
                    '/odom', at, (*route(share), ahead(route, share)), (speed, 0.0), (0.0, 0.0)
                )
    return path


def test_a_good_drive_is_enough(tmp_path: Path) -> None:
    report = inspect(write(tmp_path / 'bag'), config=ENOUGH)
    assert report.lacks == [] and report.problems == []
    told = report.as_dict()
    assert told['enough_to_train_on'] is True
    assert told['topics']['/panorama'] == {
        'type': 'sensor_msgs/msg/Image',
        'count': 600,
        'recorded': 600,
        'first_stamp_ns': START,
        'last_stamp_ns': START + 599 * STEP,
        'rate_hz': 5.0,
        'largest_gap_s': 0.2,
        'problems': [],
    }
    assert told['facts']['images'] == '60x8, panorama: 7.5 times as wide as high'
    assert len(report.samples) == SAMPLES
    assert 'enough to train on' in report.as_text()
    assert 'not enough' not in report.as_text()


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        ({'pictures': 149}, '149 images with odometry are few'),
        ({'route': cross}, 'driven along 2 of 6 directions'),
        ({'route': eight}, 'of the area lie within 1 m of an image'),
        ({'route': lambda share: (0.0, 0.0), 'speed': 0.0}, 'the robot did not move'),
        ({'shape': (48, 64)}, 'the images do not show all directions'),
        ({'brightness': 4}, 'the images are dark'),
        ({'odometry_until': 0.5}, '299 of 600 images have no odometry nearby'),
        ({'pictures': 160}, 'm apart: drive slower'),
    ],
)
def test_it_gives_the_reason_why_a_drive_is_not_enough(
    options: dict[str, object], reason: str, tmp_path: Path
) -> None:
    report = inspect(write(tmp_path / 'bag', **options), config=ENOUGH)
    assert any(reason in lack for lack in report.lacks), report.lacks
    assert f'not enough to train on: {report.lacks[0]}' in report.as_text()


@pytest.mark.parametrize('route', [line, circle])
def test_one_route_is_enough_for_a_model_of_the_route_and_says_so(
    route: Route, tmp_path: Path
) -> None:
    report = inspect(write(tmp_path / 'bag', route=route), config=ENOUGH)
    assert report.lacks == [] and ROUTE in report.notes
    assert ROUTE not in inspect(write(tmp_path / 'star'), config=ENOUGH).notes


@pytest.mark.parametrize('missing', ['/panorama', '/odom'])
def test_a_missing_topic_is_reported_not_raised(missing: str, tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(3):
            if missing != '/odom':
                bag.odometry('/odom', START + index, (0, 0, 0), (0, 0), (0, 0))
            if missing != '/panorama':
                picture = np.zeros((8, 60, 3), np.uint8)
                bag.image('/panorama', START + index, picture, 'camera')
            bag.imu('/imu', START + index, 0.0, 0.0)
    report = inspect(tmp_path / 'bag')
    assert any('has no' in lack for lack in report.lacks)
    assert {topic.name for topic in report.topics} == {'/panorama', '/odom', '/imu'} - {missing}


def test_pauses_sizes_and_faulty_messages_are_problems(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(20):
            at = START + index * STEP + (10**10 if index > 9 else 0)
            width = 60 if index % 5 else 80
            bag.image('/panorama', at, np.full((8, width, 3), index, np.uint8), 'camera')
            bag.odometry('/odom', 0 if index == 3 else at, (0, 0, 0), (0, 0), (0, 0))
    problems = {topic.name: topic.problems for topic in inspect(tmp_path / 'bag').topics}
    assert problems['/panorama'] == ['pause of 10.2 s', 'images of several sizes: 80x8, 60x8']
    assert problems['/odom'] == ['1 of 20 messages: zero or negative stamp', 'pause of 10.2 s']


@pytest.mark.parametrize(
    ('each', 'problems'), [(1, []), (2, ['10 of 20 images repeat the one before'])]
)
def test_images_that_a_driver_sends_twice_are_counted(
    each: int, problems: list[str], tmp_path: Path
) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(20):
            image = np.full((8, 60, 3), index // each, np.uint8)
            bag.image('/panorama', START + index * STEP, image, 'camera')
    assert inspect(tmp_path / 'bag').topics[0].problems == problems


def test_what_is_unusual_about_odometry_is_a_problem(tmp_path: Path) -> None:
    """A pose that is never kept, one that was reset, and twists in other units."""
    x = np.arange(50.0) / 5
    shown = {
        'constant': (0 * x, 1.0, 'the pose is constant; the twist is integrated instead'),
        'reset': (x - 6 * (x >= 6), 1.0, 'odometry was reset 1 times; joined by its twist'),
        'millimeters': (x, 1000.0, 'poses drive 9 m, twists 9e+03 m: are both in meters, radians '),
    }
    for name, (places, speed, text) in shown.items():
        with BagWriter(tmp_path / name) as bag:
            for index, place in enumerate(places):
                bag.odometry('/odom', START + index * STEP, (place, 0, 0), (speed, 0), (0, 0))
        (problem,) = inspect(tmp_path / name).problems
        assert problem.startswith(f'/odom: {text}')


def test_a_topic_that_speaks_only_on_change_does_not_pause(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for at in (0, 0.1, 7, 7.5, 30, 30.1, 30.2, 55, 56, 80):
            bag.pose('/goal', START + round(at * 1e9), (0, 0, 0))
        for index in range(500):
            bag.odometry('/odom', START + index * STEP, (0, 0, 0), (0, 0), (0, 0))
    topics = {topic.name: topic for topic in inspect(tmp_path / 'bag').topics}
    assert topics['/goal'].problems == [] and topics['/goal'].largest_gap_s > 20


def test_a_topic_of_which_nothing_can_be_read_is_an_error(tmp_path: Path, capsys) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(5):
            bag.odometry('/odom', 0, (0, 0, 0), (0, 0), (0, 0))
            bag.imu('/imu', START + index * STEP, 0.0, 0.0)
    assert main(['inspect', str(tmp_path / 'bag'), '--json', str(tmp_path / 'found.json')]) == 1
    found = json.loads((tmp_path / 'found.json').read_text())['bags'][0]['topics']
    assert (found['/odom']['count'], found['/odom']['recorded']) == (0, 5)
    assert (found['/imu']['count'], found['/imu']['recorded']) == (5, 5)
    assert '5 of 5 messages: zero or negative stamp' in capsys.readouterr().out


@pytest.mark.parametrize(('images_at', 'odometry_at', 'missing'), [
    (0, START, 'images'), (START, 0, 'odometry'), (0, 0, 'images and no odometry'),
])  # fmt: skip
def test_what_cannot_be_read_is_named(tmp_path: Path, images_at, odometry_at, missing) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(5):
            picture = np.full((8, 60, 3), 90, np.uint8)
            bag.image('/panorama', images_at and images_at + index * STEP, picture, 'camera')
            at = odometry_at and odometry_at + index * STEP
            bag.odometry('/odom', at, (0, 0, 0), (0, 0), (0, 0))
    assert inspect(tmp_path / 'bag').lacks == [f'no {missing} could be read']


def test_a_topic_without_a_name_is_not_taken_for_missing_images(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(20):
            bag.odometry('/odom', START + index * STEP, (index * 0.1, 0, 0), (0.5, 0), (0, 0))
            bag.pose('', START + index * STEP, (0, 0, 0))
    (stored,) = (tmp_path / 'bag').glob('*.mcap')
    content = stored.read_bytes()
    assert b'msg/PoseStamped' in content
    stored.write_bytes(content.replace(b'msg/PoseStamped', b'msg/PoseUnknown'))
    report = inspect(tmp_path / 'bag')
    assert report.camera is None and report.odometry is not None


def test_a_bag_recorded_while_the_nodes_ran_is_read_by_its_inputs(tmp_path: Path) -> None:
    picture = np.zeros((8, 60, 3), np.uint8)
    with BagWriter(tmp_path / 'bag') as bag:
        for index in range(5):
            at = START + index * STEP
            bag.image('/camera/image_raw', at, picture, 'camera')
            bag.image('/robot/panorama', at, picture, 'camera')
            for topic in ('/wheels/odometry', '/robot/ekf/odometry'):
                bag.odometry(topic, at, (0, 0, 0), (0, 0), (0, 0))
            for topic in ('/truth', '/robot/sfa/pose'):
                bag.pose(topic, at, (0, 0, 0))
    with Bag(tmp_path / 'bag') as bag:
        names = [bag.find(kind) for kind in ('image', 'odometry', 'ground_truth')]
    assert names == ['/camera/image_raw', '/wheels/odometry', '/truth']


def test_a_file_beside_the_metadata_and_a_missing_split_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', pictures=20)
    (file,) = path.glob('*.mcap')
    shutil.copy(file, path / 'bag_1.mcap')
    assert 'bag_1.mcap is in the folder, but not in metadata.yaml' in inspect(path).problems[0]


def test_damaged_zstd_is_not_called_empty(tmp_path: Path, capsys) -> None:
    (tmp_path / 'bag.mcap.zstd').write_bytes(ZSTD_MAGIC + b'\xff' * 200)
    assert main(['inspect', str(tmp_path / 'bag.mcap.zstd')]) == 1
    error = capsys.readouterr().err
    assert 'damaged zstd data' in error and 'is empty' not in error


# The numbers.

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]])


def test_length_area_and_directions_of_a_square() -> None:
    assert path_length(SQUARE) == 16.0
    assert hull_area(SQUARE) == pytest.approx(16.0)
    assert directions(SQUARE) == 2
    assert directions(np.array([[0, 0], [5, 0], [0, 0]])) == 1
    assert hull_area(SQUARE[:2]) == 0.0 and covered_share(SQUARE[:2], 1.0) == 0.0


def test_ground_within_reach_of_a_square_path() -> None:
    side = np.linspace(0, 4, 200)
    zero, four = np.zeros(200), np.full(200, 4.0)
    ring = np.concatenate(
        [np.stack(edge, -1) for edge in [(side, zero), (side, four), (zero, side), (four, side)]]
    )
    # All but the inner 2 m x 2 m.
    assert covered_share(ring, 1.0) == pytest.approx(1 - 4 / 16, abs=0.03)


def test_spacing_ignores_images_taken_standing() -> None:
    places = np.zeros((300, 2))
    places[:100, 0] = 0.3 * np.arange(100)
    places[100:, 0] = places[99, 0]
    assert spacing(places) == pytest.approx(0.3)


# The camera.

CALIBRATE = (
    'calibration_file: camera.yaml  # by: sfa_localization calibrate {bag} '
    '--output camera.yaml --check check.png'
)


def views(shape: tuple[int, int], count: int = 6) -> list[np.ndarray]:
    """Pictures whose contents all change."""
    rng = np.random.default_rng(1)
    small = rng.integers(40, 255, (count, 12, 12, 3), np.uint8)
    return [cv2.resize(s, shape[::-1], interpolation=cv2.INTER_CUBIC) for s in small]


def disc(shape: tuple[int, int], center: tuple[float, float], radius: float) -> np.ndarray:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(rows - center[0], columns - center[1]) < radius


def kind(pictures: Iterable[np.ndarray]) -> str:
    return guess_geometry(list(pictures))[0]


def test_a_wide_strip_is_a_panorama() -> None:
    assert kind(views((60, 600))) == PANORAMA


def test_an_image_that_closes_on_itself_is_a_panorama() -> None:
    assert kind(street(6)) == kind(street(1)) == EQUIRECTANGULAR
    assert kind(picture[60:240] for picture in street(6)) == PANORAMA
    assert kind(picture[:, :400] for picture in street(6)) == ORDINARY
    assert kind(views((200, 400))) == ORDINARY


@pytest.mark.parametrize('size', [(240, 320), (240, 240), (200, 400)])
def test_an_ordinary_image_is_recognized(size: tuple[int, int]) -> None:
    assert kind(views(size)) == kind(ordinary(6, size=size)) == ORDINARY


@pytest.mark.parametrize('shape', [(240, 240), (240, 320)])
def test_a_bright_circle_is_a_fisheye(shape: tuple[int, int]) -> None:
    circle_mask = disc(shape, (120, shape[1] / 2), 115)[..., None]
    assert kind(view * circle_mask for view in views(shape)) == FISHEYE
    assert kind(fisheye(shape, 0.05, count=6)) == FISHEYE


def test_a_circle_whose_middle_never_changes_is_a_mirror() -> None:
    shape = (240, 240)
    ring, camera = disc(shape, (120, 120), 115)[..., None], disc(shape, (120, 120), 25)[..., None]
    assert kind(np.where(camera, 90, view * ring).astype(np.uint8) for view in views(shape)) == (
        MIRROR
    )


def test_two_circles_are_a_dual_fisheye() -> None:
    shape = (200, 400)
    mask = disc(shape, (100, 100), 95) | disc(shape, (100, 300), 95)
    assert kind(view * mask[..., None] for view in views(shape)) == DUAL_FISHEYE


@pytest.mark.parametrize(
    ('pictures', 'told', 'entry'),
    [
        (desk_mirror, 'mirror: a circle, and the camera itself in its middle', CALIBRATE),
        (street, 'equirectangular: 2.0 times as wide as high', 'camera_model: equirectangular'),
        (ordinary, 'ordinary camera: no circle', ''),
    ],
)
def test_a_real_camera_is_named_and_described(
    pictures: Callable, told: str, entry: str, tmp_path: Path
) -> None:
    """Its bag says what to write into the parameter file, which can be read as YAML."""
    with BagWriter(tmp_path / 'bag') as bag:
        for index, picture in enumerate(pictures(12)):
            bag.image('/images', START + index * STEP, picture, 'camera', 'jpeg')
    report = inspect(tmp_path / 'bag')
    assert report.facts['images'].split(', ', 1)[1].startswith(told)
    _, _, lines = report.as_text().partition('start my_localization.yaml with:')
    lines = lines.partition('  not enough')[0]
    assert entry.format(bag=tmp_path / 'bag') in lines and bool(lines) == bool(entry)
    if entry:
        (parameters,) = yaml.safe_load(lines).values()
        (name,) = parameters['ros__parameters']
        CameraConfig.from_mapping(parameters['ros__parameters'], 'bag')
        assert entry.startswith(name)


# The command.


def test_the_command_writes_json_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, report = write(tmp_path / 'good'), tmp_path / 'report'
    json_file = tmp_path / 'new' / 'bags.json'
    arguments = ['inspect', str(good), str(tmp_path / 'missing'), '--json', str(json_file)]
    assert main([*arguments, '--report', str(report)]) == 1
    told = json.loads(json_file.read_text())['bags']
    assert [bag['path'] for bag in told] == [str(good), str(tmp_path / 'missing')]
    assert told[0]['topics']['/odom']['count'] == 600 and told[0]['error'] == ''
    assert 'no such bag' in told[1]['error'] and told[1]['enough_to_train_on'] is False
    out, errors = capsys.readouterr()
    assert '/odom (Odometry): 600 messages, 5.0 Hz' in out
    assert errors.strip() == f'error: {tmp_path / "missing"}: no such bag; check the path'
    for name in ('0_good_pictures.png', '0_good_path.png'):
        picture = cv2.imread(str(report / name))
        assert picture is not None and picture.std() > 5
    pictures = {'0_good_pictures.png', '0_good_path.png'}
    assert {file.name for file in report.iterdir()} == pictures | {'index.html'}


@pytest.mark.parametrize('name', ['\udcff', 'a$x^$b'], ids=['not UTF-8', 'formula'])
def test_a_bag_may_have_any_name(name, tmp_path, capsys):
    bag, report = write(tmp_path / name), tmp_path / 'report'
    words = ['--json', str(tmp_path / 'found.json'), '--report', str(report)]
    assert main(['inspect', str(bag), *words]) == 0
    shown = name.replace('\udcff', '\\udcff')
    assert f'{tmp_path}/{shown}\n' in capsys.readouterr().out
    assert f'{shown} is enough' in (report / 'index.html').read_text()
    (found,) = json.loads((tmp_path / 'found.json').read_text())['bags']
    assert found['path'] == str(bag)
    figures = {f'{name}_pictures.png', f'{name}_path.png'}
    assert {file.name for file in report.iterdir()} == figures | {'index.html'}


def test_the_command_takes_topics_and_limits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / 'bag')
    options = ['--image-topic', '/nothing', '--min-pictures', '5']
    assert main(['inspect', str(path), *options]) == 0
    assert 'has no topic /nothing' in capsys.readouterr().out


def test_json_that_cannot_be_written_leaves_nothing_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / 'out'
    (folder / 'taken').mkdir(parents=True)
    assert main(['inspect', str(tmp_path / 'missing'), '--json', str(folder / 'taken')]) == 1
    assert f'{folder / "taken"}: cannot be written' in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ['taken']
