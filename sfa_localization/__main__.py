# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run a command: ``python -m sfa_localization COMMAND ...``."""

import os
import sys


def leave_current_folder() -> None:
    """Import nothing from the folder that `python -m` was started in, unless the package is there.

    It may be a download, in which `yaml.py` would run.
    """
    home = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    try:
        here = os.getcwd()
    except FileNotFoundError:  # it was removed, and nothing can be imported from there
        return
    if sys.path[:1] in ([''], [here]) and not os.path.samefile(home, here):
        del sys.path[0]


if __name__ == '__main__':
    leave_current_folder()
    from sfa_localization.cli import main

    sys.exit(main())
