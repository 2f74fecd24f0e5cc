# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Transforms that hold for a while ahead, and are right at every odometry's stamp all the same."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from transform_buffer import TransformBuffer

from sfa_localization.nodes.broadcast import Broadcast

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
CASES = {
    'steady': lambda n, rng: np.full(n, 20_000_000),
    'whole nanoseconds apart': lambda n, rng: np.full(n, 500),
    'jittering': lambda n, rng: rng.integers(1_000_000, 60_000_000, n),
    'with gaps': lambda n, rng: np.where(np.arange(n) % 20, 20_000_000, 3 * SECOND_NS),
}


def sent(stamps_ns, poses, ahead_ns):
    """The buffer of a listener after each message, and what was looked up at once."""
    broadcast, buffer, at_once = Broadcast(), TransformBuffer(), []
    for stamp_ns, pose in zip(stamps_ns.tolist(), poses, strict=True):
        dated = broadcast.add(stamp_ns, pose, ahead_ns)
        assert ahead_ns or len(dated) == 1, 'as config/README.md says'
        for each in dated:
            buffer.insert(*each)
        at_once.append(buffer.lookup(stamp_ns))
    return buffer, np.array(at_once)


@pytest.mark.parametrize('case', CASES)
def test_a_lookup_at_odometry_is_what_was_right_then_at_once_and_later(case):
    for ahead_s in (0.0, 0.01, 0.1, 0.137, 1.0):
        rng = np.random.default_rng(4)
        stamps_ns = START_NS + np.cumsum(CASES[case](200, rng))
        # Corrections that jump now and then, as images make them.
        poses = np.cumsum(rng.normal(0, 0.2, (200, 3)) * (rng.random((200, 1)) < 0.2), axis=0)
        buffer, at_once = sent(stamps_ns, poses, round(ahead_s * SECOND_NS))
        assert np.allclose(at_once, poses, atol=1e-9)
        kept = stamps_ns > buffer.newest_ns - 9 * SECOND_NS
        later = [buffer.lookup(stamp_ns) for stamp_ns in stamps_ns[kept].tolist()]
        assert np.allclose(later, poses[kept], atol=1e-9)
        assert buffer.newest_ns >= stamps_ns[-1] + round(ahead_s * SECOND_NS)
        assert np.allclose(buffer.lookup(buffer.newest_ns), poses[-1])


def test_late_odometry_is_sent_at_its_own_stamp_only_and_a_clock_that_went_back_begins_anew():
    def stamps(stamp_ns, pose):
        dated = broadcast.add(START_NS + stamp_ns, pose * np.ones(3), 100_000_000)
        return [at_ns - START_NS for at_ns, _ in dated]

    broadcast = Broadcast()
    stamps(60 * SECOND_NS, 0)
    assert stamps(59 * SECOND_NS, 1) == [59 * SECOND_NS]
    assert stamps(0, 1) == [0, 100_000_500]
    assert len(stamps(200_000_000, 1)) == 4, 'the future that passed is corrected'
