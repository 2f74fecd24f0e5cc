# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run a command: ``python -m sfa_localization COMMAND ...``, or an executable of its name."""

import sys


def main() -> int:
    """Run a command or node; return the exit code, also if Ctrl-C comes during the import."""
    try:
        from sfa_localization import cli

        return cli.main()
    except KeyboardInterrupt:
        return 130


if __name__ == '__main__':
    sys.exit(main())
