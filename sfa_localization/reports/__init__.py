# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Figures and tables of evaluations, trainings and bags."""
