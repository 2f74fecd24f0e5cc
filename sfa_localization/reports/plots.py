# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Plots to zoom and to click: where a drive went and how far off it was, linked to its images.

Plotly draws them in the browser. Each point of a curve carries its time; a click marks the points
of that time in all plots, and shows the image that was taken then.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plotly.graph_objects import Figure, Scatter
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from sfa_localization.data.files import write_bytes
from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.data.run import Trajectory
from sfa_localization.reports.figures import MARGIN_M
from sfa_localization.reports.moments import Estimate, Moment, cards

Curve = Mapping[str, list[Any]]
"""Columns `seconds`, `x_m` and `y_m`, and but for the truth `error_m` and `heading_deg`."""
SCRIPT = 'plotly.min.js'
POINTS = 800
"""Most points of a curve: screens have as many columns."""
_REACH = 2.4477
"""Semiaxes of an ellipse that holds 95 % of a Gaussian, in standard deviations."""
_GRID = 'rgba(128, 128, 128, 0.3)'
_RED = '#D55E00'
_VIOLET = '#9370DB'
_CONFIG = {
    'displaylogo': False,
    'responsive': True,
    'modeBarButtonsToRemove': ['select2d', 'lasso2d', 'autoScale2d', 'toImage'],
}
_STYLE = """
<style>
.linked { display: grid; gap: 0.5rem 1rem; margin-inline: calc(50% - min(48vw, 44rem)); }
.linked > * { min-width: 0; }
.moment h3 { font-size: 1rem; margin: 0.5rem 0 0; }
.moment p { margin: 0; }
.moment figure { margin: 0.4rem 0; }
.moment img { width: 100%; height: auto; }
.moment figcaption { text-align: left; }
@media (max-width: 40rem) { .moment table { font-size: 0.75rem; width: 100%; } }
@media (min-width: 40rem) { .moment td { white-space: nowrap; } }
#moment { width: 100%; margin: 0; }
button.at { font: inherit; color: inherit; background: none; border: 1px solid var(--line);
  border-radius: 0.25rem; padding: 0.1rem 0.5rem; margin: 0.15rem 0; cursor: pointer; }
.js-plotly-plot .infolayer text, .js-plotly-plot .cartesianlayer text {
  fill: var(--text) !important; }
@media (min-width: 60rem) {
  .linked { grid-template-columns: 1fr 1fr; }
  .linked > .errors { grid-column: 2; grid-row: 1 / span 2; }
}
</style>"""
# A module runs when the whole page is read.
_JAVASCRIPT = """
<script type="module">
const plots = [...document.querySelectorAll('.js-plotly-plot')];
const cards = [...document.querySelectorAll('.moment')];
const slider = document.querySelector('#moment');
const times = cards.map(card => +card.dataset.seconds);
const nearest = (all, time) => all.reduce(
  (best, other, k) => Math.abs(other - time) < Math.abs(all[best] - time) ? k : best, 0);
function show(time) {
  if (cards.length) {
    const at = slider.value = nearest(times, time);
    cards.forEach((card, k) => card.hidden = k !== at);
    time = times[at];
  }
  plots.forEach(plot => Plotly.restyle(plot, {selectedpoints: plot.data.map(
    trace => trace.customdata ? [nearest(trace.customdata, time)] : null)}));
}
plots.forEach(plot => plot.on('plotly_click', ({points}) => show(points[0].customdata)));
if (slider) {
  slider.oninput = () => show(times[slider.value]);
  show(times[0]);
}
document.querySelectorAll('button.at').forEach(
  button => button.onclick = () => show(+button.dataset.seconds));
if (matchMedia('(pointer: coarse)').matches)  // a finger scrolls the page
  plots.forEach(plot => Plotly.relayout(plot, {dragmode: false}));
</script>"""


class Line(NamedTuple):
    """A curve in the plots, its name, and its look."""

    name: str
    curve: Curve
    color: str
    dash: str = 'solid'
    mode: str = 'lines'


