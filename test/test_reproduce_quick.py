# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the quick experiments reach, against a recorded result."""

import json
from pathlib import Path

import pytest
from study.results import Progress, StudyConfig
from study.sites import QUICK
from study.tables import Work

RECORDED = Path(__file__).with_name('reproduced.json')
MEASURES = {'test', 'test_supervised', 'image', 'ekf'}
WORSE = 1.25
"""An error may be this many times the recorded one: other processors round otherwise."""


@pytest.mark.study
@pytest.mark.parametrize('name', ['simulator', 'robot'])
def test_the_quick_results_are_as_accurate_as_recorded(name, tmp_path):
    """After an improvement, record its figures: `study NAME --quick`, then `study page FOLDER`."""
    Work(tmp_path, StudyConfig(), QUICK, Progress(False)).reproduced(name)
    columns = json.loads((tmp_path / f'{name}.json').read_text())['cells'][0]['columns']
    recorded = json.loads(RECORDED.read_text())['quick'][name]
    for column, errors in recorded.items():
        for measure in MEASURES & errors.keys():
            assert columns[column][measure] < WORSE * errors[measure], (column, measure)
