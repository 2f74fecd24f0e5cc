# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How sources and pages are written: headers, docstrings, words, and the linters of ROS 2."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'sfa_localization'
MODULES = sorted(PACKAGE.rglob('*.py'))
LINTED = [str(ROOT / name) for name in ('sfa_localization', 'test', 'setup.py')]
DOCUMENTS = sorted(
    [*ROOT.glob('*.md'), *ROOT.glob('config/*.md'), *ROOT.glob('bags/*.md'),
     ROOT / 'test/README.md', ROOT / 'test/EVALUATION.md']
)  # fmt: skip
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
    assert 'Apache License' in (ROOT / 'LICENSE').read_text('utf-8')


def test_flake8():
    linter = pytest.importorskip('ament_flake8.main')
    code, errors = linter.main_with_errors(argv=['--config', str(ROOT / 'setup.cfg'), *LINTED])
    assert code == 0, '\n'.join(errors)


def test_pep257():
    linter = pytest.importorskip('ament_pep257.main')
    assert linter.main(argv=[*LINTED, '--add-ignore', *OURS]) == 0


BRITISH = re.compile(
    r'\b(?:(?:kilo)?metres?|colours?|centres?|neighbours?|behaviours?|learnt|towards'
    r'|(?:normal|initial|organ|optim|minim|maxim|synchron|recogn|local)is(?:e|es|ed|ing))\b'
)
PLACEHOLDER = re.compile(r'REPOSITORY|example\.(org|com|net)|TODO|FIXME')


def test_the_words_are_american():
    wrong = [
        f'{path.relative_to(ROOT)}: {line.strip()}'
        for path in [*DOCUMENTS, *MODULES]
        for line in path.read_text('utf-8').splitlines()
        if BRITISH.search(line)
    ]
    assert wrong == []


def test_no_placeholder_is_left():
    pages = [*DOCUMENTS, *(ROOT / name for name in ('CITATION.cff', 'package.xml', 'setup.py'))]
    assert [path for path in pages if PLACEHOLDER.search(path.read_text('utf-8'))] == []


# Docstrings.


def definitions() -> dict[str, tuple[ast.AST, ast.ClassDef | None]]:
    """Return the public classes, functions and methods of the package, with their owners."""
    found: dict[str, tuple[ast.AST, ast.ClassDef | None]] = {}
    for path in MODULES:
        module = path.relative_to(ROOT)
        for node in ast.parse(path.read_text('utf-8')).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name[0] != '_':
                found[f'{module}: {node.name}'] = node, None
            if isinstance(node, ast.ClassDef) and node.name[0] != '_':
                for method in node.body:
                    if isinstance(method, ast.FunctionDef) and method.name[0] != '_':
                        found[f'{module}: {node.name}.{method.name}'] = method, node
    return found


def test_modules_and_public_names_have_docstrings():
    """But not what is very short, or implements an interface that is documented."""
    missing = [p for p in MODULES if not ast.get_docstring(ast.parse(p.read_text('utf-8')))]
    assert missing == []
    public = definitions()
    documented = {node.name for node, _ in public.values() if ast.get_docstring(node)}

    def needs_none(name, node):
        if isinstance(node, ast.ClassDef):
            return False
        of_lifecycle = node.name.startswith('on_') and '/nodes/' in name
        short = node.end_lineno - node.lineno < 4
        return short or node.name in documented or of_lifecycle

    assert [
        name for name, (node, _) in public.items()
        if not ast.get_docstring(node) and not needs_none(name, node)
    ] == []  # fmt: skip


ARRAY = re.compile(r'\b(Array|NDArray)\b(?! \| float)')
NAMES_SHAPE = re.compile(
    r'\([^()]*\b[A-Z0-9]\w*\s*(,[^()]*)?\)|picture|image|panorama|pixel|stamp', re.IGNORECASE
)
"""A shape such as (N, 2), or a word that names an array the whole package shares."""
SHAPES_BY_NAME = {'pose', 'start', 'dock', 'foot', 'mean', 'covariance', 'matrix', 'yaw_rad'}
"""Arguments of one shape everywhere: poses (3,), places (2,), the filter's state, matrices."""


def test_docstrings_of_array_functions_give_shapes():
    """The docstring of a function with array arguments, or of its class, gives their shapes."""
    missing = []
    for name, (node, owner) in definitions().items():
        if isinstance(node, ast.ClassDef) or not ast.get_docstring(node):
            continue
        taken = ' '.join(
            ast.unparse(a.annotation) for a in node.args.args
            if a.annotation and a.arg not in SHAPES_BY_NAME
        )  # fmt: skip
        text = ast.get_docstring(node) + ((ast.get_docstring(owner) or '') if owner else '')
        if ARRAY.search(taken) and not NAMES_SHAPE.search(text):
            missing.append(name)
    assert missing == []
