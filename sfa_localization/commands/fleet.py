# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Train and update the models of many gardens, each in a process of its own."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfa_localization.commands import options
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.files import read_text, write_json
from sfa_localization.data.plain_yaml import LONGEST, load_yaml
from sfa_localization.data.progress import LOG_PERIOD_S, progress_bar

if TYPE_CHECKING:
    from sfa_localization.commands.garden import Garden

WRITES = """\
for each garden model.npz, result.json and its page; index.html, a table of all gardens; with
  --json all results"""
EXAMPLES = """\
  fleet gardens --output models --workers 4
  fleet gardens.yaml --output /shared/models --scheduler tcp://10.0.0.1:8786"""
CLEAN_UP_S = 5.0
"""For a process to remove its temporary files."""
Place = tuple[Callable[..., 'Future[str]'], Callable[[], int]]
"""The `submit` of an executor, and the number of gardens that are worked on at once."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add gardens, outputs, and where the work is done."""
    cores = len(os.sched_getaffinity(0))
    parser.add_argument('gardens', type=Path, metavar='GARDENS', help='folder or YAML list of them')
    parser.add_argument('--output', type=Path, required=True, metavar='MODELS')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all results as JSON')
    place = parser.add_mutually_exclusive_group()
    place.add_argument('--workers', type=int, default=cores, help='processes here [all cores]')
    place.add_argument('--scheduler', metavar='tcp://HOST:8786', help='work on a Dask cluster')


def run(arguments: argparse.Namespace) -> int:
    """Work on all gardens that have changed; print those that are not good."""
    from sfa_localization.reports.fleet import write_fleet_page
    from sfa_localization.reports.plots import write_script

    if arguments.workers < 1:
        raise ConfigError('--workers: give 1 or more')
    output = arguments.output.resolve()
    address = arguments.scheduler
    file = arguments.json
    options.require_report(output, file)
    if file:
        options.require_output(file, [], '.json')
    gardens = _gardens(arguments.gardens, output)
    write_script(output)
    changed = [garden for garden in gardens if not garden.is_up_to_date()]
    try:
        with _cluster(address) if address else _processes(arguments.workers) as place:
            _work_on(changed, place, len(gardens))
    finally:
        results = [result for garden in gardens if (result := garden.result())]
        write_fleet_page(output, results, len(gardens), time.time())
        if file:
            write_json(file, {'gardens': results})
    for result in results:
        if result['state'] != 'good':
            print(f'{result["garden"]}: {result["state"]}: {result["sentences"][0]}')
    print(f'{output / "index.html"}: written')
    refused = any(result['state'] == 'refused' for result in results)
    return int(refused or len(results) < len(gardens))


def _gardens(source: Path, output: Path) -> list[Garden]:
    """The gardens in a folder, or in a YAML list of paths from its place. Raises ConfigError."""
    from sfa_localization.commands.garden import Garden

    if source.is_dir():
        inside = (path for path in sorted(source.iterdir()) if path.name[0] != '.')
        paths = [path for path in inside if path.is_dir() or path.is_symlink()]
    else:
        try:
            listed = load_yaml(read_text(source, LONGEST, ConfigError))
        except ValueError as error:
            raise ConfigError(f'{source}: {error}') from None
        if not isinstance(listed, list):
            raise ConfigError(f'{source}: must be a list, with lines such as "- /bags/garden_1"')
        paths = [source.parent / Path(str(name)).expanduser() for name in listed]
    folders = [Path(os.path.abspath(path)) for path in paths if path.resolve() != output]
    names = Counter(folder.name for folder in folders)
    if not folders or names.total() > len(names):
        twice = ', '.join(name for name, count in names.items() if count > 1)
        problem = f'two folders have the name {twice}' if twice else 'holds no folder'
        raise ConfigError(f'{source}: {problem}: give each garden a folder of another name')
    return [Garden(folder, output / folder.name) for folder in folders]


@contextmanager
def _processes(workers: int) -> Iterator[Place]:
    """A process for each garden: one that dies takes no other along."""
    context = multiprocessing.get_context('spawn')

    def submit(work: Callable[[Garden], str], garden: Garden) -> Future[str]:
        executor = ProcessPoolExecutor(1, context, _follow_the_parent)
        future = executor.submit(work, garden)
        executor.shutdown(wait=False)  # the process ends after this garden
        return future

    try:
        yield submit, lambda: workers
    finally:
        for process in multiprocessing.active_children():
            process.terminate()


def _follow_the_parent() -> None:
    """End with the parent, or when it says so, and remove temporary files; not by Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(CLEAN_UP_S)
        os._exit(1)  # the executor's loop outlives the signal


@contextmanager
def _cluster(address: str) -> Iterator[Place]:
    """The workers of a Dask scheduler, also those that come later. Raises OSError without it."""
    from distributed import Client

    with Client(address) as client:
        executor = client.get_executor(pure=False)  # work is done again, not remembered
        yield executor.submit, lambda: max(1, sum(client.nthreads().values()))


def _work_on(gardens: Sequence[Garden], place: Place, total: int) -> None:
    """Work on the gardens that changed, of a total; give up those whose work fails twice."""
    from sfa_localization.commands.garden import work

    submit, limit = place
    waiting = deque(gardens)
    refused = 0
    running: dict[Future[str], Garden] = {}
    failed: set[Garden] = set()
    with progress_bar('fleet', total, 'gardens', total - len(gardens), visible=True) as bar:
        while waiting or running:
            while waiting and len(running) < limit():
                garden = waiting.popleft()
                running[submit(work, garden)] = garden
            bar.set_description_str(f'running {len(running)}, refused {refused}', refresh=False)
            done = wait(running, LOG_PERIOD_S, FIRST_COMPLETED).done
            if not done:
                bar.refresh()
            for future in done:
                garden = running.pop(future)
                if _has_failed(future) and garden not in failed:
                    failed.add(garden)
                    waiting.append(garden)
                    continue
                refused += _state(garden, future, bar) == 'refused'
                bar.update()


def _has_failed(future: Future[str]) -> bool:
    """Whether the work ended in an error. Raises LocalizationError if it was never begun."""
    if future.cancelled():
        raise LocalizationError('the scheduler has ended: start it, and repeat this')
    return future.exception() is not None


def _state(garden: Garden, future: Future[str], bar: Any) -> str:
    """The state of a garden after its work, or after its second error."""
    from sfa_localization.commands.garden import give_up

    error = future.exception()
    try:
        return give_up(garden, error) if error else future.result()
    except LocalizationError as unwritten:
        bar.write(f'{garden.output.name}: refused: {unwritten}', file=sys.stderr)
        return 'refused'
