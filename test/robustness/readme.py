# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Which tests show which kind of robustness: read off the table in test/README.md."""

import re
from pathlib import Path

TABLE = Path(__file__).parents[1] / 'README.md'
_ROW = re.compile(r'^\| (\d+) \|(.*)$', re.MULTILINE)
_TEST = re.compile(r'`(test_\w+\.py)::(\w+)`')


def robustness_table():
    """Tests by number of the row, each a pair of file and function."""
    text = TABLE.read_text('utf-8')
    return {int(number): _TEST.findall(row) for number, row in _ROW.findall(text)}
