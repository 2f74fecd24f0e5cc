# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters: each changes something; their file reads back to the same settings, strictly.

Those of the filter are set to another value than their default, one by one, along a rich drive: a
new one needs no entry here. Other tests set the others.
"""

import dataclasses
import os
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from filter_drives import START_NS, FilterDrive

from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.cli import main
from sfa_localization.config import (
    SECTIONS,
    given_names,
    ignored_sections,
    load_changes,
    load_settings,
    render,
    write_config,
)
from sfa_localization.data import plain_yaml
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.plain_yaml import load_yaml
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.nodes.settings import EkfNodeConfig

SHIPPED = Path(__file__).parents[1] / 'config' / 'localization.yaml'


def believed(settings: FilterConfig):
    """Yield what a filter believes along a drive with everything that may happen to one."""
    fused, weak = PoseFilter(settings), PoseFilter(settings)
    yield weak.add_measurement(START_NS, np.zeros(3), np.diag([9.0, 9.0, 0.1])).reason
    rng = np.random.default_rng(1)
    moving = [(1.0, 0.5 * np.sin(0.05 * i)) for i in range(1200)]
    twists = np.array(moving[:300] + [(5e-4, 1e-3)] * 40 + moving[300:])
    trip = FilterDrive(twists=twists, rate_hz=20.0, v_std=0.03, omega_std=0.02, position_std=0.2,
                 yaw_std=0.1, bias=0.01, scale=0.98)  # fmt: skip
    trip.read[300:320], trip.read[320:340] = (1.5e-3, 1e-3), (5e-4, 3e-3)
    trip.kidnap(200, (2.5, 1.5, 0.0))
    for stamp, kind, index in trip.events():
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
            yield repr((update.d2, update.reason))
        state = fused.at(stamp)
        yield repr((fused.status, state and (state.pose.tolist(), state.covariance.tolist())))


SPECIAL = {
    'initial_pose': (1.0, -1.0, 0.5), 'initial_position_std': 1.0, 'initial_yaw_std': 1.0,
    'lost_yaw_std': 0.1,
}  # fmt: skip
"""Other values than twice the default."""


def another(item):
    """Return a value that is allowed, and differs from the default."""
    default, meta = item.default, item.metadata
    if item.name in SPECIAL or isinstance(default, (bool, str)):
        return SPECIAL.get(item.name) or not default
    higher = default * 2 if default else 1
    within = meta['high'] is None or higher <= meta['high']
    return type(default)(higher if within else (default + (meta['low'] or 0)) / 2)


def test_every_parameter_of_the_filter_changes_something():
    """And without another value nothing differs, else any would seem to change something."""
    placed = {'initial_pose': (0.0, 0.0, 0.0)}
    plain, started = [*believed(FilterConfig())], [*believed(FilterConfig(**placed))]
    assert [*believed(FilterConfig())] == plain
    without_effect = []
    for item in dataclasses.fields(FilterConfig):
        at_start = item.name in ('initial_position_std', 'initial_yaw_std')
        settings = FilterConfig(**{**(placed if at_start else {}), item.name: another(item)})
        pairs = zip(believed(settings), started if at_start else plain, strict=True)
        if all(changed == usual for changed, usual in pairs):
            without_effect.append(item.name)
    assert without_effect == []


def test_every_parameter_is_set_in_some_test():
    here, words = Path(__file__), set()
    for path in here.parent.glob('test_*.py'):
        words |= set(re.findall(r'\w+', path.read_text('utf-8'))) if path != here else set()
    kinds = {kind for kinds in SECTIONS.values() for kind in kinds} - {FilterConfig}
    names = {item.name for kind in kinds for item in dataclasses.fields(kind)}
    assert names - words == set(), 'nothing shows that these do anything'


def test_equal_frames_are_rejected():
    for given in ({'odom_frame': 'map'}, {'map_frame': 'base_link'}):
        with pytest.raises(ConfigError, match='three different frames'):
            EkfNodeConfig.from_mapping(given, 'parameters')


def test_the_shipped_file_explains_every_setting_and_reads_back_to_it():
    remedy = 'python -m sfa_localization config > config/localization.yaml'
    text = render()
    assert SHIPPED.read_text() == text, f'regenerate it: {remedy}'
    assert '# columns of the panorama [px]; 16..8192\n    width: 600\n' in text
    pairs = pairwise(text.splitlines())
    assert all(a.startswith('    # ') for a, b in pairs if re.match(r'    \w', b))
    document = yaml.safe_load(text)
    for section, kinds in SECTIONS.items():
        key = section if section == 'training' else f'/**/{section}'
        defaults = {i.name: i.default for kind in kinds for i in dataclasses.fields(kind)}
        assert len(defaults) == sum(len(dataclasses.fields(kind)) for kind in kinds), 'names clash'
        for name, value in document[key]['ros__parameters'].items():
            default = defaults.pop(name)
            assert type(value) is (list if isinstance(default, tuple) else type(default)), name
        assert not defaults
        assert [kind for kind in kinds if load_settings(SHIPPED, section, kind) != kind()] == []


def test_parameters_of_ros_are_kept(tmp_path):
    """A file that is read and written again keeps the parameters of ROS, and all others."""
    path, new = tmp_path / 'c.yaml', tmp_path / 'new.yaml'
    path.write_text("""
