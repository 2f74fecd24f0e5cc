# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run a command: ``python -m sfa_localization COMMAND ...``; and what is installed as executables.

Imports the rest inside of functions, because Ctrl-C may come while Python imports it.
"""

import sys

_INTERRUPTED = 130
"""Exit code of a program that SIGINT ended, as shells give it."""


def main() -> int:
    """Run the command or node that the first argument names; return the exit code."""
    try:
        from sfa_localization import cli

        return cli.main()
    except KeyboardInterrupt:
        return _INTERRUPTED


def executable() -> int:
    """Run the command or node with the name of this executable; return the exit code."""
    try:
        from sfa_localization import cli

        return cli.executable()
    except KeyboardInterrupt:
        return _INTERRUPTED


if __name__ == '__main__':
    sys.exit(main())
