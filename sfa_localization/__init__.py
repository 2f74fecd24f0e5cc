# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Localization from one omnidirectional camera and odometry, learned without ground truth."""

__version__ = '0.1.0'
