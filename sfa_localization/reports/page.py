# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""An HTML page, also for phones and dark screens: figures are part of the file, and its words and
tables need no script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from io import BytesIO
from pathlib import Path

from PIL import Image

from sfa_localization.data.errors import LocalizationError
from sfa_localization.reports.figures import save_text
from sfa_localization.reports.summary import BAD as BAD
from sfa_localization.reports.summary import GOOD as GOOD
from sfa_localization.reports.summary import WEAK as WEAK

PAGE = 'index.html'
MARK = '<meta name="generator" content="sfa_localization">'
NOTICED = 'What was noticed?'
"""The heading above the warnings that a command has printed."""
_STYLE = """
:root { color-scheme: light dark; --text: #222; --back: #fff; --line: #ddd; --dim: #555;
  --good: #e6f4ea; --weak: #fef7e0; --bad: #fce8e6; }
@media (prefers-color-scheme: dark) {
  :root { --text: #ddd; --back: #181a1b; --line: #444; --dim: #aaa;
    --good: #173a24; --weak: #453512; --bad: #4a1c19; }
  a { color: #8ab4f8; }
}
* { box-sizing: border-box; }
body { font: 1rem/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
  margin: 0 auto; max-width: 56rem; padding: 1rem; overflow-wrap: break-word; }
h1 { font-size: 1.5rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid var(--line); }
p, ul { margin: 0.5rem 0; }
ul { padding-left: 1.2rem; }
.verdict { padding: 0.6rem 0.9rem; border-left: 0.5rem solid; border-radius: 0.25rem; }
.good { background: var(--good); border-color: #1e8e3e; }
.weak { background: var(--weak); border-color: #e37400; }
.bad { background: var(--bad); border-color: #d93025; }
figure { margin: 1rem 0; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: 0.9rem; color: var(--dim); text-align: center; }
.wide { overflow-x: auto; margin: 0.75rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child { text-align: left; }
@media (max-width: 40rem) {
  body { padding: 0.6rem; }
  table { font-size: 0.8rem; }
  th, td { padding: 0.2rem 0.3rem; }
  .broad img { max-width: none; height: 22rem; width: auto; }
}
"""
BROAD = 1.5
"""Times as wide as high, from which a figure scrolls sideways on a phone: else it is too small."""
QUALITY = 80
"""Of the figures in a page: as sharp as the files beside it, in a tenth of their size."""


def verdict(level: str, text: str) -> str:
    """The answer of the page, in the color of GOOD, WEAK or BAD."""
    return f'<p class="verdict {level}"><strong>{escape(text)}</strong></p>'


def items(texts: Sequence[str]) -> str:
    """A list of plain texts; '' for none."""
    rows = ''.join(f'<li>{escape(text)}</li>' for text in texts)
    return f'<ul>{rows}</ul>' if rows else ''


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain texts, which scrolls sideways where the screen is narrow."""
    top = ''.join(f'<th>{escape(cell)}</th>' for cell in head)
    lines = [''.join(f'<td>{escape(cell)}</td>' for cell in row) for row in rows]
    body = ''.join(f'<tr>{line}</tr>' for line in lines)
    return f'<div class="wide"><table><tr>{top}</tr>{body}</table></div>'


def figure(path: Path, caption: str) -> str:
    """A PNG file, as a part of the page; a broad one scrolls sideways where the screen is narrow.

    Raises LocalizationError.
    """
    try:
        with Image.open(path) as picture:
            return embedded(picture, caption)
    except OSError as error:
        raise LocalizationError(f'{path}: cannot be read: {error.strerror or error}') from None


def embedded(picture: Image.Image, caption: str, quality: int = QUALITY) -> str:
    """A picture as a part of the page, compressed with this quality."""
    compressed = BytesIO()
    width, height = picture.size
    picture.save(compressed, 'WEBP', quality=quality)
    data = base64.b64encode(compressed.getvalue()).decode()
    words = escape(caption)
    shape = ' broad' if width > BROAD * height else ''
    return (
        f'<figure><div class="wide{shape}"><img width="{width}" height="{height}" '
        f'src="data:image/webp;base64,{data}" alt="{words}"></div>'
        f'<figcaption>{words}</figcaption></figure>'
    )


def section(title: str, *parts: str) -> str:
    """Parts below a heading; '' where there are none."""
    body = '\n'.join(part for part in parts if part)
    return f'<section>\n<h2>{escape(title)}</h2>\n{body}\n</section>' if body else ''


def begin_page(folder: Path) -> None:
    """Mark a folder as a report before its figures are written, so that the next run may replace
    an interrupted report.
    """
    write_page(folder, 'Unfinished report: it was interrupted; run the command again')


def write_page(folder: Path, title: str, *parts: str) -> None:
    """Write `folder`/index.html, completely or not at all. Raises LocalizationError."""
    body = '\n'.join(part for part in parts if part)
    save_text(
        folder / PAGE,
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'{MARK}\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n'
        f'<body>\n<h1>{escape(title)}</h1>\n{body}\n</body>\n</html>\n',
    )
