# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Print what each fault of a drive did, and what the filter claimed.

PYTHONPATH=.:test python -m robustness --live --lights 'wheels slip' kidnapped
PYTHONPATH=.:test python -m robustness --frozen     the filter alone, also against lies: seconds
"""

import argparse
import os
import sys
import tempfile

from page_tables import write_table

from robustness import frozen, promises
from robustness.faults import FAULTS, LIES
from robustness.judged import head, judge, row, summary
from robustness.recorded import OTHER_LIGHTS, two_laps
from robustness.replay import replayed


def live():
    """What plays messages through the nodes, which say nothing meanwhile."""
    logs = tempfile.mkdtemp(prefix='sfa_localization_ros_log_')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_LOG_DIR', logs)
    from rclpy.logging import LoggingSeverity, set_logger_level

    from robustness.live import played

    set_logger_level('', LoggingSeverity.FATAL)
    return played


def table(title, names, outputs_of):
    """Print a row for each fault; names of those that are not allowed, all outputs, means."""
    wrong, outputs, means, width = [], [], {}, max(map(len, names))
    tell(f'\nThrough {title}:\n\n{head(width)}')
    for name in names:
        made, fault = outputs_of(name), {**FAULTS, **LIES}[name]
        verdict = judge(made, fault.ends_s)
        tell(row(name, verdict, width))
        wrong += [] if name in LIES or fault.allows(verdict.false_s) else [f'{name}, {title}']
        means[name] = verdict.mean_m
        outputs += made
    return wrong, outputs, means


def tell(text):
    """Print a line at once: the table takes minutes."""
    sys.stdout.write(f'{text}\n')
    sys.stdout.flush()


def ways(options):
    """Titles, and what gives the outputs of a fault by name."""

    def through(play, *when):
        drive = two_laps(*when)
        return lambda name: play(FAULTS[name].messages(drive), drive.start_ns)

    if options.frozen or options.means:
        kept = frozen.Frozen()
        for light, _ in frozen.LIGHTS:
            yield light, lambda name, light=light: frozen.outputs_of(kept, light, name)
        return
    yield 'the Localizer', through(replayed)
    if options.live:
        yield 'the nodes', through(live())
    for when in OTHER_LIGHTS if options.lights else ():
        yield f'the Localizer, {" in ".join(when)}', through(replayed, *when)


def main():
    """Run all faults, or those that are named; 1 where the filter was wrong and sure too long."""
    parser = argparse.ArgumentParser(
        prog='robustness', description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('faults', nargs='*', metavar='FAULT', help='some of them, by name')
    for option, text in (
        ('--live', 'also through the three nodes'),
        ('--lights', 'also in other lights and seasons'),
        ('--frozen', 'the filter alone, on what was recorded by day and in the evening'),
        ('--means', 'the same; keep the mean errors, which test_faults.py lets get no worse'),
        ('--page', 'only write the faults of promises.py into test/README.md'),
        ('--record', 'locate all images anew: after training, features or keyframes change'),
    ):
        parser.add_argument(option, action='store_true', help=text)
    options = parser.parse_args()
    if options.page:
        write_table('faults', promises.table())
        return 0
    if options.record:
        frozen.record(tell)
        return 0
    everything, wrong, means = [], [], {}
    lies = [*LIES] if options.frozen or options.means else []
    for title, outputs_of in ways(options):
        refused, outputs, errors = table(title, options.faults or [*FAULTS, *lies], outputs_of)
        everything, wrong = everything + outputs, wrong + refused
        means[title] = {name: errors[name] for name in errors if name in FAULTS}
    if options.means:
        frozen.keep(means)
    tell(f'\n{summary(everything)}\n')
    for name in wrong:
        sys.stderr.write(f'robustness: {name}: LOCALISED and wrong for too long\n')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
