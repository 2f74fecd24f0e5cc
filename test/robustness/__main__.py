# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Print what each fault of a drive did, and draw what the filter claimed.

PYTHONPATH=.:test python -m robustness --live --lights 'wheels slip' kidnapped
"""

import argparse
import os
import sys
import tempfile

from robustness.faults import FAULTS
from robustness.judged import head, judge, row
from robustness.plot import draw, summary
from robustness.recorded import CACHE, OTHER_LIGHTS, two_laps
from robustness.replay import replayed

PLOT = CACHE / 'calibration.png'


def live():
    """What plays messages through the nodes, which say nothing meanwhile."""
    logs = tempfile.mkdtemp(prefix='sfa_localization_ros_log_')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_LOG_DIR', logs)
    from rclpy.logging import LoggingSeverity, set_logger_level

    from robustness.live import played

    set_logger_level('', LoggingSeverity.FATAL)
    return played


def run(names, play, world):
    """Print a row for each fault; the names of those that are not allowed, and all outputs."""
    wrong, outputs, width = [], [], max(map(len, names))
    tell(head(width))
    for name in names:
        fault = FAULTS[name]
        found = play(fault.messages(world), world.times_ns[0])
        verdict = judge(found, fault.ends_s)
        tell(row(name, verdict, width))
        wrong += [] if fault.allows(verdict.false_s) else [name]
        outputs += found
    return wrong, outputs


def tell(text):
    """Print a line at once: the table takes minutes."""
    sys.stdout.write(f'{text}\n')
    sys.stdout.flush()


def main():
    """Run all faults, or those that are named; 1 where the filter was wrong and sure too long."""
    parser = argparse.ArgumentParser(
        prog='robustness', description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('faults', nargs='*', metavar='FAULT', help='some of them, by name')
    parser.add_argument('--live', action='store_true', help='also through the three nodes')
    parser.add_argument('--lights', action='store_true', help='also in other lights and seasons')
    options = parser.parse_args()
    ways = [('the Localizer', replayed, ())]
    ways += [('the nodes', live(), ())] if options.live else []
    for when in OTHER_LIGHTS if options.lights else ():
        ways.append((f'the Localizer, {" in ".join(when)}', replayed, when))
    everything, wrong = [], []
    for way, play, when in ways:
        tell(f'\nThrough {way}:\n')
        refused, outputs = run(options.faults or list(FAULTS), play, two_laps(*when))
        everything += outputs
        wrong += [f'{name}, through {way}' for name in refused]
    draw(everything, PLOT)
    tell(f'\n{summary(everything)}\n\n{PLOT}: written')
    for name in wrong:
        sys.stderr.write(f'robustness: {name}: LOCALISED and wrong for too long\n')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
