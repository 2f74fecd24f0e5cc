# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Thousands of hostile messages, models, bags, YAML files and images: `fuzz.py [--inputs 10000]`.

Each kind runs in processes of its own with a limit of memory, of open files and of the time for an
input. An input that ends its process (death), raises anything but an error of ours (traceback) or
takes too long (hang) is printed with its number; `--kinds models --first 123 --inputs 1` repeats
it. Exits with 1 when there was one.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import resource
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

import numpy as np  # noqa: E402
from fuzz_inputs import KINDS  # noqa: E402

MEMORY = 4 << 30
"""Bytes of address space of a process, most of which its libraries only reserve."""
OPEN_FILES = 256
INPUT_S = 30.0
"""Seconds for an input; on an idle machine the slowest takes one."""
PATIENCE_S = 120.0
"""Seconds for a process to start: libraries are imported, and a model is read."""
SHOWN = 5


@dataclass
class Total:
    """What became of the inputs of one kind."""

    inputs: int = 0
    read: int = 0
    deaths: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    hangs: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    peak_mb: float = 0.0
    seconds: float = 0.0

    @property
    def failures(self) -> list[str]:
        return [*self.deaths, *self.tracebacks, *self.hangs]

    def add(self, event: dict[str, object], name: str) -> None:
        """Take what a process printed after an input."""
        self.inputs += 1
        self.read += bool(event['read'])
        self.slowest_s = max(self.slowest_s, float(str(event['seconds'])))
        self.peak_mb = max(self.peak_mb, float(str(event['peak_mb'])))
        if event['error']:
            self.tracebacks.append(f'{name} {event["number"]}: {event["error"]}')


class Fuzzer:
    """Runs inputs of one kind, in as many processes as it takes.

    `program` is run with the words that `run_inputs` takes.
    """

    def __init__(
        self, name: str, input_s: float = INPUT_S, program: Sequence[str] = (__file__, '--process')
    ) -> None:
        self._name, self._input_s = name, input_s
        self._command = [sys.executable, *program, name]
        self.total = Total()

    def run(self, first: int, count: int) -> Total:
        """Use the inputs of these numbers."""
        start, number = time.monotonic(), first
        with tempfile.TemporaryDirectory(prefix='fuzz-') as folder:
            intact = Path(folder) / 'intact'
            intact.mkdir()
            KINDS[self._name]().prepare(intact)
            while number < first + count:
                number = self._process(number, first + count, Path(folder))
        self.total.seconds = time.monotonic() - start
        return self.total

    def _process(self, number: int, end: int, folder: Path) -> int:
        """Start a process and listen to it; returns the number of the first input that is left."""
        with (
            (folder / 'errors').open('wb') as errors,
            subprocess.Popen(
                [*self._command, str(number), str(end), str(folder)],
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
            ) as child,
        ):
            lines, patience = _Lines(child), PATIENCE_S
            while (line := lines.next(patience)) is not None:
                patience = self._input_s
                event = json.loads(line)
                if event['number'] >= 0:
                    self.total.add(event, self._name)
                    number = event['number'] + 1
            if lines.late:
                child.kill()
            lines.join()
        if number == end:
            return end
        said = (folder / 'errors').read_text(errors='replace')[-300:].strip()
        self._failed(number, '' if lines.late else f'exit code {child.returncode} {said}')
        return number + 1

    def _failed(self, number: int, death: str) -> None:
        """Note an input that its process did not survive, or did not end with."""
        self.total.inputs += 1
        if death:
            self.total.deaths.append(f'{self._name} {number}: {death}')
        else:
            self.total.hangs.append(f'{self._name} {number}: no end after {self._input_s:g} s')


class _Lines:
    """Lines that a process prints, each within a time; `late` when one was not."""

    def __init__(self, child: subprocess.Popen[bytes]) -> None:
        assert child.stdout is not None
        self.late = False
        self._queue: queue.Queue[bytes | None] = queue.Queue()
        output = child.stdout

        def read() -> None:
            for line in output:
                self._queue.put(line)
            self._queue.put(None)

        self._thread = threading.Thread(target=read, daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the end of the process."""
        self._thread.join()

    def next(self, patience_s: float) -> bytes | None:
        try:
            return self._queue.get(timeout=patience_s)
        except queue.Empty:
            self.late = True
            return None


def run_inputs(words: list[str]) -> None:
    """In a process of its own: use inputs, and print a line after each."""
    name, first, end, folder = words[0], int(words[1]), int(words[2]), words[3]
    kind = KINDS[name]()
    kind.open(Path(folder) / 'intact')
    limits = {resource.RLIMIT_AS: MEMORY, resource.RLIMIT_NOFILE: OPEN_FILES}
    limits |= {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: 1 << 31}
    for limit, value in limits.items():
        resource.setrlimit(limit, (value, value))
    warnings.simplefilter('ignore')
    print(json.dumps({'number': -1}), flush=True)
    for number in range(first, end):
        print(json.dumps(_used(kind, name, number, Path(folder))), flush=True)


def _used(kind: object, name: str, number: int, folder: Path) -> dict[str, object]:
    seed = [number, *name.encode()]
    start, error, read = time.monotonic(), '', False
    with tempfile.TemporaryDirectory(dir=folder) as place:
        try:
            read = kind.use(np.random.default_rng(seed), Path(place))  # type: ignore[attr-defined]
        except BaseException:  # whatever it is, it is what is looked for
            error = traceback.format_exc()
    peak = _peak_mb()
    seconds = time.monotonic() - start
    return {'number': number, 'read': read, 'seconds': seconds, 'peak_mb': peak, 'error': error}


def _peak_mb() -> float:
    """Largest memory of this program; getrusage would count that of its parent's before exec."""
    status = Path('/proc/self/status').read_text('utf-8')
    return int(status.split('VmHWM:')[1].split()[0]) / 1024


def table(totals: dict[str, Total]) -> str:
    """One line for each kind."""
    lines = ['kind      inputs    read deaths tracebacks hangs slowest s peak MB    s']
    for name, total in totals.items():
        failed = f'{len(total.deaths):6} {len(total.tracebacks):10} {len(total.hangs):5}'
        cost = f'{total.slowest_s:9.2f} {total.peak_mb:7.0f} {total.seconds:4.0f}'
        lines.append(f'{name:8} {total.inputs:7} {total.read:7} {failed} {cost}')
    return '\n'.join(lines)


def main() -> int:
    """Run the kinds; print the totals, and the first failures of each kind."""
    if sys.argv[1:2] == ['--process']:
        run_inputs(sys.argv[2:])
        return 0
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))
    parser.add_argument('--inputs', type=int, default=10_000, help='of each kind [10000]')
    parser.add_argument('--first', type=int, default=0, help='number of the first [0]')
    arguments = parser.parse_args()
    totals = {}
    for name in arguments.kinds:
        totals[name] = Fuzzer(name).run(arguments.first, arguments.inputs)
        print(*totals[name].failures[:SHOWN], sep='\n')
    print(table(totals))
    return int(any(total.failures for total in totals.values()))


if __name__ == '__main__':
    sys.exit(main())
