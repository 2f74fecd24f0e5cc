# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Troubles of recorded drives: each changes bags/sample and bags/sample_test as a robot, a receiver
or a driver would, and states the error and the sentence that are right.

`PYTHONPATH=.:test python -m robustness --troubles` runs them all: train, then evaluate.
"""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores

from sfa_localization.bags.decoding import typestore

TRAINING, TEST = Path('bags/sample'), Path('bags/sample_test')
IMAGES, ODOMETRY, IMU, TRUTH = '/panorama/compressed', '/odom', '/imu', '/ground_truth'
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class Trouble:
    """`changes` of messages by topic: each takes a message and a random generator, alters it, and
    returns None, or the messages that take its place.

    `errors_m` bounds the mean error of one image and of the filter; None where a command refuses.
    `says` is a pattern of the sentence that names the trouble, by any of the commands.
    """

    changes: Callable[[], dict]
    errors_m: tuple[float, float] | None
    says: str
    trains: bool = True
    """Whether the training drive has the trouble too."""
    options: tuple[str, ...] = ()
    """Of `train`."""


def stamp_of(message):
    """The stamp of a message, ns."""
    return message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec


def restamp(message, stamp_ns):
    """Give a message another stamp."""
    stamp = message.header.stamp
    message.header.stamp = type(stamp)(*(int(part) for part in divmod(stamp_ns, SECOND_NS)))


def alter(source, target, changes, seed=0):
    """Write a bag with some of its messages changed; the order and times of reception stay."""
    types, rng = typestore(Stores.ROS2_JAZZY), np.random.default_rng(seed)
    with Reader(source) as bag, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as out:
        topics = {
            c.topic: out.add_connection(c.topic, c.msgtype, typestore=types)
            for c in bag.connections
        }
        for connection, received_ns, data in bag.messages():
            name, kind = connection.topic, connection.msgtype
            message = types.deserialize_cdr(data, kind)
            taken = changes[name](message, rng) if name in changes else None
            for part in [message] if taken is None else taken:
                out.write(topics[name], received_ns, bytes(types.serialize_cdr(part, kind)))


def run(*command):
    """The exit code of a command of the package, and all that it prints."""
    ended = subprocess.run(
        [sys.executable, '-m', 'sfa_localization', *map(str, command)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
    )  # fmt: skip
    return ended.returncode, ended.stdout


def tried(name, folder, model):
    """What train and evaluate say of a trouble, and the errors of one image and of the filter, m;
    None after a refusal. `model` is that of the untouched drive.
    """
    trouble, text = TROUBLES[name], ''
    for source in (TRAINING, TEST) if trouble.trains else (TEST,):
        alter(source, folder / source.name, trouble.changes())
    training = folder / TRAINING.name if trouble.trains else TRAINING
    if trouble.trains:
        model = folder / 'model.npz'
        code, text = run('train', training, '--output', model, *trouble.options)
        if code:
            return text, None
    results = folder / 'results.json'
    test = folder / TEST.name
    code, said = run('evaluate', model, test, '--align', training, '--json', results)
    if code:
        return text + said, None
    errors = json.loads(results.read_text())
    return text + said, tuple(errors[key]['mean'] for key in ('sfa', 'ekf'))


def verdict(name, text, errors_m):
    """Whether errors and sentence are right, and the sentence."""
    trouble = TROUBLES[name]
    said = next((line.strip() for line in text.splitlines() if re.search(trouble.says, line)), '')
    if trouble.errors_m is None or errors_m is None:
        right = errors_m is trouble.errors_m
    else:
        right = all(error <= limit for error, limit in zip(errors_m, trouble.errors_m, strict=True))
    return right and bool(said), said


def lost(m, rng, share=0.05):
    """A receiver that answers with zeros where it sees nothing."""
    if rng.random() < share:
        m.pose.position.x = m.pose.position.y = 0.0
        m.pose.orientation = type(m.pose.orientation)(0.0, 0.0, 0.0, 1.0)


RIGHT_M = 0.055, 0.055
"""One image and filter of the untouched drive err by 0.042 m: a trouble that is mended adds a
little."""
TROUBLES = {
    'truth: 5 % zeros': Trouble(
        lambda: {TRUTH: lost}, RIGHT_M, 'ground truth: .* of .* poses', trains=False
    ),
    'truth: 0.3 s late': Trouble(
        lambda: {TRUTH: lambda m, _: restamp(m, stamp_of(m) + 300_000_000)},
        RIGHT_M, 'ground truth.* 0.30 s late', trains=False,
    ),
}  # fmt: skip


def table(folder, names=()):
    """Try troubles, all by default, and yield a row of each: name, errors, sentence, verdict."""
    model = folder / 'untouched.npz'
    if any(not TROUBLES[name].trains for name in names or TROUBLES):
        run('train', TRAINING, '--output', model)
    for number, name in enumerate(names or TROUBLES):
        part = folder / str(number)
        part.mkdir()
        text, errors_m = tried(name, part, model)
        right, said = verdict(name, text, errors_m)
        errors = ' / '.join(f'{e:.3f}' for e in errors_m) if errors_m else 'refused'
        last = text.strip().splitlines()[-1:]
        yield name, errors, said or ''.join(last), right
