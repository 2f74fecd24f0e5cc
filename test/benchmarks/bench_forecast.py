# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What training expects of its model against the truth: `python bench_forecast.py [BAGS ...]`.

Without arguments, in simulated gardens: trains on a drive through each and judges the model on
another path (about a minute each). BAGS are `test,training[,training ...]`, drives with ground
truth to judge as well. Nothing but the last step reads the truth. Each line has

    expected  mean error of one image that the training expects (m)
    true      mean error on the test drive, the map laid on the truth of the training drive (m)
    ratio     expected over true
    ellipse   share of the errors inside the 95 % ellipse of their image
    rank      rank correlation of the claimed deviations and the errors
    yaw       expected over true mean error of the heading
    interval  share of the heading errors inside the 95 % interval of their image
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from scipy import stats

from sfa_localization.bags.drives import read_drive
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import align, rotation, wrap_angle
from sfa_localization.place_model import PlaceModel
from sfa_localization.simulation.drive import simulate
from sfa_localization.simulation.settings import SimulationConfig
from sfa_localization.training import Recipe, train

# Route, area (m) and length (m, 0: by the area) of the training drive; the garden's number is the
# place in this list.
DRIVES = (
    ('coverage', (8.0, 8.0), 0.0),
    ('coverage', (10.0, 8.0), 0.0),
    ('coverage', (6.0, 6.0), 0.0),
    ('coverage', (8.0, 8.0), 60.0),
    ('coverage', (12.0, 8.0), 0.0),
    ('coverage', (7.0, 9.0), 0.0),
    ('coverage', (9.0, 9.0), 0.0),
    ('coverage', (8.0, 8.0), 100.0),
    ('mower', (7.0, 7.0), 0.0),
    ('mower', (9.0, 7.0), 0.0),
    ('curves', (8.0, 8.0), 100.0),
    ('curves', (9.0, 7.0), 80.0),
)
PANORAMA = PanoramaConfig(width=300, height=30)
WORLD_FIRST = 101
COLUMNS = ('expected', 'true', 'ratio', 'ellipse', 'rank', 'yaw', 'interval')


def simulated(folder: Path, first: int, count: int) -> Iterator[tuple[str, list[Path]]]:
    """Names and bags (test, training) of simulated drives, written when they are asked for."""
    for number, (route, area, length) in list(enumerate(DRIVES))[first : first + count]:
        world = WORLD_FIRST + number
        config = SimulationConfig(images='panorama', world=world, seed=2 * world, area=area)
        bags = [folder / f'{world}-test', folder / f'{world}-{route}']
        simulate(replace(config, trajectory='test', seed=config.seed + 1), bags[0], PANORAMA)
        simulate(replace(config, trajectory=route, length=length), bags[1], PANORAMA)
        yield f'{route} {area[0]:g}x{area[1]:g}', bags


def seen(model: PlaceModel, bag: Path, folder: Path) -> tuple[np.ndarray, ...]:
    """Poses (N, 3) and covariances (N, 3, 3) of the images of a bag, and true poses (N, 3)."""
    run = read_drive(bag, folder, replace(Recipe(), panorama=model.panorama), want_truth=True)
    told = [e for images in run.panoramas.batches(16) for e in model.locate_all(images)]
    poses = np.array([np.append(e.position, e.yaw) for e in told])
    covariances = np.array([e.covariance for e in told])
    stamps = run.panoramas.stamps_ns
    known = run.ground_truth.covers(stamps, 200_000_000)
    return poses[known], covariances[known], run.ground_truth.at(stamps[known])


def judge(bags: list[Path], folder: Path) -> dict[str, float]:
    """A line of the table, of a test drive and the drives to train on."""
    test, *training = bags
    model = train(training, folder / 'model.npz', Recipe()).model
    poses, _, truth = seen(model, training[0], folder)
    frame = align(poses[:, :2], truth[:, :2])
    poses, covariances, truth = seen(model, test, folder)
    turn = rotation(frame.yaw_rad)
    off = frame.apply(poses[:, :2]) - truth[:, :2]
    spread = turn @ covariances[:, :2, :2] @ turn.T
    squared = np.einsum('ni,nij,nj->n', off, np.linalg.inv(spread), off)
    yaw = wrap_angle(frame.apply_yaw(poses[:, 2]) - truth[:, 2])
    errors, claimed = np.hypot(*off.T), np.sqrt(np.trace(spread, axis1=1, axis2=2))
    expected = model.quality['expected_error_m']
    true_yaw = np.degrees(np.abs(yaw).mean())
    return {
        'expected': expected,
        'true': errors.mean(),
        'ratio': expected / errors.mean(),
        'ellipse': np.mean(squared <= stats.chi2.ppf(0.95, 2)),
        'rank': stats.spearmanr(claimed, errors).statistic,
        'yaw': model.quality.get('expected_yaw_error_deg', np.nan) / true_yaw,
        'interval': np.mean(yaw**2 <= stats.chi2.ppf(0.95, 1) * covariances[:, 2, 2]),
    }


def line(name: str, figures: dict[str, float]) -> str:
    return f'{name:<28}' + ''.join(f'{figures[column]:>10.3f}' for column in COLUMNS) + '\n'


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('bags', nargs='*', metavar='BAGS', help='test,training[,training ...]')
    parser.add_argument('--first', type=int, default=0, help='first simulated drive [0]')
    parser.add_argument('--count', type=int, help='simulated drives [all; none beside BAGS]')
    options = parser.parse_args()
    count = options.count if options.count is not None else 0 if options.bags else len(DRIVES)
    sys.stdout.write(f'{"":<28}' + ''.join(f'{column:>10}' for column in COLUMNS) + '\n')
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        given = [[Path(bag) for bag in text.split(',')] for text in options.bags]
        named = [(bags[0].name, bags) for bags in given]
        for name, bags in chain(named, simulated(folder, options.first, count)):
            rows.append(judge(bags, folder))
            sys.stdout.write(line(name, rows[-1]))
            sys.stdout.flush()
    if len(rows) > 1:
        mean = {column: float(np.mean([row[column] for row in rows])) for column in COLUMNS}
        sys.stdout.write(line('mean', mean))


if __name__ == '__main__':
    main()
