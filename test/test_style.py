# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How sources are written: headers, and the linters of ROS 2."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINTED = [str(ROOT / name) for name in ('sfa_localization', 'test', 'setup.py')]
# ament_copyright does not know SPDX headers.
HEADER = re.compile(
    r'(#!.*\n)?# Copyright \d{4} .+\n# SPDX-License-Identifier: Apache-2\.0\n', re.ASCII
)
# Settled differently here: where the first line starts, its mood and capitals, raw docstrings.
OURS = ['D213', 'D301', 'D401', 'D402', 'D403']


def test_every_source_has_the_header_of_the_licence():
    places = [ROOT.glob('*')]
    places += [(ROOT / name).rglob('*') for name in ('sfa_localization', 'test', 'config', '.ci')]
    sources = [
        path for place in places for path in place
        if path.suffix == '.py' or path.name == 'Makefile'
        or (path.parent.name == '.ci' and not path.suffix)
    ]  # fmt: skip
    assert {'setup.py', 'errors.py', 'test_style.py', 'run'} <= {path.name for path in sources}
    assert [path for path in sources if not HEADER.match(path.read_text('utf-8'))] == []


def test_the_linters_of_ros():
    flake8 = pytest.importorskip('ament_flake8.main')
    code, errors = flake8.main_with_errors(argv=['--config', str(ROOT / 'setup.cfg'), *LINTED])
    assert code == 0, '\n'.join(errors)
    pep257 = pytest.importorskip('ament_pep257.main')
    assert pep257.main(argv=[*LINTED, '--add-ignore', *OURS]) == 0
