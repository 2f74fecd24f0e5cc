# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Five figures for a reader in a hurry, each with its sentence, from finished cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sfa_localization.reports.figures import save
from study.light_report import condition, mean_of, value_of
from study.paper_report import PAPER, gardens, values_of
from study.rig import ABOVE, CASES, SLOPES, UNEVEN

Cells = Sequence[Mapping[str, Any]]
COLORS = {
    'the paper': '0.6', "paper's recipe": '#E69F00', 'slow features alone': '#009E73',
    'labels': '#CC79A7', 'one image': '#56B4E9', 'EKF': '#0072B2', 'this package': '#0072B2',
    'one image, trained on slopes': '#F0E442', 'EKF, trained on slopes': '#D55E00',
}  # fmt: skip
"""Of Okabe and Ito, as in all reports."""
ESTIMATES = "paper's recipe", 'slow features alone', 'one image', 'EKF'


@dataclass(frozen=True, slots=True)
class Panel:
    """Bars of errors (m): for each of the `series` a value, or NaN, in each of the `groups`."""

    title: str
    groups: Sequence[str]
    series: Mapping[str, Sequence[float]]


def draw(path: Path, panels: Sequence[Panel]) -> None:
    """Draw panels side by side, with the number above each bar."""
    figure = Figure(figsize=(7.0, 2.9), layout='constrained')
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _bars(axes, panel)
    save(figure, path)


def _bars(axes: Axes, panel: Panel) -> None:
    places, width = np.arange(len(panel.groups)), 0.84 / len(panel.series)
    for number, (name, values) in enumerate(panel.series.items()):
        offset = (number - (len(panel.series) - 1) / 2) * width
        bars = axes.bar(places + offset, values, width, color=COLORS[name], label=name)
        labels = ['' if np.isnan(value) else f'{value:.2f}' for value in values]
        axes.bar_label(bars, labels, fontsize=7.5, rotation=90, padding=2)
    axes.set_ylim(0, 1.45 * float(np.nanmax([*panel.series.values()])))
    axes.set_xticks(places, panel.groups, fontsize=8)
    axes.set_ylabel('mean error (m)', fontsize=8)
    axes.tick_params(axis='y', labelsize=8)
    axes.set_title(panel.title, fontsize=9)
    axes.legend(fontsize=7.5, ncols=2, loc='upper right')
    axes.spines[['top', 'right']].set_visible(False)


def paper(results: Mapping[str, Cells]) -> tuple[list[Panel], str]:
    """The paper's experiments beside ours, on the test drive."""
    rows, panels = {'test': 'map alone', 'image': 'one image', 'ekf': 'EKF'}, []
    for name in ('simulator', 'robot'):
        series = {
            'the paper': [PAPER[name].get(row, np.nan) for row in rows],
            "paper's recipe": [_mean(values_of(results[name], 'paper', row)) for row in rows],
            'this package': [_mean(values_of(results[name], 'ours', row)) for row in rows],
        }
        panels.append(Panel(f'{name} experiment, test drive', [*rows.values()], series))
    count = gardens(min(len(results[name]) for name in ('simulator', 'robot')))
    image = [_mean(values_of(results[name], 'ours', 'image')) for name in ('simulator', 'robot')]
    gain = _mean(values_of(results['robot'], 'ours', 'gain'))
    of_paper = 1 - PAPER['robot']['ekf'] / PAPER['robot']['odometry']
    return panels, (
        f"**The paper's experiments**, rendered, {count}: one image errs "
        f'by {image[0]:.2f} and {image[1]:.2f} m. In the robot experiment the filter errs by '
        f'{-gain:.0f} % less than the wheels. In its own garden the filter of the paper erred by '
        f'{of_paper:.0%} less.'
    )


