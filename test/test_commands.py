# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Every option of every command, alone: it parses, it runs, and something comes of it."""

import argparse

import pytest

from sfa_localization import cli, config

GROUPS = {group.__name__: group for group in config.Settings.__subclasses__()}
COMMANDS = {command.name: command for command in cli.COMMANDS}


def parser_of(name: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=name)
    COMMANDS[name].configure(parser)
    return parser


def options() -> list[tuple[str, str]]:
    """Return command and name of every option that there is."""
    return [
        (name, action.option_strings[-1])
        for name in COMMANDS
        for action in parser_of(name)._actions
        if action.option_strings and action.dest != 'help'
    ]


def words_for(action: argparse.Action) -> list[str]:
    """Return words that the action takes, whatever they mean."""
    if action.nargs == 0:
        return []
    one = str(list(action.choices)[-1]) if action.choices else '7'
    count = action.nargs if isinstance(action.nargs, int) else 1
    return [one] * count


@pytest.mark.parametrize(('name', 'option'), options())
def test_an_option_reaches_one_group_of_settings_at_most(name, option):
    """Whichever groups a command reads, an option meant for one never appears in another."""
    parser = parser_of(name)
    (meant,) = (a for a in parser._actions if option in a.option_strings)
    needed = [a for a in parser._actions if a.required and a is not meant]
    needed.sort(key=lambda action: bool(action.option_strings))  # BAG before --topics takes it
    words = [word for a in needed for word in [*a.option_strings[:1], *words_for(a)]]
    words += [option, *words_for(meant)]
    given = parser.parse_args(words)
    reached = {n: told for n, group in GROUPS.items() if (told := cli._given(group, given))}
    group, _, setting = meant.dest.partition('.')
    assert reached == ({group: {setting: vars(given)[meant.dest]}} if setting else {})
