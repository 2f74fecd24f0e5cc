# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""YAML from a stranger: plain data, or one line that says which limit it exceeds."""

from itertools import pairwise

import pytest
import yaml

from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.settings import CaptureConfig, PanoramaConfig
from sfa_localization.cli import LONGEST_ERROR, main
from sfa_localization.config import load_changes, load_settings, render
from sfa_localization.data import plain_yaml
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.plain_yaml import load_yaml

BOMB = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{new}: &{new} [{", ".join([f"*{old}"] * 9)}]\n' for old, new in pairwise('abcdefghi')
)
TOO_DEEP = 'nested deeper than 32|maximum nesting depth'
"""The second from libyaml 0.2.6 on, which reads ahead and stops at 1000 levels."""
HOSTILE = {
    'alias bomb': (BOMB, 'more than 500000 values'),
    'alias of itself': ('a: &a [*a]', "alias 'a' stands for itself"),
    'date that is none': ('a: 2001-99-99', 'has a date or a number that cannot be: month must'),
    'number of 5001 digits': (f'a: {"9" * 5001}', 'a number of 5001 characters'),
    'hexadecimal number': (f'a: 0x{"f" * 5000}', 'a number of 5002 characters'),
    'tagged number': (f'a: !!int "{"9" * 5001}"', 'a number of 5001 characters'),
    'sexagesimal number': ('a: 1' + ':59' * 500, 'a number of 1501 characters'),
    'few brackets': ('a: ' + '[' * 40 + ']' * 40, 'nested deeper than 32'),
    'brackets': ('a: ' + '[' * 30_000, TOO_DEEP),
    'closed brackets': ('a: ' + '[' * 30_000 + ']' * 30_000, TOO_DEEP),
    'braces': ('{a: ' * 5000, TOO_DEEP),
    'indentation': (''.join(f'{" " * i}a:\n' for i in range(100)), TOO_DEEP),
    'the same key twice': ('a: 1\nb: 2\na: 3', "the key 'a' twice, again in line 3"),
    'the same key below': ('a:\n  b: 1\n  b: 2', "the key 'b' twice, again in line 3"),
    'a key that cannot be': ('? [a, b]\n: 1', 'unhashable'),
    'code': ('a: !!python/object/apply:os.system [x]', 'could not determine a constructor'),
    'control character': ('a: \x01', 'not YAML'),
    'two documents': ('a: 1\n---\nb: 1', 'not YAML'),
    'no YAML': ('a: [', 'not YAML'),
}


@pytest.mark.parametrize('loader', dict.fromkeys((plain_yaml.YamlLoader, yaml.SafeLoader)))
def test_hostile_text_is_one_short_error(loader, monkeypatch):
    monkeypatch.setattr(plain_yaml, 'YamlLoader', loader)
    for text, reason in HOSTILE.values():
        with pytest.raises(ValueError, match=reason) as raised:
            load_yaml(text, plain_yaml.YamlLoader)
        assert '\n' not in str(raised.value) and len(str(raised.value)) < 500
    with pytest.raises(ValueError, match='characters, more than'):
        load_yaml('#' * (plain_yaml.LONGEST + 1))


def test_a_hostile_parameter_file_or_calibration_is_one_line(tmp_path, capsys):
    path = tmp_path / 'bad.yaml'
    words = ['train', str(tmp_path / 'bag'), '--output', str(tmp_path / 'm.npz'), '--config']
    for name in ('alias bomb', 'date that is none', 'brackets', 'the same key twice', 'code'):
        path.write_text(HOSTILE[name][0])
        assert main([*words, str(path)]) == 1
        error = capsys.readouterr().err
        assert error.startswith(f'error: {path}: ') and error.count('\n') == 1
        assert len(error) < LONGEST_ERROR + 100
        with pytest.raises(CameraError, match=HOSTILE[name][1]) as raised:
            read_calibration(path)
        assert '\n' not in str(raised.value)


def test_a_hostile_value_is_quoted_in_part(tmp_path):
    path = tmp_path / 'bad.yaml'
    for value in ('"' + 'x' * 10**6 + '"', '[' + '1, ' * 10**5 + ']', '1' + '0' * 60, '-1e999'):
        for name in ('elevation_min', 'width', 'source'):
            path.write_text(f'omnicam_node:\n  ros__parameters:\n    {name}: {value}\n')
            with pytest.raises(ConfigError, match=name) as raised:
                for kind in (PanoramaConfig, CaptureConfig):
                    load_settings(path, 'omnicam_node', kind)
            assert len(str(raised.value)) < 600


def test_names_of_any_length_are_quoted_in_part(tmp_path):
    path = tmp_path / 'bad.yaml'
    for text in ('x' * 10**3 + ': 1', 'sfa_node:\n  ros__parameters:\n    ' + 'y' * 10**3 + ': 1'):
        path.write_text(text)
        with pytest.raises(ConfigError, match=r'unknown|section') as raised:
            load_changes(path)
        assert len(str(raised.value)) < 800


def test_whole_files_are_read_as_before(tmp_path):
    text = render()
    assert load_yaml(text) == yaml.safe_load(text)
    shared = 'a: &x {k: 1}\nb: *x\nc: {<<: *x, <<: {m: 2}}\n'
    assert load_yaml(shared)['c'] == {'k': 1, 'm': 2}
    assert load_yaml('') is None
    assert load_yaml('a: 1\n---\nb: [', first=True) == {'a': 1}
