# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Segments: both cutters against drives whose every pose is known."""

from dataclasses import replace

import numpy as np
import pytest
from metric_worlds import criss_cross, drive, meander, stand, straight, turn
from places import as_complex

from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import compose, relative, wrap_angle
from sfa_localization.data.run import Odometry, YawRate
from sfa_localization.metric import segments as segments_module
from sfa_localization.metric.segments import PIECE_LENGTH_M, cut
from sfa_localization.motion.settings import SegmentConfig

ANY = SegmentConfig()
STRAIGHT = SegmentConfig(segments='straight')
SQUARE = np.vstack([straight(5.0), turn(np.pi / 2)] * 4)


def length_m(segment):
    return np.abs(np.diff(segment.path)).sum()


def picked(odometry, keep):
    return Odometry(*(getattr(odometry, name)[keep] for name in Odometry.__slots__))


def check_segments(segments, poses, tolerance=1e-6):
    """Paths, headings, turns and displacements against the truth."""

    def frame(segment):
        return poses[segment.images[0]] - [0.0, 0.0, segment.headings[0]]

    for segment in segments:
        local = relative(frame(segment), poses[segment.images])
        assert np.allclose(segment.path, as_complex(local), atol=tolerance)
        assert np.allclose(wrap_angle(segment.headings - local[:, 2]), 0, atol=tolerance)
    for a, b in zip(segments.items[:-1], segments.items[1:], strict=True):
        step = relative(frame(a), frame(b))
        assert abs(wrap_angle(a.turn_rad - step[2])) < tolerance
        assert abs(a.displacement - (step[0] + 1j * step[1])) < tolerance


def test_a_square_gives_its_four_sides():
    run = drive(SQUARE)
    silent = replace(run.odometry, twists=np.zeros_like(run.odometry.twists))
    elsewhere = compose(np.array([30.0, -7.0, 2.5]), run.odometry.poses)
    for odometry in (run.odometry, silent, replace(run.odometry, poses=elsewhere)):
        segments = cut(odometry, run.stamps_ns, STRAIGHT)
        assert [round(length_m(s), 1) for s in segments] == pytest.approx([4.8] * 4, abs=0.25)
        turns = [s.turn_rad for s in segments.items[:-1]]
        assert turns == pytest.approx([np.pi / 2] * 3, abs=1e-6)
        assert not segments[3].linked
        check_segments(segments, run.poses)


def test_pieces_of_a_curved_drive_follow_the_truth():
    run = drive(*meander(60.0, seed=3))
    segments = run.segments(ANY)
    assert all(length_m(s) <= PIECE_LENGTH_M + 1e-6 for s in segments)
    assert segments.images.used == len(run.stamps_ns)
    check_segments(segments, run.poses)
    slow = picked(run.odometry, slice(None, None, 30))
    segments = cut(slow, run.stamps_ns, ANY)
    assert 'pauses' not in segments.odometry.skipped, 'not at each message'
    assert segments.images.used > 0.8 * len(run.stamps_ns)


@pytest.mark.parametrize('config', [ANY, STRAIGHT])
def test_every_picture_is_used_once_or_counted(config):
    twists, start = criss_cross(6)
    run = drive(np.vstack([twists, stand(5.0)]), start)
    stamps = np.concatenate([[0], run.stamps_ns, [10**12, 2 * 10**12]])
    segments = cut(run.odometry, stamps, config)
    images = np.concatenate([s.images for s in segments])
    assert len(np.unique(images)) == len(images) == segments.images.used
    assert segments.images.used + sum(segments.images.skipped.values()) == len(stamps)
    assert segments.images.skipped['without odometry'] == 3


def test_a_standing_robot_does_not_break_the_line_and_a_pause_of_the_odometry_does():
    run = drive(np.vstack([straight(4.0), stand(4.0), straight(12.0)]))
    segments = run.segments(ANY)
    assert segments.images.skipped['standing still'] == pytest.approx(20, abs=2)
    assert sum(length_m(s) for s in segments) > 14.9
    assert all(s.linked for s in segments.items[:-1])
    rows = np.arange(len(run.odometry.stamps_ns))
    segments = cut(picked(run.odometry, (rows < 600) | (rows >= 700)), run.stamps_ns, ANY)
    assert segments.odometry.skipped == {'pauses': 1}
    assert segments.images.skipped['in a break of odometry'] == pytest.approx(10, abs=1)
    assert sum(not s.linked for s in segments) == 2


def test_the_gyro_replaces_the_wheels_yaw():
    run, biased = drive(meander(40.0)[0]), drive(meander(40.0)[0], bias=0.02)
    segments = biased.segments(ANY, run.gyro)
    check_segments(segments, run.poses, tolerance=1e-2)
    wheels = cut(biased.odometry, biased.stamps_ns, replace(ANY, yaw_source='odometry'), run.gyro)
    assert abs(wheels[0].turn_rad - segments[0].turn_rad) > 0.02
    with pytest.raises(DataError, match='imu topic'):
        run.segments(replace(ANY, yaw_source='gyro'))


def test_where_the_gyro_pauses_the_wheels_go_on():
    """From 2 to 10 s, and in the end."""
    run, bias = drive(np.vstack([SQUARE, SQUARE])), 0.02
    seconds = (run.gyro.stamps_ns - run.gyro.stamps_ns[0]) * 1e-9
    keep = (seconds < 2.0) | ((seconds > 10.0) & (seconds < 35.0))
    columns = run.gyro.stamps_ns, run.gyro.omega + bias, run.gyro.variance
    gyro = YawRate(*(column[keep] for column in columns))
    segments = run.segments(STRAIGHT, gyro)
    assert segments.odometry.skipped['in a gap of the gyroscope'] > 0
    turns = [s.turn_rad - bias * s.turn_time_s for s in segments.items[:-1]]
    assert turns == pytest.approx([np.pi / 2] * 7, abs=0.01)


def test_links_err_as_they_or_the_messages_say(monkeypatch):
    """Straight ahead, with noise of the yaw rate alone."""
    monkeypatch.setattr(segments_module, 'PIECE_STD_M', 10.0)
    config, squared = replace(ANY, yaw_noise=0.05), []
    for seed in range(20):
        run = drive(straight(30.0), yaw_noise=0.05 * np.sqrt(50), seed=seed)
        squared += [
            (s.turn_rad**2 / s.turn_variance, s.displacement.imag**2 / s.displacement_variance)
            for s in run.segments(config)
            if s.linked
        ]
    assert np.mean(squared, axis=0) == pytest.approx([1.0, 1.0], abs=0.25)
    stated = replace(run.odometry, variances=np.full((len(run.odometry.poses), 2), 4.0))
    link = cut(stated, run.stamps_ns, config)[0]
    # 4 rad^2/s^2 per message of 0.02 s: 4 * 0.02^2 rad^2 each, over 3 s of messages.
    assert link.turn_variance == pytest.approx(4.0 * 0.02**2 * 3.0 * 50, rel=0.1)


def test_a_drive_without_segments_says_what_to_do():
    for twists, config, remedy in (
        (stand(10.0), ANY, 'robot drives'),
        (turn(6.0), STRAIGHT, 'straight lines'),
    ):
        run = drive(twists)
        with pytest.raises(DataError, match=remedy):
            run.segments(config)
