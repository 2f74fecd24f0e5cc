# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every entry point beside busy processes, with the threads that NumPy takes by default over one:
`python bench_busy.py MODEL.npz`. It starts the busy processes, twice as many as cores, and ends
them.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from sfa_localization.bags.drives import ReadingRecipe, as_live, read_drive
from sfa_localization.data.run import Image, Run
from sfa_localization.evaluation import evaluate
from sfa_localization.features.network_training import cores
from sfa_localization.localizer import Localizer
from sfa_localization.place_model import PlaceModel
from sfa_localization.updating import new_views

DRIVE = Path(__file__).parents[2] / 'bags/sample_test'
IMAGES = 20


def drive_of(model: PlaceModel) -> Run:
    """The drive of the repository, with images as the model reads them."""
    with tempfile.TemporaryDirectory() as folder:
        return read_drive(DRIVE, Path(folder), as_live(ReadingRecipe(), model.panorama), False)


def images_of(run: Run) -> Image:
    """The first images (T, H, W, 3) of a drive."""
    return run.panoramas.read(0, IMAGES)


def _locate(model: PlaceModel, run: Run) -> None:
    for image in images_of(run):
        model.locate(image)


def _localizer(model: PlaceModel, run: Run) -> None:
    localizer = Localizer(model)
    for stamp_ns, image in zip(run.panoramas.stamps_ns.tolist(), images_of(run), strict=False):
        localizer.add_odometry(stamp_ns, 0.3, 0.0)
        localizer.add_panorama(stamp_ns, image)


ENTRIES: dict[str, Callable[[PlaceModel, Run], object]] = {
    'locate': _locate,
    'localizer': _localizer,
    'evaluate': lambda model, run: evaluate(model, DRIVE),
    'update': new_views,
}


@contextlib.contextmanager
def busy() -> Iterator[None]:
    """Twice as many busy processes as cores."""
    loop = [sys.executable, '-c', 'while True: pass']
    started = [subprocess.Popen(loop) for _ in range(2 * cores())]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def seconds(entry: str, model: Path, **threads: str) -> float:
    """What an entry point takes in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith('_NUM_THREADS')} | threads
    command = [sys.executable, __file__, str(model), '--entry', entry]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return float(done.stdout)


def bench_busy(model: Path, rounds: int = 3) -> dict[str, float]:
    """Least time with default threads over the least with one, in turns, and the worst of all."""
    found: dict[str, float] = {}
    with busy():
        for entry in ENTRIES:
            pairs = [
                (seconds(entry, model), seconds(entry, model, OPENBLAS_NUM_THREADS='1'))
                for _ in range(rounds)
            ]
            default, one = np.min(pairs, axis=0)
            found[f'busy_{entry}_over_one_thread'] = float(default / one)
    return {**found, 'busy_over_one_thread': max(found.values())}


if __name__ == '__main__':
    if '--entry' in sys.argv:
        held = PlaceModel.load(sys.argv[1])
        recorded = drive_of(held)
        start = time.perf_counter()
        ENTRIES[sys.argv[3]](held, recorded)
        sys.stdout.write(f'{time.perf_counter() - start}\n')
    else:
        sys.stdout.write(json.dumps(bench_busy(Path(sys.argv[1])), indent=2) + '\n')
