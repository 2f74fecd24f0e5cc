# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Meters from slow features and odometry: the certified map.

drives            odometry of all drives, corrected by what images show, cut, learned from
  points, anchors    measured points: read, judged, laid on the map
  motion_check, motion_sources     whether all sources of a drive's motion agree
  dead_reckoning, odometry_errors, segments     odometry, corrected, in rigid pieces
learning          the map of segments and features, of slow ones and of turned maps
  stack              the unknowns, [o, z, -b z]: origins, directions and yaw-rate biases
  links, loops, anchors     rows of them: odometry, loop closures, measured points
  pose_graph         where closures or points tie a drive: sparse, certified
  quadratic_form, phases    where nothing does: from eq. 1 with the map, dense, certified
  paper_solver       the descent of the paper, for comparison
  basis, map_fit, selection     the map: regression, evidence, parts left out
  drive_check, forecast, fitted_map, saved_map     what it is worth, and what models save
turned_maps, keyframe_map     the map and keyframes that a model locates images by
"""
