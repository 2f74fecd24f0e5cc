# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What reaches the filter in each fault, recorded once, so that the filter is judged in seconds.

PYTHONPATH=.:test python -m robustness.frozen           print the table, by day and in the evening
PYTHONPATH=.:test python -m robustness.frozen --means   the same, and keep the mean errors, which
                                                        test_frozen.py lets get no worse
PYTHONPATH=.:test python -m robustness.frozen --record  locate all images anew: after training,
                                                        features or keyframes change; minutes
"""

import argparse
import dataclasses
import io
import json
import lzma
import math
import sys
from pathlib import Path

import numpy as np

from robustness.faults import FAULTS, FROM_S, Message, Reading, Restart
from robustness.judged import head, judge, output, row
from robustness.recorded import RECORDED, SECOND_NS, to_truth, two_laps
from robustness.replay import Robot
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.fusion.pose_filter import PoseFilter

FILE = Path(__file__).with_name('frozen.npz.xz')
MEANS = Path(__file__).with_name('frozen_means.json')
"""Mean errors in m by light and fault; null where there was no estimate."""
LIGHTS = RECORDED, ('evening', 'summer')
LIE_S = 5.0
"""Seconds for which a lie that contradicts nothing at first may be believed."""
_TRIANGLE = np.tril_indices(3)
_IMAGE, _ODOMETRY, _RESTART = range(3)
_WIDTHS = {_IMAGE: 10, _ODOMETRY: 10, _RESTART: 0}


@dataclasses.dataclass(frozen=True, slots=True)
class Seen:
    """What sfa_node makes of an image: pose (3,), covariance (3, 3), and how far images turned."""

    pose: np.ndarray
    covariance: np.ndarray
    turned: float


@dataclasses.dataclass(frozen=True, slots=True)
class Drive:
    """What reaches ekf_node, in the order of arrival; `correlation` is the model's."""

    messages: list
    correlation: ErrorCorrelation
    delay_s: float
    to_truth: RigidTransform
    start_ns: int


class Recorder(Robot):
    """Notes what would reach the filter."""

    @property
    def model(self):
        return self.localizer.observer.model

    def __init__(self, start_ns):
        super().__init__(start_ns)
        self.messages = []

    def drive(self, message):
        self.messages.append(message)

    def see(self, message):
        localizer = self.localizer
        add, localizer.add_observation = localizer.add_observation, self.note
        self.at_ns = message.at_ns
        try:
            super().see(message)
        finally:
            localizer.add_observation = add

    def note(self, seen):
        content = Seen(seen.pose, seen.covariance, seen.turned)
        self.messages.append(Message(self.at_ns, seen.stamp_ns, content))

    def hear(self, message):
        super().hear(message)
        if message.content == Restart('ekf_node', True):
            self.messages.append(message)


def record():
    """Locate the images of all faults, and write what would reach the filter."""
    arrays = {}
    for light in LIGHTS:
        world = two_laps(*light)
        for name, fault in FAULTS.items():
            robot = Recorder(int(world.times_ns[0]))
            for message in fault.messages(world):
                robot.hear(message)
            arrays.update(packed(f'{light[0]}/{name}', robot.messages, robot.start_ns))
            sys.stdout.write(f'{light[0]}: {name}\n')
        correlation = robot.model.error_correlation
        known = [correlation.share, correlation.distance_m, robot.model.camera_delay_s]
        arrays[light[0]] = np.array([*known, *dataclasses.astuple(to_truth())])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    FILE.write_bytes(lzma.compress(buffer.getvalue(), preset=9 | lzma.PRESET_EXTREME))


def packed(name, messages, start_ns):
    """Messages as arrays: what of odometry repeats in most faults, column by column."""
    kinds = np.array([kind_of(message) for message in messages], np.uint8)
    times = np.array([(m.at_ns - start_ns, m.stamp_ns - start_ns) for m in messages], np.int64)
    rows = {kind: [] for kind in _WIDTHS}
    for message, kind in zip(messages, kinds, strict=True):
        rows[kind].append(numbers(message))
    images, readings = (np.reshape(rows[k], (-1, 10)).T for k in (_IMAGE, _ODOMETRY))
    return {
        f'{name}/kinds': kinds,
        f'{name}/times': times.T.copy(),
        f'{name}/images': images.astype(np.float32),
        f'{name}/odometry': readings.astype(np.float64),
        f'{name}/start': np.int64(start_ns),
    }


def kind_of(message):
    kinds = {Seen: _IMAGE, Reading: _ODOMETRY, Restart: _RESTART}
    return kinds[type(message.content)]


