# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Programs are started, watched and stopped, whatever they or their starter do."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from sfa_localization.commands.processes import Processes
from sfa_localization.data.errors import NodeError

DEADLINE_S = 60
WAIT = 'import time; print("ready", flush=True); time.sleep(60)'
STUBBORN = 'import signal; [signal.signal(s, signal.SIG_IGN) for s in (2, 15)]; ' + WAIT


def python(code: str) -> list[str]:
    return [sys.executable, '-c', code]


def wait_until(condition) -> None:
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, 'deadline'
        time.sleep(0.01)


def ready(processes: Processes, name: str):
    return lambda: 'ready' in processes.log(name).read_text()


@pytest.fixture
def children():
    """The children of this process that the test started."""
    before = set(psutil.Process().children())
    return lambda: [c for c in psutil.Process().children() if c not in before]


@pytest.mark.parametrize('code', [WAIT, STUBBORN], ids=['obedient', 'stubborn'])
def test_all_have_ended_afterwards(tmp_path, children, code):
    with Processes(tmp_path / 'logs', os.environ, stop_timeout_s=0.5) as processes:
        processes.start('one', python(code))
        processes.start('two', python(code))
        wait_until(ready(processes, 'one'))
        wait_until(ready(processes, 'two'))
        processes.require_alive(['one', 'two'])
        assert len(children()) == 2
    assert children() == []


def test_a_dead_program_is_named_with_its_last_words(tmp_path):
    code = 'import sys; [print("line", i) for i in range(9)]; sys.exit("no model")'
    with Processes(tmp_path, os.environ, 5.0) as processes:
        processes.start('alive', python(WAIT))
        processes.start('sfa_node', python(code))
        wait_until(lambda: 'no model' in processes.log('sfa_node').read_text())
        with pytest.raises(NodeError) as caught:
            wait_until(lambda: processes.require_alive(['alive', 'sfa_node']))
    text = str(caught.value)
    assert 'sfa_node ended (exit code 1)' in text
    assert 'line 8' in text and 'no model' in text and 'line 3' not in text


def test_a_program_that_should_end_may_and_a_killed_one_shows_its_signal(tmp_path, children):
    with pytest.raises(ZeroDivisionError), Processes(tmp_path, os.environ, 5.0) as processes:
        processes.start('player', python('print("done")'))
        wait_until(lambda: processes.ended('player'))
        processes.start('killed', python(WAIT))
        wait_until(ready(processes, 'killed'))
        children()[-1].kill()
        with pytest.raises(NodeError, match='SIGKILL'):
            wait_until(lambda: processes.ended('killed'))
        processes.start('other', python(WAIT))
        raise ZeroDivisionError
    assert children() == [], 'all have ended also after an error'


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_nothing_is_left_when_the_starter_is_told_to_end(tmp_path, number):
    code = f"""
import os, time
from pathlib import Path
from sfa_localization.commands.processes import Processes, terminable
with terminable(), Processes(Path({str(tmp_path)!r}), os.environ, 5.0) as processes:
    processes.start('node', [{sys.executable!r}, '-c', {WAIT!r}])
    while 'ready' not in processes.log('node').read_text():
        time.sleep(0.01)
    print('started', flush=True)
    time.sleep(60)
"""
    starter = subprocess.Popen(
        python(code), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert starter.stdout.readline() == 'started\n'
        (node,) = psutil.Process(starter.pid).children()
        starter.send_signal(number)
        _, errors = starter.communicate(timeout=DEADLINE_S)
    finally:
        starter.kill()
    assert 'KeyboardInterrupt' in errors
    assert not node.is_running()
