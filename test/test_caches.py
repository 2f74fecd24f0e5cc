# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Decoded images on disk are gone at the end of their process, however it ends."""

import os
import signal
import subprocess
import sys
from functools import partial

import pytest
from page_tables import ROOT

from sfa_localization import cli
from sfa_localization.data.rejections import LONGEST, MOST, OTHER, RejectionCounter, short_line

TRAIN_AND_WAIT = """
import sys, time
from pathlib import Path
from sfa_localization import cli
from sfa_localization.bags.drives import image_folder, read_drive
from sfa_localization.commands import train

def run(arguments):
    run = read_drive(arguments.bags[0], image_folder(arguments.output))
    print('ready', len(run.panoramas), flush=True)
    time.sleep(60)

train.run = run
sys.exit(cli.main(['train', 'bags/sample_test', '--output', sys.argv[1]]))
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_a_signal_leaves_no_images(number, tmp_path):
    command = [sys.executable, '-c', TRAIN_AND_WAIT, str(tmp_path / 'a.npz')]
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment
    ) as process:
        assert process.stdout.readline() == 'ready 140\n'
        process.send_signal(number)
        assert process.wait(60) == (-number if number == signal.SIGKILL else 130)
    assert list(tmp_path.iterdir()) == []


def test_a_full_machine_is_a_single_line(capsys):
    def fail(error):
        raise error

    full, unmapped = OSError(28, 'No space left on device'), 'a.so: failed to map segment from'
    for error, why in (
        (full, '[Errno 28] No space left on device'), (MemoryError(), 'not enough memory'),
        (ImportError(f'{unmapped} shared object'), 'not enough memory'),
    ):  # fmt: skip
        assert cli.guarded(partial(fail, error)) == 1
        assert capsys.readouterr() == ('', f'error: {why}\n')


def test_reasons_are_counted_singly_up_to_a_number_and_then_together():
    """What senders write can fill neither the memory nor the diagnostics."""
    reasons = RejectionCounter()
    for k in range(3000):
        assert reasons.add(f'frame is {k}') == (1 if k < MOST else k - MOST + 1)
    assert len(reasons) == MOST + 1 and reasons[OTHER] == 3000 - MOST
    assert reasons.add('frame is 0', 5) == 6 and sum(reasons.values()) == 3005
    assert short_line('a\nb\x1b[31m\tc') == 'a b?[31m c'
    assert len(short_line('x' * 10**6)) == LONGEST and short_line('x' * 10**6).endswith('...')
