# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What senders write can fill neither the memory nor the diagnostics."""

from sfa_localization.data.rejections import LONGEST, MOST, OTHER, RejectionCounter, short_line


def test_reasons_are_counted_apart_up_to_a_number_and_then_together():
    reasons = RejectionCounter()
    for k in range(3000):
        assert reasons.add(f'frame is {k}') == (1 if k < MOST else k - MOST + 1)
    assert len(reasons) == MOST + 1 and reasons[OTHER] == 3000 - MOST
    assert reasons.add('frame is 0', 5) == 6
    assert sum(reasons.values()) == 3005


def test_a_reason_is_one_printable_line_of_bounded_length():
    assert short_line('short') == 'short'
    assert short_line('a\nb\x1b[31m\tc') == 'a b?[31m c'
    assert len(short_line('x' * 10**6)) == LONGEST and short_line('x' * 10**6).endswith('...')
    reasons = RejectionCounter()
    reasons.add('y' * 10**5)
    assert [len(reason) for reason in reasons] == [LONGEST]
