# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every parameter changes something.

For each group of settings there is something to observe, in a world that is rich enough, and each
parameter is set to another value than its default there. SPECIAL holds the values, and the
settings beside them, for parameters that need some. A new parameter is exercised without an entry.
"""

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cylinder_worlds import PLACE_ARCHITECTURE, Spheres, recipe, run_in, wander
from filter_drives import START_NS, Drive
from test_commands import OPTIONS, parser_of

from sfa_localization.bags.reader import Bag
from sfa_localization.bags.settings import BagConfig
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.panorama import Unwrapper
from sfa_localization.camera.settings import (
    CameraConfig,
    CaptureConfig,
    PanoramaConfig,
    WatchConfig,
)
from sfa_localization.camera.watch import ImageWatch
from sfa_localization.commands.options import destination
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.settings import Settings
from sfa_localization.features.network_training import ImageSequence, train_network
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.metric.settings import MetricConfig, SegmentConfig
from sfa_localization.nodes.settings import (
    EkfNodeConfig,
    NodeConfig,
    OmnicamNodeConfig,
    SfaNodeConfig,
)


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


def of_bag(settings: BagConfig) -> Any:
    """Stamps of the images of a bag that were received later than they were taken."""

    class Late(BagWriter):
        def message(self, topic: str, stamp_ns: int, message: Any) -> None:
            super().message(topic, stamp_ns + 5_000_000, message)

    with tempfile.TemporaryDirectory() as folder:
        with Late(Path(folder) / 'bag') as bag:
            for stamp_ns in range(START_NS, START_NS + 10**9, 10**8):
                bag.image('/panorama', stamp_ns, np.zeros((8, 80, 3), np.uint8), 'camera')
        with Bag(Path(folder) / 'bag', config=settings) as bag:
            return [stamp for stamp, _ in bag.images()]


def of_filter(settings: FilterConfig) -> Any:
    """What a filter believes along a drive with everything that may happen to one."""
    fused, weak = PoseFilter(settings), PoseFilter(settings)
    seen = [weak.add_measurement(START_NS, np.zeros(3), np.diag([9.0, 9.0, 0.1])).reason]
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


def of_network(settings: NetworkConfig) -> Any:
    """The output of a network for the images that it was trained on."""
    run = run_in(Spheres.about(1), wander(60, 2, hz=4.0), recipe().panorama)
    architecture = dataclasses.replace(PLACE_ARCHITECTURE, normalization=settings.normalization)
    network = train_network(architecture, [ImageSequence.of(run)], settings.seed)
    return network.maps(run.panoramas.read(0, 10))[-1]


def of_watch(settings: WatchConfig) -> Any:
    """How images of some novelties are judged."""
    return [*map(ImageWatch(settings).judge_novelty, (2, 4, 7))]


OBSERVE: dict[type[Settings], Callable[..., Any]] = {
    CameraConfig: of_camera,
    PanoramaConfig: of_panorama,
    BagConfig: of_bag,
    FilterConfig: of_filter,
    WatchConfig: of_watch,
    NetworkConfig: of_network,
}
START = {'initial_pose': (0.0, 0.0, 0.0)}
SPECIAL: dict[type[Settings], dict[str, Other]] = {
    CameraConfig: {
        'camera_model': Other('equirectangular'),
        'mount_rpy': Other((0.0, 0.0, 30.0)),
        'blind_sectors': Other((10.0, 60.0)),
    },
    FilterConfig: {
        'initial_pose': Other((1.0, -1.0, 0.5)),
        'initial_position_std': Other(1.0, START),
        'initial_yaw_std': Other(1.0, START),
        'lost_yaw_std': Other(0.1),
    },
}
ELSEWHERE: dict[type[Settings], str] = {
    CameraConfig: 'calibration_file mask_file',
    CaptureConfig: 'source source_path source_rate source_size silence_timeout',
    SegmentConfig: 'yaw_source yaw_noise',
    MetricConfig: 'slow_features anchor',
    OmnicamNodeConfig: 'image_transport frame_id',
    NodeConfig: 'autostart',
    SfaNodeConfig: 'model image_transport silence_timeout map_frame',
    EkfNodeConfig: 'map_frame odom_frame base_frame publish_tf transform_tolerance pose_file '
    'silence_timeout',
}
"""Parameters that other tests set: they need a camera, a node or a drive to show."""


def options_of(group: type[Settings]) -> set[str]:
    """Settings of a group that are options of commands: those are run in test_commands.py."""
    places = {
        action.dest
        for name in OPTIONS
        for action in parser_of(name)._actions
        if set(action.option_strings) & set(OPTIONS[name])
    }
    return {f.name for f in dataclasses.fields(group) if destination(group, f.name) in places}


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


@functools.cache
def observed(settings: Settings) -> Any:
    """What is observed, or the error that says that it cannot be."""
    try:
        return OBSERVE[type(settings)](settings)
    except LocalizationError as error:
        return str(error)


def changes_something(kind: type[Settings], item: dataclasses.Field[Any]) -> bool:
    other = SPECIAL.get(kind, {}).get(item.name) or Other(another(item))
    before = kind(**other.beside)
    after = dataclasses.replace(before, **{item.name: other.value})
    assert after != before
    return differ(observed(before), observed(after))


@pytest.mark.parametrize('kind', OBSERVE, ids=lambda kind: kind.__name__)
def test_every_parameter_changes_something(kind):
    """And without another value nothing differs, else any would seem to change something."""
    elsewhere = set(ELSEWHERE.get(kind, '').split())
    if kind is NetworkConfig:
        elsewhere |= {'engine'} & options_of(kind)
    fields = [item for item in dataclasses.fields(kind) if item.name not in elsewhere]
    assert [item.name for item in fields if not changes_something(kind, item)] == []
    assert not differ(observed(kind()), OBSERVE[kind](kind()))


def test_parameters_of_cameras_nodes_and_commands_are_set_in_their_tests():
    groups = [g for g in Settings.__subclasses__() if 'sfa_loc' in g.__module__]
    unseen = []
    for kind in {g.__name__: g for g in groups}.values():  # slots leave a class without behind
        if kind.__name__ == 'LensCalibration':  # test_cameras.py looks through each lens
            continue
        names, elsewhere = {f.name for f in dataclasses.fields(kind)}, ELSEWHERE.get(kind, '')
        assert {*elsewhere.split(), *SPECIAL.get(kind, {})} <= names
        seen = names if kind in OBSERVE else {*elsewhere.split()} | options_of(kind)
        unseen += [f'{kind.__name__}.{name}' for name in names - seen]
    assert unseen == [], 'nothing shows that these do anything'


def test_frames_that_are_one_are_rejected():
    for given in ({'odom_frame': 'map'}, {'map_frame': 'base_link'}):
        with pytest.raises(ConfigError, match='three different frames'):
            EkfNodeConfig.from_mapping(given, 'parameters')
