# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""How the robot moved: whether its sources of motion agree, and what its odometry counts wrongly.

check             which source is faulty, what is corrected, and what to change
  sources            turns and ways that each source measured; two of them compared
  fit                one fit of two sources: scale, delay, drift of a clock, likeness
  gyro, samples      faulty samples
  truth              ground truth and receivers beside the odometry
  breaks             steps of the odometry that no robot can do
dead_reckoning    wheels and gyroscope, with breaks and accumulated errors
turns, odometry_errors     turns and ways corrected by images and by the map
"""
