# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Learn a place model from bags, or extend a model by later drives."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfa_localization.camera.settings import WatchConfig
from sfa_localization.commands import options
from sfa_localization.data.errors import ConfigError
from sfa_localization.data.files import first_bytes, write_json
from sfa_localization.fusion.settings import FilterConfig
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.sfa.settings import NetworkConfig

if TYPE_CHECKING:
    from sfa_localization.training import Recipe, Trained
    from sfa_localization.updating import Updated

WRITES = """\
MODEL.npz; with --report index.html (one page for a browser) and its figures; with --json the
  grade (good, weak or bad), the first sentence, and the quality of the map"""
EXAMPLES = """\
  train bags/coverage --output garden.npz
  train bags/a bags/b --output garden.npz --config localization.yaml --report report
  train recording --output garden.npz --image-topic /front/image_raw --odom-topic /odom
  train recording --output garden.npz --points points.csv
  train --update garden.npz recording --output newer.npz"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bags, model, topics, and the settings that are often changed."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='drives to learn from')
    parser.add_argument('--output', type=Path, required=True, metavar='MODEL.npz')
    parser.add_argument(
        '--update',
        type=Path,
        metavar='MODEL',
        help='extend this model by images of new viewpoints, light or seasons, instead of training',
    )
    parser.add_argument('--config', type=Path, help='parameter file')
    parser.add_argument('--report', type=Path, metavar='DIR', help='write a page about the model')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the judgment as JSON')
    parser.add_argument('--resume', action='store_true', help='continue an interrupted training')
    parser.add_argument('--strict', action='store_true', help='reject damaged bags')
    parser.add_argument('--force', action='store_true', help='train also on contradictory motion')
    options.add_topics(parser, 'image', 'odometry', 'imu', 'points_topic')
    options.add_settings(parser, SegmentConfig, ('segments',))
    options.add_settings(parser, MetricConfig, ('solver', 'metric_map', 'points'))
    options.add_settings(parser, NetworkConfig, ('engine', 'normalization'))


def run(arguments: argparse.Namespace) -> int:
    """Train or update; print the summary."""
    for output, suffix in ((arguments.output, '.npz'), (arguments.json, '.json')):
        if output:
            options.require_output(output, [*arguments.bags, arguments.config], suffix)
            options.require_report(arguments.report, output)
    replaces = bool(first_bytes(arguments.output)) and arguments.output != arguments.update
    written = f'{arguments.output}: written' + ', the model that was there is replaced' * replaces
    if arguments.update:
        return _update(arguments, written)
    from sfa_localization import training
    from sfa_localization.reports.summary import judgment, summary

    used = options.recipe(arguments)
    try:
        with options.noticed() as warnings:
            trained = training.train(
                arguments.bags,
                arguments.output,
                used,
                progress=True,
                resume=arguments.resume,
                strict=arguments.strict,
                force=arguments.force,
            )
    except KeyboardInterrupt:
        remedy = 'the same command with --resume continues from its last finished pass'
        raise KeyboardInterrupt(remedy) from None
    print(summary(trained), written, sep='\n')
    if arguments.json:
        _write_judgment(arguments.json, *judgment(trained), quality=trained.model.quality)
    if arguments.report:
        _write_report(arguments, trained, used, warnings)
    return 0


def _update(arguments: argparse.Namespace, written: str) -> int:
    """Extend a model; print what was added, and what was written."""
    unused = [name for name in ('resume', 'force') if getattr(arguments, name)]
    for group in (SegmentConfig, MetricConfig, NetworkConfig):
        unused += options.given(group, arguments)
    if unused:
        option = unused[0].replace('_', '-')
        raise ConfigError(f'--{option} has no effect on --update: leave one of them out')
    from sfa_localization.place_model import PlaceModel
    from sfa_localization.reports.summary import GOOD
    from sfa_localization.updating import update

    model = PlaceModel.load(arguments.update)
    options.require_same_panorama(arguments.config, model.panorama)
    with options.noticed() as warnings:
        updated = update(
            model,
            arguments.bags,
            arguments.output,
            options.recipe(arguments),
            config=options.settings(FilterConfig, arguments),
            watch=options.settings(WatchConfig, arguments),
            progress=True,
            strict=arguments.strict,
        )
    sentence = updated.sentence()
    print(sentence, written, sep='\n')
    if arguments.json:
        _write_judgment(arguments.json, GOOD, sentence)
    if arguments.report:
        _write_update_report(arguments, updated, warnings)
    return 0


def _write_judgment(file: Path, grade: str, sentence: str, **more: Mapping[str, Any]) -> None:
    write_json(file, {'grade': grade, 'sentence': sentence, **more})


def _write_update_report(
    arguments: argparse.Namespace, updated: Updated, warnings: Sequence[str]
) -> None:
    """Write the page about what was added to a model."""
    from sfa_localization.reports.page import PAGE, begin_page
    from sfa_localization.reports.update import write_update_report

    folder = arguments.report
    begin_page(folder)
    title = f'{arguments.update.name}, extended by {", ".join(bag.name for bag in arguments.bags)}'
    write_update_report(folder, title, updated.sentence(), updated.keyframes, warnings)
    print(f'{folder / PAGE}: written')


def _write_report(
    arguments: argparse.Namespace, trained: Trained, used: Recipe, warnings: Sequence[str]
) -> None:
    """Write figures and the page; the worst images are read from the bags again."""
    from sfa_localization.bags.drives import images_at
    from sfa_localization.reports.page import PAGE, begin_page
    from sfa_localization.reports.training import worst_of, write_training_report

    folder = arguments.report
    bags = arguments.bags
    worst = worst_of(trained)
    model = trained.model
    around = replace(used, panorama=model.panorama, surround=model.surround)
    read = [
        images_at(bag, [stamp for run, stamp in worst.values() if run == number], around)
        for number, bag in enumerate(bags)
    ]
    samples = {image: read[run][at] for image, (run, at) in worst.items() if at in read[run]}
    begin_page(folder)
    lens = _lens_picture(bags[0], trained, used)
    write_training_report(folder, trained, samples, lens, warnings)
    print(f'{folder / PAGE}: written')


def _lens_picture(bag: Path, trained: Trained, used: Recipe) -> bytes:
    """An image with the lens drawn in, above its panorama (PNG); empty for panoramas."""
    from sfa_localization.bags.drives import images_at
    from sfa_localization.camera.calibration import check_image
    from sfa_localization.camera.encodings import encode_png
    from sfa_localization.camera.panorama import Unwrapper

    model = trained.model
    run = trained.runs[0]
    if model.lens is None or trained.lens is None:
        return b''
    middle = int(run.panoramas.stamps_ns[len(run.panoramas) // 2])
    image = next(iter(images_at(bag, [middle], used).values()), None)
    unwrapper = Unwrapper(used.camera, model.panorama, model.lens)
    return b'' if image is None else encode_png(check_image(image, unwrapper))
