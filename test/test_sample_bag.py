# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The bags that come with the project are what their README says."""

import re

import pytest
from page_tables import ROOT

from sfa_localization.bags.drives import read_drive
from sfa_localization.camera.kinds import PANORAMA
from sfa_localization.inspection import inspect

BAGS = ROOT / 'bags'
README = (BAGS / 'README.md').read_text(encoding='utf-8')


@pytest.mark.parametrize(('name', 'enough'), [('sample', True), ('sample_test', False)])
def test_the_sample_holds_what_its_readme_lists(name, enough, tmp_path):
    row = re.search(rf'^\| `{name}` .*\| (\d+) \| (\d+) each \|$', README, re.MULTILINE)
    assert row
    others = dict.fromkeys(('/odom', '/imu', '/ground_truth'), int(row[2]))
    report = inspect(BAGS / name, strict=True)
    counts = {topic.name: topic.count for topic in report.topics}
    assert counts == {'/panorama/compressed': int(row[1]), **others}
    assert not any(topic.problems for topic in report.topics) and report.problems == []
    assert report.camera is not None and report.camera.name == PANORAMA
    assert (report.lacks == []) is enough
    run = read_drive(BAGS / name, tmp_path, want_truth=True, strict=True)
    assert run.panoramas.shape == (60, 600, 3) and len(run.panoramas) == int(row[1])
    assert sum(file.stat().st_size for file in (BAGS / name).iterdir()) < 6_000_000
