# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures, right in any light; how they and links of odometry bend graph and map."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cylinder_worlds import Spheres
from metric_worlds import criss_cross, drive, garden_features, meander, mixtures, straight, turn
from numpy.testing import assert_allclose
from places import aligned_errors, as_complex, distances, lengths

from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.geometry import align, compose, wrap_angle
from sfa_localization.data.run import PanoramaArray
from sfa_localization.keyframes.closures import STRETCH_M, Closures, Textures, find_closures
from sfa_localization.keyframes.offsets import find_offsets
from sfa_localization.keyframes.texture import quantized, texture
from sfa_localization.mapping import selection
from sfa_localization.mapping.basis import Process
from sfa_localization.mapping.learning import learn_metric
from sfa_localization.mapping.map_fit import MetricProblem
from sfa_localization.mapping.settings import MetricConfig
from sfa_localization.metric.links import Links
from sfa_localization.metric.loops import with_closures
from sfa_localization.metric.pose_graph import Graph, cost, form_of, graph_poses, proof, refined
from sfa_localization.metric.segments import join
from sfa_localization.metric.stack import SegmentPoses, Stack, tracks
from sfa_localization.sfa.zero_time_edges import edges_between

CONFIG = PanoramaConfig(width=120, height=24)
COUNTER = replace(CONFIG, clockwise=False)
GP = MetricConfig(slow_features=12)


