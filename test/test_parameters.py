# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters: each changes something; their file reads back to the same settings, strictly.

Those of the filter are set to another value than their default, one by one, along a drive: a new
one needs no entry here. Other tests set the others.
"""

import dataclasses
import os
import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from filter_drives import NOISY, FilterDrive, seconds_of
from page_tables import ROOT

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

SHIPPED = ROOT / 'config' / 'localization.yaml'


def believed(settings):
    """What a filter believes along a drive, whose odometry knows its errors for a time, and whose
    images end early.
    """
    fused = PoseFilter(settings)
    drive = FilterDrive(seconds=30, rate_hz=10.0, **NOISY)
    for event in drive.events():
        stamp_ns, is_image, index = event
        if is_image and seconds_of(event) < 8:
            drive.give(fused, event, heading=True)
        elif not is_image:
            variances = drive.variances() if seconds_of(event) < 4 else (0.0, 0.0)
            fused.add_odometry(stamp_ns, *drive.read[index], variances)
        state = fused.state
        yield repr((fused.status, state and (state.pose.tolist(), state.covariance.tolist())))


def test_every_parameter_of_the_filter_changes_something():
    """And without another value nothing differs, else any would seem to change something."""
    placed = {'initial_pose': (0.0, 0.0, 0.0)}
    plain = [*believed(FilterConfig(**placed))]
    assert [*believed(FilterConfig(**placed))] == plain
    special = {'initial_pose': (1.0, -1.0, 0.5), 'lost_yaw_std': 0.1}
    numbers = [i for i in dataclasses.fields(FilterConfig) if i.name not in special]
    others = {i.name: 0.6 * i.default or 1.0 for i in numbers} | special
    settings = {name: FilterConfig(**placed | {name: value}) for name, value in others.items()}
    assert [name for name, other in settings.items() if [*believed(other)] == plain] == []


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
    ('ekf_node: {ros__parameters: {lost_std: x}}\n', "lost_std: 'x' is not a number"),
    ('ekf_node: {ros__parameters: {initial_pose: abc}}\n', 'is not a list of numbers, such as'),
    ('sfa_node: {ros__parameters: {max_rat: 3}}\n', "sfa_node: unknown parameter 'max_rat'"),
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
    powers = '[4e-09, -1E+3, .5e2, 2.e-1, 1.5e-3, e5, 0x1e5, 1e5 m]'
    assert load_yaml(powers) == [4e-9, -1e3, 50.0, 0.2, 1.5e-3, 'e5', 0x1E5, '1e5 m']
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
