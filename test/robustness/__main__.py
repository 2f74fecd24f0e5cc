# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Print the errors of a drive with each fault, and how often the filter's claims were true.

PYTHONPATH=.:test python -m robustness --live --lights 'wheels slip' kidnapped
PYTHONPATH=.:test python -m robustness --frozen     the filter alone, also against lies: minutes
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

from page_tables import write_table

from robustness import frozen, promises, troubles
from robustness.faults import FAULTS, LIES
from robustness.judged import errors_table, head, judge, row, states_table, summary
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


def judged(title, names, outputs_of):
    """Print a row for each fault; return the verdicts and the outputs, by name."""
    verdicts, outputs, width = {}, {}, max(map(len, names))
    tell(f'\nThrough {title}:\n\n{head(width)}')
    for name in names:
        outputs[name] = outputs_of(name)
        verdicts[name] = judge(outputs[name], {**FAULTS, **LIES}[name].ends_s)
        tell(row(name, verdicts[name], width))
    return verdicts, outputs


def tell(text):
    """Print a line at once: the table takes minutes."""
    sys.stdout.write(f'{text}\n')
    sys.stdout.flush()


def tell_troubles(names):
    """Print a row for each trouble of a recorded drive; 1 if any is not as it should be."""
    wrong = []
    with tempfile.TemporaryDirectory() as folder:
        for name, errors, said, right in troubles.table(Path(folder), names):
            tell(f'{name:32} {errors:16} {said}{"" if right else "   <- WRONG"}')
            wrong += [] if right else [name]
    return bool(wrong)


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
    """Run all faults, or those that are named; 1 if any is LOCALISED and wrong for too long."""
    parser = argparse.ArgumentParser(
        prog='robustness', description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('faults', nargs='*', metavar='FAULT', help='some of them, by name')
    for option, text in (
        ('--live', 'also through the three nodes'),
        ('--lights', 'also in other lights and seasons'),
        ('--frozen', 'the filter alone, by day and in the evening; writes test/README.md'),
        ('--means', 'the same; keep the mean errors, which test_faults.py lets get no worse'),
        ('--troubles', 'instead the troubles of recorded drives, with training: half an hour'),
        ('--page', 'only write the faults of promises.py into test/FAULTS.md'),
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
    if options.troubles:
        unknown = [name for name in options.faults if name not in troubles.TROUBLES]
        if unknown:
            parser.error(f'no trouble {unknown[0]!r}; there are: {"; ".join(troubles.TROUBLES)}')
        return tell_troubles(options.faults)
    lies = [*LIES] if options.frozen or options.means else []
    results = {
        title: judged(title, options.faults or [*FAULTS, *lies], outputs_of)
        for title, outputs_of in ways(options)
    }
    means = {
        title: {name: verdict.mean_m for name, verdict in verdicts.items() if name in FAULTS}
        for title, (verdicts, _) in results.items()
    }
    if options.means:
        frozen.keep(means)
    promised = [
        output
        for _, outputs in results.values()
        for name in outputs
        if name in FAULTS and 'another robot' not in name
        for output in outputs[name]
    ]
    tell(f'\n{summary(promised)}\n')
    if options.frozen and not options.faults:
        by_day, *_ = results.values()
        write_table('errors', errors_table(by_day[0]))
        write_table('states', states_table(promised))
    exceeded = [
        f'{name}, {title}'
        for title, (verdicts, _) in results.items()
        for name, verdict in verdicts.items()
        if name in FAULTS and not FAULTS[name].allows(verdict.false_s)
    ]
    for name in exceeded:
        sys.stderr.write(f'robustness: {name}: LOCALISED and wrong for too long\n')
    return bool(exceeded)


if __name__ == '__main__':
    sys.exit(main())
