# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The messages to the filter in each fault, recorded once: they judge the filter in seconds."""

import io
import json
import lzma
from dataclasses import astuple, dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from robustness.faults import FAULTS, LIES
from robustness.judged import judge
from robustness.messages import Message, Reading, Restart, Seen
from robustness.recorded import RECORDED, model, to_truth, two_laps
from robustness.replay import Robot, replayed
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.error_correlation import ErrorCorrelation
from sfa_localization.data.geometry import RigidTransform
from sfa_localization.data.rig import Quantity, Rig

FILE = Path(__file__).with_name('frozen.npz.xz')
MEANS = Path(__file__).with_name('frozen_means.json')
"""Mean errors in m by light and fault; null where there was no estimate."""
LIGHTS = RECORDED, ('evening', 'summer')
_TRIANGLE = np.tril_indices(3)
_KINDS = (Seen, Reading, Restart)


@dataclass(frozen=True)
class FilterInput:
    """What reaches ekf_node, in the order of arrival, and what it knows of the model."""

    messages: list
    start_ns: int
    model: SimpleNamespace
    to_truth: RigidTransform


class Recorder(Robot):
    """Notes what would reach the filter."""

    def __init__(self, *learned):
        super().__init__(*learned)
        self.messages = []

    def drive(self, message):
        self.messages.append(message)

    def fuse(self, message, seen):
        content = Seen(seen.pose, seen.covariance, seen.turned)
        self.messages.append(message._replace(content=content))

    def restart(self, event):
        super().restart(event)
        if event == Restart('ekf_node', True):
            self.messages.append(Message(self.at_ns, self.at_ns, event))

    def hear(self, message):
        self.at_ns = message.at_ns
        super().hear(message)


def record(tell):
    """Locate the images of all faults, and write what would reach the filter."""
    arrays = {}
    for light in LIGHTS:
        world = two_laps(*light)
        for name, fault in FAULTS.items():
            robot = Recorder(world.start_ns, model(), to_truth())
            for message in fault.messages(world):
                robot.hear(message)
            arrays.update(packed(f'{light[0]}/{name}', robot.messages, world.start_ns))
            tell(f'{light[0]}: {name}')
        correlation = model().error_correlation
        learned = [correlation.share, correlation.distance_m, model().rig.camera_delay.value]
        arrays[light[0]] = np.array([*learned, *astuple(to_truth())])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    FILE.write_bytes(lzma.compress(buffer.getvalue(), preset=9 | lzma.PRESET_EXTREME))


def packed(name, messages, start_ns):
    """Messages as arrays: what of odometry repeats in most faults, column by column."""
    kinds = np.array([_KINDS.index(type(message.content)) for message in messages], np.uint8)
    times = np.array([(m.at_ns - start_ns, m.stamp_ns - start_ns) for m in messages], np.int64)
    images = [
        [*m.content.pose, *m.content.covariance[_TRIANGLE], m.content.turned]
        for m in messages
        if isinstance(m.content, Seen)
    ]
    readings = [[*np.concatenate(m.content), *m.true] for m in messages if m.true is not None]
    return {
        f'{name}/kinds': kinds,
        f'{name}/times': times.T.copy(),
        f'{name}/images': np.reshape(images, (-1, 10)).T.astype(np.float32),
        f'{name}/odometry': np.reshape(readings, (-1, 10)).T.astype(np.float64),
        f'{name}/start': np.int64(start_ns),
    }


class Frozen:
    """The recorded drives, by light and fault."""

    def __init__(self):
        self._arrays = np.load(io.BytesIO(lzma.decompress(FILE.read_bytes())))

    def drive(self, light, name):
        kinds, times, images, odometry, start_ns = (
            self._arrays[f'{light}/{name}/{key}']
            for key in ('kinds', 'times', 'images', 'odometry', 'start')
        )
        rows = {0: iter(images.T.astype(float)), 1: iter(odometry.T)}
        messages = [
            unpacked(kind, at_ns, stamp_ns, next(rows[kind]) if kind in rows else None)
            for kind, at_ns, stamp_ns in zip(kinds, *(times + start_ns).tolist(), strict=True)
        ]
        share, distance_m, delay_s, *transform = self._arrays[light].tolist()
        learned = SimpleNamespace(
            error_correlation=ErrorCorrelation(share, distance_m),
            rig=Rig(camera_delay=Quantity(delay_s, 0.05)),
            panorama=PanoramaConfig(),
            keyframes=None,
        )
        return FilterInput(messages, int(start_ns), learned, RigidTransform(*transform))


def unpacked(kind, at_ns, stamp_ns, values):
    if values is None:
        return Message(at_ns, stamp_ns, Restart('ekf_node', True))
    if _KINDS[kind] is Reading:
        pose, twist, variances, true = np.split(values, [3, 5, 7])
        return Message(at_ns, stamp_ns, Reading(pose, twist, variances), true)
    covariance = np.zeros((3, 3))
    covariance[_TRIANGLE] = values[3:9]
    covariance = covariance + np.tril(covariance, -1).T
    return Message(at_ns, stamp_ns, Seen(values[:3], covariance, float(values[9])))


def outputs_of(frozen, light, name):
    """What the filter says in a light's fault, or on its drive without a fault under a lie."""
    drive = frozen.drive(light, name if name in FAULTS else 'nothing')
    messages = drive.messages if name in FAULTS else LIES[name].messages(drive)
    return replayed(messages, drive.start_ns, drive.model, drive.to_truth)


def judged(frozen, light, name):
    """The verdict on a fault or a lie."""
    return judge(outputs_of(frozen, light, name), {**FAULTS, **LIES}[name].ends_s)


def totals(verdicts):
    """Seconds LOCALISED and wrong, and LOCALISED, of all together."""
    false_s, localised_s = np.sum([verdict[2:4] for verdict in verdicts], axis=0)
    return false_s, localised_s


def keep(means):
    """Write the mean errors by light and fault."""
    rounded = {
        light: {name: None if np.isnan(mean) else round(mean, 3) for name, mean in of.items()}
        for light, of in means.items()
    }
    MEANS.write_text(json.dumps(rounded, indent=1) + '\n')
