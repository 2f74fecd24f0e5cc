# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Hierarchical Slow Feature Analysis: from panoramas to slow features."""
