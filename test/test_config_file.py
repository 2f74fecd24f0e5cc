# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The parameter file: written from the settings, read back to the same settings, strict."""

import dataclasses
import os
from pathlib import Path

import pytest
import yaml
from ros_domains import free_domain

from sfa_localization import config as config_file
from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.cli import main
from sfa_localization.config import SECTIONS, ignored_sections, load_settings, render, write_config
from sfa_localization.data import plain_yaml
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.plain_yaml import load_yaml
from sfa_localization.fusion.settings import FilterConfig

DOMAIN = free_domain()

SHIPPED = Path(__file__).parents[1] / 'config' / 'localization.yaml'
EVERY = [(section, kind) for section, kinds in SECTIONS.items() for kind in kinds]


def saved(tmp_path, text):
    path = tmp_path / 'c.yaml'
    path.write_text(text)
    return path


def key(section):
    return section if section == 'training' else f'/**/{section}'


def test_the_shipped_file_is_what_the_settings_say_and_reads_back_to_them():
    remedy = 'python -m sfa_localization config > config/localization.yaml'
    assert SHIPPED.read_text() == render(), f'regenerate it: {remedy}'
    assert [k for section, k in EVERY if load_settings(SHIPPED, section, k) != k()] == []


def test_every_parameter_is_explained_and_has_the_type_that_ros_needs():
    text = render()
    lines, document = text.splitlines(), yaml.safe_load(text)
    assert '# columns of the panorama [px]; 16..8192\n    width: 600\n' in text
    for section, kinds in SECTIONS.items():
        items = [item for kind in kinds for item in dataclasses.fields(kind)]
        assert len({item.name for item in items}) == len(items), 'names do not clash'
        values = document[key(section)]['ros__parameters']
        for item in items:
            places = [i for i, line in enumerate(lines) if line.startswith(f'    {item.name}: ')]
            assert places and all(lines[i - 1].startswith('    # ') for i in places), item.name
            default = list(item.default) if isinstance(item.default, tuple) else item.default
            assert type(values[item.name]) is type(default), item.name


def test_parameters_of_ros_are_kept(tmp_path):
    """A file that is read and written again keeps the parameters of ROS, and all others."""
    path = saved(
        tmp_path,
        """
/**: {ros__parameters: {use_sim_time: true, width: 300}}
ekf_node:
  ros__parameters:
    lost_std: 3
    slip_per_meter: 1e-3
    qos_overrides: {/odom: {subscription: {depth: 3}}}
omnicam_node: {ros__parameters: {qos_overrides./panorama.publisher.depth: 7}}
training: {ros__parameters: {slow_features: 7}}
""",
    )
    assert load_settings(path, 'omnicam_node', PanoramaConfig) == PanoramaConfig(width=300)
    found = load_settings(path, 'ekf_node', FilterConfig)
    assert found == FilterConfig(lost_std=3.0, slip_per_meter=1e-3), 'whole numbers, no points'
    changes = config_file.load_changes(path)
    write_config(tmp_path / 'new.yaml', changes)
    sections = yaml.safe_load((tmp_path / 'new.yaml').read_text())
    ekf, omnicam, sfa, training = (
        sections[key(name)]['ros__parameters']
        for name in ('ekf_node', 'omnicam_node', 'sfa_node', 'training')
    )
    assert ekf['use_sim_time'] is omnicam['use_sim_time'] is sfa['use_sim_time'] is True
    assert ekf['qos_overrides'] == {'/odom': {'subscription': {'depth': 3}}}
    assert omnicam['qos_overrides./panorama.publisher.depth'] == 7
    assert (ekf['slip_per_meter'], type(ekf['lost_std'])) == (1e-3, float), 'as ROS reads them'
    assert (omnicam['width'], training['slow_features']) == (300, 7)
    assert config_file.load_changes(tmp_path / 'new.yaml')['ekf_node'].items() >= ekf.items()


VALUES = '{ros__parameters: {lost_std: 3.0}}'
SPELLINGS = {
    f'ekf_node: {VALUES}': ['/ekf_node'],
    f'/ekf_node: {VALUES}': ['/ekf_node'],
    f'/**/ekf_node: {VALUES}': ['/ekf_node', '/robot1/ekf_node', '/a/robot1/ekf_node'],
    f'/*/ekf_node: {VALUES}': ['/robot1/ekf_node'],
    f'/robot1/ekf_node: {VALUES}': ['/robot1/ekf_node'],
    f'robot1: {{ekf_node: {VALUES}}}': ['/robot1/ekf_node'],
    f'/a: {{robot1: {{ekf_node: {VALUES}}}}}': ['/a/robot1/ekf_node'],
    f'/**: {{ekf_node: {VALUES}}}': ['/ekf_node', '/robot1/ekf_node', '/a/robot1/ekf_node'],
    f'/**: {VALUES}': ['/ekf_node', '/robot1/ekf_node', '/a/robot1/ekf_node'],
}
"""A section, and which of these nodes ROS gives it to."""


