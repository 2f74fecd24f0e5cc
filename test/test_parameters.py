# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter changes something.

For each group of settings there is something to observe, in a world that is rich enough, and each
parameter is set to another value than its default there. SPECIAL holds the values, and the
settings beside them, for parameters that need some; OBSERVED_BY names the tests of those that
need a camera, a node or a command to show. A new parameter is exercised without an entry.
"""

import ast
import dataclasses
import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cylinder_worlds import PLACE_ARCHITECTURE, Spheres, recipe, run_in, wander
from filter_drives import START_NS, Drive
from metric_worlds import (
    criss_cross,
    drive,
    garden_features,
    lanes,
    meander,
    stand,
    straight,
    turn,
)
from test_commands import OPTIONS, parser_of

from sfa_localization.bags.reader import Bag
from sfa_localization.bags.settings import BagConfig
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera import capture
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import (
    CameraConfig,
    CaptureConfig,
    LensCalibration,
    PanoramaConfig,
    WatchConfig,
)
from sfa_localization.camera.watch import ImageWatch
from sfa_localization.commands.options import destination
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.run import Odometry, PanoramaArray, Run
from sfa_localization.data.settings import Settings
from sfa_localization.features.network_training import ImageSequence, train_network
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.metric import selection
from sfa_localization.metric.learning import learn_metric, positions
from sfa_localization.metric.segments import Segments, cut
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.nodes.settings import (
    EkfNodeConfig,
    NodeConfig,
    OmnicamNodeConfig,
    SfaNodeConfig,
)

GROUPS = {
    group.__name__: group
    for group in Settings.__subclasses__()
    if group.__module__.startswith('sfa_localization')
}


@dataclasses.dataclass(frozen=True)
class Other:
    """Another value than the default, and the settings beside which it matters."""

    value: Any
    beside: Mapping[str, Any] = dataclasses.field(default_factory=dict)


# What is observed: numbers, of which some must change.


def unwrapped(*settings: Any) -> Any:
    """The panorama of an image of noise; `settings` are those of an Unwrapper."""
    image = np.random.default_rng(0).integers(0, 256, (640, 640, 3), np.uint8)
    return Unwrapper(*settings)(image)


def of_camera(settings: CameraConfig) -> Any:
    model = settings.camera_model or 'mirror'  # without one there is no panorama
    return unwrapped(dataclasses.replace(settings, camera_model=model), PanoramaConfig())


def of_panorama(settings: PanoramaConfig) -> Any:
    return unwrapped(CameraConfig(camera_model='mirror'), settings)


def of_lens(settings: LensCalibration) -> Any:
    """No parameters of a node, but of a calibration file: each matters as well."""
    return unwrapped(CameraConfig(), PanoramaConfig(), settings)


def of_bag(settings: BagConfig, folder: Path) -> Any:
    """Stamps of the images of a bag that were received later than they were taken."""

    class Late(BagWriter):
        def message(self, topic: str, stamp_ns: int, message: Any) -> None:
            super().message(topic, stamp_ns + 5_000_000, message)

    with Late(folder / 'bag') as bag:
        for stamp_ns in range(START_NS, START_NS + 10**9, 10**8):
            bag.image('/panorama', stamp_ns, np.zeros((8, 80, 3), np.uint8), 'camera')
    with Bag(folder / 'bag', config=settings) as bag:
        return [stamp for stamp, _ in bag.images()]


def of_filter(settings: FilterConfig) -> Any:
    """What a filter believes along a drive with everything that may happen to one."""
    fused, seen = PoseFilter(settings), []
    rng = np.random.default_rng(1)
    moving = [(1.0, 0.5 * np.sin(0.05 * i)) for i in range(1200)]
    twists = np.array(moving[:300] + [(5e-4, 1e-3)] * 40 + moving[300:])
    trip = Drive(twists=twists, rate_hz=20.0, v_std=0.03, omega_std=0.02, position_std=0.2,
                 yaw_std=0.1, bias=0.01, scale=0.98)  # fmt: skip
    trip.read[300:320], trip.read[320:340] = (1.5e-3, 1e-3), (5e-4, 3e-3)
    trip.kidnap(200, (2.5, 1.5, 0.0))
    for event in trip.events():
        stamp, kind, index = event
        t = (stamp - START_NS) * 1e-9
        if kind == 0:
            if 20 < t < 26 or 40 < t < 40.8:
                continue
            told = (-1.0, -1.0) if 10 < t < 14 or 30 < t < 32 else (1e-8, 1e-8)
            told = (4e-3, 4e-3) if 14 < t < 17 else told
            fused.add_odometry(stamp, *trip.read[index], told)
            if index == 600:
                fused.add_odometry(stamp + 80 * 10**9, 1.0, 0.0)
        elif 20.5 < t < 25.5 or 33 < t < 38:
            continue
        else:
            value, spread = trip.seen[index].copy(), np.diag([0.04, 0.04, 0.01])
            if t < 3 or 12 < t < 13.5 or 25.5 < t < 26.5 or t > 55:
                value, spread = value[:2], np.zeros((2, 2))
            if 5 < t < 7:
                spread = spread * 1e-4
            if 17 < t < 18:
                spread[2, 2] = 1.5
            value[:2] += (rng.random() < 0.1) * 3.0
            late = stamp - 6 * 10**9 if index % 40 == 39 else stamp
            update = fused.add_measurement(late, value, spread)
            seen.append((update.d2, update.reason))
        state = fused.at(stamp)
        seen.append((fused.status, None if state is None else
                     (state.pose.tolist(), state.covariance.tolist())))  # fmt: skip
    return repr(seen)


@cache
def odd_drive() -> tuple[Any, Any]:
    """A drive with lines, turns, curves, pauses and pictures near and far; and its gyroscope."""
    parts = [
        lanes(6.0, 1.5, 3),
        stand(2.0),
        meander(40.0, seed=3)[0],
        straight(3.0, 0.5),
        turn(2.0),
        lanes(5.0, 0.6, 2),
    ]
    run = drive(np.vstack(parts), bias=0.01, speed_noise=0.02, yaw_noise=0.01, seed=3)
    return run, run.gyro


def of_segments(settings: SegmentConfig) -> Any:
    """The segments of a drive whose odometry pauses and jumps, and whose pictures are uneven."""
    run, gyro = odd_drive()
    odometry = run.odometry
    kept = np.ones(len(odometry.stamps_ns), bool)
    kept[900:940] = False
    poses = odometry.poses.copy()
    poses[2000:, 0] += 0.5
    variances = np.tile([1e-4, 0.0], (len(poses), 1))
    odometry = Odometry(
        odometry.stamps_ns[kept], poses[kept], odometry.twists[kept], variances[kept]
    )
    gyro = dataclasses.replace(gyro, omega=gyro.omega + 0.002)
    stamps = np.delete(run.stamps_ns, [*range(60, 72), *range(150, 156)])
    return plain(cut(odometry, stamps, settings, gyro))


def plain(segments: Segments) -> str:
    with np.printoptions(threshold=10**6, precision=12):
        return repr(segments)


@cache
def garden() -> tuple[Any, Any]:
    """Features and straight segments of a criss-cross drive with errors."""
    twists, start = criss_cross(9)
    run = drive(twists, start=start, bias=0.004, yaw_noise=0.01, speed_noise=0.02)
    segments = cut(run.odometry, run.stamps_ns, SegmentConfig(segments='straight'))
    return garden_features(run.poses[:, :2], noise=0.3, seed=2), segments


def of_metric(settings: MetricConfig) -> Any:
    """The map that is learnt, and how it does on what was left out."""
    features, segments = garden()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selection, 'INDUCING_POINTS', 60)
        result = learn_metric(features, segments, settings)
    _, places = positions(result, segments)
    return result.map.predict(features), places, result.left_out, result.history


@cache
def panoramas() -> Run:
    """A short drive whose odometry is not even, with a pause and a jump in it."""
    odometry = wander(60, 2, hz=4.0)
    stamps = odometry.stamps_ns + np.where(np.arange(60) >= 30, 8 * 10**9, 0)
    stamps += 3 * 10**7 * (np.arange(60) % 3)
    poses = odometry.poses + np.where(np.arange(60) >= 45, 3.0, 0.0)[:, None] * [1, 0, 0]
    run = run_in(Spheres.about(1), odometry, recipe().panorama)
    moved = Odometry(stamps, poses, odometry.twists, odometry.variances)
    return Run('run', PanoramaArray(stamps, run.panoramas.images), moved)


def of_network(settings: NetworkConfig) -> Any:
    """The output of a network for the images that it was trained on."""
    run = panoramas()
    architecture = dataclasses.replace(PLACE_ARCHITECTURE, normalization=settings.normalization)
    network = train_network(architecture, [ImageSequence.of(run)], settings.seed)
    return network.maps(run.panoramas.read(0, 10))[-1]


def of_watch(settings: WatchConfig) -> Any:
    """How images of some novelties are judged."""
    return [*map(ImageWatch(settings).judge_novelty, (2, 4, 7))]


OBSERVE: dict[type[Settings], Callable[..., Any]] = {
    CameraConfig: of_camera,
    LensCalibration: of_lens,
    PanoramaConfig: of_panorama,
    BagConfig: of_bag,
    FilterConfig: of_filter,
    WatchConfig: of_watch,
    SegmentConfig: of_segments,
    MetricConfig: of_metric,
    NetworkConfig: of_network,
}
BESIDE: dict[type[Settings], dict[str, Any]] = {
    MetricConfig: {'slow_features': 6},
}
"""What is set for a whole group, where its default would be slow, or use little of it."""
START = {'initial_pose': (0.0, 0.0, 0.0)}
POLAR = {'camera_model': 'polar'}
OCAM = {'camera_model': 'ocam', 'polynomial': (-150.0, 0.0, 1e-3), 'axis': 'down'}
TWO = {'camera_model': 'dual_fisheye', 'fx': 95.0, 'fy': 95.0, 'cx': 160.0, 'second_cx': 480.0,
       'second_cy': 319.5}  # fmt: skip
SPECIAL: dict[type[Settings], dict[str, Other]] = {
    CameraConfig: {
        'camera_model': Other('equirectangular'),
        'mount_rpy': Other((0.0, 0.0, 30.0)),
        'blind_sectors': Other((10.0, 60.0)),
    },
    LensCalibration: {
        'distortion': Other((0.1, 0.0, 0.0, 0.0)),
        'polynomial': Other((-120.0, 0.0, 1e-3), OCAM),
        'affine': Other((1.1, 0.0, 0.0), OCAM),
        'radius_min': Other(150.0),
        'radius_max': Other(200.0),
        'angle_min': Other(60.0, POLAR),
        'angle_max': Other(120.0, POLAR),
        'second_cx': Other(470.0, TWO),
        'second_cy': Other(300.0, TWO),
        'second_roll': Other(5.0, TWO),
        'axis': Other('up', {'camera_model': 'fisheye', 'axis': 'down'}),
        'mirrored': Other('no'),
    },
    MetricConfig: {'anchor': Other((1.0, 2.0, 0.5))},
    FilterConfig: {
        'initial_pose': Other((1.0, -1.0, 0.5)),
        'initial_position_std': Other(1.0, START),
        'initial_yaw_std': Other(1.0, START),
    },
}
OF_A_COMMAND = 'test_commands.py'
_OMNICAM, _SOURCES = 'test_omnicam_node.py', 'test_sources.py'
OBSERVED_BY: dict[type[Settings], dict[str, str]] = {
    CameraConfig: {
        'calibration_file': 'test_calibration_files.py::'
        'test_a_calibration_file_replaces_the_camera_model',
        'mask_file': 'test_panorama.py::test_a_mask_picture_hides_what_is_black',
    },
    NetworkConfig: {'engine': OF_A_COMMAND},
    CaptureConfig: {
        'source': f'{_OMNICAM}::test_a_folder_of_pictures',
        'source_path': f'{_OMNICAM}::test_a_folder_of_pictures',
        'silence_timeout': f'{_OMNICAM}::test_a_silent_camera_shows_in_diagnostics',
        'source_rate': f'{_SOURCES}::test_video',
        'source_size': 'test_parameters.py::test_a_device_is_asked_for_a_size_and_a_rate',
    },
    OmnicamNodeConfig: {
        'image_transport': f'{_OMNICAM}::test_compressed_pictures_in_and_out',
        'frame_id': f'{_OMNICAM}::test_frame_and_quality_of_service_by_parameter',
    },
    NodeConfig: {
        'autostart': 'test_nodes_base.py::test_a_node_starts_itself_unless_told_not_to',
    },
    SfaNodeConfig: {
        'model': 'test_sfa_node.py::test_the_model_changes_while_running_and_a_bad_one_is_refused',
        'image_transport': 'test_sfa_node.py::test_compressed_panoramas_are_taken_too',
        'silence_timeout': 'test_sfa_node.py::test_waiting_for_images_is_reported',
        'map_frame': 'test_sfa_node.py::test_the_map_frame_is_a_parameter_and_novelty_is_warned_of',
    },
    EkfNodeConfig: {
        'map_frame': 'test_ekf_node.py::test_frames_are_parameters',
        'odom_frame': 'test_ekf_node.py::test_frames_are_parameters',
        'base_frame': 'test_ekf_node.py::test_frames_are_parameters',
        'publish_tf': 'test_ekf_node.py::test_frames_are_parameters',
        'transform_tolerance': 'test_ekf_node.py::'
        'test_a_lookup_in_tf_is_the_pose_of_ekf_odometry_and_there_is_one_ahead',
        'pose_file': 'test_ekf_node.py::test_after_a_restart_it_looks_where_it_was_first',
        'silence_timeout': 'test_ekf_node.py::test_silence_is_reported_without_any_clock_moving',
    },
}


def options_of(group: type[Settings]) -> set[str]:
    """Settings of a group that are options of commands: those are run in test_commands.py."""
    places = {
        action.dest: option
        for name in OPTIONS
        for action in parser_of(name)._actions
        for option in action.option_strings
        if option in OPTIONS[name]
    }
    return {f.name for f in dataclasses.fields(group) if destination(group, f.name) in places}


def parameters() -> list[tuple[str, str]]:
    return [
        (group.__name__, f.name) for group in GROUPS.values() for f in dataclasses.fields(group)
    ]


def another(item: dataclasses.Field[Any]) -> Any:
    """Return a value that is allowed, and differs from the default."""
    default, meta = item.default, item.metadata
    if isinstance(default, bool):
        return not default
    if meta['choices']:
        return next(choice for choice in meta['choices'] if choice != default)
    if isinstance(default, str):
        return 'another'
    if isinstance(default, (int, float)):
        higher = default * 2 if default else 1
        within = meta['high'] is None or higher <= meta['high']
        return type(default)(higher if within else (default + (meta['low'] or 0)) / 2)
    raise AssertionError(f'{item.name}: name another value in SPECIAL')


def differ(a: Any, b: Any) -> bool:
    if isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)):
        return len(a) != len(b) or any(differ(x, y) for x, y in zip(a, b, strict=True))
    return repr(a) != repr(b) if isinstance(a, str) else not np.array_equal(a, b)


def observed(settings: Settings, folder: Path) -> Any:
    """What is observed, or the error that says that it cannot be."""
    observe = OBSERVE[type(settings)]
    try:
        return observe(settings, folder) if observe is of_bag else observe(settings)
    except LocalizationError as error:
        return str(error)


@pytest.mark.parametrize(('group', 'name'), parameters())
def test_a_parameter_changes_something(group, name, tmp_path):
    kind = GROUPS[group]
    where = OBSERVED_BY.get(kind, {}).get(name, '' if kind in OBSERVE else OF_A_COMMAND)
    if where == OF_A_COMMAND:
        assert name in options_of(kind), f'{group}.{name}: nothing shows that it does anything'
        return
    if where:
        file, _, test = where.partition('::')
        assert re.search(rf'\b{name}\b', source_of(file, test)), f'{test} does not use {name}'
        return
    (item,) = (f for f in dataclasses.fields(kind) if f.name == name)
    other = SPECIAL.get(kind, {}).get(name) or Other(another(item))
    before = kind(**{**BESIDE.get(kind, {}), **other.beside})
    after = dataclasses.replace(before, **{name: other.value})
    assert after != before
    first, then = tmp_path / 'first', tmp_path / 'then'
    first.mkdir(), then.mkdir()
    changed = differ(observed(before, first), observed(after, then))
    assert changed, f'{name}: {other.value!r} changes nothing'


@cache
def source_of(file: str, test: str) -> str:
    """Return the source of a test, with its decorators."""
    text = Path(__file__).with_name(file).read_text('utf-8')
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.name == test:
            start = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            return '\n'.join(text.splitlines()[start - 1 : node.end_lineno])
    raise AssertionError(f'{file} has no {test}')


def test_a_device_is_asked_for_a_size_and_a_rate(monkeypatch, tmp_path):
    asked = {}

    class Capture:
        def __init__(self, *_args):
            pass

        def isOpened(self):
            return True

        def set(self, what, value):
            asked[what] = value

    monkeypatch.setattr(capture.cv2, 'VideoCapture', Capture)
    (tmp_path / 'video0').touch()
    values = {'source_size': (1280.0, 720.0), 'source_rate': 15.0}
    capture.Device(CaptureConfig(source_path=str(tmp_path / 'video0'), **values))
    wanted = {
        capture.cv2.CAP_PROP_FRAME_WIDTH: 1280,
        capture.cv2.CAP_PROP_FRAME_HEIGHT: 720,
        capture.cv2.CAP_PROP_FPS: 15.0,
    }
    assert asked.items() >= wanted.items()
    asked.clear()
    capture.Device(CaptureConfig(source_path=str(tmp_path / 'video0')))
    assert not asked.keys() & wanted.keys(), 'a device keeps its own'


@pytest.mark.parametrize('kind', OBSERVE, ids=lambda kind: kind.__name__)
def test_without_another_value_nothing_differs(kind, tmp_path):
    """Else any parameter would seem to change something."""
    settings = kind(**BESIDE.get(kind, {}))
    first, then = tmp_path / 'first', tmp_path / 'then'
    first.mkdir(), then.mkdir()
    assert not differ(observed(settings, first), observed(settings, then))


def test_the_tables_name_parameters_that_there_are():
    for table in (SPECIAL, OBSERVED_BY, BESIDE):
        for kind, entries in table.items():
            assert set(entries) <= {item.name for item in dataclasses.fields(kind)}, kind.__name__


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'blind_sectors': [0.0] * 10_000}, 'blind_sectors: 10000 entries are more than 100'),
        ({'mask_file': 'x' * 10_000}, 'mask_file: a text of 10000 characters, more than 4096'),
    ],
)
def test_values_that_would_block_a_node_are_rejected_at_once(given, message):
    with pytest.raises(ConfigError, match=message):
        CameraConfig.from_mapping(given, 'parameters')


@pytest.mark.parametrize(
    'frames', [{'odom_frame': 'map'}, {'base_frame': 'odom'}, {'map_frame': 'base_link'}]
)
def test_frames_that_are_one_are_rejected(frames):
    with pytest.raises(ConfigError, match='three different frames'):
        EkfNodeConfig.from_mapping(frames, 'parameters')
