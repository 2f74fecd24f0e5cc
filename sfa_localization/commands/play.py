# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag through ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfa_localization.commands import options
from sfa_localization.commands.settings import PlayConfig

WRITES = 'no file: it publishes'
EXAMPLES = """\
  play bags/sample
  play bags/sample --rate 2 --loop --clock
  play bags/sample --topics /panorama/compressed /odom"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bag, topics and pace."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='bag: a folder or a single file')
    parser.add_argument('--loop', action='store_true', help='start again at the end')
    parser.add_argument(
        '--clock', action='store_true', help='publish the time of the bag on /clock'
    )
    parser.add_argument('--topics', nargs='+', default=(), metavar='T', help='only these topics')
    options.add_settings(parser, PlayConfig)


def run(arguments: argparse.Namespace) -> int:
    """Replay; print the number of messages by topic."""
    from sfa_localization.commands.bag_player import play

    played = play(
        arguments.bag,
        options.settings(PlayConfig, arguments),
        loop=arguments.loop,
        clock=arguments.clock,
        topics=arguments.topics,
    )
    for topic, count in sorted(played.items()):
        print(f'{topic}: {count} messages')
    return 0