def numbers(message):
    """The content of a message in a row."""
    content = message.content
    if isinstance(content, Seen):
        return [*content.pose, *content.covariance[_TRIANGLE], content.turned]
    if isinstance(content, Reading):
        return [*content.pose, *content.twist, *content.variances, *message.true]
    return []


class Frozen:
    """The recorded drives, by light and fault."""

    def __init__(self):
        self._arrays = np.load(io.BytesIO(lzma.decompress(FILE.read_bytes())))

    def drive(self, light, name):
        part = {key: self._arrays[f'{light}/{name}/{key}']
                for key in ('kinds', 'times', 'images', 'odometry', 'start')}  # fmt: skip
        start_ns = int(part['start'])
        rows = {_IMAGE: iter(part['images'].T.astype(float)), _ODOMETRY: iter(part['odometry'].T)}
        messages = []
        for kind, at_ns, stamp_ns in zip(part['kinds'], *part['times'], strict=True):
            values = next(rows[kind]) if kind in rows else None
            messages.append(unpacked(kind, int(at_ns) + start_ns, int(stamp_ns) + start_ns, values))
        share, distance_m, delay_s, *transform = self._arrays[light].tolist()
        correlation, to_truth = ErrorCorrelation(share, distance_m), RigidTransform(*transform)
        return Drive(messages, correlation, delay_s, to_truth, start_ns)


def unpacked(kind, at_ns, stamp_ns, values):
    if kind == _RESTART:
        return Message(at_ns, stamp_ns, Restart('ekf_node', True))
    if kind == _ODOMETRY:
        pose, twist, variances, true = np.split(values, [3, 5, 7])
        return Message(at_ns, stamp_ns, Reading(pose, twist, variances), true)
    covariance = np.zeros((3, 3))
    covariance[_TRIANGLE] = values[3:9]
    covariance = covariance + np.tril(covariance, -1).T
    return Message(at_ns, stamp_ns, Seen(values[:3], covariance, float(values[9])))


# Lies: what no fault of the table shows, made of the drive without a fault.


def queued(delay_s):
    """Images that wait, and are stamped when they leave: `delay_s` of the second of the drive."""

    def change(second, message):
        late_ns = round(delay_s(second) * SECOND_NS)
        at_ns, stamp_ns = message.at_ns + late_ns, message.stamp_ns + late_ns
        return dataclasses.replace(message, at_ns=at_ns, stamp_ns=stamp_ns)

    return images_changed(change)


def clocked(ahead_s):
    """A camera whose clock is ahead."""

    def change(second, message):
        stamp_ns = message.stamp_ns + round(ahead_s(second) * SECOND_NS)
        return dataclasses.replace(message, stamp_ns=stamp_ns)

    return images_changed(change)


def mounted(lever, from_s):
    """A camera that sits beside where it was: ahead, left in meters."""

    def change(second, message):
        if second < from_s:
            return message
        x, y, yaw = message.content.pose
        place = complex(x, y) + np.exp(1j * yaw) * lever
        return seen_at(message, [place.real, place.imag, yaw], message.content.turned)

    return images_changed(change)


def turning(degrees_per_s):
    """A camera that turns on its mast."""

    def change(second, message):
        angle = math.radians(degrees_per_s) * max(second - FROM_S, 0.0)
        x, y, yaw = message.content.pose
        return seen_at(message, [x, y, yaw + angle], message.content.turned + angle)

    return images_changed(change)


def seen_at(message, pose, turned):
    content = dataclasses.replace(message.content, pose=np.array(pose), turned=turned)
    return dataclasses.replace(message, content=content)


def images_changed(change):
    """A lie about images: `change` makes another message of a second of the drive and one."""

    def lie(drive):
        return [
            change((m.stamp_ns - drive.start_ns) / SECOND_NS, m) if kind_of(m) == _IMAGE else m
            for m in drive.messages
        ]

    return lie


def wheels(factor):
    """Wheels that read so many times the way."""

    def lie(drive):
        scale = np.array([factor, factor, 1.0])
        return [
            dataclasses.replace(m, content=dataclasses.replace(
                m.content, pose=m.content.pose * scale, twist=m.content.twist * scale[1:]))
            if kind_of(m) == _ODOMETRY else m
            for m in drive.messages
        ]  # fmt: skip

    return lie


def looped(from_s, length_s):
    """A video that repeats its last seconds."""

    def lie(drive):
        images = [m for m in drive.messages if kind_of(m) == _IMAGE]
        at_s = np.array([(m.stamp_ns - drive.start_ns) / SECOND_NS for m in images])
        again_s = from_s - length_s + (at_s - from_s) % length_s
        shown = np.where(at_s < from_s, np.arange(len(images)), np.searchsorted(at_s, again_s))
        turned = iter([images[i].content.turned for i in shown])
        poses = iter([images[i].content for i in shown])
        return [
            dataclasses.replace(m, content=dataclasses.replace(next(poses), turned=next(turned)))
            if kind_of(m) == _IMAGE else m
            for m in drive.messages
        ]  # fmt: skip

    return lie