def test_commands_and_ros_agree_on_which_nodes_a_section_is_for(tmp_path):
    """Commands read a section of any namespace, and know which nodes ROS gives it to."""
    for text, nodes in SPELLINGS.items():
        path = saved(tmp_path, text)
        assert load_settings(path, 'ekf_node', FilterConfig).lost_std == 3.0
        for node in ('/ekf_node', '/robot1/ekf_node', '/a/robot1/ekf_node'):
            assert bool(ignored_sections(path, node)) == (node not in nodes)
        assert ignored_sections(path, '/robot2/sfa_node') == []
    rclpy = pytest.importorskip('rclpy')
    for text, nodes in SPELLINGS.items():
        context, arguments = rclpy.Context(), ['--ros-args', '--params-file']
        arguments.append(str(saved(tmp_path, text)))
        rclpy.init(context=context, domain_id=DOMAIN, args=arguments)
        taken = []
        for namespace in ('', 'robot1', 'a/robot1'):
            node = rclpy.create_node(
                'ekf_node', namespace=namespace, context=context,
                automatically_declare_parameters_from_overrides=True,
            )  # fmt: skip
            if node.has_parameter('lost_std'):
                taken.append(node.get_fully_qualified_name())
            node.destroy_node()
        rclpy.try_shutdown(context=context)
        assert taken == nodes, text


def test_a_robot_of_its_own_comes_before_all_robots(tmp_path):
    path = saved(tmp_path, f'/robot1/ekf_node: {VALUES}\n'
                           '/**/ekf_node: {ros__parameters: {lost_std: 4.0, speed_std: 0.5}}\n'
                           '/robot2/ekf_node: {ros__parameters: {rate_std: 0.5}}\n')  # fmt: skip
    settings = load_settings(path, 'ekf_node', FilterConfig)
    assert (settings.lost_std, settings.speed_std, settings.rate_std) == (3.0, 0.5, 0.5)


INVALID = [
    ('ekf_node: [1', 'is not YAML'), ('a: 1\n---\nb: 1', 'is not YAML'),
    ('- 1\n', 'must hold sections'), ('3\n', 'must hold sections'),
    ('efk_node: {}\n', "unknown section 'efk_node'"),
    ('ekf_node: {lost_std: 3}\n', 'ros__parameters'),
    ('ekf_node: {ros__parameters: 3}\n', 'names and values'),
    ('ekf_node: {ros__parameters: {lost_sdt: 3}}\n', "did you mean 'lost_std'"),
    ('ekf_node: {ros__parameters: {lost_std: x}}\n', 'lost_std'),
    ('ekf_node: {ros__parameters: {lost_std: -1}}\n', 'outside'),
    ('ekf_node: {ros__parameters: {lost_std: .nan}}\n', 'finite'),
    ('ekf_node: {ros__parameters: {width: 300}}\n', "unknown parameter 'width'"),
    ('/**: {ros__parameters: {nonsense: 1}}\n', "unknown parameter 'nonsense'"),
    ('/**/efk_node: {ros__parameters: {lost_std: 3}}\n', "unknown section '/\\*\\*/efk_node'"),
    ('robot1: {ekf_node: {lost_std: 3}}\n', "'robot1/ekf_node' must hold 'ros__parameters'"),
    ('robot1: {ekf_node: {ros__parameters: {lost_std: 3}}}\n'
     '/robot2/ekf_node: {ros__parameters: {lost_std: 4}}\n', 'a file of one robot'),
]  # fmt: skip


# Text that is no parameter file, and no other YAML of a user.
REJECTED = {
    'a: 2001-99-99': 'has an impossible date or number: month must',
    'a: ' + '[' * 40 + ']' * 40: 'nested deeper than 32',
    'a: 1\nb: 2\na: 3': "the key 'a' twice",
    'a: !!python/object/apply:os.system [x]': 'could not determine a constructor',
    'a: [': 'not YAML',
}


@pytest.mark.parametrize('loader', dict.fromkeys((plain_yaml.YamlLoader, yaml.SafeLoader)))
def test_an_invalid_file_is_rejected_with_its_name_and_the_reason(loader, tmp_path, monkeypatch):
    """With libyaml and without, as a parameter file and as a calibration."""
    monkeypatch.setattr(plain_yaml, 'YamlLoader', loader)
    for text, why in [*INVALID, *REJECTED.items()]:
        path = saved(tmp_path, text)
        with pytest.raises(ConfigError, match=why) as raised:
            load_settings(path, 'ekf_node', FilterConfig)
        assert str(path) in str(raised.value) and '\n' not in str(raised.value), text
        if text in REJECTED:
            with pytest.raises(CameraError, match=why):
                read_calibration(path)
    long = saved(tmp_path, f'ekf_node: {{ros__parameters: {{lost_std: [{"1, " * 10**3}]}}}}')
    with pytest.raises(ConfigError, match='lost_std') as raised:
        load_settings(long, 'ekf_node', FilterConfig)
    assert len(str(raised.value)) < 600
    shared = 'a: &x {k: 1}\nb: *x\nc: {<<: *x, <<: {m: 2}}\n'
    assert load_yaml(shared)['c'] == {'k': 1, 'm': 2} and load_yaml('') is None


def test_the_command_prints_and_writes_and_others_name_a_file_that_cannot_be_read(tmp_path, capsys):
    """A pipe would be waited for."""
    assert main(['config']) == 0
    assert capsys.readouterr().out == render()
    assert main(['config', '--output', str(tmp_path / 'c.yaml')]) == 0
    assert (tmp_path / 'c.yaml').read_text() == render()
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'bad.yaml').write_text('a: [')
    for name, why in {
        'pipe': 'cannot be read: it is no regular file', 'none.yaml': 'cannot be read: No such',
        'bad.yaml': 'is not YAML',
    }.items():  # fmt: skip
        words = ['train', 'no_bag', '--output', str(tmp_path / 'a.npz')]
        assert main([*words, '--config', str(tmp_path / name)]) == 1
        error = capsys.readouterr().err
        assert error.startswith(f'error: {tmp_path / name}: {why}') and error.count('\n') == 1
