# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The three ROS 2 nodes: thin shells that convert, call the core and publish."""
