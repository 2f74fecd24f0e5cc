# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Each reason of a state in the code is on the troubleshooting page, and what problems.md names."""

import re
from pathlib import Path

from message_templates import reason_templates

from sfa_localization.fusion.ekf import STARTS
from sfa_localization.fusion.pose_filter import Level

TEST = Path(__file__).parent
TEXT = (TEST.parent / 'config/troubleshooting.md').read_text('utf-8')
ROWS = [row.strip('|').split('|') for row in TEXT.splitlines() if row.startswith('| `')]
# Of values on /diagnostics, and of a parameter.
KEYS = {'camera model', 'panorama visible [%]', 'unlike by light', 'use_sim_time'}


def test_each_reason_has_cause_and_remedy_and_nothing_else_is_explained():
    said = {text.replace('`', "'") for _, text in reason_templates()} - KEYS
    listed = {row[0].strip()[1:-1] for row in ROWS}
    assert said - listed == set(), 'explain it in config/troubleshooting.md'
    assert listed - said - set(STARTS) == set(), 'nothing says this'
    assert all(len(row) == 3 and all(cell.strip() for cell in row) for row in ROWS)
    assert [level for level in Level if f'| {level.name} | ' not in TEXT] == []


def test_each_problem_names_tests_that_there_are():
    """Its commands are checked in test_docs.py."""
    text = (TEST.parent / 'config/problems.md').read_text('utf-8').split('## ')[0]
    rows = [row.strip('|').split('|') for row in text.splitlines() if row.startswith('| ')][1:]
    assert len(rows) > 10
    for problem, answer, shown in rows:
        named = re.findall(r'`(test_\w+\.py)::(\w+)`', shown)
        assert problem.strip() and answer.strip() and named
        for file, name in named:
            assert f'def {name}(' in (TEST / file).read_text('utf-8'), f'{file}::{name}'
