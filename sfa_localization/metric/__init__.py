# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Metric learning: where the drives went, in meters.

points, measured_points     read, judged, and laid on the map
segments          odometry in rigid pieces
  mount              where the camera sits on the robot
  stack              the images, and the unknown poses of segments and yaw-rate biases
  links, loops, point_ties     residuals of odometry, offsets, measured points
  pose_graph         the poses, by these residuals and eq. 1, certified
"""
