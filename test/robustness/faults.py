# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What goes wrong: each fault makes the messages of a drive from what happened.

Most last from FROM_S to UNTIL_S of the drive; the robot drives properly before and after.
"""

import dataclasses
import functools
import math

import cv2
import numpy as np

from robustness.recorded import SECOND_NS, foreign_pictures, noisy, odometry_poses

FROM_S, UNTIL_S = 15.0, 30.0
CONSISTENT_LIE_S = 2.0
"""Seconds for which a lie that was there from the start, and contradicts nothing at first, may be
believed."""
SAME_PLACE_S = 20.0
"""Images of another robot in the same garden contradict nothing for as long as both drive alike:
nothing promises that they are noticed."""
NOTICED_S = 1.0
"""A robot that is moved, or held, suddenly is noticed by the next few images: one alone may err."""
DOWN_S = 2.0
"""A node that was killed is back after so many seconds."""
STANDING_HZ = 5
"""Rate of pictures where the robot stands."""
LAP = 0.5
"""Of the drive, which is two laps."""
ONE_IMAGE_S = 0.25
"""By rounding, another machine may reject an image earlier or later."""
SLIP_S, DARK_S = 8.0, 4.0
"""How long wheels slip, and how long a kidnapped robot sees nothing."""
CARRIED_S = 9.0
"""A kidnapped robot is put down where it would have been so much later."""


@dataclasses.dataclass(frozen=True, slots=True)
class Reading:
    """What the wheels say: pose (3,), twist (2,) and variances (2,)."""

    pose: np.ndarray
    twist: np.ndarray
    variances: np.ndarray


@dataclasses.dataclass(frozen=True, slots=True)
class Picture:
    """A picture (H, W, 3) uint8 BGR, or a JPEG file that may be damaged."""

    image: np.ndarray | None = None
    jpeg: bytes | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class Restart:
    """A node is killed, or has come back."""

    node: str
    up: bool


@dataclasses.dataclass(frozen=True, slots=True)
class Message:
    """What arrives at `at_ns` with a stamp; `true` (3,) is the pose where it was measured."""

    at_ns: int
    stamp_ns: int
    content: Reading | Picture | Restart
    true: np.ndarray | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class Fault:
    """Makes messages of a `World` and a random generator; `ends_s` is when all is well again.

    `allowed_s` are the seconds for which the filter may be LOCALISED and wrong.
    """

    make: object
    ends_s: float = UNTIL_S
    allowed_s: float = 0.0

    def allows(self, false_s):
        """Whether so many seconds LOCALISED and wrong are not too long."""
        return false_s <= (self.allowed_s + ONE_IMAGE_S if self.allowed_s else 0.0)

    def messages(self, world):
        """The messages in the order in which they arrive."""
        made = self.make(world, np.random.default_rng(0))
        return sorted(made, key=lambda message: message.at_ns)


FAULTS = {}
NEVER = math.inf


def fault(name, **properties):
    """Enter a function into the table of faults."""

    def enter(function):
        FAULTS[name] = Fault(function, **properties)
        return function

    return enter


def messages(world):
    """All messages of a drive, without any fault."""
    readings = zip(
        world.times_ns, odometry_poses(world.steps), world.twists, world.variances, world.true,
        strict=True,
    )  # fmt: skip
    found = [Message(int(t), int(t), Reading(*values), true) for t, *values, true in readings]
    seen = zip(world.pictures_ns, world.pictures, strict=True)
    return found + [Message(int(t), int(t), Picture(image)) for t, image in seen]


def lasting(world, message, start_s=FROM_S, stop_s=UNTIL_S):
    """Whether a message is of the time of the fault."""
    return start_s <= (message.at_ns - world.times_ns[0]) * 1e-9 < stop_s


def changed(kind, change, start_s=FROM_S, stop_s=UNTIL_S):
    """A fault of messages: `change` makes a list of messages of each that it concerns."""

    def make(world, rng):
        for message in messages(world):
            if isinstance(message.content, kind) and lasting(world, message, start_s, stop_s):
                yield from change(message, rng)
            else:
                yield message

    return make


def pictures_changed(change, start_s=FROM_S, stop_s=UNTIL_S):
    """A fault of pictures: `change` makes another (H, W, 3) of each, its number and a generator."""

    def make(world, rng):
        seconds = world.seconds(world.pictures_ns)
        pictures = world.pictures.copy()
        for i in np.flatnonzero((start_s <= seconds) & (seconds < stop_s)):
            pictures[i] = change(world.pictures, i, rng)
        return messages(dataclasses.replace(world, pictures=pictures))

    return make


def enter_all(made, **properties):
    """Enter faults by name."""
    FAULTS.update({name: Fault(make, **properties) for name, make in made.items()})


# Messages that are lost, late, double or in another order.


def dropped(share):
    return lambda message, rng: [message] if rng.random() >= share else []


def delayed(seconds, spread_s=0.0):
    def late(message, rng):
        delay_s = seconds + spread_s * rng.random()
        return [dataclasses.replace(message, at_ns=message.at_ns + round(delay_s * SECOND_NS))]

    return late


def bundled(message, _):
    """Sent, and stamped, together with all of the same 40 ms, hardly apart."""
    bundle_ns = SECOND_NS // 25
    left_ns = -message.stamp_ns % bundle_ns
    at_ns = message.stamp_ns + left_ns - left_ns // 40
    return [dataclasses.replace(message, at_ns=at_ns, stamp_ns=at_ns)]


def received(message, rng):
    """Stamped when it arrives, 10 ms late on average."""
    at_ns = message.at_ns + round(rng.exponential(0.01) * SECOND_NS)
    return [dataclasses.replace(message, at_ns=at_ns, stamp_ns=at_ns)]


def stalled(world, rng):
    """All is stamped when it arrives over a network that now and then stalls, for up to 0.6 s."""
    begins_s = np.cumsum(rng.uniform(0.6, 4.0, round(world.seconds(world.times_ns)[-1])))
    ends_s = begins_s + rng.uniform(0.1, 0.6, len(begins_s))
    last_s, sent = 0.0, []
    for message in sorted(messages(world), key=lambda message: message.at_ns):
        at_s = float(world.seconds(message.at_ns))
        held_s = ends_s[(begins_s <= at_s) & (at_s < ends_s)]
        last_s = max(at_s, last_s + 1e-4, *held_s)
        at_ns = int(world.times_ns[0]) + round(last_s * SECOND_NS)
        sent.append(dataclasses.replace(message, at_ns=at_ns, stamp_ns=at_ns))
    return sent


def doubled(message, _):
    return [message, dataclasses.replace(message, at_ns=message.at_ns + SECOND_NS // 10)]


enter_all({
    'nothing': lambda world, _: messages(world),
    'images dropped': changed(Picture, dropped(1.0)),
    'half of the images dropped': changed(Picture, dropped(0.5)),
    'images 2 s late': changed(Picture, delayed(2.0)),
    'images 8 s late': changed(Picture, delayed(8.0)),
    'images doubled': changed(Picture, doubled),
    'images in disorder': changed(Picture, delayed(0.0, 2.0)),
    'odometry dropped for 5 s': changed(Reading, dropped(1.0), stop_s=FROM_S + 5.0),
    'half of the odometry dropped': changed(Reading, dropped(0.5)),
    'odometry 1 s late': changed(Reading, delayed(1.0)),
    'odometry doubled': changed(Reading, doubled),
    'odometry in disorder': changed(Reading, delayed(0.0, 0.5)),
    'images and odometry dropped': changed((Picture, Reading), dropped(1.0)),
})  # fmt: skip
enter_all({
    'odometry sent in bundles': changed(Reading, bundled, 0.0, NEVER),
    'odometry stamped on reception': changed(Reading, received, 0.0, NEVER),
    'all stamped on reception, with stalls': stalled,
}, ends_s=NEVER)  # fmt: skip


# Pictures that are damaged, stand still, are hidden, or show something else.


def damaged(message, rng):
    """Its JPEG with some bytes overwritten, or cut off."""
    _, data = cv2.imencode('.jpg', message.content.image)
    data = data.copy().ravel()
    if rng.random() < 0.5:
        data = data[: rng.integers(len(data) // 4, len(data))]
    else:
        data[rng.integers(len(data) // 10, len(data), 20)] = rng.integers(0, 256, 20)
    return [dataclasses.replace(message, content=Picture(jpeg=data.tobytes()))]


def frozen(std, step=0, gain=0.0):
    """The picture where the fault began, in turns with one `step` before, with noise."""
    begin = []

    def change(pictures, i, rng):
        if not begin:
            begin.append(i)
        image = pictures[begin[0] - (i % 2) * step] * (1 + gain * math.sin(i))
        return noisy(image, rng, std)

    return change


def blackened(share, begin):
    def change(pictures, i, _):
        image = pictures[i].copy()
        width = image.shape[1]
        image[:, int(begin * width) : int((begin + share) * width)] = 0
        return image

    return change


def covered(share, begin):
    """As by a hand: flat brown, without the sharp edge."""

    def change(pictures, i, rng):
        image = pictures[i]
        width = image.shape[1]
        hidden = np.zeros(image.shape[:2], np.float32)
        hidden[:, int(begin * width) : int((begin + share) * width)] = 1.0
        hidden = cv2.GaussianBlur(hidden, (0, 0), 6)[:, :, None]
        return noisy(image * (1 - hidden) + hidden * np.array([60.0, 80.0, 120.0]), rng)

    return change


def rolled(degrees):
    return lambda pictures, i, _: np.roll(
        pictures[i], round(degrees / 360 * pictures.shape[2]), axis=1
    )


def off_center(degrees):
    """As by a mirror, or a whole camera, that sits beside where it was: things close up ahead."""

    def change(pictures, i, _):
        height, width = pictures[i].shape[:2]
        angle = 2 * np.pi * np.arange(width) / width
        columns = np.arange(width) + degrees / 360 * width * np.sin(angle)
        x = np.tile(columns % width, (height, 1)).astype(np.float32)
        y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
        closed = np.hstack([pictures[i], pictures[i][:, :1]])  # remap interpolates over the seam
        return cv2.remap(closed, x, y, cv2.INTER_LINEAR)

    return change


def gray(pictures, i, _):
    return cv2.cvtColor(cv2.cvtColor(pictures[i], cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)


PICTURES = {
    'black': lambda pictures, i, _: np.zeros_like(pictures[i]),
    'a quarter black': blackened(0.25, 0.3),
    'half black': blackened(0.5, 0.1),
    'a quarter covered': covered(0.25, 0.6),
    'half covered': covered(0.5, 0.4),
    'mirrored': lambda pictures, i, _: pictures[i][:, ::-1],
    'upside down': lambda pictures, i, _: pictures[i][::-1],
    'of a foreign garden': lambda pictures, i, _: foreign_pictures()[i % len(foreign_pictures())],
    'of noise': lambda pictures, i, rng: rng.integers(0, 256, pictures[i].shape),
    'blurred': lambda pictures, i, _: cv2.GaussianBlur(pictures[i], (0, 0), 5),
    'gray': gray,
    'brighter by half': lambda pictures, i, _: np.minimum(pictures[i] * 1.5, 255),
    'from anywhere': lambda pictures, _, rng: pictures[rng.integers(len(pictures))],
    'of a slipped mirror': off_center(8),
}
ALSO_FROM_START = (
    'a quarter black', 'half black', 'a quarter covered', 'mirrored', 'of a foreign garden',
    'of a slipped mirror',
)  # fmt: skip
enter_all({f'images {name}': pictures_changed(change) for name, change in PICTURES.items()})
enter_all({
    f'images {name}, from the start': pictures_changed(PICTURES[name], 0.0)
    for name in ALSO_FROM_START
})  # fmt: skip
enter_all(
    {
        f'images of another robot, {part:g} of the lap ahead': pictures_changed(
            lambda pictures, i, _, part=part: pictures[
                (i + int(part * LAP * len(pictures))) % len(pictures)
            ],
            0.0,
            NEVER,
        )
        for part in (0.3, 0.6)
    },
    ends_s=NEVER,
    allowed_s=SAME_PLACE_S,
)
enter_all({'images damaged': changed(Picture, damaged)})
STANDING = {
    'camera frozen': (0.0,),
    'camera frozen, with noise': (6.0,),
    'camera frozen, noise and gain': (6.0, 0, 0.1),
    'two frames in turns': (3.0, 1),
    'two far frames in turns': (3.0, 20),
}
enter_all({
    # Each drive has a freeze of its own: where it began is remembered.
    name: lambda world, rng, how=how: pictures_changed(frozen(*how))(world, rng)
    for name, how in STANDING.items()
})  # fmt: skip
enter_all(
    {f'camera turned by {degrees} degrees': pictures_changed(rolled(degrees), FROM_S, NEVER)
     for degrees in (30, 90)},
    ends_s=NEVER,
)  # fmt: skip


# Clocks.


def stamped(seconds, kind=Picture, start_s=0.0, stop_s=NEVER):
    """The stamps are so many seconds ahead."""
    later = round(seconds * SECOND_NS)
    return changed(
        kind,
        lambda message, _: [dataclasses.replace(message, stamp_ns=message.stamp_ns + later)],
        start_s,
        stop_s,
    )


enter_all(
    {f'clock of the camera {s:+g} s': stamped(s) for s in (-7.0, -2.0, -0.3, 0.3, 2.0, 7.0)},
    ends_s=NEVER,
    allowed_s=CONSISTENT_LIE_S,
)
enter_all({
    f'clock of the camera steps {s:+g} s': stamped(s, Picture, FROM_S, UNTIL_S)
    for s in (-2.0, -0.3, 0.3, 2.0)
})  # fmt: skip
enter_all(
    {f'all clocks step {s:+g} s': stamped(s, (Picture, Reading), FROM_S) for s in (-100, -3, 3)},
    ends_s=FROM_S,
)
# Three messages pass before odometry of times that have passed is no accident.
enter_all(
    {'all clocks step -1.71 s': stamped(-1.71, (Picture, Reading), FROM_S)},
    ends_s=FROM_S,
    allowed_s=0.1,
)


# Wheels that slip, robots that are carried.


def slip(world, rng, twist=(0.6, 0.3)):
    """The wheels turn for some seconds while the robot stands."""
    before, after = world.part(0.0, FROM_S), world.part(FROM_S, NEVER)
    period = int(np.median(np.diff(world.times_ns)))
    count, seen = round(SLIP_S * SECOND_NS / period), round(SLIP_S * STANDING_HZ)
    angle = twist[1] * period * 1e-9
    step = [twist[0] * period * 1e-9, 0.0, angle]
    standing = dataclasses.replace(
        before,
        times_ns=np.arange(count) * period,
        steps=np.tile(step, (count, 1)),
        twists=np.tile(twist, (count, 1)),
        variances=np.repeat(before.variances[-1:], count, axis=0),
        true=np.repeat(before.true[-1:], count, axis=0),
        pictures_ns=np.arange(seen) * (SECOND_NS // STANDING_HZ),
        pictures=noisy(np.repeat(before.pictures[-1:], seen, axis=0), rng),
    )
    return messages(before.followed_by(standing).followed_by(after))


def pushed(world, _):
    """The robot moves for some seconds while the wheels say that it stands."""
    t = world.seconds(world.times_ns)
    during = (t >= FROM_S) & (t < FROM_S + SLIP_S)
    steps, twists = world.steps.copy(), world.twists.copy()
    steps[during] = twists[during] = 0.0
    return messages(dataclasses.replace(world, steps=steps, twists=twists))


def kidnapped(world, _):
    """In the middle of the drive the robot is put down elsewhere, in no time."""
    before = world.part(0.0, FROM_S)
    return messages(before.followed_by(world.part(FROM_S + CARRIED_S, NEVER)))


def kidnapped_in_the_dark(world, _):
    """The same while the camera shows nothing, which lasts some seconds more."""
    before, after = world.part(0.0, FROM_S), world.part(FROM_S + CARRIED_S, NEVER)
    keep = after.seconds(after.pictures_ns) >= DARK_S
    after = dataclasses.replace(
        after, pictures_ns=after.pictures_ns[keep], pictures=after.pictures[keep]
    )
    return messages(before.followed_by(after))


enter_all(
    {'wheels slip': slip, 'robot pushed': pushed}, ends_s=FROM_S + SLIP_S, allowed_s=NOTICED_S
)
enter_all({'kidnapped': kidnapped}, ends_s=FROM_S, allowed_s=NOTICED_S)
# Nothing shows it until images are missed.
enter_all(
    {'kidnapped in the dark': kidnapped_in_the_dark},
    ends_s=FROM_S + DARK_S,
    allowed_s=1.5,
)


# Nodes that end and come back.


def restarted(node, world, _):
    begin, back = (int(world.times_ns[0] + s * SECOND_NS) for s in (FROM_S, FROM_S + DOWN_S))
    return [
        *messages(world),
        Message(begin, begin, Restart(node, False)),
        Message(back, back, Restart(node, True)),
    ]


NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
enter_all(
    {f'{node} restarted': functools.partial(restarted, node) for node in NODES},
    ends_s=FROM_S + DOWN_S,
)
