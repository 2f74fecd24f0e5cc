# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""YAML of anyone: plain data, or one line that says what is wrong with it."""

import pytest
import yaml

from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.settings import CaptureConfig, PanoramaConfig
from sfa_localization.cli import main
from sfa_localization.config import load_changes, load_settings, render
from sfa_localization.data import plain_yaml
from sfa_localization.data.errors import CameraError, ConfigError
from sfa_localization.data.plain_yaml import load_yaml

TOO_DEEP = 'nested deeper than 32|maximum nesting depth'
"""The second from libyaml 0.2.6 on, which reads ahead and stops at 1000 levels."""
REJECTED = {
    'a: 2001-99-99': 'has a date or a number that cannot be: month must',
    f'a: {"9" * 5001}': 'has a date or a number that cannot be',
    'a: ' + '[' * 40 + ']' * 40: 'nested deeper than 32',
    'a: ' + '[' * 30_000: TOO_DEEP,
    'a: 1\nb: 2\na: 3': "the key 'a' twice",
    'a:\n  b: 1\n  b: 2': "the key 'b' twice",
    '? [a, b]\n: 1': 'unhashable',
    'a: !!python/object/apply:os.system [x]': 'could not determine a constructor',
    'a: \x01': 'not YAML',
    'a: 1\n---\nb: 1': 'not YAML',
    'a: [': 'not YAML',
}


@pytest.mark.parametrize('loader', dict.fromkeys((plain_yaml.YamlLoader, yaml.SafeLoader)))
def test_text_that_cannot_be_used_is_one_short_error(loader, monkeypatch):
    monkeypatch.setattr(plain_yaml, 'YamlLoader', loader)
    for text, reason in REJECTED.items():
        with pytest.raises(ValueError, match=reason) as raised:
            load_yaml(text, loader)
        assert '\n' not in str(raised.value) and len(str(raised.value)) < 500
    with pytest.raises(ValueError, match='characters, more than'):
        load_yaml('#' * (plain_yaml.LONGEST + 1))


def test_a_bad_parameter_file_or_calibration_is_one_line(tmp_path, capsys):
    path = tmp_path / 'bad.yaml'
    words = ['train', str(tmp_path / 'bag'), '--output', str(tmp_path / 'm.npz'), '--config']
    for text in ('a: 2001-99-99', 'a: 1\nb: 2\na: 3', 'a: ['):
        path.write_text(text)
        assert main([*words, str(path)]) == 1
        error = capsys.readouterr().err
        assert error.startswith(f'error: {path}: ') and error.count('\n') == 1
        with pytest.raises(CameraError, match=REJECTED[text]):
            read_calibration(path)


def test_values_and_names_of_any_length_are_quoted_in_part(tmp_path):
    path = tmp_path / 'bad.yaml'
    for value in ('"' + 'x' * 10**6 + '"', '[' + '1, ' * 10**5 + ']', '1' + '0' * 400, '-1e999'):
        for name in ('elevation_min', 'width', 'source'):
            path.write_text(f'omnicam_node:\n  ros__parameters:\n    {name}: {value}\n')
            with pytest.raises(ConfigError, match=name) as raised:
                for kind in (PanoramaConfig, CaptureConfig):
                    load_settings(path, 'omnicam_node', kind)
            assert len(str(raised.value)) < 600
    for text in ('x' * 10**3 + ': 1', 'sfa_node:\n  ros__parameters:\n    ' + 'y' * 10**3 + ': 1'):
        path.write_text(text)
        with pytest.raises(ConfigError, match=r'unknown|section') as raised:
            load_changes(path)
        assert len(str(raised.value)) < 800


def test_whole_files_are_read(tmp_path):
    assert load_yaml(render()) == yaml.safe_load(render())
    shared = 'a: &x {k: 1}\nb: *x\nc: {<<: *x, <<: {m: 2}}\n'
    assert load_yaml(shared)['c'] == {'k': 1, 'm': 2}
    assert load_yaml('') is None
    assert load_yaml('a: 1\n---\nb: [', first=True) == {'a': 1}
