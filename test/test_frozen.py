# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What reaches the filter in each fault, recorded once: never LOCALISED and wrong for long, and
LOCALISED where it can be. `python -m robustness --frozen` prints the same as a table.
"""

import functools
import json
import math

import pytest
from robustness.faults import FAULTS, LIES, SAME_PLACE_S
from robustness.frozen import LIGHTS, MEANS, Frozen, judged, totals

pytestmark = pytest.mark.slow  # a minute for each light
NAMES = [light for light, _ in LIGHTS]
DAY = NAMES[0]
WRONG_S, LIE_S = 1.5, 5.5
"""A robot that is carried in the dark is believed to be where it was for some images; a lie that
contradicts nothing at first, longer."""
ALL_LIES_S = 25.0
LOCALISED_S, LOCALISED_IN_LIES_S, LOCALISED_WITHOUT_S = 5300.0, 246.0, 54.0
WORSE_M = 0.01


@functools.cache
def frozen():
    return Frozen()


@functools.cache
def verdict(light, name):
    return judged(frozen(), light, name)


@pytest.mark.parametrize('light', NAMES)
@pytest.mark.parametrize('name', FAULTS)
def test_no_fault_is_believed_for_long_or_makes_the_estimate_worse(name, light):
    made, mean_m = verdict(light, name), json.loads(MEANS.read_text())[light][name]
    assert made.false_s <= (SAME_PLACE_S if 'another robot' in name else WRONG_S), made
    assert math.isnan(made.mean_m) if mean_m is None else made.mean_m <= mean_m + WORSE_M, made


@pytest.mark.parametrize('light', NAMES)
@pytest.mark.parametrize('name', LIES)
def test_no_lie_is_believed_for_long(name, light):
    assert round(verdict(light, name).false_s, 1) <= LIE_S, verdict(light, name)


def test_lies_together_are_believed_for_seconds_and_it_is_localised_as_long_as_it_can_be():
    false_s, localised_s = totals(verdict(DAY, name) for name in LIES)
    assert false_s <= ALL_LIES_S and localised_s >= LOCALISED_IN_LIES_S
    assert totals(verdict(light, name) for light in NAMES for name in FAULTS)[1] >= LOCALISED_S
    assert min(verdict(light, 'nothing').localised_s for light in NAMES) >= LOCALISED_WITHOUT_S
