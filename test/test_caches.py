# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Decoded images on disk: gone at the end of their process, and nobody else's are touched."""

import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from sfa_localization import cli
from sfa_localization.bags.drives import image_cache
from sfa_localization.data.errors import ModelError

ROOT = Path(__file__).parents[1]
TRAIN_AND_WAIT = """
    import sys, time
    from pathlib import Path
    from sfa_localization import cli
    from sfa_localization.bags.drives import image_cache
    from sfa_localization.commands import train

    def run(arguments):
        with image_cache(arguments.output):
            print('ready', flush=True)
            time.sleep(60)

    train.run = run
    sys.exit(cli.main(['train', 'bag', '--output', sys.argv[1]]))
"""


@contextmanager
def training(output: Path) -> Iterator[subprocess.Popen]:
    """A training in another process that has its cache and works on."""
    command = [sys.executable, '-c', textwrap.dedent(TRAIN_AND_WAIT), str(output)]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
    )
    try:
        assert process.stdout.readline() == 'ready\n', process.stderr.read()
        yield process
    finally:
        process.kill()
        process.communicate()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_cache(number, tmp_path):
    with training(tmp_path / 'a.npz') as process:
        assert len(names(tmp_path)) == 1
        process.send_signal(number)
        assert process.wait(60) == 130
    assert names(tmp_path) == []


def test_the_next_training_clears_the_cache_of_a_killed_one_only(tmp_path):
    with training(tmp_path / 'a.npz') as process:
        (other,) = names(tmp_path)
        with image_cache(tmp_path / 'a.npz') as cache:
            assert names(tmp_path) == sorted([other, cache.name]), 'it works on'
        process.kill()
        process.wait(60)
    assert names(tmp_path) == [other]
    with image_cache(tmp_path / 'a.npz') as cache:
        assert names(tmp_path) == [cache.name] != [other]
    assert names(tmp_path) == []


def test_a_pattern_as_name_is_only_a_name(tmp_path):
    others = [tmp_path / f'.{letter}.npz.cache-1' for letter in 'ab']
    for other in others:
        other.mkdir()
        (other / 'lock').touch()
    for name in ('*.npz', '?.npz', '[ab].npz'):
        with image_cache(tmp_path / name):
            pass
    assert names(tmp_path) == [other.name for other in others]


def test_what_only_looks_like_a_cache_stays(tmp_path):
    (tmp_path / 'precious').mkdir()
    (tmp_path / 'precious' / 'lock').touch()
    (tmp_path / '.a.npz.cache-link').symlink_to('precious')
    (tmp_path / '.a.npz.cache-file').touch()
    (tmp_path / '.a.npz.cache-new').mkdir()
    (tmp_path / '.a.npz.cache-pipe').mkdir()
    os.mkfifo(tmp_path / '.a.npz.cache-pipe' / 'lock')
    with image_cache(tmp_path / 'a.npz'):
        pass
    assert (tmp_path / 'precious' / 'lock').exists()
    assert {'.a.npz.cache-file', '.a.npz.cache-new'} < set(names(tmp_path))


def test_an_output_that_cannot_be_written_is_named_before_the_training(tmp_path):
    (tmp_path / 'link').symlink_to('/dev/null')
    for path, why in {
        '/dev/null/a': 'cannot be written', '/dev/null': 'no regular file',
        tmp_path / 'link': 'no regular file',
    }.items():  # fmt: skip
        with pytest.raises(ModelError, match=why), image_cache(Path(path)):
            raise AssertionError


def test_a_full_machine_is_one_line(capsys):
    def fail(error) -> int:
        raise error

    full, unmapped = OSError(28, 'No space left on device'), 'a.so: failed to map segment from'
    for error, why in (
        (full, '[Errno 28] No space left on device'), (MemoryError(), 'not enough memory'),
        (ImportError(f'{unmapped} shared object'), 'not enough memory'),
    ):  # fmt: skip
        assert cli.guarded(partial(fail, error)) == 1
        assert capsys.readouterr() == ('', f'error: {why}\n')
