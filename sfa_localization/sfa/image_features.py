# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The outputs of a trained network for all images of the drives, and their statistics.

The sums over all views are those of section 2.2: features that code for the place vary between
places, and not over the simulated rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array
from sfa_localization.data.run import BATCH, Run
from sfa_localization.sfa.network import Network
from sfa_localization.sfa.rotation import Map

Spectrum = NDArray[np.complex64]

TURNED_LAYER = 1
"""Layer (0-based) below the top whose map is turned to locate by: it still shows the heading."""
HARMONICS = 13
"""Mean and harmonics 1 to 12 over the columns; all 31 of a 60-column map locate no better."""


def slow_features(maps: list[Map]) -> Array:
    """Slow features (T, K) s_j of section 2.2: the top node, averaged over all rotations."""
    return np.asarray(maps[-1].mean((1, 2), dtype=np.float64))


def spectrum(maps: Map, count: int = HARMONICS) -> Spectrum:
    """Harmonics 0, 1, ... of maps (T, rows, R, C) over the columns: (T, H, rows * C).

    H is at most `count`, and harmonics are below R / 2: a turn by a fraction of a column only
    shifts the phases of these. With all harmonics of an odd R, squared norms are those of the maps.
    """
    columns = maps.shape[2]
    order = np.arange(min(count, (columns + 1) // 2))
    phase = -2j * np.pi / columns * np.outer(order, np.arange(columns))
    wave = np.exp(phase) * np.sqrt(np.where(order > 0, 2.0, 1.0) / columns)[:, None]
    parts = wave.astype(np.complex64) @ maps
    return np.asarray(parts.transpose(0, 2, 1, 3).reshape(len(maps), len(order), -1))


@dataclass(frozen=True, slots=True)
class ImageFeatures:
    """Network outputs for all N images, run after run."""

    slow: Array
    """(N, K) slow features."""
    spectra: Spectrum | None
    """(N, H, J) of the layer that is turned; None in a network without it."""
    variance_shares: dict[str, list[float]]
    """(K,) each: `eta_phi` over rotations and `eta_p` over places, of the total variance."""

    @property
    def quality(self) -> dict[str, Any]:
        """Figures that are stored in the model."""
        return {'pictures': len(self.slow), **self.variance_shares}


def features_of_runs(
    network: Network,
    runs: Sequence[Run],
    on_images: Callable[[int], object] = lambda count: None,
) -> ImageFeatures:
    """Run all images through the network once; `on_images` receives the size of each batch."""
    slow = list[Array]()
    spectra: list[Spectrum] = []
    shares = _VarianceShares(network.architecture.outputs)
    for images in (batch for run in runs for batch in run.panoramas.batches(BATCH)):
        maps = network.maps(images)
        slow.append(slow_features(maps))
        shares.add(maps[-1])
        # The top's own maps hardly show the heading.
        if len(maps) > TURNED_LAYER + 1:
            spectra.append(spectrum(maps[TURNED_LAYER]))
        on_images(len(images))
    return ImageFeatures(
        np.concatenate(slow),
        np.concatenate(spectra) if spectra else None,
        shares.result(),
    )


class _VarianceShares:
    """Shares of the variance of each slow feature over rotations, and over places.

    eta_phi = variance over the rotation at a place / total, ideally 0; eta_p = variance over the
    places / total, ideally 1.
    """

    def __init__(self, outputs: int) -> None:
        self._count = 0
        self._mean, self._square, self._place = np.zeros((3, outputs))

    def add(self, top: Map) -> None:
        """Add top maps (T, 1, R, K)."""
        views = top.reshape(len(top), -1, top.shape[-1]).astype(np.float64)
        mean = views.mean(1)
        self._count += len(top)
        self._mean += mean.sum(0)
        self._square += (views**2).mean(1).sum(0)
        self._place += (mean**2).sum(0)

    def result(self) -> dict[str, list[float]]:
        mean, square, place = (
            part / self._count for part in (self._mean, self._square, self._place)
        )
        total = np.maximum(square - mean**2, 1e-12)
        return {
            'eta_phi': ((square - place) / total).tolist(),
            'eta_p': ((place - mean**2) / total).tolist(),
        }
