# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""From the image of an omnidirectional camera to a panorama that can be trusted."""