class Errors(NamedTuple):
    """Errors of an estimate where the truth covers it: `seconds` (M,) since the truth's start, true
    `places` (M, 2) m, estimated `poses` (M, 3), errors of position (M,) m and of heading (M,)
    degrees, NaN without a heading.
    """

    seconds: Array
    places: Array
    poses: Array
    position_m: Array
    heading_deg: Array


def errors_of(truth: Trajectory, estimate: Trajectory) -> Errors:
    """The errors of an estimate."""
    mask = truth.covers(estimate.stamps_ns)
    poses = estimate.poses[mask]
    true = truth.at(estimate.stamps_ns[mask])
    x, y, yaw = (poses - true).T
    seconds = (estimate.stamps_ns[mask] - truth.stamps_ns[0]) * 1e-9
    return Errors(seconds, true[:, :2], poses, np.hypot(x, y), np.degrees(wrap_angle(yaw)))


def curves_of(truth: Trajectory, estimates: Mapping[str, Trajectory]) -> dict[str, Curve]:
    """The curves of a drive by their names, that of the truth too, with at most POINTS points."""
    rows = np.linspace(0, len(truth) - 1, min(POINTS, len(truth))).astype(int)
    seconds = (truth.stamps_ns[rows] - truth.stamps_ns[0]) * 1e-9
    curves = {'truth': _curve(seconds, truth.poses[rows])}
    for name, estimate in estimates.items():
        errors = errors_of(truth, estimate)
        kept = _largest(errors.position_m)
        curves[name] = _curve(
            errors.seconds[kept],
            errors.poses[kept],
            error_m=errors.position_m[kept],
            heading_deg=errors.heading_deg[kept],
        )
    return curves


