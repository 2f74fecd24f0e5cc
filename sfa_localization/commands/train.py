# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn a place model from bags."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sfa_localization.commands.options import add_settings, add_topics, recipe
from sfa_localization.features.settings import NetworkConfig
from sfa_localization.metric.settings import MetricConfig, SegmentConfig

if TYPE_CHECKING:
    from sfa_localization.training import Recipe, Trained

WRITES = 'MODEL.npz; with --report index.html (one page for a browser), its figures, training.md'
EXAMPLES = """\
  train bags/coverage --output garden.npz
  train bags/a bags/b --output garden.npz --config localization.yaml --report report
  train recording --output garden.npz --image-topic /front/image_raw --odom-topic /odom"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bags, model, topics, and the settings that are often changed."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='drives to learn from')
    parser.add_argument('--output', type=Path, required=True, metavar='MODEL.npz')
    parser.add_argument('--config', type=Path, help='parameter file')
    parser.add_argument('--report', type=Path, metavar='DIR', help='write figures of the training')
    parser.add_argument('--resume', action='store_true', help='continue an interrupted training')
    parser.add_argument('--strict', action='store_true', help='reject damaged bags')
    parser.add_argument(
        '--dask', metavar='ADDRESS', help='train on a cluster whose workers share the output folder'
    )
    add_topics(parser, 'image', 'odometry', 'imu')
    add_settings(parser, SegmentConfig, ('segments',))
    add_settings(parser, MetricConfig, ('solver', 'metric_map'))
    add_settings(parser, NetworkConfig, ('engine', 'normalization'))


def run(arguments: argparse.Namespace) -> int:
    """Train; print the summary."""
    from sfa_localization import training
    from sfa_localization.features.cluster import executor_at
    from sfa_localization.reports.summary import summary

    used = recipe(arguments)
    with executor_at(arguments.dask) as executor:
        trained = training.train(
            arguments.bags,
            arguments.output,
            used,
            progress=True,
            resume=arguments.resume,
            strict=arguments.strict,
            executor=executor,
        )
    print(summary(trained))
    if arguments.report:
        _write_report(arguments.report, arguments.bags, trained, used)
    print(f'{arguments.output}: written')
    return 0


def _write_report(folder: Path, bags: Sequence[Path], trained: Trained, used: Recipe) -> None:
    """Write figures and the page, with the worst images read from the bags once more."""
    from sfa_localization.bags.drives import images_at
    from sfa_localization.reports.page import PAGE
    from sfa_localization.reports.training import worst_images, write_training_report

    worst = worst_images(trained)
    read = {
        run: images_at(bag, [one.stamp_ns for one in worst if one.run == run], used)
        for run, bag in enumerate(bags)
        if any(one.run == run for one in worst)
    }
    samples = {one: read[one.run][one.stamp_ns] for one in worst if one.stamp_ns in read[one.run]}
    write_training_report(folder, trained, samples)
    print(f'{folder / PAGE}: written')
