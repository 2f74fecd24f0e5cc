# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The history: events that lie ahead are not redone for each late one; its length is bounded."""

from sfa_localization.fusion.history import History


def test_events_that_lie_ahead_are_redone_when_they_are_asked_for_alone():
    stepped = []
    history = History(1000, (), lambda belief, event: stepped.append(event) or (*belief, event))
    for stamp in (100, 101, 102):
        history.add((stamp, 0), stamp)
    del stepped[:]
    for stamp in range(50):
        assert history.add((stamp, 0), stamp) == history.before(stamp) == tuple(range(stamp + 1))
    assert stepped == list(range(50))
    assert history.newest == (*range(50), 100, 101, 102)
    assert len(stepped) == 53


def test_it_stays_bounded_and_knows_what_it_no_longer_reaches():
    history = History(100, 0, lambda belief, event: belief + event)
    for stamp in range(10_000):
        history.add((stamp, 0), 1)
        assert len(history) <= 300 and (stamp < 200 or history.reaches(stamp - 99))
    assert history.newest == 10_000
    assert history.reaches(9_950) and not history.reaches(9_800)


def test_what_comes_before_the_start_is_out_of_reach():
    history = History(100, 'start', lambda belief, event: event, start_ns=50)
    assert history.newest_ns == 50 and history.newest == 'start'
    assert not history.reaches(50) and history.reaches(51)
