# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Unsupervised metric learning against worlds whose every place is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from metric_worlds import (
    RATE,
    criss_cross,
    drive,
    exact_features,
    garden_features,
    grid,
    lanes,
    meander,
    straight,
    turn,
)
from places import aligned_errors, distances, lengths

from sfa_localization.data.errors import ConfigError, DataError
from sfa_localization.data.geometry import RigidTransform, align, compose, invert, wrap_angle
from sfa_localization.mapping import paper_solver, selection
from sfa_localization.mapping.basis import monomials
from sfa_localization.mapping.learning import learn_metric
from sfa_localization.mapping.map_fit import MetricProblem
from sfa_localization.mapping.paper_solver import Lines, mirrored, odometry_start
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric import pose_graph
from sfa_localization.metric.pose_graph import Certificate
from sfa_localization.metric.segments import assignment, join
from sfa_localization.metric.stack import Stack
from sfa_localization.motion.settings import SegmentConfig

ANY = SegmentConfig()
STRAIGHT = SegmentConfig(segments='straight')
EXACT = MetricConfig(metric_map='monomials', slow_features=5)
GP = MetricConfig(slow_features=12)
LINES, LINES_START = criss_cross(10)
CURVES, CURVES_START = meander(150.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Few inducing points, as the worlds are small; no ridge, as monomials are exact in them."""
    monkeypatch.setattr(selection, 'INDUCING_POINTS', 300)
    monkeypatch.setattr(selection, 'RIDGE', 0.0)


def without(segments, *names):
    """The same segments with links of turns or displacements that have no weight."""
    unused = {f'{name}_variance': np.inf for name in names}
    items = tuple(replace(s, **unused) for s in segments)
    return replace(segments, items=items)


LINKS = ('turn', 'displacement')


@cache
def lines_drive():
    return drive(LINES, LINES_START)


@cache
def curved_drive():
    return drive(CURVES, CURVES_START)


def noisy_drive(twists, start, seed=0, bias=1.4e-3):
    return drive(twists, start, bias=bias, yaw_noise=0.01, speed_noise=0.03, seed=seed)


def in_odometry_frame(run):
    """True poses (N, 3) as the odometry would have them had it not drifted."""
    return compose(invert(run.poses[0]), run.poses)


ALL = MetricConfig(metric_map='monomials')
MODES = {
    'lines': (lines_drive, STRAIGHT, EXACT, ()),
    'curves without links': (curved_drive, ANY, EXACT, LINKS),
    'as many features as there are': (lines_drive, STRAIGHT, ALL, ()),
}


@pytest.mark.parametrize('mode', MODES)
def test_noiseless_data_gives_no_error(mode):
    make, cutter, config, unused = MODES[mode]
    run = make()
    segments = without(run.segments(cutter), *unused)
    result, truth = (
        learn_metric(exact_features(run.poses), segments, config),
        in_odometry_frame(run),
    )
    predicted, _ = result.map.predict(exact_features(run.poses))
    assert np.abs(predicted - truth[:, :2]).max() < 1e-9
    missed = result.poses - truth[result.images]
    assert np.abs(missed[:, :2]).max() < 1e-9 and np.abs(wrap_angle(missed[:, 2])).max() < 1e-9
    assert result.graph.certificate.certified and np.abs(result.residuals).max() < 1e-9
    # A left-out segment that nothing links is held by rounding alone.
    assert result.held_out_error_m < 1e-7


def test_without_ground_truth_it_is_far_better_than_the_odometry():
    """By images of an unseen drive, where it comes within a meter of the trained places."""
    run = noisy_drive(*criss_cross(24, seed=2))
    segments, true = run.segments(STRAIGHT), run.poses[:, :2]
    result = learn_metric(garden_features(true, noise=0.05), segments, GP)
    unseen = drive(*meander(120.0, seed=77)[:1]).poses[:, :2]
    unseen = unseen[[distances(true, place).min() < 1.0 for place in unseen]]
    frame = align(result.poses[:, :2], true[result.images])
    predicted, _ = result.map.predict(garden_features(unseen, noise=0.05, seed=9))
    reckoned = run.odometry.poses[::10]
    odometry = aligned_errors(reckoned, true).mean()
    assert distances(frame.apply(predicted), unseen).mean() < min(0.15, 0.5 * odometry)
    assert result.graph.certificate.certified


@cache
def noisy_result():
    run = noisy_drive(*meander(200.0, seed=4), seed=4)
    segments = run.segments(ANY)
    features = garden_features(run.poses, noise=0.05)
    return run, segments, features, learn_metric(features, segments, GP)


BIASES = np.array([1.4e-3, -2e-3, 1e-3, 3e-3])
"""rad/s, of one minute each."""


def test_a_bias_that_changes_every_minute_is_learned():
    twists, start = meander(200.0, seed=4)
    bias = np.repeat(BIASES, 60 * RATE)[: len(twists) + 1]
    run = noisy_drive(twists, start, seed=4, bias=bias)
    features = garden_features(run.poses, noise=0.05)
    segments = join([run.segments(ANY)], [0])
    result = learn_metric(features, segments, GP)
    yaw_error = wrap_angle(result.poses[:, 2] - in_odometry_frame(run)[result.images, 2])
    assert result.graph.poses.bias == pytest.approx(BIASES, abs=4e-4)
    assert result.graph.certificate.certified and yaw_error.std() < 0.02


def test_the_map_is_the_odometry_frame_at_the_start_and_a_start_pose_moves_it():
    run, segments, features, result = noisy_result()
    start = result.images < 40
    missed = (result.poses - in_odometry_frame(run)[result.images])[start]
    assert lengths(missed).mean() < 0.15
    assert np.abs(wrap_angle(missed[:, 2])).mean() < np.deg2rad(1.5)
    frame = RigidTransform(5.0, -2.0, 2.0)
    moved = learn_metric(features, segments, replace(GP, start_pose=(5.0, -2.0, 2.0)))
    expected = frame.apply(result.map.predict(features)[0])
    assert np.allclose(moved.map.predict(features)[0], expected, atol=1e-6)
    assert np.allclose(moved.poses[:, :2], frame.apply(result.poses[:, :2]))
    *worst, error = result.forecast.worst
    assert moved.forecast.worst == pytest.approx([*frame.apply(np.array([worst]))[0], error])
    for pose, why in (((1.0,), 'give x'), ((1.0,) * 4, 'give x'), ((1.0, 2.0, 90.0), 'radians')):
        with pytest.raises(ConfigError, match=f'start_pose: .*{why}'):
            MetricConfig(start_pose=pose)


def test_the_common_error_of_positions_is_about_as_large_as_they_err():
    claimed, true = [], []
    for seed in range(3):
        course = criss_cross(25, half=(5.0, 5.0), seed=seed, shortest=5.0)
        run = noisy_drive(*course, seed=seed)
        segments = run.segments(ANY)
        features = garden_features(run.poses, noise=0.05)
        result = learn_metric(features, segments, GP)
        true.append((aligned_errors(result.poses, run.poses[result.images]) ** 2).mean())
        claimed.append(2 * result.map.common_m**2 / result.map.inflation)
    # What no drive can show, such as a wrong wheel radius, is not in it.
    assert 0.55 < np.sqrt(np.mean(claimed) / np.mean(true)) < 1.3


def test_two_runs_share_a_map():
    runs = noisy_drive(*criss_cross(10, seed=1), seed=1), noisy_drive(*meander(80.0), seed=2)
    poses = np.vstack([run.poses for run in runs])
    parts = [run.segments(ANY) for run in runs]
    segments = join(parts, [0, len(runs[0].poses)])
    result = learn_metric(garden_features(poses, noise=0.05), segments, GP)
    assert aligned_errors(result.poses, poses[result.images]).mean() < 0.2
    minutes = [np.ptp(run.stamps_ns) / 60e9 for run in runs]
    assert len(result.graph.poses.bias) == np.ceil(minutes).sum()
    used = np.flatnonzero(assignment(segments, len(poses)) >= 0)
    assert np.array_equal(used, np.sort(result.images))


# --- what cannot be learnt, and what must not be believed -------------------------------------


def test_straight_lines_are_refused_without_turns_and_lanes_without_crossings_are_one_route():
    for twists, crossed in ((grid(10.0, 1.2, 9), True), (lanes(10.0, 1.2, 9), False)):
        run = drive(twists)
        segments = run.segments(STRAIGHT)
        features = exact_features(run.poses - [3.0, 3.0, 0.0])
        with pytest.raises(DataError, match='breaks between all straight lines'):
            learn_metric(features, without(segments, *LINKS), EXACT)
        result = learn_metric(features, segments, EXACT)
        assert result.diagnostics.single_route != crossed
        assert distances(result.map.predict(features)[0], in_odometry_frame(run)).max() < 1e-6


def test_too_few_segments_and_features_that_say_nothing_are_refused():
    run = drive(np.vstack([straight(5.0), turn(1.0), straight(5.0)]))
    segments = run.segments(STRAIGHT)
    with pytest.raises(DataError, match='only 2 segments'):
        learn_metric(exact_features(run.poses), segments, EXACT)
    run = curved_drive()
    segments = run.segments(ANY)
    noise = np.random.default_rng(0).standard_normal((len(run.poses), 5))
    with pytest.raises(DataError, match=r'uncertain|cover|directions|not proven'):
        learn_metric(noise, without(segments, *LINKS), EXACT)


def test_unusable_features_are_named():
    run = lines_drive()
    segments = run.segments(STRAIGHT)
    features = exact_features(run.poses)
    holed = features.copy()
    holed[60] = np.nan
    for spoilt, message in (
        (features[:10], 'one row per image'), (holed, 'of 1 images are not finite'),
        (np.ones_like(features), 'constant'), (features[:, :3], 'only 3'),
    ):  # fmt: skip
        with pytest.raises(DataError, match=message):
            learn_metric(spoilt, segments, EXACT)


def test_an_unproven_map_is_rejected(monkeypatch):
    """Odometry that contradicts the images so is hard to make; the proof is taken away."""
    monkeypatch.setattr(pose_graph, 'proof', lambda *_: Certificate(-1.0))
    run = lines_drive()
    segments = run.segments(STRAIGHT)
    with pytest.raises(DataError, match='not proven to be optimal'):
        learn_metric(exact_features(run.poses), segments, EXACT)


# --- the paper's solver through the same door ------------------------------------------------


def test_the_papers_cosine_cannot_tell_a_mirror_image_but_the_signs_can():
    run = noisy_drive(LINES, LINES_START, bias=0.0)
    segments = run.segments(STRAIGHT)
    stack = Stack.of(segments)
    turns = np.array([s.turn_rad for s in segments.items[:-1]])
    regressors = monomials(exact_features(run.poses)[stack.images])
    lines = Lines(regressors, stack.path.real, stack.owner, turns)
    theta = odometry_start(lines, stack.starts)
    assert lines.cost(mirrored(lines, theta)) == pytest.approx(lines.cost(theta), rel=1e-9)
    # Odometry that starts mirrored would lead the descent there; learn_metric() turns it back.
    flipped = replace(
        segments,
        items=tuple(replace(s, start=s.start * [1, -1, -1]) for s in segments),
    )
    config = replace(EXACT, solver='paper')
    fit = paper_solver.learn(MetricProblem.of(exact_features(run.poses), flipped, config))
    step = np.diff(np.angle(fit.graph.poses.z))
    assert np.cos(step - turns).mean() > 0.99
