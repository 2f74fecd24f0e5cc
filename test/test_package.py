# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
def test_placeholder():
    import sfa_localization
    assert sfa_localization.__version__
