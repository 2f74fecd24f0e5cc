# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Troubles of recorded drives: each changes bags/sample and bags/sample_test as a robot, a receiver
or a driver would, and states the error and the sentence that are right.

`PYTHONPATH=.:test python -m robustness --troubles` runs them all: train, then evaluate.
"""

import itertools
import json
import math
import re
import subprocess
import sys
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores

from sfa_localization.bags.decoding import FIX, IMAGE, typestore
from sfa_localization.bags.writer import blank
from sfa_localization.camera.encodings import decode_compressed, encode_jpeg
from sfa_localization.camera.settings import PanoramaConfig
from sfa_localization.data.messages import read_yaw
from sfa_localization.data.sphere import rotation

TRAINING, TEST = Path('bags/sample'), Path('bags/sample_test')
IMAGES, ODOMETRY, IMU, TRUTH = '/panorama/compressed', '/odom', '/imu', '/ground_truth'
SECOND_NS = 1_000_000_000
STORE = typestore(Stores.ROS2_JAZZY)
RIGHT_M = 0.055, 0.055
"""One image and filter of the untouched drive err by 0.041 m: a trouble that is mended adds a
little."""


@dataclass(frozen=True)
class Trouble:
    """`changes` of messages by topic: each takes a message and a random generator, alters it, and
    returns None, or the messages that take its place.

    `errors_m` bounds the mean error of one image and of the filter; None where a command refuses.
    `says` is a pattern of the sentence that names the trouble, by any of the commands.
    """

    changes: Callable[[], dict]
    says: str
    errors_m: tuple[float, float] | None = RIGHT_M
    trains: bool = True
    """Whether the training drive has the trouble too."""
    options: tuple[str, ...] = ()
    """Of `train`."""
    kinds: Mapping[str, str] = field(default_factory=dict)
    """Types of topics that get others."""
    camera: str = ''
    """Parameters of omnicam_node, as YAML, for `train` and `evaluate`."""


def stamp_of(message):
    """The stamp of a message, ns."""
    return message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec


def restamp(message, stamp_ns):
    """Give a message another stamp."""
    stamp = message.header.stamp
    message.header.stamp = type(stamp)(*(int(part) for part in divmod(stamp_ns, SECOND_NS)))


def alter(source, target, changes, seed=0, kinds=types.MappingProxyType({})):
    """Write a bag with some of its messages changed; the order and times of reception stay."""
    rng = np.random.default_rng(seed)
    with Reader(source) as bag, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as out:
        topics = {
            c.topic: out.add_connection(c.topic, kinds.get(c.topic, c.msgtype), typestore=STORE)
            for c in bag.connections
        }
        for connection, received_ns, data in bag.messages():
            name, kind = connection.topic, connection.msgtype
            message = STORE.deserialize_cdr(data, kind)
            taken = changes[name](message, rng) if name in changes else None
            for part in [message] if taken is None else taken:
                part = STORE.serialize_cdr(part, topics[name].msgtype)
                out.write(topics[name], received_ns, bytes(part))


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
    trouble, text, parameters = TROUBLES[name], '', []
    if trouble.camera:
        parameters = ['--config', folder / 'parameters.yaml']
        parameters[1].write_text(
            f'/**/omnicam_node: {{ros__parameters: {{{trouble.camera}}}}}', encoding='utf-8'
        )
    for source in (TRAINING, TEST) if trouble.trains else (TEST,):
        alter(source, folder / source.name, trouble.changes(), kinds=trouble.kinds)
    training = folder / TRAINING.name if trouble.trains else TRAINING
    if trouble.trains:
        model = folder / 'model.npz'
        code, text = run('train', training, '--output', model, *trouble.options, *parameters)
        if code:
            return text, None
    results = folder / 'results.json'
    test = folder / TEST.name
    options = '--ground-truth-topic', TRUTH, '--align', training, '--json', results
    code, said = run('evaluate', model, test, *options, *parameters)
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


def wrong_rate(share, value):
    """A gyroscope of which a share of the messages reports another rate, rad/s."""

    def change(m, rng):
        if rng.random() < share:
            m.angular_velocity.z = value * rng.choice([-1.0, 1.0])

    return change


def held_rate(period_s=4.0, share=0.25):
    """A gyroscope that repeats a rate for a share of each period."""
    last = [0.0]

    def change(m, _):
        if stamp_of(m) * 1e-9 % period_s < share * period_s:
            m.angular_velocity.z = last[0]
        last[0] = m.angular_velocity.z

    return change


def second_publisher():
    """Every second message comes from another publisher, whose origin is elsewhere."""
    count = itertools.count()

    def change(m, _):
        if next(count) % 2:
            place, q = m.pose.pose.position, m.pose.pose.orientation
            place.x, place.y = 2.0 - place.y, 1.0 + place.x  # turned by 90 degrees
            q.z, q.w = (q.z + q.w) / math.sqrt(2.0), (q.w - q.z) / math.sqrt(2.0)

    return change


def fill(m, x, quaternion, twist=True):
    """Fill the pose of a message with this x and quaternion, and perhaps its twist with zeros."""
    m.pose.pose.position.x, m.pose.pose.position.y = x, 0.0
    m.pose.pose.orientation = type(m.pose.pose.orientation)(*quaternion)
    if not twist:
        m.twist.twist.linear.x = m.twist.twist.angular.z = 0.0


def unoriented(m, _):
    """A driver that fills position and twist only."""
    m.pose.pose.orientation = type(m.pose.pose.orientation)(0.0, 0.0, 0.0, 1.0)


def zeros_at_times(m, rng):
    """A driver that sends a message of zeros now and then."""
    if rng.random() < 0.02:
        fill(m, 0.0, (0, 0, 0, 1), twist=False)


def stale(times):
    """A driver that repeats each pose, and fills no twist."""
    poses = []

    def change(m, _):
        poses.append(poses[-1] if len(poses) % times else m.pose.pose)
        m.pose.pose, m.twist.twist.linear.x, m.twist.twist.angular.z = poses[-1], 0.0, 0.0

    return {ODOMETRY: change}


def counting(wheels):
    """Odometry of wheels that count another way and turn than were driven."""
    state = {}

    def change(m, _):
        place, q, now = m.pose.pose.position, m.pose.pose.orientation, stamp_of(m)
        true = place.x + 1j * place.y, read_yaw(q)
        before, (there, yaw), then = state.get('last', (true, true, now - 1))
        turn = math.remainder(true[1] - before[1], 2 * math.pi)
        way = ((true[0] - before[0]) * np.exp(-1j * (before[1] + turn / 2))).real
        way, turn = wheels(way, turn)
        there, seconds = there + way * np.exp(1j * (yaw + turn / 2)), (now - then) / SECOND_NS
        state['last'] = true, (there, yaw + turn), now
        place.x, place.y = float(there.real), float(there.imag)
        q.z, q.w = math.sin((yaw + turn) / 2), math.cos((yaw + turn) / 2)
        m.twist.twist.linear.x, m.twist.twist.angular.z = float(way / seconds), turn / seconds

    return {ODOMETRY: change}


def no_gyroscope():
    """Changes that leave out the gyroscope."""
    return {IMU: lambda m, _: []}


def cut_nanoseconds(m, _):
    """A driver that puts all nanoseconds into the field for those of a second."""
    m.header.stamp.nanosec = stamp_of(m) % 2**32


def columns(first, last):
    """Panoramas from one column to another: beyond the width, columns are repeated."""
    return seen(lambda image, rng: np.take(image, range(first, last), axis=1, mode='wrap'))


def ahead(topic, seconds):
    """Changes that stamp a topic so many s ahead."""
    return {topic: lambda m, _: restamp(m, stamp_of(m) + round(seconds * SECOND_NS))}


def fast(topic, rate):
    """Changes by a clock that gains `rate` s in each second since the first message."""
    first = []

    def change(m, _):
        first.append(stamp_of(m))
        restamp(m, first[0] + round((first[-1] - first[0]) * (1 + rate)))

    return {topic: change}


def following(lag_s):
    """Changes by a camera that turns its images after the robot, with a lag."""
    state = {}

    def turned(m, _):
        q, now = m.pose.pose.orientation, stamp_of(m)
        yaw = 2 * np.arctan2(q.z, q.w)
        before, shown = state.get('yaw', (now, yaw))
        behind = (yaw - shown + np.pi) % (2 * np.pi) - np.pi
        shown += behind * -np.expm1((before - now) / (lag_s * SECOND_NS))
        state.update(yaw=(now, shown), behind=yaw - shown)

    def roll(m, _):
        image = cv2.imdecode(np.asarray(m.data), cv2.IMREAD_COLOR)
        columns = round(-state.get('behind', 0.0) * image.shape[1] / (2 * np.pi))
        m.data = cv2.imencode('.jpg', np.roll(image, columns, 1))[1].ravel()

    return {ODOMETRY: turned, IMAGES: roll}


def fixed(m, rng):
    """A receiver of satellites, 50 degrees north, with corrections of a base station."""
    east, north = np.array([m.pose.position.x, m.pose.position.y]) + rng.normal(0, 0.02, 2)
    answer = blank(STORE, FIX)
    answer.header, answer.position_covariance_type = m.header, 2
    answer.position_covariance[[0, 4]] = 0.02**2
    answer.latitude, answer.longitude = 50 + north / 111_229.0, 8 + east / 71_695.8
    return [answer]


def late_fixes(m, rng):
    """The same receiver 0.3 s late, with an antenna 0.4 m ahead that no tf states."""
    yaw = 2 * math.atan2(m.pose.orientation.z, m.pose.orientation.w)
    m.pose.position.x += 0.4 * math.cos(yaw)
    m.pose.position.y += 0.4 * math.sin(yaw)
    restamp(m, stamp_of(m) + 300_000_000)
    return fixed(m, rng)


def unpacked(m, _):
    """A driver that leaves out the step of raw images."""
    image = decode_compressed(m.data)
    answer = blank(STORE, IMAGE)
    answer.header, answer.encoding, answer.data = m.header, 'bgr8', image.ravel()
    answer.height, answer.width = image.shape[:2]
    return [answer]


def paused(begin_s=55, end_s=80):
    """A recording that paused while the robot drove on, and odometry that started anew."""
    times, starts = [], []

    def seconds(m):
        times.append(stamp_of(m))
        return (times[-1] - times[0]) / SECOND_NS

    def kept(m, _):
        return [] if begin_s < seconds(m) < end_s else [m]

    def started_anew(m, _):
        pose, driven_s = m.pose.pose, seconds(m)
        if driven_s < end_s:
            return [m] if driven_s <= begin_s else []
        yaw, place = read_yaw(pose.orientation), pose.position.x + 1j * pose.position.y
        starts.append((yaw, place))
        yaw, place = yaw - starts[0][0], (place - starts[0][1]) * np.exp(-1j * starts[0][0])
        pose.position.x, pose.position.y = place.real, place.imag
        pose.orientation.z, pose.orientation.w = np.sin(yaw / 2), np.cos(yaw / 2)
        return [m]

    return dict.fromkeys((IMAGES, IMU, TRUTH), kept) | {ODOMETRY: started_anew}


def cut_off(m, rng, share=0.125):
    """A camera that loses bytes in the middle of some JPEGs."""
    if rng.random() < share:
        first = int(len(m.data) * rng.uniform(0.25, 0.6))
        m.data = np.delete(m.data, slice(first, first + len(m.data) // 4))


def as_video(key_every=30):
    """A driver that publishes H.264, with a key frame every few images."""
    import av

    encoder = av.CodecContext.create('libx264', 'w')
    encoder.options = {'tune': 'zerolatency', 'crf': '18', 'g': str(key_every)}
    encoder.pix_fmt, encoder.time_base = 'yuv420p', Fraction(1, 10)
    encoder.width, encoder.height = 600, 60

    def encode(m, _):
        frame = av.VideoFrame.from_ndarray(decode_compressed(m.data), format='bgr24')
        packets = encoder.encode(frame.reformat(format='yuv420p'))
        m.format, m.data = 'h264', np.frombuffer(b''.join(map(bytes, packets)), np.uint8)

    return encode


def true(change):
    """A ground truth whose place x + i y, m, and heading, rad, are changed."""

    def altered(m, _):
        p, q = m.pose.position, m.pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        place, yaw = change(complex(p.x, p.y), yaw)
        p.x, p.y, q.z, q.w = place.real, place.imag, math.sin(yaw / 2), math.cos(yaw / 2)
        if not np.isfinite(yaw):
            q.z = q.w = 0.0

    return {TRUTH: altered}


def occluded():
    """A tracker that repeats its last pose for a second in each six."""
    seen = []

    def altered(m, _):
        seen.append(seen[-1] if len(seen) % 150 > 124 else m.pose)
        m.pose = seen[-1]

    return {TRUTH: altered}


def wandering():
    """The ground truth of another robot."""
    seconds = itertools.count()
    path = (complex(3 * math.cos(at / 90), 2 * math.sin(at / 40)) for at in seconds)
    return true(lambda place, yaw: (next(path), yaw))[TRUTH]


def seen(change):
    """A change of panoramas (H, W, 3)."""

    def changed(m, rng):
        image = change(decode_compressed(m.data.tobytes()), rng)
        m.data = np.frombuffer(encode_jpeg(image, 90), np.uint8)

    return {IMAGES: changed}


def body(share, top=0.0, plain=False):
    """The robot itself, textured or plain gray, behind: on a share of the columns, and from a share
    of the height downward.
    """
    colors = np.random.default_rng(7).integers(0, 255, (6, 15, 3), np.uint8)

    def change(image, rng):
        height, width = image.shape[:2]
        size = round(share * width), height - round(top * height)
        part = cv2.resize(colors, size, interpolation=cv2.INTER_NEAREST)
        part = np.full_like(part, 90) if plain else part
        image = np.roll(image, size[0] // 2, axis=1)
        image[-size[1] :, : size[0]] = part
        return np.roll(image, -(size[0] // 2), axis=1)

    return seen(change)


def mounted(roll, pitch, yaw):
    """A camera that sits on the robot at these angles, degrees."""
    turn = rotation(*np.radians([roll, pitch, yaw]))

    def change(image, rng):
        sphere, size = PanoramaConfig().sphere, image.shape[:2]
        pixels = sphere.pixels(sphere.rays(*size) @ turn.T, *size).astype(np.float32)
        around = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
        maps = pixels[..., 0] + 1, pixels[..., 1]
        return cv2.remap(around, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return seen(change)


TROUBLES = {
    'truth: 5 % zeros': Trouble(
        lambda: {TRUTH: lost}, 'ground truth: .* of .* messages contradict', trains=False
    ),
    'truth: 0.3 s late': Trouble(
        lambda: ahead(TRUTH, 0.3),
        'ground truth is stamped 0.3. s late', trains=False,
    ),
    'gyroscope: 20 % zeros': Trouble(
        lambda: {IMU: wrong_rate(0.2, 0.0)}, 'gyroscope: .* contradict wheels and images'
    ),
    'gyroscope: 1 % spikes': Trouble(
        lambda: {IMU: wrong_rate(0.01, 30.0)}, 'gyroscope: .* contradict wheels and images'
    ),
    'gyroscope: held': Trouble(
        lambda: {IMU: held_rate()}, 'gyroscope: .* contradict wheels and images'
    ),
    'gyroscope: half of it zeros': Trouble(
        lambda: {IMU: wrong_rate(0.5, 0.0)}, 'gyroscope: left out: the wheels agree better'
    ),
    'odometry: two publishers': Trouble(
        lambda: {ODOMETRY: second_publisher()}, 'two publishers on /odom: .*; stop one', None
    ),
    'odometry: single zeros': Trouble(
        lambda: {ODOMETRY: zeros_at_times},
        'messages left out: pose beside the path',
    ),
    'odometry: poses five times, no twist': Trouble(
        # Its poses are 0.1 s old on average, for which single images are compared with the truth.
        lambda: stale(5), 'SFA, one', (0.11, 0.055), trains=False
    ),
    'odometry: no orientation': Trouble(
        lambda: {ODOMETRY: unoriented},
        'the orientation is never filled; the twist is integrated',
    ),
    'odometry: tracks that skid, no gyroscope': Trouble(
        lambda: counting(lambda way, turn: (way, 1.3 * turn)) | no_gyroscope(),
        r'wheels: 0\.7\d+ times the turns counted',
    ),
    'odometry: turns twice as far in the test': Trouble(
        lambda: counting(lambda way, turn: (way, 2.0 * turn)),
        # Until the turns of the first curve show it, the filter turns twice as far.
        r'wheels: 0\.(49|5\d) times the turns counted, 1\.', (0.055, 0.065), trains=False,
    ),
    'odometry: half of the turns': Trouble(
        lambda: counting(lambda way, turn: (way, 0.5 * turn)),
        r'wheels: (1\.9|2\.0)\d+ times the turns',
    ),
    'odometry: whole seconds': Trouble(
        lambda: {ODOMETRY: lambda m, _: restamp(m, stamp_of(m) // SECOND_NS * SECOND_NS)},
        'drivers that stamp whole seconds: use the time of reception', None,
    ),
    'odometry: nanoseconds of 1e9 and more': Trouble(
        lambda: {ODOMETRY: cut_nanoseconds}, 'stamps of 1e9 nanoseconds or more: use', None,
    ),
    'odometry: left encoder dead': Trouble(
        lambda: counting(lambda way, turn: (way / 2 + 0.075 * turn, way / 0.3 + turn / 2)),
        'ground truth drives 2.* times as far as odometry', None,
    ),
    'panoramas of 330 degrees': Trouble(
        lambda: columns(25, 575), 'gyroscope, as panoramas of 33. degrees would', (0.4, 0.25)
    ),
    'panoramas of 345 degrees': Trouble(
        lambda: columns(12, 588), 'gyroscope, as panoramas of 34. degrees would', (0.25, 0.2)
    ),
    'panoramas of 400 degrees': Trouble(
        lambda: columns(-33, 633), 'gyroscope, as panoramas of 40. degrees would', (0.45, 0.35)
    ),
    'odometry: quaternion of zeros': Trouble(
        lambda: {ODOMETRY: lambda m, _: fill(m, 0.0, (0, 0, 0, 0))},
        'have no pose .*; the twist is integrated',
    ),
    'odometry: NaN poses': Trouble(
        lambda: {ODOMETRY: lambda m, _: fill(m, math.nan, (0, 0, 0, 1))},
        'have no pose .*; the twist is integrated',
    ),
    'images: TAI': Trouble(
        lambda: ahead(IMAGES, 37), r'images: stamped 37\.0 s ahead .* in TAI'
    ),
    'odometry: GPS time': Trouble(
        lambda: ahead(ODOMETRY, 18), r'images: stamped 18\.0 s behind .*/odom in GPS time'
    ),
    'images: an hour behind': Trouble(
        lambda: ahead(IMAGES, -3600.4), r'images: stamped 3600\.4 s behind'
    ),
    'images: 0.3 % fast': Trouble(
        # In a test drive of 32 s it gains 0.1 s, too little to be certain of.
        lambda: fast(IMAGES, 0.003), r'images: their clock runs 0\.30 % fast', (0.07, 0.05)
    ),
    'odometry: 0.5 % slow': Trouble(
        # The truth keeps the clock of the images, and is corrected by a constant delay alone.
        lambda: fast(ODOMETRY, -0.005), r'odometry: its clock runs 0\.50 % slow', (0.1, 0.11)
    ),
    'images follow the turns': Trouble(
        lambda: following(0.5), "images follow the robot's turns with a lag of 0.5 s", None
    ),
    'points: fixes of a receiver': Trouble(
        lambda: {TRUTH: fixed}, 'latitude .*, longitude .* is the origin', (0.06, 0.07),
        options=('--points-topic', TRUTH), kinds={TRUTH: FIX},
    ),
    'points: 0.3 s late, antenna 0.4 m ahead': Trouble(
        # The truth, which lies there too, is placed by the wheels of a test drive of 32 s.
        lambda: {TRUTH: late_fixes}, 'points_topic is stamped 0.3. s late', (0.07, 0.09),
        options=('--points-topic', TRUTH), kinds={TRUTH: FIX},
    ),
    'images: step left out': Trouble(
        lambda: {IMAGES: unpacked}, 'images: 140 used', kinds={IMAGES: IMAGE},
    ),
    'odometry: starts anew after a pause': Trouble(
        paused, 'odometry pauses once, first after 55.0 s', (0.08, 0.06),
    ),
    'images: JPEGs cut off': Trouble(
        lambda: {IMAGES: cut_off}, 'images: .* cut-off JPEG'
    ),
    'images: H.264': Trouble(lambda: {IMAGES: as_video()}, 'images: 140 used'),
    'body behind, a quarter': Trouble(
        lambda: body(0.25), 'the view from 13. to 23. degrees .* shows the robot', (0.15, 0.1)
    ),
    'body behind, the lower half': Trouble(
        lambda: body(0.2, top=0.5, plain=True), 'the lower [45].% of the view from 1', (0.1, 0.07)
    ),
    'mast behind, hidden': Trouble(
        lambda: body(0.06), 'SFA, one', (0.065, 0.06), camera='blind_sectors: [165.0, 195.0]'
    ),
    'body behind, a quarter, hidden': Trouble(
        lambda: body(0.25), 'SFA, one', (0.15, 0.1), camera='blind_sectors: [134.0, 226.0]'
    ),
    'camera askew': Trouble(
        lambda: mounted(10.0, 0.0, 30.0), 'the camera leans by 9.. degrees to the r', (0.09, 0.065)
    ),
    'camera askew, mount_rpy set': Trouble(
        lambda: mounted(5.0, 0.0, 30.0), 'SFA, one', (0.06, 0.05),
        camera='mount_rpy: [5.0, 0.0, 30.0]',
    ),
    'truth: 0.15 s early': Trouble(
        lambda: ahead(TRUTH, -0.15),
        'ground truth is stamped 0.1. s early', trains=False,
    ),
    'truth: marker 0.45 m beside base_link': Trouble(
        lambda: true(lambda place, yaw: (place + (0.4 + 0.2j) * np.exp(1j * yaw), yaw)),
        'ground truth lies 0.4. m ahead of and 0.(19|2.) m to the left', trains=False,
    ),
    'truth: x and y swapped': Trouble(
        lambda: true(lambda place, yaw: (1j * place.conjugate(), math.pi / 2 - yaw)),
        'ground truth is mirrored',
    ),
    'truth: millimeters': Trouble(
        lambda: true(lambda place, yaw: (1000 * place, yaw)),
        'ground truth is in millimeters; converted', trains=False,
    ),
    'truth: no heading': Trouble(
        lambda: true(lambda place, yaw: (place, math.nan)),
        'ground truth has no headings of base_link; they are not judged', trains=False,
    ),
    'truth: last pose held': Trouble(
        occluded, 'ground truth: 1.. of 810 messages contradict', trains=False
    ),
    'truth: of another drive': Trouble(
        lambda: {TRUTH: wandering()}, 'ground truth moves independently', None, trains=False
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
