# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Table of a year: errors of a model that stays as it is, and of one that is updated each month.

A cell is a mapping with `model`, `month`, `light` and `season`, and the scores that `year` gives; a
score that does not exist is None or missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from page_tables import markdown

Cells = Sequence[Mapping[str, Any]]
MODELS = {'frozen': 'never updated:', 'updated': 'updated each month:'}
MEASURES = {'ekf_m': 'EKF', 'sfa_m': 'one image'}


def table(cells: Cells) -> str:
    """The mean and the largest value of each measure over the months, as Markdown."""
    rows = []
    for name, title in MEASURES.items():
        values = [[c.get(name, np.nan) for c in cells if c['model'] == m] for m in MODELS]
        for word, of in (('mean', np.nanmean), ('worst', np.nanmax)):
            rows.append([f'{title}, {word} month', *(f'{of(months):.3f}' for months in values)])
    return markdown(['error (m)', *MODELS.values()], rows)