LIES = {
    'images 1 s late by a queue': queued(lambda _: 1.0),
    'images 2 s late by a queue': queued(lambda _: 2.0),
    'a queue that grows by 0.05 s/s': queued(lambda s: 0.05 * max(s - 10.0, 0.0)),
    'a queue that grows by 0.15 s/s': queued(lambda s: 0.15 * max(s - 10.0, 0.0)),
    'clock of the camera -1 s': clocked(lambda _: -1.0),
    'clock of the camera +1 s': clocked(lambda _: 1.0),
    'clock of the camera drifts -0.03 s/s': clocked(lambda s: -0.03 * s),
    'camera 1 m ahead': mounted(1.0 + 0j, FROM_S),
    'camera 1.5 m to the left': mounted(1.5j, FROM_S),
    'camera 1.5 m ahead, from the start': mounted(1.5 + 0j, 0.0),
    'wheels read 0.8 of the way': wheels(0.8),
    'wheels read 1.25 of the way': wheels(1.25),
    'camera turns by 1 degree/s': turning(1.0),
    'camera turns by 3 degrees/s': turning(3.0),
    'a video loops its last 8 s': looped(20.0, 8.0),
}


def fused(drive, messages):
    """Outputs of a filter that hears messages in the order of their arrival."""
    made = new_filter(drive)
    outputs = []
    for message in sorted(messages, key=lambda message: message.at_ns):
        content, stamp_ns = message.content, message.stamp_ns
        if isinstance(content, Restart):
            made = new_filter(drive)
        elif isinstance(content, Seen):
            made.add_turned(stamp_ns, content.turned)
            made.add_measurement(stamp_ns, content.pose, content.covariance)
        else:
            refused = made.add_odometry(stamp_ns, *content.twist, content.variances, content.pose)
            state = made.state if refused else made.at(stamp_ns)
            state = state or made.state
            if state is not None:
                second = (message.at_ns - drive.start_ns) / SECOND_NS
                outputs.append(output(
                    second, made.status, state.pose, state.pose_covariance, message.true,
                    drive.to_truth,
                ))  # fmt: skip
    return outputs


def new_filter(drive):
    made = PoseFilter(correlation=drive.correlation)
    made.expect_delay(drive.delay_s)
    return made


def judged(frozen, light, name):
    """The verdict on a light's fault, or on its drive without a fault under a lie."""
    if name in FAULTS:
        drive = frozen.drive(light, name)
        return judge(fused(drive, drive.messages), FAULTS[name].ends_s)
    drive = frozen.drive(light, 'nothing')
    return judge(fused(drive, LIES[name](drive)), math.inf)


def totals(verdicts):
    """Seconds LOCALISED and wrong, and LOCALISED, of all together."""
    verdicts = list(verdicts)
    return sum(one.false_s for one in verdicts), sum(one.localised_s for one in verdicts)


def keep(means):
    """Write the mean errors by light and fault."""
    rounded = {
        light: {name: None if math.isnan(mean) else round(mean, 3) for name, mean in of.items()}
        for light, of in means.items()
    }
    MEANS.write_text(json.dumps(rounded, indent=1) + '\n')


def main():
    """Record, or print the table."""
    parser = argparse.ArgumentParser(prog='robustness.frozen', description=__doc__)
    parser.add_argument('--record', action='store_true', help='locate all images anew')
    parser.add_argument('--means', action='store_true', help='keep the mean errors')
    given = parser.parse_args()
    if given.record:
        record()
        return
    frozen, means, width = Frozen(), {}, max(map(len, (*FAULTS, *LIES)))
    for light, _ in LIGHTS:
        sys.stdout.write(f'\n{light}\n{head(width)}\n')
        rows = {}
        for name in (*FAULTS, *LIES):
            rows[name] = judged(frozen, light, name)
            sys.stdout.write(row(name, rows[name], width) + '\n')
        means[light] = {name: rows[name].mean_m for name in FAULTS}
        for what, names in (('faults', FAULTS), ('lies', LIES)):
            false_s, localised_s = totals(rows[name] for name in names)
            sys.stdout.write(f'{what}: wrong {false_s:.1f} s, LOCALISED {localised_s:.1f} s\n')
    if given.means:
        keep(means)


if __name__ == '__main__':
    main()
