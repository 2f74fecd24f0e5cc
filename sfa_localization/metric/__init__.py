# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Meters from slow features and odometry: the certified map.

drives            odometry of all drives, corrected by what images show, cut, learned from
  points, measured_points     read, judged, and laid on the map
  motion_check, motion_sources     whether all sources of a drive's motion agree
  dead_reckoning, odometry_errors, segments     odometry, corrected, in rigid pieces
learning          the map of segments and features, of slow ones and of turned maps
  stack              the images, and the unknown poses of segments and yaw-rate biases
  links, loops, measured_points     residuals of odometry, offsets, measured points
  pose_graph         the poses, by these residuals and eq. 1, certified
  paper_solver       the descent of the paper, for comparison
  basis, ridge, map_fit, selection     the map: regression, evidence, held-out parts
  drive_check, forecast, fitted_map, saved_map     what it is worth, and what models save
turned_maps, keyframe_map     the map and keyframes that a model locates images by
"""
