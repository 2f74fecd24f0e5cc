# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Programs that run together: started, watched, and stopped by their own handles."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType

from sfa_localization.data.errors import NodeError

LAST_LINES = 5


class Processes:
    """Context manager of programs whose output goes to files; all have ended when it is left."""

    def __init__(self, folder: Path, environment: Mapping[str, str], stop_timeout_s: float) -> None:
        self._folder = folder
        self._environment = dict(environment)
        self._stop_timeout_s = stop_timeout_s
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Interrupt all, then terminate and finally kill what does not end in time."""
        with _undisturbed():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
                self._stop(number)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a program under a name of its own."""
        with open(self.log(name), 'wb') as output:
            self._running[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=self._environment,
            )

    def log(self, name: str) -> Path:
        """File with what a program printed."""
        return self._folder / f'{name}.log'

    def ended(self, name: str) -> bool:
        """True after a program ended by itself, as it should. Raises NodeError for a failure."""
        code = self._running[name].poll()
        if code:
            raise NodeError(self._obituary(name, code))
        return code is not None

    def require_alive(self, names: Sequence[str]) -> None:
        """Raise NodeError, with the last lines it printed, for a program that has ended."""
        for name in names:
            code = self._running[name].poll()
            if code is not None:
                raise NodeError(self._obituary(name, code))

    def _obituary(self, name: str, code: int) -> str:
        lines = self.log(name).read_text(encoding='utf-8', errors='replace').strip().splitlines()
        last = '\n  '.join(lines[-LAST_LINES:])
        how = f'exit code {code}' if code >= 0 else signal.Signals(-code).name
        return f'{name} ended ({how}); it said, in {self.log(name)}:\n  {last}'

    def _stop(self, number: signal.Signals) -> None:
        alive = [process for process in self._running.values() if process.poll() is None]
        for process in alive:
            process.send_signal(number)
        for process in alive:
            try:
                process.wait(self._stop_timeout_s)
            except subprocess.TimeoutExpired:
                continue


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Put off a second Ctrl-C: no program must be left behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM and a closed terminal end the block like Ctrl-C, so that it can tidy up."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals = (signal.SIGTERM, signal.SIGHUP)
    # What is ignored, as after nohup, stays so.
    heeded = [number for number in signals if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, interrupt) for number in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
