# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Reading and writing of recorded bags, damaged ones too."""
