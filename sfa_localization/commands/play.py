# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag through ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

from sfa_localization.commands.options import add_settings, settings
from sfa_localization.commands.pace import PlayConfig
from sfa_localization.commands.processes import terminable

WRITES = 'no file: it publishes'
EXAMPLES = """\
  play bags/sample
  play bags/sample --rate 2 --loop --clock
  play bags/sample --start-offset 10 --topics /panorama/compressed /odom

keys: space pauses, s or right arrow plays one message, up and down change the rate,
Ctrl-C ends the replay"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bag, topics and pace."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='bag: a folder or a single file')
    parser.add_argument('--loop', action='store_true', help='start again at the end')
    parser.add_argument(
        '--clock', action='store_true', help='publish the time of the bag on /clock'
    )
    parser.add_argument('--topics', nargs='+', default=(), metavar='T', help='only these topics')
    parser.add_argument(
        '--wait-for',
        nargs='+',
        default=(),
        metavar='T',
        help='topics that need a subscriber first; none: one of images and one of odometry',
    )
    parser.add_argument('--strict', action='store_true', help='reject a damaged bag')
    add_settings(parser, PlayConfig)


def run(arguments: argparse.Namespace) -> int:
    """Replay; print the number of messages by topic."""
    with terminable():
        from sfa_localization.commands.bag_player import play

    played = play(
        arguments.bag,
        config=settings(PlayConfig, arguments),
        loop=arguments.loop,
        clock=arguments.clock,
        topics=arguments.topics,
        wait_for=arguments.wait_for,
        strict=arguments.strict,
    )
    for topic, count in sorted(played.messages.items()):
        print(f'{topic}: {count} messages')
    return 0