def _largest(values: Array) -> list[int]:
    """Rows of at most POINTS values: of neighbors the largest one stands for all."""
    size = max(1, -(-len(values) // POINTS))
    starts = range(0, len(values), size)
    return [start + int(values[start : start + size].argmax()) for start in starts]


def _curve(seconds: Array, poses: Array, **errors: Array) -> Curve:
    columns = {'seconds': seconds, 'x_m': poses[:, 0], 'y_m': poses[:, 1], **errors}
    return {
        name: [round(value, 3) if math.isfinite(value) else None for value in column.tolist()]
        for name, column in columns.items()
    }


def linked_plots(
    folder: Path,
    truth: Curve,
    lines: Sequence[Line],
    moments: Sequence[Moment] = (),
    trained: Array | None = None,
) -> str:
    """The part of a page in `folder` with both plots, and a card for each moment; `trained` (K, 2)
    m are the places of the training's images. Raises LocalizationError.
    """
    slider = (
        f'<input id="moment" type="range" min="0" max="{len(moments) - 1}" value="0" '
        'aria-label="image of the drive">'
    )
    return '\n'.join([
        _STYLE,
        f'<script src="{_script_for(folder)}"></script>',
        '<noscript><p>The plots need JavaScript.</p></noscript>',
        '<div class="linked">',
        f'<div>{_html(_path_plot(truth, lines, moments, trained))}</div>',
        f'<div>{slider}{cards(moments)}</div>' if moments else '',
        f'<div class="errors">{_html(_error_plot(lines, moments))}</div>',
        f'</div>{_JAVASCRIPT}',
    ])  # fmt: skip


def write_script(folder: Path) -> None:
    """Write the script that draws plots, for the pages in `folder` and in its folders. Raises
    LocalizationError.
    """
    write_bytes(folder / SCRIPT, get_plotlyjs().encode())


def _script_for(folder: Path) -> str:
    """The path of that script from a page in `folder`: the one of a fleet, or else beside it."""
    size = len(get_plotlyjs().encode())
    for place in folder.absolute().parents[:2]:
        file = place / SCRIPT
        if file.is_file() and file.stat().st_size == size:
            return os.path.relpath(file, folder)
    write_script(folder)
    return SCRIPT


def _html(figure: Figure) -> str:
    return str(figure.to_html(full_html=False, include_plotlyjs=False, config=_CONFIG))


def _path_plot(
    truth: Curve, lines: Sequence[Line], moments: Sequence[Moment], trained: Array | None
) -> Figure:
    figure = Figure(layout=_layout(470))
    if trained is not None:
        spots = {'marker': {'color': 'rgba(128, 128, 128, 0.45)', 'size': 3}}
        figure.add_trace(_trace('images of the training', *trained.T, mode='markers', **spots))
    wide = {'line': {'color': 'rgba(150, 150, 150, 0.7)', 'width': 6}}
    places = truth['x_m'], truth['y_m']
    figure.add_trace(_trace('ground truth', *places, customdata=truth['seconds'], **wide))
    for line in lines:
        figure.add_trace(_line_trace(line, line.curve['x_m'], line.curve['y_m']))
    if moments:
        _add_moments(figure, moments)
    low, high = _view([truth, *(line.curve for line in lines)])
    figure.update_xaxes(title='x (m)', range=[low[0], high[0]])
    figure.update_yaxes(title='y (m)', range=[low[1], high[1]], scaleanchor='x')
    return figure


def _add_moments(figure: Figure, moments: Sequence[Moment]) -> None:
    """Mark the images by the error of the filter, with the covariances and the keyframes."""
    seconds = [round(moment.seconds, 3) for moment in moments]
    single = [m.single for m in moments if not m.problem]
    fused = [m.filtered for m in moments if m.filtered]
    hidden = {'visible': 'legendonly'}
    for name, estimates, look in (('image alone', single, hidden), ('filter', fused, {})):
        outline = {'line': {'color': _VIOLET, 'width': 1}, 'opacity': 0.5}
        x, y = _ellipses(estimates)
        figure.add_trace(_trace(f'{name}: 95 % region', x, y, hoverinfo='skip', **outline, **look))
    errors = np.array([moment.error_m(moment.filtered) for moment in moments])
    known = errors[np.isfinite(errors)]
    top = max(float(np.percentile(known, 98)), 0.05) if len(known) else 1.0
    bar = {'title': {'text': 'error of the filter (m)', 'side': 'top'}, 'orientation': 'h',
           'thickness': 10, 'nticks': 4, 'y': 1.0, 'yanchor': 'bottom'}  # fmt: skip
    colors = {'color': errors, 'colorscale': 'Viridis', 'cmin': 0, 'cmax': top, 'colorbar': bar}
    x, y = np.array([moment.place for moment in moments]).T
    figure.add_trace(_marks('images', x, y, seconds, {'size': 8, **colors}))
    x, y = np.array([moment.keyframe[:2] for moment in moments]).T
    diamonds = {'symbol': 'diamond-open', 'color': _RED, 'size': 13}
    figure.add_trace(_marks('likest keyframe', x, y, seconds, diamonds, others=0.0))


def _error_plot(lines: Sequence[Line], moments: Sequence[Moment]) -> Figure:
    figure = make_subplots(rows=2, shared_xaxes=True, vertical_spacing=0.05)
    figure.update_layout(_layout(640))
    for row, column in ((1, 'error_m'), (2, 'heading_deg')):
        for line in lines:
            trace = _line_trace(line, line.curve['seconds'], line.curve[column])
            figure.add_trace(trace.update(showlegend=row == 1), row, 1)
    fused = [(m.seconds, m.filtered) for m in moments if m.filtered]
    if fused:
        seconds = [round(second, 3) for second, _ in fused]
        stds = np.sqrt([estimate.covariance.diagonal() for _, estimate in fused])
        look = {'line': {'color': _VIOLET, 'width': 1, 'dash': 'dot'}}
        expected = np.hypot(*stds[:, :2].T), np.degrees(stds[:, 2])
        for row, values in enumerate(expected, 1):
            trace = _trace('filter: expected', seconds, values, customdata=seconds, **look)
            figure.add_trace(trace.update(showlegend=row == 1), row, 1)
    figure.update_yaxes(title='position error (m)', rangemode='tozero', row=1)
    figure.update_yaxes(title='heading error (°)', row=2)
    figure.update_xaxes(title='time (s)', row=2)
    return figure


def _layout(height: int) -> dict[str, Any]:
    """What all plots share: the page shows through, in the light and in the dark."""
    axis = {'gridcolor': _GRID, 'zerolinecolor': _GRID, 'automargin': True}
    return {
        'template': {'layout': {'xaxis': axis, 'yaxis': axis}},
        'height': height,
        'margin': {'l': 10, 'r': 10, 't': 30, 'b': 10},
        'paper_bgcolor': 'rgba(0, 0, 0, 0)',
        'plot_bgcolor': 'rgba(0, 0, 0, 0)',
        'legend': {'orientation': 'h', 'yref': 'container', 'y': 0, 'yanchor': 'bottom',
                   'font': {'size': 11}},
        'modebar': {'bgcolor': 'rgba(0, 0, 0, 0)', 'color': '#888', 'activecolor': '#0072B2'},
        'hovermode': 'closest',
    }  # fmt: skip


def _line_trace(line: Line, x: Sequence[Any], y: Sequence[Any]) -> Scatter:
    """A curve, whose point at the marked time is large where it has points."""
    look = {'line': {'color': line.color, 'dash': line.dash, 'width': 1.7}}
    if line.mode == 'markers':
        return _marks(line.name, x, y, line.curve['seconds'], {'color': line.color, 'size': 4})
    return _trace(line.name, x, y, customdata=line.curve['seconds'], **look)


def _marks(
    name: str,
    x: Any,
    y: Any,
    seconds: Sequence[Any],
    marker: dict[str, Any],
    others: float = 1.0,
) -> Scatter:
    """Points, of which the one at the marked time is red and large, with the opacity of others."""
    chosen = {'marker': {'color': _RED, 'size': 13, 'opacity': 1.0}}
    rest = {'marker': {'opacity': others}}
    return _trace(name, x, y, mode='markers', customdata=seconds, marker=marker, selected=chosen,
                  unselected=rest)  # fmt: skip


def _trace(name: str, x: Any, y: Any, **look: Any) -> Scatter:
    x, y = (np.asarray(values, np.float32) for values in (x, y))
    tip = '%{x:.2f}, %{y:.2f}' + (' at %{customdata:.1f} s' if 'customdata' in look else '')
    return Scatter(name=name, x=x, y=y, **{'mode': 'lines', 'hovertemplate': tip, **look})


def _ellipses(estimates: Sequence[Estimate]) -> tuple[Array, Array]:
    """The outlines (N,) x and y of the 95 % regions, NaN between them."""
    if not estimates:
        return np.zeros(0), np.zeros(0)
    circle = np.linspace(0, 2 * np.pi, 21)
    unit = _REACH * np.stack([np.cos(circle), np.sin(circle)])
    roots = np.linalg.cholesky([estimate.covariance[:2, :2] for estimate in estimates])
    centers = np.array([estimate.pose[:2] for estimate in estimates])
    outlines = np.pad(centers[:, :, None] + roots @ unit, ((0, 0), (0, 0), (0, 1)),
                      constant_values=np.nan)  # fmt: skip
    x, y = np.moveaxis(outlines, 1, 0).reshape(2, -1)
    return x, y


def _view(curves: Sequence[Curve]) -> tuple[Array, Array]:
    """Corners (2,) m around the paths; outliers are left outside."""
    paths = [np.array([curve['x_m'], curve['y_m']], float) for curve in curves]
    bulk = [np.nanpercentile(path, (1, 99), axis=1) for path in paths if path.size]
    if not bulk:
        return np.zeros(2), np.ones(2)
    return np.min(bulk, axis=(0, 1)) - MARGIN_M, np.max(bulk, axis=(0, 1)) + MARGIN_M
