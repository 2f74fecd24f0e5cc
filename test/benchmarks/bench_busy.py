# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every entry point beside busy processes, with the threads that NumPy takes by default over one:
`python bench_busy.py MODEL.npz BAG`. It starts the busy processes, twice as many as cores, and ends
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
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from sfa_localization.bags.drives import as_live, read_drive
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.data.run import Image, Run
from sfa_localization.evaluation import evaluate
from sfa_localization.localizer import Localizer
from sfa_localization.place_model import PlaceModel
from sfa_localization.sfa.network_training import cores
from sfa_localization.training_input import Recipe
from sfa_localization.updating import new_views

IMAGES = 20
RECIPE = Recipe(camera=CameraConfig(camera_model='mirror'))
"""Of drives of the simulator; panoramas need no camera."""


def drive_of(model: PlaceModel, bag: Path) -> Run:
    """The drive in a bag, with images as the model reads them."""
    with tempfile.TemporaryDirectory() as folder:
        return read_drive(bag, Path(folder), as_live(RECIPE, model.panorama), False)


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
    'evaluate': lambda model, run: evaluate(model, Path(sys.argv[2]), recipe=RECIPE),
    'update': new_views,
}


@contextlib.contextmanager
def busy() -> Iterator[None]:
    """Twice as many busy processes as cores."""
    loop = f'import os\nwhile os.getppid() == {os.getpid()}: pass'  # ends also with this process
    started = [subprocess.Popen([sys.executable, '-c', loop]) for _ in range(2 * cores())]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def seconds(entry: str, model: Path, drive: Path, **threads: str) -> float:
    """What an entry point takes in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith('_NUM_THREADS')} | threads
    command = [sys.executable, __file__, str(model), str(drive), '--entry', entry]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return float(done.stdout)


def bench_busy(
    model: Path, drive: Path, entries: Iterable[str] = ENTRIES, rounds: int = 3
) -> dict[str, float]:
    """Least time with default threads over the least with one, in turns, and the worst of all."""
    found: dict[str, float] = {}
    with busy():
        for entry in entries:
            pairs = [
                (
                    seconds(entry, model, drive),
                    seconds(entry, model, drive, OPENBLAS_NUM_THREADS='1'),
                )
                for _ in range(rounds)
            ]
            default, one = np.min(pairs, axis=0)
            found[f'busy_{entry}_over_one_thread'] = float(default / one)
    return {**found, 'busy_over_one_thread': max(found.values())}


if __name__ == '__main__':
    if '--entry' in sys.argv:
        held = PlaceModel.load(sys.argv[1])
        recorded = drive_of(held, Path(sys.argv[2]))
        start = time.perf_counter()
        ENTRIES[sys.argv[4]](held, recorded)
        sys.stdout.write(f'{time.perf_counter() - start}\n')
    else:
        sys.stdout.write(json.dumps(bench_busy(*map(Path, sys.argv[1:])), indent=2) + '\n')
