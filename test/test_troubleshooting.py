# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Each error and each reason of a state in the code is explained on the troubleshooting page."""

import re
from pathlib import Path

import pytest
from message_templates import error_templates, reason_templates

from sfa_localization.fusion.ekf import STARTS
from sfa_localization.fusion.pose_filter import Level

TEXT = (Path(__file__).parents[1] / 'config/troubleshooting.md').read_text('utf-8')
ROWS = [row.strip('|').split('|') for row in TEXT.splitlines() if row.startswith('| `')]
ERRORS = [
    row.strip('|').split('|') for row in TEXT.split('## Errors')[1].splitlines() if '` |' in row
]


# Of values on /diagnostics, and of a parameter.
KEYS = {'camera model', 'panorama visible [%]', 'unlike by light', 'use_sim_time'}


def plain(text: str) -> str:
    return text.replace('`', "'")


LISTED = {row[0].strip()[1:-1] for row in ROWS} | {
    message[1:-1] for row in ERRORS for message in row[3].strip().split('<br>')
}


@pytest.mark.parametrize(('file', 'text'), sorted(set(error_templates())))
def test_each_error_has_cause_and_remedy(file, text):
    assert plain(text) in LISTED, f'{file}: explain it in config/troubleshooting.md'


@pytest.mark.parametrize(('file', 'text'), sorted(set(reason_templates())))
def test_each_reason_has_cause_and_remedy(file, text):
    if text in KEYS:
        return
    assert plain(text) in LISTED, file


def test_each_row_is_complete_and_each_level_explained():
    assert len(ROWS) > 30
    assert all(len(row) >= 3 and all(cell.strip() for cell in row) for row in ROWS + ERRORS)
    for level in Level:
        assert f'| {level.name} | ' in TEXT


def test_nothing_is_explained_that_is_not_said():
    said = {plain(text) for _, text in [*error_templates(), *reason_templates()]}
    assert said | set(STARTS) >= LISTED


PROBLEMS = (Path(__file__).parents[1] / 'config/problems.md').read_text('utf-8')
PROBLEM_ROWS = [
    row.strip('|').split('|')
    for row in PROBLEMS.split('## ')[0].splitlines()
    if row.startswith('| ') and not row.startswith('| problem |')
]


@pytest.mark.parametrize('row', PROBLEM_ROWS, ids=lambda row: row[0].strip()[:40])
def test_each_problem_names_tests_that_there_are(row):
    """Its commands are checked in test_docs.py."""
    problem, answer, shown = (cell.strip() for cell in row)
    assert problem and answer
    named = re.findall(r'`(test_\w+\.py)::(\w+)`', shown)
    assert named
    for file, name in named:
        assert f'def {name}(' in (Path(__file__).parent / file).read_text('utf-8'), name
