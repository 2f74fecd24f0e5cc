# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""One owner for each quantity and rule: the table of test/OWNERS.md is true; twins fail."""

import re

import pytest
from page_tables import ROOT

PACKAGE = ROOT / 'sfa_localization'
SOURCES = {
    path.relative_to(PACKAGE).as_posix(): path.read_text('utf-8') for path in PACKAGE.rglob('*.py')
}
ROW = re.compile(r'^\| ([^|]+) \| `([\w/]+\.py)` `(\w+)` \| [^|]+ \|$', re.MULTILINE)
OWNERS = ROW.findall((ROOT / 'test/OWNERS.md').read_text('utf-8'))
"""Quantity, module and name of each row."""
STATISTICS = {'data/statistics.py'}
TWINS = {
    'standard deviation over median': (r'\b1\.48\d*|\b0\.67[45]\d*|\b1\.177\d*', STATISTICS),
    'peak of a parabola': (r'0\.5 \* \(\w+ - \w+\) / \w+', STATISTICS),
    'heavy tails': (r'(?i)_tail\b|degrees of freedom of student|cauchy|huber|tukey', STATISTICS),
    'quantile by weight': (r'def \w*(quantile|weighted_median)\w*\(', STATISTICS),
    'alignment': (r'def _?align(_\w+)?\(|procrustes|umeyama|kabsch', {'data/geometry.py'}),
    'errors by likeness': (r'log1p\((\w+\.)?unlike\)', {'keyframes/errors.py'}),
    'events of a drive': (
        r'merge_by_stamp\(', {'data/events.py', 'fusion/replay.py', 'fusion/camera_clock.py'},
    ),
    'feeding a filter': (
        r'\.add_measurement\(', {'fusion/replay.py', 'localizer.py', 'nodes/ekf_node.py'},
    ),
    'writing a file, whole or not at all': (
        r"\.write_(text|bytes)\(|imwrite\(|savetxt\(|mk[ds]temp\(|\.rename\(|NamedTemporaryFile\(|"
        r"fdopen\(|open\([^)]*'[wxa]b?'",
        # A folder that is renamed when whole; temporary folders; standard output.
        # What is recorded while the robot drives; the log of a process.
        {
            'data/files.py', 'bags/writer.py', 'bags/files.py', 'commands/live_nodes.py', 'cli.py',
            'bags/recorder.py', 'nodes/worker.py',
        },
    ),
    'a filter for a model': (
        r'(fused|filter)\.expect\(', {'localizer.py', 'nodes/ekf_node.py'},
    ),
    # Where a quantity is computed, by the calls that do it.
    'delay between two sources': (
        r'signal\.correlate\(|CLOCK_RANGE_S [*/]|CLOCK_RANGE_S\)',
        {
            'motion/fit.py', 'motion/truth.py', 'fusion/camera_clock.py',
            'bags/topic_stream.py', 'evaluation.py',
        },
    ),
    'turns by images and odometry': (
        r'\bestimated\(', {'motion/turns.py', 'mapping/drives.py'},
    ),
    'way that wheels lose': (r'\bway_of\(', {'motion/odometry_errors.py', 'mapping/drives.py'}),
    'steps beyond what a robot can do': (
        r'(?<![\w.])beyond\(', {'data/odometry_steps.py', 'fusion/odometry.py', 'motion/breaks.py'},
    ),
    'places laid on others': (
        r'\balign_complex\(',
        {
            'data/geometry.py', 'metric/measured_points.py', 'metric/point_ties.py',
            'mapping/selection.py', 'mapping/learning.py', 'mapping/fitted_map.py',
        },
    ),
    'weighted places and headings laid on a path': (
        r'(?<!def )(?<![\w.])aligned\(', {'fusion/relocation.py', 'fusion/health.py'},
    ),
}  # fmt: skip
"""A pattern that stands for a rule, and the modules that may hold it."""


def test_every_owner_exists_and_no_other_module_defines_its_name():
    assert len(OWNERS) > 20
    assert len({quantity for quantity, _, _ in OWNERS}) == len(OWNERS)
    for _, owner, name in OWNERS:
        definition = re.compile(rf'^(class |def |(\w+, )*){name}\b', re.MULTILINE)
        assert [module for module in SOURCES if definition.search(SOURCES[module])] == [owner]


@pytest.mark.parametrize('rule', TWINS)
def test_what_would_be_a_twin_stands_in_its_owner_alone(rule):
    pattern, owners = TWINS[rule]
    holders = {module for module, source in SOURCES.items() if re.search(pattern, source)}
    assert holders - owners == set()
    assert holders, f'{rule}: the pattern finds nothing any more'