def lights(results: Mapping[str, Cells]) -> tuple[list[Panel], str]:
    """Trained by day, tested in each light and season."""
    cells = results['light']
    worlds = len({cell['world'] for cell in cells})
    conditions = [*dict.fromkeys(map(condition, cells))]
    names = dict(zip(ESTIMATES, ('paper', 'slow', 'sfa', 'ekf'), strict=True))
    series = {
        title: [_number(mean_of(cells, each, name, 'mean_m')) for each in conditions]
        for title, name in names.items()
    }
    groups = [each.replace(', ', '\n') for each in conditions]
    errors = [_number(value_of(cell, 'ekf', 'mean_m')) for cell in cells]
    wrong = sum(cell.get('false_localised_s', 0.0) for cell in cells)
    return [Panel('trained by day in summer', groups, series)], (
        f'**Light and season**, rendered, {gardens(worlds)}: trained by day in summer, the '
        f'filter errs by {np.nanmin(errors):.2f} to {np.nanmax(errors):.2f} m in all gardens and '
        f'lights, and was LOCALISED and wrong by more than 1 m for {wrong:.0f} s.'
    )


def ground(results: Mapping[str, Cells]) -> tuple[list[Panel], str]:
    """On slopes, trained on flat ground or on slopes."""
    series = {
        f'{title}{behind}': [_of_rig(results, case, slope, name) for slope in SLOPES]
        for case, behind in ((ABOVE, ''), (UNEVEN, ', trained on slopes'))
        for title, name in (('one image', 'sfa'), ('EKF', 'ekf'))
    }
    groups = ['flat' if not slope else f'{slope:g}°' for slope in SLOPES]
    image, ekf = series['one image'], series['EKF']
    return [Panel('standard deviation of the slope', groups, series)], (
        f'**Uneven ground**, rendered, {_gardens(results)}: trained on flat ground, one image errs '
        f'by {image[0]:.2f} m there and by {max(image):.2f} m on slopes of up to 4°, the filter by '
        f'{ekf[0]:.2f} and {max(ekf):.2f} m.'
    )


def sizes(results: Mapping[str, Cells]) -> tuple[list[Panel], str]:
    """Places of three sizes."""
    cells = results['large']
    names = {'labels': 'labels', 'one image': 'sfa', 'EKF': 'ekf'}
    series = {title: [cell[name] for cell in cells] for title, name in names.items()}
    first, last = cells[0], cells[-1]
    return [Panel('size of the place', [cell['garden'] for cell in cells], series)], (
        f'**Size**, rendered: on {first["garden"]} the filter errs by {first["ekf"]:.2f} m, on '
        f'{last["garden"]} by {last["ekf"]:.2f} m, after {last["training_s"] / 60:.0f} minutes of '
        'training on one core.'
    )


def camera(results: Mapping[str, Cells]) -> tuple[list[Panel], str]:
    """A camera ahead of the axle."""
    cases = [case for case in CASES if case != UNEVEN]
    series = {
        title: [_of_rig(results, case, 0.0, name) for case in cases]
        for title, name in (('one image', 'sfa'), ('EKF', 'ekf'))
    }
    _, measured, learned, ignored = series['EKF']
    groups = [case.replace(', ', '\n') for case in cases]
    return [Panel('place of the camera, and what the training knew of it', groups, series)], (
        f'**Camera beside the axle**, rendered, {_gardens(results)}: with the camera 0.3 m ahead '
        f'the filter errs by {learned:.2f} m if the training learned this, {measured:.2f} m if it '
        f'was measured, and {ignored:.2f} m if it was ignored.'
    )


def _gardens(results: Mapping[str, Cells]) -> str:
    """Number of gardens of the study `rig`."""
    return gardens(len({cell['world'] for cell in results['rig']}))


def _of_rig(results: Mapping[str, Cells], case: str, slope: float, name: str) -> float:
    """The mean of a score over the gardens."""
    cells = results['rig']
    return _mean([c[name] for c in cells if c['case'] == case and c['slope'] == slope])


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else np.nan


def _number(value: float | None) -> float:
    return np.nan if value is None else value


FIGURES: dict[str, tuple[tuple[str, ...], Callable[..., tuple[list[Panel], str]]]] = {
    'paper': (('simulator', 'robot'), paper),
    'lights': (('light',), lights),
    'ground': (('rig',), ground),
    'sizes': (('large',), sizes),
    'camera': (('rig',), camera),
}
"""By the name of the file: the results that a figure needs, and its panels and sentence."""
