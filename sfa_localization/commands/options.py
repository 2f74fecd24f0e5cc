# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Options from settings classes, settings from options, and checks that commands share."""

from __future__ import annotations

import argparse
import dataclasses
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.config import SECTIONS, load_settings
from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.files import first_bytes, require_outputs, resolved
from sfa_localization.data.settings import Settings

if TYPE_CHECKING:
    from sfa_localization.bags.drives import ReadingRecipe
    from sfa_localization.training import Recipe

S = TypeVar('S', bound=Settings)
R = TypeVar('R', bound='ReadingRecipe')
TOPIC_OPTIONS = {
    'image': '--image-topic',
    'odometry': '--odom-topic',
    'imu': '--imu-topic',
    'points_topic': '--points-topic',
    'ground_truth': '--ground-truth-topic',
}
REPORT_FILES = ('.html', '.md', '.png')
"""Kinds of files in the folder of a report."""


class _Noticed(logging.Handler):
    """Keeps the texts of warnings; where nothing else does, it prints them as without it."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())
        if not logging.getLogger().handlers and logging.lastResort is not None:
            logging.lastResort.handle(record)


@contextmanager
def noticed() -> Iterator[list[str]]:
    """The warnings of the package meanwhile, for the page: it says what the terminal has said."""
    handler = _Noticed()
    package = logging.getLogger('sfa_localization')
    package.addHandler(handler)
    try:
        yield handler.texts
    finally:
        package.removeHandler(handler)


def require_output(output: Path, inputs: Iterable[Path | None], *suffixes: str) -> None:
    """Raise LocalizationError if an output replaces an input or a file of another suffix."""
    from sfa_localization.bags.recording import recorded_files

    require_outputs([output], [file for path in inputs if path for file in recorded_files(path)])
    require_kind(output, *suffixes)


def require_kind(output: Path, *suffixes: str) -> None:
    """Raise LocalizationError if an output, or what it links to, is a file of another suffix."""
    replaced = resolved(output)
    if first_bytes(replaced) and replaced.suffix.lower() not in suffixes:
        kinds = ' or '.join(suffixes)
        raise LocalizationError(f'{output}: is there and no {kinds} file: give another name')


def require_new(output: Path) -> None:
    """Raise LocalizationError if an output would replace any file."""
    require_outputs([output], [])
    if first_bytes(output):
        raise LocalizationError(f'{output}: is there: give another name, or remove it')


def require_report(folder: Path | None, other: Path | None) -> None:
    """Raise LocalizationError if a report has no folder, or replaces files of the user."""
    if folder is None:
        return
    from sfa_localization.reports.page import MARK, PAGE

    if folder.exists() and not folder.is_dir():
        raise LocalizationError(f'{folder}: is no folder: give --report another name')
    if MARK.encode() not in first_bytes(folder / PAGE):
        for file in sorted(folder.glob('*')):
            if file.suffix.lower() in REPORT_FILES and first_bytes(file):
                raise LocalizationError(f'{file}: is no report: give --report another folder')
    if other is not None:
        place = resolved(folder)
        file = resolved(other)
        in_report = file.parent == place and file.suffix.lower() in REPORT_FILES
        if in_report or file in (place, *place.parents):
            raise LocalizationError(f'{other}: named for two outputs: give each its own')


def add_settings(
    parser: argparse.ArgumentParser, group: type[Settings], names: Sequence[str] = ()
) -> None:
    """Add an option --some-name for each named setting of the group, without names for all."""
    for item in dataclasses.fields(group):
        if names and item.name not in names:
            continue
        unit = f' ({item.metadata["unit"]})' if item.metadata['unit'] else ''
        parser.add_argument(
            f'--{item.name.replace("_", "-")}',
            dest=destination(group, item.name),
            metavar=None if item.metadata['choices'] else item.name.upper(),
            type=numbers if isinstance(item.default, tuple) else type(item.default),
            choices=item.metadata['choices'] or None,
            default=argparse.SUPPRESS,
            help=f'{item.metadata["doc"]}{unit} [{_text(item.default)}]',
        )


def numbers(text: str) -> tuple[float, ...]:
    """Parse numbers joined by x, as in 16x18."""
    try:
        return tuple(float(part) for part in text.split('x'))
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r} is not like 16x18') from None


def _text(default: object) -> str:
    return 'x'.join(f'{part:g}' for part in default) if isinstance(default, tuple) else str(default)


def add_topics(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add the options that choose topics, by the names of TopicNames."""
    docs = {item.name: item.metadata['doc'] for item in dataclasses.fields(TopicNames)}
    for name in names:
        parser.add_argument(
            TOPIC_OPTIONS[name],
            dest=destination(TopicNames, name),
            metavar='T',
            default=argparse.SUPPRESS,
            help=docs[name],
        )


def destination(group: type[Settings], name: str) -> str:
    """Return the parser's name of a setting, which includes the group: names may repeat."""
    return f'{group.__name__}.{name}'


def given(group: type[Settings], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the group that were given on the command line."""
    names = {destination(group, item.name): item.name for item in dataclasses.fields(group)}
    return {names[key]: value for key, value in vars(arguments).items() if key in names}


def settings(group: type[S], arguments: argparse.Namespace) -> S:
    """Return the group's settings: the command line overrides the parameter file."""
    path = getattr(arguments, 'config', None)
    section = next((name for name, kinds in SECTIONS.items() if group in kinds), '')
    base = load_settings(path, section, group) if path and section else group()
    from_file = dataclasses.asdict(base)
    return group.from_mapping({**from_file, **given(group, arguments)}, 'command line')


def recipe(arguments: argparse.Namespace) -> Recipe:
    """Return the training recipe of --config and of the command line."""
    from sfa_localization.training import Recipe

    return recipe_of(Recipe, arguments)


def recipe_of(kind: type[R], arguments: argparse.Namespace) -> R:
    """Return a recipe whose groups of settings are those of --config and of the command line."""
    default = kind()
    chosen: dict[str, Any] = {}
    for item in dataclasses.fields(kind):
        group = getattr(default, item.name)
        if isinstance(group, Settings):
            chosen[item.name] = settings(type(group), arguments)
    return kind(**chosen)


def require_same_panorama(path: Path | None, trained: PanoramaConfig) -> None:
    """Raise ConfigError for a parameter file with other panoramas than those of the training."""
    if path is None:
        return
    declared = load_settings(path, 'omnicam_node', PanoramaConfig)
    # Recorded panoramas keep their size.
    declared = dataclasses.replace(declared, width=trained.width, height=trained.height)
    differences = trained.asked_differences(declared)
    if differences:
        raise ConfigError(
            f'{path}: omnicam_node: panoramas would differ from those of training: {differences}'
        )
