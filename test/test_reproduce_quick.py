# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What `reproduce --quick` reaches, against a recorded result; and the variants of ablations."""

import json
from pathlib import Path

import pytest

from sfa_localization.commands.comparisons import VARIANTS, Variant
from sfa_localization.commands.paper_tables import NAMES, Work
from sfa_localization.commands.reproduce import PAPER_RESULTS, ReproduceConfig
from sfa_localization.commands.reproduction import Progress
from sfa_localization.commands.sites import FULL, QUICK

RECORDED = Path(__file__).with_name('reproduced.json')


def test_every_variant_differs_from_everything_in_something():
    whole = VARIANTS['everything']
    assert whole == Variant() and sum(one == whole for one in VARIANTS.values()) == 1
    for one in VARIANTS.values():
        architecture = one.architecture((60, 600))
        assert one.layers in ((), architecture.layers)
        assert architecture.normalization == one.normalization


def test_every_result_has_its_minutes():
    assert NAMES == PAPER_RESULTS
    for plan in (FULL, QUICK):
        assert set(plan.minutes) == set(NAMES) and min(plan.minutes.values()) > 0


WORSE = 1.25
"""An error may be this many times the recorded one: other processors round otherwise."""


@pytest.mark.slow
@pytest.mark.parametrize('name', ['simulator', 'robot'])
def test_the_quick_results_are_as_accurate_as_recorded(name, tmp_path):
    """After an improvement, record its figures: `reproduce NAME --quick`, NAME.json, `columns`."""
    Work(tmp_path, ReproduceConfig(), QUICK, Progress(False)).reproduced(name)
    found = json.loads((tmp_path / f'{name}.json').read_text())['cells'][0]['columns']
    recorded = json.loads(RECORDED.read_text())[name]
    for column, errors in recorded.items():
        for measure, error in errors.items():
            assert found[column][measure] < WORSE * error, (column, measure)
