# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Programs are started, watched and stopped, whatever they or their starter do."""

import signal
import subprocess
import sys
import time

import psutil
import pytest

from sfa_localization.data.errors import NodeError

pytest.importorskip('rclpy')
from sfa_localization.commands.live_nodes import Processes

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


def test_all_have_ended_afterwards_also_after_an_error(tmp_path, children):
    with (
        pytest.raises(ZeroDivisionError),
        Processes(tmp_path / 'logs', 0.5) as processes,
    ):
        for name, code in {'obedient': WAIT, 'stubborn': STUBBORN}.items():
            processes.start(name, python(code))
            wait_until(ready(processes, name))
        processes.require_alive(['obedient', 'stubborn'])
        assert len(children()) == 2
        raise ZeroDivisionError
    assert children() == []


def test_a_dead_program_is_named_with_its_last_words(tmp_path, children):
    code = 'import sys; [print("line", i) for i in range(9)]; sys.exit("no model")'
    with Processes(tmp_path, 5.0) as processes:
        processes.start('sfa_node', python(code))
        with pytest.raises(NodeError) as caught:
            wait_until(lambda: processes.require_alive(['sfa_node']))
        processes.start('player', python('print("done")'))
        wait_until(lambda: processes.ended('player'))
        processes.start('killed', python(WAIT))
        wait_until(ready(processes, 'killed'))
        children()[-1].kill()
        with pytest.raises(NodeError, match='SIGKILL'):
            wait_until(lambda: processes.ended('killed'))
    text = str(caught.value)
    assert 'sfa_node ended (exit code 1)' in text
    assert 'line 8' in text and 'no model' in text and 'line 3' not in text


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_nothing_is_left_when_the_command_is_told_to_end(tmp_path, number):
    code = f"""
import sys, time
from pathlib import Path
from sfa_localization import cli
from sfa_localization.commands import config
from sfa_localization.commands.live_nodes import Processes

def run(arguments):
    with Processes(Path({str(tmp_path)!r}), 5.0) as processes:
        processes.start('node', [{sys.executable!r}, '-c', {WAIT!r}])
        while 'ready' not in processes.log('node').read_text():
            time.sleep(0.01)
        print('started', flush=True)
        time.sleep(60)

config.run = run
sys.exit(cli.main(['config']))
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
    assert (starter.returncode, errors) == (130, 'interrupted\n')
    assert not node.is_running()
