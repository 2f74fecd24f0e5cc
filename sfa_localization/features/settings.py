# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the SFA network and its training."""

from __future__ import annotations

from dataclasses import dataclass

from sfa_localization.data.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class NetworkConfig(Settings):
    """The hierarchical SFA network and its training."""

    engine: str = setting(
        'rotation',
        'exact sums over the rotation, or the same from MDP on really turned pictures '
        '(hundreds of times slower; needs the extra mdp)',
        choices=('rotation', 'mdp'),
    )
    layers: str = setting(
        'auto',
        'sizes of the layers: by the size of the panorama, a standard set, or the arrays below',
        choices=('auto', '600x60', '300x30', '320x40', 'custom'),
    )
    normalization: str = setting(
        'panorama',
        'what is taken out of each picture: mean and scale of each channel, of all together, '
        'gains (log), nothing, or color (grey)',
        choices=('panorama', 'brightness', 'log', 'none', 'grey'),
    )
    relative_cut: float = setting(
        1e-3,
        'signals of less variance than this part of the largest are dropped',
        low=0.0,
        high=1.0,
    )
    difference: str = setting(
        'picture',
        'slowness per picture, per metre driven, or per second',
        choices=('picture', 'distance', 'time'),
    )
    break_time: float = setting(
        5.0, 'pictures farther apart are no neighbors', unit='s', low=0.01, high=1e4
    )
    break_distance: float = setting(
        2.0, 'pictures farther apart are no neighbors', unit='m', low=0.01, high=1e4
    )
    photometric_std: float = setting(
        0.3, 'random light of each training picture, logarithmic', low=0.0, high=2.0
    )
    photometric_seed: int = setting(0, 'seed of the random light', low=0)
    binning: int = setting(2, 'custom: pixels averaged per side', low=1, high=64)
    field_rows: tuple[int, ...] = setting((10, 3, 4), 'custom: rows of a field', low=1)
    field_columns: tuple[int, ...] = setting((10, 5, 20), 'custom: columns of a field', low=1)
    stride_rows: tuple[int, ...] = setting((4, 1, 1), 'custom: rows between fields', low=1)
    stride_columns: tuple[int, ...] = setting((5, 1, 1), 'custom: columns between fields', low=1)
    linear_dimensions: tuple[int, ...] = setting(
        (32, 32, 48), 'custom: dimensions that are expanded', low=1
    )
    output_dimensions: tuple[int, ...] = setting(
        (32, 32, 32), 'custom: slow features that leave a layer', low=1
    )
    clip: float = setting(4.0, 'custom: limit of a slow feature', low=0.1, high=1e6)
