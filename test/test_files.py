# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A file is there whole or not at all, whatever happens while it is written, and whoever writes."""

import errno
import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from page_tables import ROOT
from test_calibration import INFO

from sfa_localization.bags import writer as bag_writer
from sfa_localization.bags.writer import BagWriter
from sfa_localization.cli import main
from sfa_localization.commands import demo
from sfa_localization.data.errors import BagError, DataError, LocalizationError
from sfa_localization.data.files import atomic_write

BAGS = ROOT / 'bags'
FULL = OSError(errno.ENOSPC, 'No space left on device')


@pytest.mark.parametrize('error', [ValueError(), KeyboardInterrupt(), FULL])
def test_an_error_leaves_what_was_there_and_nothing_else(tmp_path, error):
    path = tmp_path / 'a.txt'
    path.write_bytes(b'old')
    expected = DataError if error is FULL else type(error)
    with pytest.raises(expected) as raised, atomic_write(path, DataError) as file:
        file.write(b'half')
        raise error
    assert path.read_bytes() == b'old'
    assert list(tmp_path.iterdir()) == [path]
    if error is FULL:
        assert str(raised.value) == f'{path}: cannot be written: No space left on device'


def test_a_file_is_there_only_in_the_end_and_keeps_its_link_and_permissions(tmp_path):
    target, link = tmp_path / 'new/target.txt', tmp_path / 'link.txt'
    link.symlink_to('new/target.txt')
    for mode, text in ((0o644, b'new'), (0o600, b'newer')):
        if target.exists():
            target.chmod(mode)
        before = target.exists() and target.read_bytes()
        with atomic_write(link) as file:
            file.write(text)
            assert (target.exists() and target.read_bytes()) == before
        assert link.is_symlink() and target.read_bytes() == text
        assert target.stat().st_mode & 0o777 == mode
    assert [p.name for p in target.parent.iterdir()] == ['target.txt']


def test_what_is_no_regular_file_is_not_replaced_and_named(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'file').touch()
    for name, what in {'pipe': 'no regular file', 'folder': 'is a folder',
                       'file/a.txt': 'File exists'}.items():  # fmt: skip
        refusal = pytest.raises(DataError, match=f'{name}: cannot be written: .*{what}')
        with refusal, atomic_write(tmp_path / name, DataError):
            raise AssertionError
    assert stat.S_ISFIFO((tmp_path / 'pipe').stat().st_mode)


@pytest.mark.parametrize('storage', bag_writer.STORAGES)
@pytest.mark.parametrize('error', [FULL, KeyboardInterrupt(), RuntimeError('database is full')])
def test_no_part_of_a_bag_remains(tmp_path, storage, error):
    """And the error inside is not hidden by that of closing."""
    expected = KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else BagError
    for step in ('open', 'write', 'close'):
        with mock.patch.object(bag_writer.Writer, step, side_effect=error):
            with pytest.raises(expected) as raised, BagWriter(tmp_path / 'bag', storage) as bag:
                bag.pose('/truth', 1, np.zeros(3))
            if step == 'close':
                with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / 'bag', storage):
                    raise ZeroDivisionError
        assert list(tmp_path.iterdir()) == []
        if expected is BagError:
            assert str(raised.value).startswith(f'{tmp_path / "bag"}: cannot be written: ')


@pytest.mark.parametrize(('to', 'code', 'error'), [
    ('config | true', 0, ''), ('config > /dev/full', 1, 'error: .*No space left on device\n'),
    ('ekf_node -h > /dev/full', 1, 'error: .*No space left on device\n'),
])  # fmt: skip
def test_a_reader_that_has_seen_enough_is_no_error_but_a_full_output_is(to, code, error):
    """As in `sfa_localization config | head -1`."""
    line = f'set -o pipefail; {sys.executable} -m sfa_localization {to}'
    done = subprocess.run(['bash', '-c', line], capture_output=True, text=True, timeout=120)
    assert done.returncode == code and re.fullmatch(error, done.stderr)


