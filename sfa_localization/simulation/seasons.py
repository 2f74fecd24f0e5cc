# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Seasons of the simulated garden: colors and leaves of its plants.

A garden is laid out in summer; a season changes only plants, and moves none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfa_localization.simulation.rendering import Shape

Tint = tuple[float, float, float]

LEAVES: tuple[Tint, ...] = ((0.07, 0.36, 0.52), (0.05, 0.22, 0.50), (0.07, 0.12, 0.34))
BROWNS: tuple[Tint, ...] = ((0.10, 0.17, 0.25), (0.13, 0.22, 0.33))
TWIGS: tuple[Tint, ...] = ((0.16, 0.19, 0.22), (0.13, 0.16, 0.20))
STRAW: tuple[Tint, ...] = ((0.13, 0.30, 0.33),)


@dataclass(frozen=True, slots=True)
class Change:
    """The effect of a season on a kind of plant: each plant mixes one of the BGR `tints` into its
    color, by a share drawn from the range `share`, and loses the part `bare` of its leaves.
    """

    tints: tuple[Tint, ...]
    share: tuple[float, float]
    bare: float = 0.0


SEASONS: dict[str, dict[str, Change]] = {
    'summer': {},
    'autumn': {
        'grass': Change(STRAW, (0.35, 0.35)),
        'crown': Change(LEAVES, (0.6, 1.0), bare=0.2),
        'bush': Change(LEAVES, (0.2, 0.8)),
        'bloom': Change(BROWNS, (0.4, 0.9)),
        'hedge': Change(LEAVES, (0.1, 0.3)),
    },
    'winter': {
        'grass': Change(STRAW, (0.6, 0.6)),
        'crown': Change(TWIGS, (1.0, 1.0), bare=0.75),
        'bush': Change(TWIGS, (0.7, 1.0), bare=0.4),
        'bloom': Change(TWIGS, (0.8, 1.0), bare=0.4),
        'hedge': Change(BROWNS, (0.4, 0.7)),
    },
}
"""Choices of `simulate --season`: the plants that change. Conifers do not."""


def in_season(shapes: Sequence[Shape], season: str, rng: np.random.Generator) -> list[Shape]:
    """The shapes of a garden in a season, in their order; `rng` draws colors and lost leaves."""
    changes = SEASONS[season]
    return [
        _changed(shape, changes[shape.plant], rng) if shape.plant in changes else shape
        for shape in shapes
    ]


def _changed(shape: Shape, change: Change, rng: np.random.Generator) -> Shape:
    share = rng.uniform(*change.share)
    tint = change.tints[rng.integers(len(change.tints))]
    b, g, r = (1 - share) * np.array(shape.tint) + share * np.array(tint)
    leaves = rng.random(len(shape.faces)) >= change.bare
    return replace(shape, tint=(float(b), float(g), float(r)), faces=shape.faces[leaves])
