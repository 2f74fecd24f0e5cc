# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Training and inference against MDP and against bare matrix products: `python bench_sfa.py`.

Ratios compare two ways of doing the same, measured in turns, in one run, on one core. `--quick`
takes fewer pictures; inference is measured by `bench_all.py`.
"""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import psutil
from bench_busy import drive_of, images_of

from sfa_localization.data.errors import ConfigError
from sfa_localization.data.run import PanoramaArray
from sfa_localization.data.threads import one_core
from sfa_localization.metric.basis import Process
from sfa_localization.metric.saved_map import MetricMap
from sfa_localization.place_model import PlaceModel
from sfa_localization.sfa import mdp_engine
from sfa_localization.sfa.network import standard_architecture
from sfa_localization.sfa.network_training import (
    ImageSequence,
    cores,
    shards_of,
    train_network,
)

SIZE = (60, 600)
PAPER_PICTURES = 1773
CLOSE, LEVELED, NEAR, TILTS, HEADINGS = 64, 16, 64, 11, 1
"""Keyframes that an image is compared with in full, leveled to, and located among; the tilts that
are tried along each axis, and the headings at which the map is read."""
ARCHITECTURE = standard_architecture(SIZE, 'panorama')


def panoramas(path: Path, count: int, seed: int = 0) -> ImageSequence:
    """Colour textures that change and turn slowly, in a memory-mapped file."""
    rng = np.random.default_rng(seed)
    tiles = [_texture(rng) for _ in range(count // 60 + 3)]
    images = np.memmap(path, np.uint8, 'w+', shape=(count, *SIZE, 3))
    turn = rng.normal(0, 12, count).cumsum().astype(int)
    for t in range(count):
        k, share = divmod(t / 60, 1.0)
        blend = np.tensordot(_spline(share), np.stack(tiles[int(k) : int(k) + 3]), 1)
        images[t] = np.roll(np.clip(blend, 0, 255), turn[t], axis=1)
    images.flush()
    read_only = np.memmap(path, np.uint8, 'r', shape=images.shape)
    return ImageSequence(
        PanoramaArray(np.arange(count), read_only, path.open('rb')), np.ones(count - 1, bool)
    )


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Soft spots of many sizes that wrap around."""
    noise = np.zeros((*SIZE, 3), np.float32)
    for width in (1.5, 4, 12):
        spots = rng.normal(size=(SIZE[0], 3 * SIZE[1], 3)).astype(np.float32)
        spots[:, : SIZE[1]] = spots[:, SIZE[1] : 2 * SIZE[1]] = spots[:, 2 * SIZE[1] :]
        noise += cv2.GaussianBlur(spots, (0, 0), width)[:, SIZE[1] : 2 * SIZE[1]] * width
    return 128 + 40 * noise / noise.std()


def _spline(x: float) -> np.ndarray:
    return np.array([(1 - x) ** 2 / 2, 0.5 + x - x * x, x * x / 2])


def bench_training(folder: Path, quick: bool = False) -> dict[str, float]:
    """Seconds to train the network on the paper's number of pictures; all cores, a warm file."""
    count = 200 if quick else PAPER_PICTURES
    drive = panoramas(folder / 'paper.u8', count)
    wall, cpu = time.perf_counter(), time.process_time()
    train_network(ARCHITECTURE, [drive])
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    name = 'train_200_pictures' if quick else 'train_paper_size'
    return {f'{name}_s': wall, f'{name}_cpu_s': cpu, 'cores': float(cores())}


