# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of the command line, a module each, and the parts of `play` and `demo`."""
