# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What a user sees of long work, and of --help."""

import io
import subprocess
import sys

import pytest
from page_tables import ROOT

from sfa_localization import cli
from sfa_localization.data import progress


def test_a_log_gets_a_line_each_ten_seconds(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr('tqdm.std.time', lambda: now[0])
    with progress.progress_bar('read', 100, visible=True) as bar:
        for _ in range(50):
            now[0] += 0.5
            bar.update()
    assert capsys.readouterr().err.splitlines() == [
        'read: 20% of 100 images, 40 s left',
        'read: 40% of 100 images, 30 s left',
    ]
    for _ in progress.progress_over(range(3), 'read', visible=True):
        now[0] += 11.0
    assert capsys.readouterr().err.splitlines()[0] == 'read: 1 images'
    assert list(progress.progress_over(range(5), 'read', 5, visible=True)) == [0, 1, 2, 3, 4]
    assert capsys.readouterr() == ('', ''), 'short work leaves nothing'


def test_a_terminal_gets_a_bar(monkeypatch):
    screen = io.StringIO()
    screen.isatty = lambda: True
    monkeypatch.setattr(sys, 'stderr', screen)
    assert list(progress.progress_over(range(4), 'read', 4, visible=True)) == [0, 1, 2, 3]
    assert '\r' in screen.getvalue() and 'read: 100%' in screen.getvalue()


@pytest.mark.parametrize('name', cli.EXECUTABLES)
def test_a_node_explains_itself_without_ros(name):
    """And does not start: the process ends."""
    code = f'import sys; sys.modules["rclpy"] = None; sys.argv = ["{name}", "--help"]; '
    code += f'from sfa_localization.nodes import entry; sys.exit(entry.{name}())'
    words = [sys.executable, '-c', code]
    done = subprocess.run(words, cwd=ROOT, timeout=60, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f'usage: {name} ' in done.stdout and 'autostart: true' in done.stdout
    other = 'least_explained:' if name != 'sfa_node' else 'slip_per_meter:'
    assert (other in done.stdout) == (name == 'localization'), 'parameters of another node'
