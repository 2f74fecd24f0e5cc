# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Train and update the models of many gardens, each in a process of its own."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfa_localization.commands import options
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.files import read_text, write_json
from sfa_localization.data.plain_yaml import LONGEST, load_yaml
from sfa_localization.data.progress import progress_bar

if TYPE_CHECKING:
    from sfa_localization.commands.garden import Garden

WRITES = """\
for each garden model.npz, result.json and its page; index.html, a table of all gardens; with
  --json all results"""
EXAMPLES = """\
  fleet gardens --output models --workers 4
  fleet gardens.yaml --output /shared/models --scheduler tcp://10.0.0.1:8786"""
ATTEMPTS = 2
"""A garden is given up when its process has ended so often: by chance once, not twice."""
Places = tuple[Callable[[], Executor], Callable[[], int]]
"""What starts an executor for one garden, and how many gardens are worked on at once."""


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
    from sfa_localization.commands.garden import is_up_to_date

    if arguments.workers < 1:
        raise ConfigError('--workers: give 1 or more')
    output, address = arguments.output.resolve(), arguments.scheduler
    options.require_report(output, arguments.json)
    if arguments.json:
        options.require_output(arguments.json, [], '.json')
    gardens = _gardens(arguments.gardens, output)
    changed = [garden for garden in gardens if not is_up_to_date(garden)]
    try:
        with _cluster(address) if address else _processes(arguments.workers) as places:
            _work_on(changed, places, len(gardens))
    finally:
        results = _write_results(gardens, output, arguments.json)
    for result in results:
        if result['state'] != 'good':
            print(f'{result["garden"]}: {result["state"]}: {result["sentence"]}')
    print(f'{output / "index.html"}: written')
    return int(any(result['state'] == 'refused' for result in results))


def _gardens(source: Path, output: Path) -> list[Garden]:
    """The gardens in a folder, or in a YAML list of paths from its place. Raises ConfigError."""
    from sfa_localization.commands.garden import Garden

    if source.is_dir():
        inside = (path for path in sorted(source.iterdir()) if path.name[0] != '.')
        folders = [path.resolve() for path in inside if path.is_dir()]
    else:
        try:
            listed = load_yaml(read_text(source, LONGEST, ConfigError))
        except ValueError as error:
            raise ConfigError(f'{source}: {error}') from None
        if not isinstance(listed, list):
            raise ConfigError(f'{source}: must be a list, with lines such as "- /bags/garden_1"')
        folders = [(source.parent / str(name)).resolve() for name in listed]
    repeated = [name for name, n in Counter(folder.name for folder in folders).items() if n > 1]
    if repeated or not folders:
        problem = f'two folders are named {repeated[0]}' if repeated else 'holds no folder'
        raise ConfigError(f'{source}: {problem}: name a folder for each garden')
    if output in folders or output.parent == source.resolve():
        raise ConfigError(f'{output}: lies among the gardens: give --output another place')
    return [Garden(folder, output / folder.name) for folder in folders]


@contextmanager
def _processes(workers: int) -> Iterator[Places]:
    """A process for each garden: one that dies takes no other along."""
    context = multiprocessing.get_context('spawn')
    try:
        yield lambda: ProcessPoolExecutor(1, context, _begin), lambda: workers
    finally:
        for process in multiprocessing.active_children():
            process.terminate()


def _begin() -> None:
    """In a new process: leave Ctrl-C to the parent, which then terminates it, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # to remove temporary files
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[Places]:
    """The workers of a Dask scheduler, also those that come later. Raises OSError without it."""
    from distributed import Client

    with Client(address) as client:
        start = partial(client.get_executor, pure=False)  # work is done again, not remembered
        yield start, lambda: max(1, sum(client.nthreads().values()))


def _work_on(gardens: Sequence[Garden], places: Places, total: int) -> None:
    """Work on the gardens that changed, of a total; give up those whose process ends again."""
    from sfa_localization.commands.garden import give_up, work

    start, limit = places
    waiting, refused = deque(gardens), 0
    failures: Counter[Garden] = Counter()
    running: dict[Future[str], tuple[Garden, Executor]] = {}
    with progress_bar('fleet', total, 'gardens', total - len(gardens), visible=True) as bar:
        while waiting or running:
            while waiting and len(running) < limit():
                garden, executor = waiting.popleft(), start()
                running[executor.submit(work, garden)] = garden, executor
            bar.set_description_str(f'running {len(running)}, refused {refused}', refresh=False)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                garden, executor = running.pop(future)
                if future.cancelled():
                    raise LocalizationError('the scheduler has ended: start it, and repeat this')
                executor.shutdown()
                error = future.exception()
                failures[garden] += error is not None
                if error and failures[garden] < ATTEMPTS:
                    waiting.append(garden)
                    continue
                state = give_up(garden, error) if error else future.result()
                refused += state == 'refused'
                bar.update()


def _write_results(
    gardens: Sequence[Garden], output: Path, file: Path | None
) -> list[dict[str, Any]]:
    """Write the page, and all results as JSON; a garden without a result is waiting."""
    from sfa_localization.reports.fleet import write_fleet_page

    waiting = {'state': 'waiting', 'sentence': 'run the command again', 'judgments': []}
    results = [g.result() or {'garden': g.output.name, **waiting} for g in gardens]
    write_fleet_page(output, results, time.time())
    if file:
        write_json(file, {'gardens': results})
    return results
