# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of images, odometry, clocks and nodes: what a recorded drive with each of them gives.

`recorded` holds the drive and the model for it, `messages` what a robot hears, `faults` what goes
wrong; `replay` and `live` run it through the Localizer and the three nodes, `frozen` through the
filter alone, `judged` compares with the truth. `promises` lists the tests of each fault.
"""