def wander(count, seed):
    """Poses (N, 3) of a winding drive, 0.1 m apart, turned anyhow."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(np.full(count, 0.06)) + seed
    places = np.column_stack([1.6 * np.sin(1.1 * t + seed), 1.6 * np.sin(0.83 * t)])
    return np.column_stack([places, np.cumsum(rng.normal(0, 0.3, count))])


def views(worlds, drives, config=CONFIG, gamma=1.0):
    """Of drives, each in its world; all but the first in another light."""
    textures, run = [], np.repeat(np.arange(len(drives)), list(map(len, drives)))
    for number, (world, poses) in enumerate(zip(worlds, drives, strict=True)):
        images = 255 * (world.panoramas(poses, config) / 255) ** (gamma if number else 1.0)
        textures += [texture(image) for image in images.astype(np.uint8)]
    steps = lengths(np.diff(np.concatenate(drives), axis=0, prepend=drives[0][:1]))
    path_m = np.cumsum(np.where(np.diff(run, prepend=0), 0.0, steps))
    return Textures(quantized(np.stack(textures)), np.arange(len(run)), run, path_m)


@pytest.mark.parametrize('config', [CONFIG, COUNTER])
def test_closures_are_of_the_same_place_and_measure_the_turn(config):
    """Of two drives, and none of a third one elsewhere."""
    poses, home = [wander(250, 0), wander(200, 1), wander(150, 1)], Spheres.about(0)
    seen = views([home, home, Spheres.about(5)], poses, config, gamma=1.8)
    closures = find_closures(seen, config.clockwise)
    true = np.concatenate(poses)
    first, second = closures.images.T
    between, third = seen.run[first] != seen.run[second], second >= 450
    assert not (between & third).any() and between.sum() > 20
    assert (distances(true[first], true[second]) < 0.5).mean() > 0.93
    error = np.abs(wrap_angle(true[second, 2] - true[first, 2] - closures.turn))
    assert np.median(error) < np.radians(1.5)
    way = np.abs(seen.path_m[first] - seen.path_m[second])
    assert (way[~between] >= STRETCH_M).all()
    assert len({tuple(pair) for pair in closures.images.tolist()}) == len(closures)


# --- in the map -------------------------------------------------------------------------------


def in_two_lights():
    """Two drives whose features have nothing in common, as in lights that no feature survives."""
    drives = [
        drive(twists, start, bias=1e-3, yaw_noise=0.01, speed_noise=0.03, seed=seed)
        for seed, (twists, start) in enumerate([criss_cross(12, seed=1), meander(120.0)])
    ]
    parts = [run.segments() for run in drives]
    first = len(drives[0].poses)
    poses = np.vstack([run.poses for run in drives])
    features = np.zeros((len(poses), 12))
    features[:, :6] = garden_features(poses, noise=0.05, count=6)
    features[first:] = 5.0 + garden_features(poses[first:], noise=0.05, world=3)
    return poses, features, join(parts, [0, first])


def true_closures(poses, first):
    """Of a second drive, that begins with image `first`, at every second image of the first."""
    rows, rng = np.arange(0, first, 2), np.random.default_rng(0)
    distance = np.linalg.norm(poses[rows, None, :2] - poses[None, first:, :2], axis=2)
    near, pairs = distance.min(1) < 0.3, np.column_stack([rows, first + distance.argmin(1)])
    turn = wrap_angle(np.diff(poses[pairs[near], 2])[:, 0])
    return Closures(pairs[near], turn + rng.normal(0, 0.005, len(turn)))


def errors_of(images, estimated, poses):
    """Errors (N,) m and (N,) rad of estimated poses (N, 3) of images."""
    frame = align(estimated[:, :2], poses[images, :2])
    far = distances(frame.apply(estimated[:, :2]), poses[images])
    return far, np.abs(wrap_angle(estimated[:, 2] + frame.yaw_rad - poses[images, 2]))


def graph_errors(graph, poses):
    """Errors (N,) m of the images of a graph."""
    images = graph.stack.images
    return errors_of(images, graph_poses(graph, len(poses))[images], poses)[0]


def test_offsets_tie_drives_whose_features_have_nothing_in_common_and_do_not_bend_them(monkeypatch):
    """One offset of seven is wrong."""
    monkeypatch.setattr(selection, 'INDUCING_POINTS', 300)
    poses, features, segments = in_two_lights()
    offsets, rng = mixtures(Stack.of(segments), poses), np.random.default_rng(0)
    lies = rng.random(len(offsets.images)) < 0.15
    turn = np.where(lies[:, None], rng.uniform(-np.pi, np.pi, offsets.turn.shape), offsets.turn)
    images = np.where(lies, rng.permutation(offsets.images), offsets.images)
    offsets = replace(offsets, images=images, turn=turn)
    measured = replace(segments, offsets=offsets)
    results = [learn_metric(each, measured, GP) for each in (features, features[:, ::-1])]
    (far, turned), (other, _) = (errors_of(each.images, each.poses, poses) for each in results)
    assert results[0].graph.certificate.certified and np.allclose(far, other)
    assert far.mean() < 0.25 and turned.mean() < 0.03


def test_offsets_hold_in_any_frame():
    drives = [wander(250, 0), wander(200, 1)]
    seen, poses = views([Spheres.about(0)] * 2, drives), np.concatenate(drives)
    offsets = find_offsets(seen, poses, CONFIG.sphere)
    assert len(offsets.images) > 20
    mixed = (offsets.shares[:, :, None] * poses[offsets.others, :2]).sum(1)
    assert np.median(distances(mixed, poses[offsets.images])) < 0.05
    turn = wrap_angle(poses[offsets.images, None, 2] - poses[offsets.others, 2] - offsets.turn)
    assert np.median(np.abs(turn)) < np.radians(1.0)
    same = find_offsets(seen, compose(np.array([3.0, -1.0, 0.7]), poses), CONFIG.sphere)
    assert np.array_equal(same.images, offsets.images)
    again = (same.shares[:, :, None] * poses[same.others, :2]).sum(1)
    assert_allclose(again, mixed, atol=0.01)


def measured_world(noise_m=0.02, seed=0):
    """Two drives with offsets, each in an odometry frame of its own."""
    poses, _, segments = in_two_lights()
    offsets = mixtures(Stack.of(segments), poses, noise_m, 1000, seed, lasting=True)
    return poses, replace(segments, offsets=offsets)


def test_angles_that_wind_around_a_ring_are_no_minimum():
    """Equal links of a ring have a local minimum there, which is left."""
    count, ring = 12, np.arange(12)
    _, segments = measured_world()
    stack = Stack.of(replace(segments, items=segments.items[:count]))
    wound = np.exp(2j * np.pi * ring / count)
    starts = np.column_stack([np.zeros((count, 2)), np.angle(wound)])
    stack = replace(stack, starts=starts, period=np.zeros(count, int))
    edges = stack.sparse(
        (count + ring, np.ones(count)), (count + np.roll(ring, 1), -np.ones(count))
    )
    form, local = form_of(edges, stack), SegmentPoses(wound, np.zeros(count, complex), np.zeros(1))
    assert cost(form, refined(form, stack, local), stack) > 1.0
    assert not proof(form, local, stack.period).certified
    graph = Graph.solved(form, stack)
    assert graph.certificate.certified and cost(form, graph.poses, stack) < 1e-9


def test_the_graph_errs_as_it_says():
    """Five offsets a meter that err alike by 0.3 m tell little more than one."""
    turned, angle_variances, missed, variances = [], [], [], []
    for seed in range(4):
        poses, segments = measured_world(0.3, seed)
        graph = Graph.of(segments)
        stack, rows = graph.stack, graph.stack.first
        error = np.angle(graph.poses.z) + stack.headings[rows] - poses[stack.images[rows], 2]
        turned.append(wrap_angle(error - np.angle(np.exp(1j * error).mean())))
        angle_variances.append(np.diag(graph.angle_covariance))
        missed.append(graph_errors(graph, poses) ** 2)
        variances.append(graph.variance(np.eye(len(stack.images))[::10]))
    assert 0.5 < np.sqrt(np.mean(np.square(turned)) / np.mean(angle_variances)) < 1.5
    assert np.sqrt(np.mean(missed)) < 0.14  # 0.20 m where each of them counts
    assert np.mean(missed) < np.mean(variances)


def test_odometry_that_turns_wrongly_misleads_no_graph():
    """From where it leads, the least squares end in a wrong minimum."""
    run = drive(*meander(150.0), bias=0.06, yaw_noise=0.05)
    segments = run.segments()
    offsets = mixtures(Stack.of(segments), run.poses, 0.03, count=1000)
    graph = Graph.of(replace(segments, offsets=offsets))
    assert graph.certificate.certified and graph.poses.bias == pytest.approx(0.06, abs=0.01)


def test_what_nothing_ties_is_uncertain():
    _, _, segments = in_two_lights()
    single = Graph.of(replace(segments, items=segments.items[:1]))
    assert single.certificate.certified and abs(single.poses.z[0]) == pytest.approx(1.0)
    graph, first = Graph.of(segments), [s.run for s in segments].count(0)
    between = np.eye(len(segments))[0] - np.eye(len(segments))[first]
    assert graph.certificate.certified
    assert between @ graph.angle_covariance @ between > np.pi**2


def test_a_segment_along_an_earlier_track_has_its_number_and_is_held_out_with_it():
    """A second drive along the same track, somewhat aside."""
    twists, start = criss_cross(8, seed=1)
    aside = (start[0], start[1] + 0.1, start[2])
    drives = [drive(twists, place, yaw_noise=0.002) for place in (start, aside)]
    parts = [run.segments() for run in drives]
    first, half = len(drives[0].poses), len(parts[0])
    closures = true_closures(np.vstack([run.poses for run in drives]), first)
    segments = replace(join(parts, [0, first]), closures=closures)
    track = tracks(segments)
    assert (track[:half] == np.arange(half)).mean() > 0.9
    assert (track[half:] < half).mean() > 0.8
    assert np.median(np.abs(track[half:] - np.arange(len(track) - half))) <= 1
    stack = Stack.of(segments)
    part = selection.folds(stack, 0)
    for number in np.unique(part):
        inside = np.isin(np.arange(len(segments)), stack.owner[part == number])
        assert (inside == inside[track]).all()


def test_doors_of_a_corridor_that_look_alike_close_no_loop():
    run = drive(np.vstack([straight(30.0), turn(np.pi), straight(30.0)]), yaw_noise=0.01)
    segments = run.segments()
    there, back = np.arange(10, 140, 25), len(run.poses) - 1
    true, alike = np.column_stack([there, back - there]), np.column_stack([there[:-1], there[1:]])
    closures = Closures(np.vstack([true, alike]), np.zeros(len(true) + len(alike)))
    assert with_closures(segments, closures).closures.images.tolist() == true.tolist()


# --- links of odometry -------------------------------------------------------------------------


def worse(segments, factor, seed=0):
    """Displacements and turns with errors whose variances are a factor above the stated ones."""
    rng = np.random.default_rng(seed)

    def wrong(item):
        if not item.linked:
            return item
        std = np.sqrt((factor - 1) * item.displacement_variance)
        moved = item.displacement + std * complex(*rng.standard_normal(2))
        turned = item.turn_rad + np.sqrt((factor - 1) * item.turn_variance) * rng.standard_normal()
        return replace(item, displacement=moved, turn_rad=float(turned))

    return replace(segments, items=tuple(wrong(item) for item in segments))


@cache
def recorded():
    """A drive, its segments, features of its images, and the fit of them."""
    run = drive(*meander(250.0, seed=2), yaw_noise=0.01, speed_noise=0.03, seed=2)
    segments = run.segments()
    features = garden_features(run.poses, noise=0.05)
    return run, segments, features, solved(segments, features)


def solved(segments, features):
    problem = MetricProblem.of(features, segments, MetricConfig())
    rows = problem.features
    scale = np.full(rows.shape[1], 1.0 / np.sqrt(rows.var(0).sum()))
    return problem.fit(Process.fit(rows, scale, 1e-2, 300))


def factors(fit):
    """How many times the stated variance each link of a fit has: of turns, of displacements."""
    names = 'turn_variance', 'displacement_variance'
    return [getattr(fit.links, name) / getattr(fit.problem.links, name) for name in names]


def map_error(fit):
    """Mean error of a map, m."""
    places = np.column_stack([fit.places.real, fit.places.imag])
    truth = recorded()[0].poses[fit.stack.images, :2]
    return aligned_errors(places, truth).mean()


def test_links_that_err_by_more_than_they_say_weigh_less_for_the_good_of_the_map(
    monkeypatch,
):
    _, segments, features, right = recorded()
    for factor in factors(right):
        assert 0.8 < np.median(factor) < 1.2 and factor.max() < 3.0
    wrong = worse(segments, 16.0)
    fit = solved(wrong, features)
    for factor in factors(fit):
        assert 5.0 < np.median(factor) < 25.0
    monkeypatch.setattr(Links, 'learned', lambda stated, *_: stated)
    assert map_error(fit) < 0.9 * map_error(solved(wrong, features))


def test_a_wheel_that_slips_costs_single_links():
    _, segments, features, right = recorded()
    slipped = list(segments)
    for n in (10, 40, 70):
        slipped[n] = replace(slipped[n], displacement=slipped[n].displacement + 0.7)
    fit = solved(replace(segments, items=tuple(slipped)), features)
    (_, before), (_, move) = factors(right), factors(fit)
    wrong = np.isin(fit.links.at, (10, 40, 70))
    assert move[wrong].min() > 10.0
    assert np.median(move[~wrong]) < 1.5 * np.median(before)


def test_the_gram_is_what_eq_1_costs_at_the_best_map():
    fit, rng = recorded()[3], np.random.default_rng(0)
    stack, n, ridge = fit.stack, fit.stack.segments, fit.ridge
    bias = 1e-3 * rng.normal(size=stack.period[-1] + 1)
    z = np.exp(1j * rng.uniform(-3, 3, n))
    poses = SegmentPoses(z, as_complex(rng.normal(size=(n, 2))), bias)
    places, y = poses.places(stack), poses.coefficients(stack.period)
    weights = ridge.fitted(places)
    residuals = places - ridge.expanded @ weights
    prior = ridge.basis.ridge @ np.abs(weights) ** 2
    total = ridge.weights @ np.abs(residuals) ** 2 + prior
    assert np.vdot(y, ridge.gram(stack) @ y).real == pytest.approx(total)


# --- in the network ---------------------------------------------------------------------------


@pytest.mark.parametrize('config', [CONFIG, COUNTER])
def test_an_edge_turns_the_second_image_to_the_heading_of_the_first(config):
    rotations, turns = 12, 2 * np.pi / config.width * np.array([0, 7, -30])
    first = np.array([[0.1, 0.2, 0.3], [0.5, -0.4, 2.0], [-1.0, 0.3, -2.0]])
    both = first, first + np.outer(turns, [0, 0, 1])
    drives = [
        PanoramaArray(np.arange(3), Spheres.about(0).panoramas(poses, config)) for poses in both
    ]
    pairs = np.column_stack([np.arange(3), np.arange(3, 6)])
    (edges,) = edges_between(drives, Closures(pairs, turns), rotations, config.clockwise)
    images = edges.panoramas.read(0, 6)
    for a, b in zip(images[::2], images[1::2], strict=True):
        ahead = np.roll(a, config.width // rotations, axis=1).astype(int)
        assert np.abs(b - ahead).mean() < 4.0
        assert np.abs(b - a.astype(int)).mean() > 10.0
    assert edges.joined.tolist() == [True, False, True, False, True]
    inside = Closures(np.array([[0, 2], [3, 5]]), np.zeros(2))
    assert edges_between(drives, inside, rotations, config.clockwise) == []
