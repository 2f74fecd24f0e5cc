# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Programs that run together: started, monitored, and stopped by their handles."""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from subprocess import DEVNULL, STDOUT, Popen, TimeoutExpired

from sfa_localization.data.errors import NodeError

LAST_LINES = 5  # of a failed program's output, in the error message


class Processes:
    """Context manager of programs that write to log files; all have ended after its exit."""

    def __init__(self, folder: Path, environment: Mapping[str, str], stop_timeout_s: float) -> None:
        self._folder = folder
        self._environment = dict(environment)
        self._stop_timeout_s = stop_timeout_s
        self._running: dict[str, Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_error: object) -> None:
        """Interrupt all, then terminate and finally kill those that do not end in time.

        A second Ctrl-C is ignored meanwhile: no program must be left running.
        """
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
                self._stop(number)
        finally:
            signal.signal(signal.SIGINT, before)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a program under a unique name."""
        with open(self.log(name), 'wb') as output:
            self._running[name] = Popen(
                command, stdin=DEVNULL, stdout=output, stderr=STDOUT, env=self._environment
            )

    def log(self, name: str) -> Path:
        """File with the output of a program."""
        return self._folder / f'{name}.log'

    def ended(self, name: str) -> bool:
        """True after a program has ended with exit code 0. Raises NodeError for another."""
        code = self._running[name].poll()
        if code:
            raise NodeError(self._failure(name, code))
        return code is not None

    def require_alive(self, names: Sequence[str]) -> None:
        """Raise NodeError, with the last lines of its output, for a program that has ended."""
        for name in names:
            code = self._running[name].poll()
            if code is not None:
                raise NodeError(self._failure(name, code))

    def _failure(self, name: str, code: int) -> str:
        lines = self.log(name).read_text(encoding='utf-8', errors='replace').strip().splitlines()
        last = '\n  '.join(lines[-LAST_LINES:])
        how = f'exit code {code}' if code >= 0 else signal.Signals(-code).name
        return f'{name} ended ({how}); its last output, from {self.log(name)}:\n  {last}'

    def _stop(self, number: signal.Signals) -> None:
        alive = [process for process in self._running.values() if process.poll() is None]
        for process in alive:
            process.send_signal(number)
        for process in alive:
            with suppress(TimeoutExpired):
                process.wait(self._stop_timeout_s)
