# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: where an image was taken, by training images of known poses."""
