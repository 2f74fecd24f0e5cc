# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The texts of states in the code, with … for what is filled in."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from sfa_localization.data import errors

PACKAGE = Path(errors.__file__).parents[1]
REASONS = {
    'fusion/status.py': ('status_of', '_known_to', '_missing', '_silences'),
    'fusion/health.py': ('problems', '_told'),
    'fusion/timeline.py': ('problems', 'require_place'),
    'fusion/pose_filter.py': ('status', '_require_place'),
    'fusion/ekf.py': ('_found', '_gated'),
    'camera/watch.py': ('judge', 'judge_novelty'),
    'localizer.py': ('_usable',),
    'nodes/discovery.py': ('_tell',),
    'nodes/lifecycle.py': ('_time_problem',),
    'nodes/ekf_node.py': ('status', '_receive_pose'),
    'nodes/sfa_node.py': ('health',),
    'nodes/omnicam_node.py': ('health', '_judge_source', '_judge_images'),
}
"""Functions whose texts a user reads as a state, or as what became of a message."""


def template(node: ast.AST) -> str:
    """The text of an expression; '' where it has none of its own."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    elif isinstance(node, ast.JoinedStr):
        text = ''.join(
            part.value if isinstance(part, ast.Constant) else '…' for part in node.values
        )
    else:
        return ''
    return re.sub(r'\s+', ' ', text).strip()


def is_sentence(text: str) -> bool:
    """Whether it says something by itself."""
    return len(re.findall(r'[A-Za-z]{2,}', text.replace('…', ' '))) >= 2


def reason_templates() -> Iterator[tuple[str, str]]:
    """File and text of each reason in the functions of REASONS."""
    for file, names in REASONS.items():
        tree = ast.parse((PACKAGE / file).read_text('utf-8'))
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and function.name in names:
                body = function.body[1:] if ast.get_docstring(function) else function.body
                for part in body:
                    yield from ((file, text) for text in texts_in(part))


def texts_in(part: ast.AST) -> Iterator[str]:
    """The sentences in a piece of code; parts of a text in pieces are no texts of their own."""
    text = template(part)
    if text:
        if is_sentence(text):
            yield text
        return
    for child in ast.iter_child_nodes(part):
        yield from texts_in(child)
