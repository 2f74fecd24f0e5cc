# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unwrapping against bare cv2.remap, in turns, in one run: `python bench_panorama.py`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from sfa_localization.camera.panorama import Unwrapper, build_tables
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig

CAMERA = CameraConfig(camera_model='mirror')
SIZE = {'image_width': 1280, 'image_height': 960, 'cx': 640.0, 'cy': 480.0}
LENS = LensCalibration(fx=225.0, fy=225.0, radius_min=60.0, radius_max=476.0, **SIZE)
PANORAMAS = {'600x60': PanoramaConfig(), '1200x120': PanoramaConfig(width=1200, height=120)}


def picture() -> np.ndarray:
    """A textured raw picture (960, 1280, 3)."""
    noise = np.random.default_rng(1).integers(0, 256, (60, 80, 3), np.uint8)
    return np.asarray(cv2.resize(noise, (1280, 960), interpolation=cv2.INTER_CUBIC))


def interleaved(functions: list[Callable[[], object]], rounds: int) -> np.ndarray:
    """Seconds (rounds, functions), each round calling every function once, in turns."""
    times = np.empty((rounds, len(functions)))
    for row in range(rounds):
        for column in np.roll(np.arange(len(functions)), row):
            start = time.perf_counter()
            functions[column]()
            times[row, column] = time.perf_counter() - start
    return times


def bench_unwrap(rounds: int = 400) -> dict[str, float]:
    """Median time of a whole unwrapping over that of cv2.remap with the same tables, at worst."""
    raw, ratios, result = picture(), [], {}
    for name, panorama in PANORAMAS.items():
        unwrap = Unwrapper(CAMERA, panorama, LENS)
        tables = build_tables(CAMERA, LENS, panorama, raw.shape[:2])
        maps = tables.pixels, tables.fractions

        def remap(maps=maps, border=tables.border):
            return cv2.remap(raw, *maps, cv2.INTER_LINEAR, borderMode=border)

        def rebuild(panorama=panorama):
            return Unwrapper(CAMERA, panorama, LENS)(raw)

        unwrap(raw)
        times = interleaved([remap, lambda unwrap=unwrap: unwrap(raw)], rounds)
        middle = np.median(times[rounds // 10 :], axis=0)
        building = np.median(interleaved([rebuild], 5))
        ratios.append(middle[1] / middle[0])
        result[f'unwrap_{name}_ms'] = middle[1] * 1e3
        result[f'remap_{name}_ms'] = middle[0] * 1e3
        result[f'tables_each_time_{name}_over_unwrap'] = building / middle[1]
    return {'unwrap_over_remap': float(max(ratios)), **{k: float(v) for k, v in result.items()}}


if __name__ == '__main__':
    json.dump(bench_unwrap(), sys.stdout, indent=2)