/**: {ros__parameters: {use_sim_time: true, width: 300}}
ekf_node:
  ros__parameters:
    lost_std: 3
    slip_per_meter: 1e-3
    qos_overrides: {/odom: {subscription: {depth: 3}}}
training: {ros__parameters: {slow_features: 7}}
""")
    settings = load_settings(path, 'ekf_node', FilterConfig)
    assert settings == FilterConfig(lost_std=3.0, slip_per_meter=1e-3), 'whole numbers, no points'
    write_config(new, load_changes(path))
    sections = yaml.safe_load(new.read_text())
    ekf, omnicam = (sections[f'/**/{name}_node']['ros__parameters'] for name in ('ekf', 'omnicam'))
    assert ekf['use_sim_time'] is omnicam['use_sim_time'] is True and omnicam['width'] == 300
    assert ekf['qos_overrides'] == {'/odom': {'subscription': {'depth': 3}}}
    assert (ekf['slip_per_meter'], type(ekf['lost_std'])) == (1e-3, float), 'as ROS reads them'
    assert sections['training']['ros__parameters']['slow_features'] == 7
    assert load_changes(new)['ekf_node'].items() >= ekf.items()


VALUES = '{ros__parameters: {lost_std: 3.0}}'
ALL = ['/ekf_node', '/robot1/ekf_node', '/a/robot1/ekf_node']
SPELLINGS = {
    f'ekf_node: {VALUES}': ALL[:1], f'/**/ekf_node: {VALUES}': ALL,
    f'/*/ekf_node: {VALUES}': ALL[1:2], f'/robot1/ekf_node: {VALUES}': ALL[1:2],
    f'robot1: {{ekf_node: {VALUES}}}': ALL[1:2],
    f'/a: {{robot1: {{ekf_node: {VALUES}}}}}': ALL[2:],
    f'/**: {{ekf_node: {VALUES}}}': ALL, f'/**: {VALUES}': ALL,
}  # fmt: skip
"""A section, and which of these nodes ROS gives it to."""


@pytest.mark.ros
def test_commands_and_ros_agree_on_which_nodes_a_section_is_for(request, tmp_path):
    """Commands read a section of any namespace, and know which nodes ROS gives it to."""
    rclpy, path = pytest.importorskip('rclpy'), tmp_path / 'c.yaml'
    context = request.getfixturevalue('bench').context
    for text, nodes in SPELLINGS.items():
        path.write_text(text)
        assert load_settings(path, 'ekf_node', FilterConfig).lost_std == 3.0
        assert ignored_sections(path, '/robot2/sfa_node') == []
        for name in ALL:
            node = rclpy.create_node(
                'ekf_node', namespace=name.removesuffix('/ekf_node'), context=context,
                cli_args=['--ros-args', '--params-file', str(path)],
                automatically_declare_parameters_from_overrides=True,
            )  # fmt: skip
            is_given = name in nodes
            assert node.has_parameter('lost_std') == is_given, (text, name)
            node.destroy_node()
            assert bool(given_names(path, name)) == is_given
            assert bool(ignored_sections(path, name)) != is_given


