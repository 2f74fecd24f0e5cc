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
MEASURES = {
    'ekf_m': 'EKF (m)',
    'sfa_m': 'one image (m)',
    'false_localised_s': 'LOCALISED, wrong (s)',
}


def table(cells: Cells) -> str:
    """The mean and the largest value of each measure over the months, as Markdown."""
    rows = []
    for name, title in MEASURES.items():
        values = [[c.get(name, np.nan) for c in cells if c['model'] == m] for m in MODELS]
        for word, of in (('mean', np.mean), ('worst', np.max)):
            texts = [f'{of(v):.3f}' if v else '-' for v in values]
            rows.append([f'{title}, {word} of the months', *texts])
    return markdown(['measure', *MODELS.values()], rows)