# No output replaces what is read, what is of another kind, or what the user made: by the command,
# what its error says. The model, parameter and log files there hold nothing.
REFUSED = {
    **dict.fromkeys([
        'inspect bag/metadata.yaml --json bag/metadata.yaml', 'inspect link --json bag/sample.mcap',
        'evaluate model.npz bag --json model.npz',
        'evaluate model.npz other --align bag --json bag/sample.mcap',
        'evaluate model.npz bag --config a.yaml --json a.yaml',
        'train bag --update model.npz --output link/a.mcap',
        'calibrate picture.png --check picture.png',
        'calibrate --calibration a.yaml --output ./a.yaml',
    ], 'would be replaced by an output'),
    **dict.fromkeys([
        'inspect bag --json diary.txt', 'evaluate model.npz bag --json diary.txt',
        'train bag --output link.npz', 'train bag --update model.npz --output diary.txt',
        'calibrate picture.png --check model.npz',
        'filter odom.csv positions.csv --output picture.png',
    ], 'is there and no .'),
    'tune bag --model model.npz --output diary.txt': ': is there: give another name',
    'config --output bag/metadata.yaml': ': is there: give another name',
    'calibrate picture.png --output diary.txt': ': is no file of calibrate',
    'inspect bag --report bag/metadata.yaml': 'bag/metadata.yaml: is no folder',
    **dict.fromkeys([
        'evaluate none.npz bag --report=new --json=new/index.html',
        'inspect bag --report=new --json=to_new/bag_path.png',
        'train bag --output=new --report=new/report',
        'calibrate picture.png --output=new --check=./new',
    ], 'named for two outputs: give each its own'),
    'config --output loop.yaml': 'loop.yaml: ',
}  # fmt: skip


def test_no_output_replaces_what_it_should_not(tmp_path, monkeypatch, capsys):
    bag = shutil.copytree(BAGS / 'sample', tmp_path / 'bag')
    (bag / 'a.mcap').symlink_to('sample.mcap')
    for name in ('model.npz', 'a.yaml', 'odom.csv', 'positions.csv', 'diary.txt', 'picture.png'):
        (tmp_path / name).write_text('# no data\n')
    for name, to in {
        'link': bag, 'link.npz': 'diary.txt', 'to_new': 'new', 'loop.yaml': 'loop.yaml',
    }.items():  # fmt: skip
        (tmp_path / name).symlink_to(to)
    monkeypatch.chdir(tmp_path)

    def files_there():
        return {p: p.read_bytes() if p.is_file() else b'' for p in tmp_path.rglob('*')}

    before = files_there()
    for command, why in REFUSED.items():
        assert main(command.split()) == 1, command
        error = capsys.readouterr().err
        assert why in error and error.count('\n') == 1, (command, error)
        assert files_there() == before, command


def test_an_output_replaces_an_empty_file_and_what_the_command_wrote(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('info.yaml').write_text(INFO)
    calibrate = 'calibrate --calibration info.yaml --output camera.yaml'
    for command in ('config --output a.yaml', calibrate):
        Path(command.split()[-1]).touch()
        assert main(command.split()) == 0
    assert main(command.split()) == 0


def test_a_report_replaces_only_files_of_reports(tmp_path, capsys):
    words, own = ['inspect', str(BAGS / 'sample'), '--report'], tmp_path / 'own'
    for name in ('index.html', 'sample_path.png'):
        mine = tmp_path / name / name
        mine.parent.mkdir()
        mine.write_text('<title>my home</title>\n')
        assert main([*words, str(mine.parent)]) == 1
        error = f'error: {mine}: is no report: give --report another folder\n'
        assert capsys.readouterr().err == error
        assert mine.read_text().endswith('<title>my home</title>\n')
    with mock.patch('sfa_localization.reports.bag.write_path', side_effect=KeyboardInterrupt):
        assert main([*words, str(own)]) == 130
    assert 'Unfinished report' in (own / 'index.html').read_text()
    assert main([*words, str(own), '--json', str(own / 'a.json')]) == 0
    assert 'Unfinished report' not in (own / 'index.html').read_text()
    assert {file.suffix for file in own.iterdir()} == {'.html', '.json', '.png'}


def test_a_folder_is_of_one_demo_whose_old_results_go_or_is_not_changed(tmp_path):
    (tmp_path / 'thesis').mkdir()
    (tmp_path / 'thesis/thesis.tex').write_text('ten years of work')
    own = tmp_path / 'new/demo'
    demo.prepare_folder(own, 3)
    (own / 'coverage').mkdir()
    for name in ('model.npz', 'results.json', 'my_notes.txt'):
        (own / name).write_text('old')
    demo.prepare_folder(own, 3)
    assert {path.name for path in own.iterdir()} == {'coverage', demo.MARKER, 'my_notes.txt'}
    for folder in (tmp_path / 'thesis', own):
        before = sorted(folder.iterdir())
        with pytest.raises(LocalizationError, match=f'{folder}: not a folder of this demo.*--out'):
            demo.prepare_folder(folder, 4)
        assert sorted(folder.iterdir()) == before
    (tmp_path / 'file').touch()
    with pytest.raises(LocalizationError, match='cannot be written'):
        demo.prepare_folder(tmp_path / 'file/demo', 1)