def test_the_section_of_a_robot_comes_before_that_of_all_robots(tmp_path):
    path = tmp_path / 'c.yaml'
    others = '/**/ekf_node: {ros__parameters: {lost_std: 4.0, speed_std: 0.5}}'
    path.write_text(f'/robot1/ekf_node: {VALUES}\n{others}\n')
    settings = load_settings(path, 'ekf_node', FilterConfig)
    assert (settings.lost_std, settings.speed_std) == (3.0, 0.5)


INVALID = [
    ('- 1\n', 'must hold sections'), ('a: 1\n---\nb: 1', 'is not YAML'),
    ('/**/efk_node: {ros__parameters: {lost_std: 3}}\n', "unknown section '/\\*\\*/efk_node'"),
    ('ekf_node: {ros__parameters: 3}\n', 'names and values'),
    ('ekf_node: {ros__parameters: {lost_sdt: 3}}\n', "did you mean 'lost_std'"),
    ('ekf_node: {ros__parameters: {lost_std: x}}\n', 'lost_std'),
    ('ekf_node: {ros__parameters: {lost_std: -1}}\n', 'outside'),
    ('ekf_node: {ros__parameters: {lost_std: .nan}}\n', 'finite'),
    ('/**: {ros__parameters: {nonsense: 1}}\n', "unknown parameter 'nonsense'"),
    ('robot1: {ekf_node: {lost_std: 3}}\n', "'robot1/ekf_node' must hold 'ros__parameters'"),
    (f'robot1: {{ekf_node: {VALUES}}}\n'
     '/robot2/ekf_node: {ros__parameters: {lost_std: 4}}\n', 'a file of one robot'),
]  # fmt: skip
NO_YAML = [
    ('a: 2001-99-99', 'has an impossible date or number: month must'),
    ('a: ' + '[' * 40 + ']' * 40, 'nested deeper than 32'),
    ('a: 1\nb: 2\na: 3', "the key 'a' twice"),
    ('a: !!python/object/apply:os.system [x]', 'could not determine a constructor'),
    ('a: [', 'not YAML'),
]
"""Also not of a calibration."""


@pytest.mark.parametrize('loader', dict.fromkeys((plain_yaml.YamlLoader, yaml.SafeLoader)))
def test_an_invalid_file_is_rejected_with_its_name_and_the_reason(loader, tmp_path, monkeypatch):
    """With libyaml and without, as a parameter file and as a calibration."""
    monkeypatch.setattr(plain_yaml, 'YamlLoader', loader)
    path, long = tmp_path / 'c.yaml', f'[{"1, " * 10**3}]'
    too_long = f'ekf_node: {{ros__parameters: {{lost_std: {long}}}}}', 'lost_std'
    for text, why in [*INVALID, *NO_YAML, too_long]:
        path.write_text(text)
        with pytest.raises(ConfigError, match=why) as raised:
            load_settings(path, 'ekf_node', FilterConfig)
        error = str(raised.value)
        assert str(path) in error and '\n' not in error and len(error) < 600, text
        if (text, why) in NO_YAML:
            with pytest.raises(CameraError, match=why):
                read_calibration(path)
    shared = 'a: &x {k: 1}\nb: *x\nc: {<<: *x, <<: {m: 2}}\n'
    assert load_yaml(shared)['c'] == {'k': 1, 'm': 2} and load_yaml('') is None


def test_the_command_prints_the_file_and_others_name_one_that_cannot_be_read(tmp_path, capsys):
    """A pipe would be waited for."""
    assert main(['config']) == 0
    assert capsys.readouterr().out == render()
    os.mkfifo(tmp_path / 'pipe')
    for name, why in {'pipe': 'it is no regular file', 'none.yaml': 'No such'}.items():
        words = ['train', 'no_bag', '--output', str(tmp_path / 'a.npz')]
        assert main([*words, '--config', str(tmp_path / name)]) == 1
        error = capsys.readouterr().err
        assert error.startswith(f'error: {tmp_path / name}: cannot be read: {why}')
        assert error.count('\n') == 1
