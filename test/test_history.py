# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The history: any order of arrival gives the same belief; what is too old is refused."""

import itertools

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


def test_rank_orders_equal_stamps_and_equal_keys_follow_each_other():
    history = trail()
    for key, name in (((1, 2), 'late'), ((1, 0), 'early'), ((9, 2), 'last'), ((1, 2), 'other')):
        history.add(key, name)
    assert history.newest == ('early', 'late', 'other', 'last')
    assert history.before(0) == () and history.before(8) == ('early', 'late', 'other')


def test_it_stays_bounded_and_knows_what_it_no_longer_reaches():
    history = History(100, 0, lambda belief, event: belief + event)
    for stamp in range(10_000):
        history.add((stamp, 0), 1)
        assert len(history) <= 300 and (stamp < 200 or history.reaches(stamp - 99))
    assert history.newest == 10_000
    assert history.reaches(9_950) and not history.reaches(9_800)


def test_a_start_stamp_bounds_an_empty_history():
    history = History(100, 'start', lambda belief, event: event, start_ns=50)
    assert history.newest_ns == 50 and history.newest == 'start'
    assert not history.reaches(50) and history.reaches(51)
