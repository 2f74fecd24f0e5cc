# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Data types that all rooms share: drives, poses, errors, files, settings. Numpy only."""
