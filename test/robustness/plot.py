# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Is the state a promise? Claimed standard deviations against errors, over all faults, by state."""

import math

import numpy as np
from matplotlib.figure import Figure

from robustness.judged import WRONG_DEG
from sfa_localization.evaluation import WRONG_M

LEVELS = ('LOCALISED', 'DEGRADED', 'LOST')
WITHIN_95 = {'position': math.sqrt(-2 * math.log(0.05)), 'heading': 1.96}
"""Standard deviations that hold 95 % of the errors: of two coordinates, and of one."""
_SMALLEST = {'position': 1e-2, 'heading': 0.1}


def values(outputs, quantity):
    """Claimed standard deviations and errors (N,) of a quantity, meters or degrees."""
    names = ('std_m', 'error_m') if quantity == 'position' else ('yaw_std_deg', 'yaw_deg')
    return tuple(np.array([getattr(one, name) for one in outputs]) for name in names)


def summary(outputs):
    """A line for each state: its seconds, its errors, and the share that its claims hold."""
    rows = [f'{"state":10s}   share  95 % of errors below  wrong  within 95 % (position, heading)']
    for level in LEVELS:
        mine = [one for one in outputs if one.level == level]
        if not mine:
            continue
        within = []
        for quantity, factor in WITHIN_95.items():
            std, error = values(mine, quantity)
            within.append(float(np.mean(error <= factor * std)))
        error = values(mine, 'position')[1]
        rows.append(
            f'{level:10s}  {len(mine) / len(outputs):6.1%}  {np.percentile(error, 95):18.2f} m'
            f'  {np.mean([one.wrong for one in mine]):5.1%}  {within[0]:6.1%}, {within[1]:6.1%}'
        )
    return '\n'.join(rows)


def draw(outputs, path):
    """Write the calibration plot of outputs to a PNG file."""
    figure = Figure(figsize=(12, 7.5), layout='constrained')
    axes = figure.subplots(2, len(LEVELS), sharex='row', sharey='row')
    for row, quantity in zip(axes, WITHIN_95, strict=True):
        for axis, level in zip(row, LEVELS, strict=True):
            panel(axis, [one for one in outputs if one.level == level], quantity)
            axis.set_title(f'{quantity}, {level}')
    axes[0, 0].legend(loc='upper left', fontsize=8)
    figure.suptitle('Claimed standard deviation and error, over all faults')
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def panel(axis, outputs, quantity):
    """Claims and errors, and below which line 95 % of the errors lie where claims are right."""
    unit, limit = ('m', WRONG_M) if quantity == 'position' else ('deg', WRONG_DEG)
    lowest = _SMALLEST[quantity]
    axis.set(xscale='log', yscale='log', xlabel=f'claimed standard deviation [{unit}]')
    axis.set_ylabel(f'error [{unit}]')
    axis.axhline(limit, color='tab:red', lw=0.8, label='wrong above')
    ends = np.array([lowest, 20 * limit])
    axis.plot(ends, WITHIN_95[quantity] * ends, 'k--', lw=0.8, label='95 % if the claim is right')
    if outputs:
        std, error = (np.maximum(array, lowest) for array in values(outputs, quantity))
        grid = {'xscale': 'log', 'yscale': 'log', 'gridsize': 40, 'mincnt': 1}
        axis.hexbin(std, error, bins='log', cmap='Blues', **grid)