def bench_engines(folder: Path, quick: bool = False) -> dict[str, float]:
    """Seconds of one core per picture and in all, by MDP on the explicit sequence and by ours.

    Each is measured at two sizes, in turns; time is a + b pictures.
    """
    sizes, our_sizes = ((2, 4) if quick else (4, 8)), (64, 320)
    drive = panoramas(folder / 'engines.u8', our_sizes[1])
    seconds: dict[str, list[float]] = {'mdp': [], 'ours': []}
    for size, our_size in zip(sizes, our_sizes, strict=True):
        part = _first(drive, size)
        with one_core():
            start = time.process_time()
            mdp_engine.train_flow(ARCHITECTURE, shards_of([part], 0))
            seconds['mdp'].append(time.process_time() - start)
            part = _first(drive, our_size)
            start = time.process_time()
            train_network(ARCHITECTURE, [part])
            seconds['ours'].append(time.process_time() - start)
    theirs = _extrapolated(sizes, seconds['mdp'])
    ours = _extrapolated(our_sizes, seconds['ours'])
    speedup = float(theirs @ [1, PAPER_PICTURES] / (ours @ [1, PAPER_PICTURES]))
    return {
        'train_speedup_vs_mdp': speedup,
        'train_speedup_vs_mdp_per_picture': float(theirs[1] / ours[1]),
        'train_mdp_s_per_picture': float(theirs[1]),
        'train_s_per_picture': float(ours[1]),
        'train_mdp_paper_size_hours': float(theirs @ [1, PAPER_PICTURES]) / 3600,
    }


def _first(drive: ImageSequence, count: int) -> ImageSequence:
    part = PanoramaArray(drive.panoramas.stamps_ns[:count], drive.panoramas.images[:count])
    return ImageSequence(part, drive.joined[: count - 1])


def _extrapolated(sizes: tuple[int, ...], seconds: list[float]) -> np.ndarray:
    """(a, b) of a + b pictures."""
    slope = (seconds[1] - seconds[0]) / (sizes[1] - sizes[0])
    return np.array([max(seconds[0] - slope * sizes[0], 0.0), slope])


def in_turns(functions: list[Callable[[], object]], rounds: int) -> np.ndarray:
    """Seconds of CPU (functions, rounds) of each function, called in turns."""
    taken = np.zeros((len(functions), rounds))
    for function in functions:
        function()
    for at in range(rounds):
        for row, function in zip(taken, functions, strict=True):
            start = time.thread_time()
            function()
            row[at] = time.thread_time() - start
    return taken


def bench_locate(model: PlaceModel, images: np.ndarray, rounds: int = 300) -> dict[str, float]:
    """Locating pictures (T, H, W, 3) of the place, in turns, against the matrix products of the
    equations, on one core.
    """
    each, products = itertools.cycle(images), bare_products(model)
    with one_core():
        whole, bare = in_turns(
            [lambda: model.locate(next(each)), lambda: [product() for product in products]], rounds
        )
        grown = _growth(lambda: model.locate(images[0]), 500)
    return {
        'locate_over_matmul': float(np.median(whole) / np.median(bare)),
        'locate_ms': float(np.median(whole)) * 1e3,
        'locate_p99_ms': float(np.percentile(whole, 99)) * 1e3,
        'matmul_ms': float(np.median(bare)) * 1e3,
        'locate_growth_mib': grown,
    }


def _growth(function: Callable[[], object], calls: int) -> float:
    """MiB by which the process's memory grows over many calls."""
    for _ in range(100):
        function()
    before = psutil.Process().memory_info().rss
    for _ in range(calls):
        function()
    return (psutil.Process().memory_info().rss - before) / 2**20


def bare_network(model: PlaceModel) -> list[Callable[[], object]]:
    """The two products of every layer, on inputs that are ready."""
    made = []
    network = model.network
    for depth, node in enumerate(network.nodes):
        nodes = network.architecture.map_rows[depth + 1] * network.architecture.rotations
        for weights in (node.linear, node.slow):
            made.append(_product(np.ones((nodes, len(weights)), np.float32), weights))
    return made


