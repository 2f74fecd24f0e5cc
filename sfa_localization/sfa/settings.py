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
        'exact sums over the simulated rotation, or the same from MDP on images that are really '
        'rotated (hundreds of times slower; needs the extra mdp)',
        choices=('rotation', 'mdp'),
    )
    normalization: str = setting(
        'panorama',
        'what is removed from each image: mean and scale of each channel, nothing, or color (grey)',
        choices=('panorama', 'none', 'grey'),
    )
    seed: int = setting(
        0,
        'seed of the random light of training images, and of the parts of the drive that are left '
        'out to check the map',
        low=0,
    )
