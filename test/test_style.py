# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How sources are written: headers, docstrings, and the linters of ROS 2."""

import ast
import re

import pytest
from page_tables import ROOT

PACKAGE = ROOT / 'sfa_localization'
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


ARRAY = re.compile(r'\b(Array|NDArray)\b(?! \| float)')
NAMES_SHAPE = re.compile(
    r'\([^()]*\b[A-Z0-9]\w*\s*(,[^()]*)?\)|picture|image|panorama|pixel|stamp', re.IGNORECASE
)
"""A shape such as (N, 2), or a word that names an array the whole package shares."""
SHAPES_BY_NAME = {'pose', 'start', 'dock', 'foot', 'mean', 'covariance', 'matrix', 'yaw_rad'}
"""Arguments of one shape everywhere: poses (3,), places (2,), the filter's state, matrices."""


def public(tree, owner_text=''):
    """The public classes, functions and methods of a module, with the docstring of their class."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name[0] != '_':
            yield node, owner_text
            if isinstance(node, ast.ClassDef):
                yield from public(node, ast.get_docstring(node) or '')


def test_public_names_have_docstrings_that_give_the_shapes_of_arrays():
    """But not what is very short, or implements an interface that is documented."""
    trees = {path: ast.parse(path.read_text('utf-8')) for path in PACKAGE.rglob('*.py')}
    assert [path for path, tree in trees.items() if not ast.get_docstring(tree)] == []
    names = [(path.name, node, more) for path in trees for node, more in public(trees[path])]
    documented = {node.name for _, node, _ in names if ast.get_docstring(node)}
    missing = []
    for file, node, more in names:
        text, short = ast.get_docstring(node), node.end_lineno - node.lineno < 4
        if isinstance(node, ast.ClassDef):
            wrong = not text
        elif not text:
            wrong = not (short or node.name in documented or node.name.startswith('on_'))
        else:
            taken = ' '.join(
                ast.unparse(a.annotation) for a in node.args.args
                if a.annotation and a.arg not in SHAPES_BY_NAME
            )  # fmt: skip
            wrong = ARRAY.search(taken) and not NAMES_SHAPE.search(text + more)
        missing += [f'{file}: {node.name}'] * bool(wrong)
    assert missing == []