def bare_products(model: PlaceModel) -> list[Callable[[], object]]:
    """All products of a model's equations, on inputs that are ready; each regression's once."""
    keyframes = model.keyframes
    (low, parts, count), (_, frequencies, size) = keyframes.coarse.shape, keyframes.values.shape
    few, rows, length = keyframes.columns // 2, size // 2, frequencies * size
    shapes = [
        ((low, 2, parts), (low, parts, count)),  # the rough search
        ((2 * low + 2, 2 * low), (2 * low, count)),
        ((frequencies, CLOSE, size), (frequencies, size, 2)),
        ((few, rows), (rows, rows * TILTS)),  # the tilt
        ((few, LEVELED, rows), (few, rows, TILTS)),
        ((LEVELED, few * TILTS), (few * TILTS, TILTS**2)),
        ((NEAR, length), (length, NEAR)),  # keyframes with each other, the image and what turns it
        ((4, length), (length, NEAR)),
        ((3, NEAR), (NEAR, length)),  # what is left of it
    ]
    if model.turned is not None:
        shapes.append(((HEADINGS, len(model.turned.axes)), model.turned.axes.shape))
    ready = [_product(*(np.ones(shape, np.float32) for shape in pair)) for pair in shapes]
    features = np.ones((HEADINGS if model.turned else 1, model.metric.features))
    return [*bare_network(model), *ready, *bare_process(model.metric, features)]


def bare_process(learned: MetricMap, features: np.ndarray) -> list[Callable[[], object]]:
    """The products of a map of features (N, K)."""
    basis = learned.basis
    assert isinstance(basis, Process)
    scaled = features[:, : basis.features] * basis.scale
    kernel = np.ones((len(features), len(basis.points)))
    made = [_product(scaled, basis.points.T.copy()), _product(kernel, learned.linear)]
    return [*made, lambda: kernel @ learned.factor]


def _product(a: np.ndarray, b: np.ndarray) -> Callable[[], object]:
    return lambda: a @ b


def bench_memory(folder: Path, quick: bool = False) -> dict[str, float]:
    """Peak memory of training on 4 and 16 times the pictures over that of 1 times."""
    least, path, peaks = 128, folder / 'memory.u8', {}
    panoramas(path, least * (4 if quick else 16))
    for times in (1, 4) if quick else (1, 4, 16):
        command = [sys.executable, __file__, '--peak', str(path), str(least * times)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        peaks[times] = float(done.stdout)
    ratios = {f'train_memory_{n}x_over_1x': peaks[n] / peaks[1] for n in peaks if n > 1}
    return {**ratios, 'train_memory_mib': peaks[1]}


def peak(path: Path, count: int) -> float:
    """Peak memory (MiB) of this process after training on a file's first pictures."""
    images = np.memmap(path, np.uint8, 'r', shape=(count, *SIZE, 3))
    drive = ImageSequence(
        PanoramaArray(np.arange(count), images, path.open('rb')), np.ones(count - 1, bool)
    )
    layers = tuple(replace(layer, linear=16, outputs=16) for layer in ARCHITECTURE.layers)
    train_network(replace(ARCHITECTURE, layers=layers), [drive])
    # Not ru_maxrss: a process inherits it from the one that started it.
    status = Path('/proc/self/status').read_text()
    return float(re.search(r'VmHWM:\s+(\d+) kB', status).group(1)) / 1024


def bench_located(path: Path, drive: Path, rounds: int = 300) -> dict[str, float]:
    """The figures of a model in a file, with images of a drive in its place."""
    model = PlaceModel.load(path)
    return bench_locate(model, images_of(drive_of(model, drive)), rounds)


def bench_sfa(folder: Path, quick: bool = False) -> dict[str, float]:
    """All figures of the training, by name."""
    figures = bench_memory(folder, quick) | bench_training(folder, quick)
    try:
        figures |= bench_engines(folder, quick)
    except ConfigError as error:
        sys.stderr.write(f'no comparison with MDP: {error}\n')
    return figures


def main() -> None:
    if sys.argv[1:2] == ['--peak']:
        sys.stdout.write(f'{peak(Path(sys.argv[2]), int(sys.argv[3]))}\n')
        return
    with tempfile.TemporaryDirectory() as folder:
        figures = bench_sfa(Path(folder), '--quick' in sys.argv)
    sys.stdout.write(json.dumps(figures, indent=2) + '\n')


if __name__ == '__main__':
    main()
