# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The history: any order of arrival gives the same belief; what is too old is known as such."""

import itertools

import pytest

from sfa_localization.fusion.history import History


def trail(span_ns=1000):
    """Beliefs are the events so far, in the order in which they were applied."""
    return History(span_ns, (), lambda belief, event: (*belief, event))


def test_every_order_of_arrival_ends_alike():
    for order in itertools.permutations('abcde'):
        history = trail()
        for name in order:
            history.add((ord(name), 0), name)
        assert history.newest == tuple('abcde')


def test_events_that_lie_ahead_are_redone_when_they_are_asked_for_alone():
    stepped = []
    history = History(1000, (), lambda belief, event: stepped.append(event) or (*belief, event))
    for stamp in (100, 101, 102):
        history.add((stamp, 0), stamp)
    del stepped[:]
    for stamp in range(50):
        assert history.add((stamp, 0), stamp) == tuple(range(stamp + 1))
        assert history.before(stamp) == tuple(range(stamp + 1))
    assert stepped == list(range(50))
    assert history.newest == (*range(50), 100, 101, 102)
    assert len(stepped) == 53


def test_rank_orders_equal_stamps_and_equal_keys_replace():
    history = trail()
    history.add((1, 2), 'late')
    history.add((1, 0), 'early')
    assert history.newest == ('early', 'late')
    history.add((1, 2), 'other')
    assert history.newest == ('early', 'other') and len(history) == 2


def test_belief_before_a_stamp():
    history = trail()
    for stamp in (10, 20, 30):
        history.add((stamp, 0), stamp)
    assert history.before(9) == () and history.before(20) == (10, 20)
    assert history.before(29) == (10, 20) and history.before(99) == (10, 20, 30)


def test_it_stays_bounded_and_knows_what_it_no_longer_reaches():
    history = History(100, 0, lambda belief, event: belief + event)
    for stamp in range(10_000):
        history.add((stamp, 0), 1)
        assert len(history) <= 300
    assert history.newest == 10_000
    assert history.reaches(9_950) and not history.reaches(9_800)


@pytest.mark.parametrize('late', [0, 5, 50, 99])
def test_within_the_span_everything_can_be_placed(late):
    history = History(100, 0, lambda belief, event: belief + event)
    for stamp in range(0, 2000, 2):
        history.add((stamp, 0), 1)
        if stamp > 100:
            assert history.reaches(stamp - late)


def test_a_start_stamp_bounds_an_empty_history():
    history = History(100, 'start', lambda belief, event: event, start_ns=50)
    assert history.newest_ns == 50 and history.newest == 'start'
    assert not history.reaches(50) and history.reaches(51)
