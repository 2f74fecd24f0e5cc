# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write an evaluated drive as the nodes would have published it, to open in RViz or Foxglove."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from sfa_localization.bags.writer import BagWriter
from sfa_localization.data.geometry import invert
from sfa_localization.data.run import BATCH
from sfa_localization.evaluation import Evaluation
from sfa_localization.mapping.driven_ground import LINE_M, DrivenGround
from sfa_localization.mapping.settings import GroundConfig

_MAP = 'map'
_TRUTH = 'world'


def write_replay(path: Path, result: Evaluation, ground: DrivenGround) -> None:
    """Write a bag of the topics of the nodes, and the ground truth as /ground_truth.

    Estimates are in the frame map, the truth in world; /tf_static holds the transform between them.
    ekf/path holds the whole drive from the start. Raises BagError, also if `path` exists.
    """
    start_ns = result.steps[0].stamp_ns
    with BagWriter(path) as bag:
        bag.static_transform(start_ns, invert(result.transform.pose), (_MAP, _TRUTH))
        cells = ground.cells(GroundConfig())
        bag.grid('/sfa/map', start_ns, cells.driven, cells.corner, cells.size_m, _MAP)
        ends = ground.places[ground.lines.ravel()]
        bag.lines('/sfa/map_paths', start_ns, ends, ground.red, LINE_M, _MAP)
        states = [step.state for step in result.steps if step.state and step.image is None]
        if states:
            stamps_ns = np.array([start_ns, *(state.stamp_ns for state in states)])
            poses = np.array([states[0].pose, *(state.pose for state in states)])
            bag.trail('/ekf/path', stamps_ns, poses, _MAP)
        for stamp_ns, pose in zip(result.truth.stamps_ns.tolist(), result.truth.poses, strict=True):
            bag.pose('/ground_truth', stamp_ns, np.nan_to_num(pose), _TRUTH)
        _write_steps(bag, result)


def _write_steps(bag: BagWriter, result: Evaluation) -> None:
    """Write images and estimates; the state where it changes."""
    images = chain.from_iterable(result.run.panoramas.batches(BATCH))
    before = ''
    for step in result.steps:
        if step.image is not None:
            panorama = next(images)
            bag.image('/panorama/compressed', step.stamp_ns, panorama, 'omnicam', 'jpeg')
            seen = step.image
            if np.isfinite(seen.slow_features).all():
                bag.array('/sfa/slow_features', step.stamp_ns, seen.slow_features)
            bag.estimate('/sfa/pose_with_covariance', step.stamp_ns, seen.pose, seen.covariance)
            if state := step.state:
                bag.estimate('/ekf/pose', step.stamp_ns, state.pose, state.pose_covariance)
            continue
        if str(step.status) != before:
            before = str(step.status)
            bag.text('/ekf/state', step.stamp_ns, before)
        if state := step.state:
            pose = state.pose, state.pose_covariance
            twist = state.twist, state.twist_covariance
            bag.estimate('/ekf/odometry', step.stamp_ns, *pose, *twist)
