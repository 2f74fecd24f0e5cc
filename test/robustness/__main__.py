# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Print the table of faults."""

import argparse
import sys

from robustness.faults import FAULTS
from robustness.judged import judge, table
from robustness.recorded import two_laps
from robustness.replay import replayed


def main():
    """Run all faults, or those that are named."""
    parser = argparse.ArgumentParser(prog='robustness', description=__doc__)
    parser.add_argument('faults', nargs='*', metavar='FAULT', help='some of them, by name')
    options = parser.parse_args()
    world = two_laps()
    verdicts = {}
    for name in options.faults or FAULTS:
        fault = FAULTS[name]
        outputs = replayed(fault.messages(world), world.times_ns[0])
        verdicts[name] = judge(outputs, fault.ends_s)
    sys.stdout.write(table(verdicts) + '\n')


if __name__ == '__main__':
    main()
