# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every source file says whose it is and under which licence.

Checked here and not with ament_copyright, which does not know SPDX headers.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEADER = re.compile(
    r'(#!.*\n)?# Copyright \d{4} .+\n# SPDX-License-Identifier: Apache-2\.0\n', re.ASCII
)
SOURCES = sorted(
    path
    for folder in ('sfa_localization', 'test', 'config', '.ci', '.')
    for path in ROOT.glob(f'{folder}/**/*' if folder != '.' else '*')
    if path.suffix == '.py' or path.name == 'Makefile' or (folder == '.ci' and not path.suffix)
)


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_header(path):
    assert HEADER.match(path.read_text(encoding='utf-8'))


def test_sources_were_found():
    assert {'setup.py', 'errors.py', 'test_copyright.py', 'run'} <= {path.name for path in SOURCES}


def test_licence_text_is_the_named_one():
    text = (ROOT / 'LICENSE').read_text(encoding='utf-8')
    assert 'Apache License' in text
    assert 'Version 2.0' in text
