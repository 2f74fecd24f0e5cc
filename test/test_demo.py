# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of the demo: what is kept, what must never be touched.

The nodes are tested in test_processes.py; the complete demo by `make demo` in CI.
"""

import pytest

from sfa_localization.commands import demo
from sfa_localization.data.errors import LocalizationError


def test_a_folder_of_anything_else_is_not_changed(tmp_path):
    (tmp_path / 'thesis').mkdir()
    (tmp_path / 'thesis/thesis.tex').write_text('ten years of work')
    demo.prepare_folder(tmp_path / 'other', 3)
    for name, world in {'thesis': 1, 'other': 4}.items():
        before = sorted((tmp_path / name).iterdir())
        with pytest.raises(LocalizationError, match=f'{name}: not a folder of this demo.*--out'):
            demo.prepare_folder(tmp_path / name, world)
        assert sorted((tmp_path / name).iterdir()) == before
    (tmp_path / 'file').touch()
    for name in ('file', 'file/demo'):
        with pytest.raises(LocalizationError, match='cannot be written'):
            demo.prepare_folder(tmp_path / name, 1)


def test_bags_of_the_same_settings_are_reused_and_old_results_are_not(tmp_path):
    out = tmp_path / 'new' / 'demo'
    demo.prepare_folder(out, 3)
    (out / 'coverage').mkdir()
    for name in ('model.npz', 'results.json', 'my_notes.txt'):
        (out / name).write_text('old')
    demo.prepare_folder(out, 3)
    assert {path.name for path in out.iterdir()} == {'coverage', demo.MARKER, 'my_notes.txt'}
