# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A command of this package in a process of its own, at low priority."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile

from sfa_localization.nodes.monitor import steady_s

_NICE = 10
_STOP_S = 5.0
_LAST_BYTES = 2000
_BOUND = f"""
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, {int(signal.SIGTERM)})
if os.getppid() != int(sys.argv.pop(1)):
    sys.exit(1)
from sfa_localization.cli import main
sys.exit(main())
"""
"""Runs the command until the node ends, by any signal (PR_SET_PDEATHSIG): a node that is started
again never meets the work of the one before."""


class Worker:
    """Runs a command, as of the command line; its output goes to a file without a name, which a
    killed node does not leave.
    """

    def __init__(self, words: Sequence[str | Path]) -> None:
        self.start_s = steady_s()
        self._log = TemporaryFile()  # noqa: SIM115 - closed with this object
        command = [sys.executable, '-c', _BOUND, str(os.getpid()), *map(str, words)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=self._log, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
        with suppress(OSError):  # it may have ended
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICE)

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._process.poll()

    @property
    def elapsed_s(self) -> float:
        """How long it has been running."""
        return steady_s() - self.start_s

    def last_line(self) -> str:
        """What it printed last; progress bars return to the start of their line."""
        written = os.fstat(self._log.fileno()).st_size
        last = os.pread(self._log.fileno(), _LAST_BYTES, max(written - _LAST_BYTES, 0))
        text = last.decode(errors='replace')
        lines = [line.strip() for line in text.replace('\r', '\n').split('\n')]
        return next(filter(None, reversed(lines)), '')

    def failure(self) -> str:
        """Why it failed: the signal that ended it, or what it printed last."""
        if self.code is None or self.code >= 0:
            return self.last_line()
        name = signal.Signals(-self.code).name
        memory = ', as by a system without memory' if name == 'SIGKILL' else ''
        return f'{name} ended it{memory}'

    def stop(self) -> None:
        """End it, as a terminal does; what it wrote stays whole."""
        if self.code is not None:
            return
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
