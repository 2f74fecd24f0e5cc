# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Run a command: ``python -m sfa_localization COMMAND ...``."""

import sys

from sfa_localization.cli import main

if __name__ == '__main__':
    sys.exit(main())
