# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Meters from slow features and odometry: the certified map."""
