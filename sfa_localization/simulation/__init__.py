# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated garden, and a robot that drives through it."""
