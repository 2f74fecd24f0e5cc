# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures and tables of evaluations, trainings and bags."""
