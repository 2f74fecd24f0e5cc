# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of an update: the keyframes that later drives have added to a model, and where."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from sfa_localization.data.geometry import Array
from sfa_localization.reports import page
from sfa_localization.reports.figures import SQUARE, as_title, in_meters, save


def write_update_report(
    folder: Path,
    title: str,
    sentence: str,
    keyframes: Sequence[tuple[str, Array]],
    warnings: Sequence[str] = (),
) -> None:
    """Write `folder`/index.html with a map of the keyframes, poses (K, 3) by the name of their
    drives, of which the first are those of the training, and the warnings of the update.

    Raises LocalizationError.
    """
    keyframes_figure(folder / 'keyframes.png', keyframes)
    lines = [f'{name}: {len(poses)} keyframes' for name, poses in keyframes]
    page.write_page(
        folder,
        title,
        page.verdict(page.GOOD, sentence),
        page.section('What is in the model?', page.items(lines),
                     page.figure(folder / 'keyframes.png', 'Where keyframes were taken: those of '
                                 'the training (gray), and of each later drive')),
        page.section(page.NOTICED, page.items(warnings)),
        page.section('May I trust it?', page.items([
            'Evaluate both models on another drive in the new light: evaluate MODEL BAG --report.',
        ])),
    )  # fmt: skip


def keyframes_figure(path: Path, keyframes: Sequence[tuple[str, Array]]) -> None:
    """Draw where the keyframes of each drive were taken, poses (K, 3) by its name."""
    figure = Figure(figsize=SQUARE, layout='constrained')
    axes = figure.subplots()
    for number, (name, poses) in enumerate(keyframes):
        style = {'markersize': 5} if number else {'markersize': 3, 'color': '0.7'}
        axes.plot(poses[:, 0], poses[:, 1], '.', **style, label=as_title(name))
    figure.legend(loc='outside lower center')
    in_meters(axes, 'Keyframes')
    save(figure, path)
