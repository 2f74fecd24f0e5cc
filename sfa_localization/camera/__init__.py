# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Panoramas from images of an omnidirectional camera, and whether they are usable."""
