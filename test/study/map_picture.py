# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the map that sfa_node publishes, and the path of the filter on a drive: FILE.png.

PYTHONPATH=.:test python -m study.map_picture demo/model.npz demo/test resource/map.png
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from sfa_localization.data.geometry import RigidTransform
from sfa_localization.evaluation import evaluate
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.nodes.conversions import to_grid, to_lines
from sfa_localization.place_model import PlaceModel

UNKNOWN, FREE = 0.8, 1.0  # gray


def main(model, bag, output):
    """As RViz and Foxglove show `sfa/map`, `sfa/map_paths` and `ekf/path`."""
    model = PlaceModel.load(model)
    grid = to_grid(model.ground.cells(GroundConfig()), 0, 'map')
    (marker,) = to_lines(model.ground, 0, 'map').markers
    info, corner = grid.info, grid.info.origin.position
    free = np.reshape(grid.data, (info.height, info.width)) == 0
    extent = [corner.x, corner.x + info.width * info.resolution,
              corner.y, corner.y + info.height * info.resolution]  # fmt: skip
    figure = Figure(figsize=(6.0, 6.0), layout='constrained')
    axes = figure.subplots()
    gray = np.where(free, FREE, UNKNOWN)
    axes.imshow(gray, cmap='gray', vmin=0, vmax=1, extent=extent, origin='lower')
    ends = np.reshape([(point.x, point.y) for point in marker.points], (-1, 2, 2))
    colors = [(color.r, color.g, color.b) for color in marker.colors][1::2]
    axes.add_collection(LineCollection(ends, colors=colors, linewidths=1.5))
    drive = evaluate(model, Path(bag), transform=RigidTransform(0.0, 0.0, 0.0), progress=True)
    path = drive.estimates['ekf'].poses
    axes.plot(*path[:, :2].T, color='#0072b2', linewidth=1.5)
    axes.set(xlabel='x (m)', ylabel='y (m)', aspect='equal')
    figure.savefig(output, dpi=100)


if __name__ == '__main__':
    main(*sys.argv[1:])
