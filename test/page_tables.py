# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the pages that programs write: `<!-- NAME -->`, the table, `<!-- end -->`."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / 'README.md', ROOT / 'config' / 'cameras.md', *sorted(ROOT.glob('test/*.md')))


def markdown(header, rows):
    """Return a table; columns whose name ends with a colon are right aligned."""
    ruler = ''.join('|---:' if name.endswith(':') else '|---' for name in header)
    head, *lines = (
        f'| {" | ".join(line)} |\n' for line in ([n.rstrip(':') for n in header], *rows)
    )
    return f'{head}{ruler}|\n{"".join(lines)}'


def write_table(name, table):
    """Replace the table of this name on each page that has it, once."""
    mark = re.compile(rf'(<!-- {name} -->\n).*?(<!-- end -->\n)', re.DOTALL)
    counts = []
    for page in PAGES:
        text, count = mark.subn(lambda match: match[1] + table + match[2], page.read_text('utf-8'))
        page.write_text(text, 'utf-8')
        counts.append(count)
    assert max(counts) == 1, f'no page has <!-- {name} --> and <!-- end -->, or one has two'
