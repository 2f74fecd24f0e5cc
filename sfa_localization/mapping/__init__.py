# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The map from slow features to poses: fitted to segments, certified, saved.

drives            odometry of all drives, corrected by what images show, cut, learned from
learning          the map of segments and features, of slow ones and of turned maps
  basis, ridge, map_fit, selection     regression, evidence, held-out parts
  paper_solver       the descent of the paper, for comparison
  drive_check, forecast, fitted_map, saved_map     what it is worth, and what models save
turned_maps, keyframe_map     the map and keyframes that a model locates images by
driven_ground     the ground of the training as a map of cells
"""
