# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filter that fuses odometry with what images show."""
