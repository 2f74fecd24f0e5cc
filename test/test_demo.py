# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of the demo: what is kept, what is cleared, what must never be touched.

The nodes are tested in test_demo_nodes.py; the complete demo by `make demo` in CI.
"""

import json

import pytest

from sfa_localization.commands import demo
from sfa_localization.commands.demo import DemoConfig
from sfa_localization.data.errors import LocalizationError

OURS = ('coverage', 'test', 'logs', 'report')


def fill(out) -> None:
    for name in OURS:
        (out / name).mkdir(parents=True)
    for name in ('model.npz', 'results.json', 'my_notes.txt'):
        (out / name).write_text('old')


def test_a_foreign_folder_is_not_changed(tmp_path):
    (tmp_path / 'thesis.tex').write_text('ten years of work')
    with pytest.raises(LocalizationError, match='--out'):
        demo.prepare_folder(tmp_path, DemoConfig())
    assert [path.name for path in tmp_path.iterdir()] == ['thesis.tex']


def test_bags_of_the_same_settings_are_reused(tmp_path):
    out = tmp_path / 'new' / 'demo'
    demo.prepare_folder(out, DemoConfig(world=3))
    fill(out)
    demo.prepare_folder(out, DemoConfig(world=3))
    names = {path.name for path in out.iterdir()}
    assert names == {*OURS, demo.MARKER, 'my_notes.txt'}, 'old results must not survive a failure'


@pytest.mark.parametrize('changed', [DemoConfig(world=4), DemoConfig(world=3, seed=2)])
def test_bags_of_other_settings_are_removed(tmp_path, changed):
    demo.prepare_folder(tmp_path, DemoConfig(world=3))
    fill(tmp_path)
    demo.prepare_folder(tmp_path, changed)
    assert {path.name for path in tmp_path.iterdir()} == {demo.MARKER, 'my_notes.txt'}
    assert json.loads((tmp_path / demo.MARKER).read_text())['world'] == changed.world


def test_a_folder_that_cannot_be_created_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    for name in ('file', 'file/demo'):
        with pytest.raises(LocalizationError, match='cannot be written'):
            demo.prepare_folder(tmp_path / name, DemoConfig())
