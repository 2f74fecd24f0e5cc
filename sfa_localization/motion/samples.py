# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Single samples of a source of motion that contradict the other sources: one robust rule."""

from __future__ import annotations

import numpy as np

from sfa_localization.data.geometry import Array, Mask
from sfa_localization.data.run import Stamps
from sfa_localization.data.statistics import MEDIAN_TO_STD

OUTLIER = 5.0
"""Robust standard deviations beyond which a residual is a fault: noise reaches it once in a
million."""


def faulty(residual: Array, floor: float) -> Mask:
    """Samples (N,) whose residual against the other sources no noise explains.

    `floor` is a residual, in its unit, that harms nothing.
    """
    size = np.abs(residual)
    return np.asarray(size > max(OUTLIER * MEDIAN_TO_STD * float(np.nanmedian(size)), floor))


def fault_sentence(name: str, mask: Mask, stamps_ns: Stamps, others: str) -> str:
    """How many samples of a source, at stamps (N,), contradict the others, since when, and how many
    in a row; '' for none.
    """
    rows = np.flatnonzero(mask)
    if not len(rows):
        return ''
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    longest = int(np.diff(edges)[::2].max())
    first_s = (stamps_ns[rows[0]] - stamps_ns[0]) * 1e-9
    row = f', up to {longest} in a row' if longest > 1 else ''
    return (
        f'{name}: {len(rows)} of {len(mask)} messages contradict {others}{row}, the first after '
        f'{first_s:.1f} s: left out'
    )
