# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Film teach_node while a garden is driven, and the nodes that localize in it then: FILE.webp.

PYTHONPATH=.:test python -m study.teaching resource/teaching.webp
"""

import argparse
import dataclasses
import tempfile
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sfa_localization.data.geometry import compose, invert
from sfa_localization.evaluation import evaluate
from sfa_localization.place_model import PlaceModel
from study.animation import BLUE, COLORS, GRAY, TRAIL, draw_robot, film

PARTS = 24
"""Parts in which the drive is taught; teach_node looks at it after each."""
TESTED_S, STEP_S = 14.0, 0.25
"""Seconds of the other drive that are shown, in real time, and between two frames."""
TRAINING, WIDTH = 8, 34
"""Shots of the training, and letters in a line."""
UNKNOWN, TO_DRIVE, COVERED = 0.8, 0.45, 1.0
"""Shades of gray."""


@dataclasses.dataclass(frozen=True, slots=True)
class Shot:
    """A title, a sentence, and poses (3,) of the filter and of the truth in the map."""

    title: str
    said: str
    pose: np.ndarray | None = None
    true: np.ndarray | None = None
    grid: object = None
    hints: object = None


def filmed(folder):
    """Teach the sample drive through DDS, and localize on the other one: a shot now and then."""
    from ros_bench import Bench
    from taught_drives import start_chain, start_teaching

    bench, model = Bench(), folder / 'garden.npz'
    chain = start_chain(bench, model)
    taught = start_teaching(bench, model)
    try:
        shots = taught_shots(bench, taught)
        return [*shots, *localized_shots(bench, chain, PlaceModel.load(model), shots[-1])]
    finally:
        bench.close()


def taught_shots(bench, taught):
    """What teach_node publishes while it is driven, and while it trains."""
    from nav_msgs.msg import OccupancyGrid
    from ros_bench import until
    from std_msgs.msg import String
    from std_srvs.srv import Trigger
    from taught_drives import SAMPLE, driver, records
    from visualization_msgs.msg import MarkerArray

    from sfa_localization.nodes.lifecycle import latched_qos

    latched = latched_qos()
    said = bench.listen(String, 'teach/state', latched)
    grids = bench.listen(OccupancyGrid, 'teach/map', latched)
    hints = bench.listen(MarkerArray, 'teach/hints', latched)
    messages = records(SAMPLE, '/odom', '/imu', '/panorama/compressed')
    drive, shots = driver(bench, taught._recorder.counts.total), []
    for part in np.array_split(np.arange(len(messages)), PARTS):
        drive(messages[part[0] : part[-1] + 1])
        seen = len(hints)
        assert until(lambda: len(hints) >= seen + 2)  # noqa: B023 - the first may be of before
        text = hints[-1].markers[-1].text
        assert until(lambda: text in said[-1].data)  # noqa: B023
        # Before it stands that nothing comes: the drive waits for the look.
        text = '; '.join(said[-1].data.split('; ')[-2:])
        shots.append(Shot('drive', text, grid=grids[-1], hints=hints[-1]))
    first = len(said)
    assert bench.call(Trigger, 'teach_node/finish', Trigger.Request()).success
    assert until(lambda: 'is written' in said[-1].data, 600.0)
    chosen = np.linspace(first, len(said) - 1, TRAINING).astype(int)
    lines = [said[k].data.replace(f'{taught._model.parent}/', '') for k in chosen]
    return shots + [dataclasses.replace(shots[-1], title='finish', said=line) for line in lines]


def localized_shots(bench, chain, model, last):
    """Poses of the filter beside the truth, on the ground that was taught."""
    from nav_msgs.msg import Odometry
    from ros_bench import until
    from taught_drives import SAMPLE, TEST, passed_on

    from sfa_localization.nodes.conversions import read_odometry

    assert until(lambda: all(node.active for node in chain))
    offline = evaluate(model, TEST, align_bags=[SAMPLE])
    to_map = invert(np.array(dataclasses.astuple(offline.transform)))
    fused, shots, start_ns = bench.listen(Odometry, 'ekf/odometry'), [], None
    for message in passed_on(bench, chain):
        stamp_ns = read_odometry(fused[-1])[0] if fused else None
        start_ns = start_ns or stamp_ns
        if isinstance(message, Odometry) and stamp_ns:
            second = (stamp_ns - start_ns) * 1e-9
            if second >= TESTED_S:
                return shots
            if second >= len(shots) * STEP_S:
                true = compose(to_map, offline.truth.at(np.array([stamp_ns]))[0])
                pose = np.array(read_odometry(fused[-1])[2])
                level = chain[2].status().level.name
                shots.append(dataclasses.replace(last, title=level, said='', pose=pose, true=true))
    return shots


def draw(figure, shots, k):
    """Shot k: the map beside the sentence."""
    shot = shots[k]
    figure.clear()
    axes = figure.add_axes((0.01, 0.02, 0.58, 0.96))
    axes.set(xticks=[], yticks=[], facecolor=str(UNKNOWN))
    info, corner = shot.grid.info, shot.grid.info.origin.position
    cells = np.reshape(shot.grid.data, (info.height, info.width))
    size = np.array([info.width, info.height]) * info.resolution
    extent = [corner.x, corner.x + size[0], corner.y, corner.y + size[1]]
    shades = np.select([cells == 0, cells > 0], [COVERED, TO_DRIVE], UNKNOWN)
    axes.imshow(shades, cmap='gray', vmin=0, vmax=1, extent=extent, origin='lower')
    *lines, _ = shot.hints.markers
    for line in lines:
        axes.plot(*np.transpose([(p.x, p.y) for p in line.points]), color='#1e8c3c', lw=1)
    whole = shots[-1].grid.info
    low = np.array([whole.origin.position.x, whole.origin.position.y])
    high = low + np.array([whole.width, whole.height]) * whole.resolution
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
    legend = 'white: covered   dark: to drive still'
    if shot.pose is None:
        points = lines[-1].points
        axes.plot(points[-1].x, points[-1].y, 'o', color=GRAY, ms=9)
    else:
        trail = np.array([s.pose for s in shots[max(k - TRAIL, 0) : k + 1] if s.pose is not None])
        axes.plot(*trail[:, :2].T, '.', color=BLUE, ms=3)
        draw_robot(axes, shot.true, GRAY, 10)
        draw_robot(axes, shot.pose, BLUE, 6)
        error = float(np.hypot(*(shot.pose - shot.true)[:2]))
        figure.text(0.61, 0.78, f'error {error:.2f} m', color=GRAY)
        legend = 'gray: true robot   blue: estimate'
    figure.text(0.61, 0.87, shot.title, size='x-large', color=COLORS.get(shot.title, BLUE))
    figure.text(0.61, 0.8, textwrap.fill(shot.said, WIDTH), va='top', size='medium')
    figure.text(0.61, 0.04, legend, color=GRAY, size='small')


def main():
    """Film, and write the file."""
    parser = argparse.ArgumentParser(prog='teaching', description=__doc__)
    parser.add_argument('output', type=Path, metavar='FILE.webp')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        shots = filmed(Path(folder))
    film(
        arguments.output,
        Figure((7.2, 4.2)),
        lambda figure, k: draw(figure, shots, k),
        len(shots),
        1 / STEP_S,
    )


if __name__ == '__main__':
    main()
