# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Faults and lies: each changes the messages of a recorded drive, most from FROM_S to UNTIL_S.

FAULTS change pictures and odometry; LIES, which contradict nothing at first, the poses by images.
"""

import functools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from robustness.messages import SECOND_NS, Message, Picture, Reading, Restart, Seen
from robustness.recorded import foreign_pictures, noisy

FROM_S, UNTIL_S, NEVER = 15.0, 30.0, math.inf
CONSISTENT_LIE_S = 2.0
"""Seconds for which a lie from the start may be believed."""
SAME_PLACE_S = 20.0
"""Images of another robot in the same garden contradict nothing while both drive alike: they need
not be noticed."""
NOTICED_S = 1.0
"""A robot or camera that is moved or held is noticed after a few images."""
DOWN_S = 2.0
"""A node that was killed is back after so many seconds."""
STANDING_HZ = 5
"""Rate of pictures where the robot stands."""
LAP = 0.5
"""Share of the drive, which is two laps."""
IMAGE_PERIOD_S = 0.25
"""By rounding, another machine may reject an image earlier or later."""
SLIP_S, DARK_S, CARRIED_S = 8.0, 4.0, 9.0
"""How long wheels slip, and how long a kidnapped robot sees nothing; it is put down where it would
have been CARRIED_S later."""


@dataclass(frozen=True)
class Fault:
    """Makes messages of a drive and a random generator; `ends_s` is when all is well again, and
    `allowed_s` are the seconds for which the filter may be LOCALISED and wrong.
    """

    make: object
    ends_s: float = UNTIL_S
    allowed_s: float = 0.0

    def allows(self, false_s):
        """Whether so many seconds LOCALISED and wrong are not too long."""
        return false_s <= (self.allowed_s + IMAGE_PERIOD_S if self.allowed_s else 0.0)

    def messages(self, drive):
        """The messages in the order in which they arrive."""
        made = self.make(drive, np.random.default_rng(0))
        return sorted(made, key=lambda message: message.at_ns)


FAULTS, LIES = {}, {}


def enter(made, **properties):
    """Enter faults by name."""
    FAULTS.update({name: Fault(make, **properties) for name, make in made.items()})


def changed(kind, change, start_s=FROM_S, stop_s=UNTIL_S):
    """A fault of messages: `change` makes a list of messages of each that it concerns, a generator
    and the second of the drive.
    """

    def make(drive, rng):
        for message in drive.messages:
            second = (message.at_ns - drive.start_ns) / SECOND_NS
            if isinstance(message.content, kind) and start_s <= second < stop_s:
                yield from change(message, rng, second)
            else:
                yield message

    return make


def pictures_changed(change, start_s=FROM_S, stop_s=UNTIL_S):
    """A fault of pictures: `change` makes another (H, W, 3) of each, its number and a generator."""

    def make(world, rng):
        seconds, pictures = world.seconds(world.pictures_ns), world.pictures.copy()
        for i in np.flatnonzero((start_s <= seconds) & (seconds < stop_s)):
            pictures[i] = change(world.pictures, i, rng)
        return replace(world, pictures=pictures).messages

    return make


# Messages that are lost, late, double or in another order.


def dropped(share):
    return lambda message, rng, _: [message] if rng.random() >= share else []


def delayed(seconds, spread_s=0.0):
    return lambda message, rng, _: [message.later(seconds + spread_s * rng.random())]


def doubled(message, *_):
    return [message, message.later(0.1)]


def bundled(message, *_):
    """Sent, and stamped, together with all of the same 40 ms, hardly apart."""
    wait_ns = -message.stamp_ns % (SECOND_NS // 25)
    at_ns = message.stamp_ns + wait_ns - wait_ns // 40
    return [message._replace(at_ns=at_ns, stamp_ns=at_ns)]


def received(message, rng, _):
    """Stamped when it arrives, 10 ms late on average."""
    late_s = rng.exponential(0.01)
    return [message.later(late_s, late_s)]


def stalled(world, rng):
    """All is stamped when it arrives over a network that now and then stalls, for up to 0.6 s."""
    begins_s = np.cumsum(rng.uniform(0.6, 4.0, round(world.seconds(world.times_ns)[-1])))
    ends_s = begins_s + rng.uniform(0.1, 0.6, len(begins_s))
    last_s = 0.0
    for message in sorted(world.messages, key=lambda message: message.at_ns):
        at_s = float(world.seconds(message.at_ns))
        held_s = ends_s[(begins_s <= at_s) & (at_s < ends_s)]
        last_s = max(at_s, last_s + 1e-4, *held_s)
        at_ns = int(world.start_ns) + round(last_s * SECOND_NS)
        yield message._replace(at_ns=at_ns, stamp_ns=at_ns)


enter({
    'nothing': lambda world, _: world.messages,
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
enter({
    'odometry sent in bundles': changed(Reading, bundled, 0.0, NEVER),
    'odometry stamped on reception': changed(Reading, received, 0.0, NEVER),
    'all stamped on reception, with stalls': stalled,
}, ends_s=NEVER)  # fmt: skip


# Pictures that are damaged, stand still, are hidden, or show something else.


def damaged(message, rng, _):
    """Its JPEG with some bytes overwritten, or cut off."""
    data = cv2.imencode('.jpg', message.content.image)[1].copy().ravel()
    if rng.random() < 0.5:
        data = data[: rng.integers(len(data) // 4, len(data))]
    else:
        data[rng.integers(len(data) // 10, len(data), 20)] = rng.integers(0, 256, 20)
    return [message._replace(content=Picture(jpeg=data.tobytes()))]


def frozen(std, step=0, gain=0.0):
    """The picture where the fault began, in turns with one `step` before, with noise."""

    def make(world, rng):
        first = int(np.searchsorted(world.seconds(world.pictures_ns), FROM_S))

        def change(pictures, i, rng):
            image = pictures[first - (i % 2) * step] * (1 + gain * math.sin(i))
            return noisy(image, rng, std)

        return pictures_changed(change)(world, rng)

    return make


def hidden(image, share, begin):
    """Where (H, W, 1) a part of a panorama is hidden: 1, else 0."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width, 1), np.float32)
    mask[:, int(begin * width) : int((begin + share) * width)] = 1.0
    return mask


def blackened(share, begin):
    return lambda pictures, i, _: pictures[i] * (1 - hidden(pictures[i], share, begin))


def covered(share, begin):
    """As by a hand: flat brown, without the sharp edge."""

    def change(pictures, i, rng):
        share_hidden = cv2.GaussianBlur(hidden(pictures[i], share, begin), (0, 0), 6)[:, :, None]
        brown = share_hidden * np.array([60.0, 80.0, 120.0])
        return noisy(pictures[i] * (1 - share_hidden) + brown, rng)

    return change


def rolled(degrees):
    return lambda pictures, i, _: np.roll(pictures[i], round(degrees / 360 * pictures.shape[2]), 1)


def off_center(degrees):
    """As by a mirror, or a whole camera, that sits beside where it was: things close up ahead."""

    def change(pictures, i, _):
        height, width = pictures[i].shape[:2]
        columns = np.arange(width)
        columns = columns + degrees / 360 * width * np.sin(2 * np.pi * columns / width)
        x = np.tile(columns % width, (height, 1)).astype(np.float32)
        y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
        closed = np.hstack([pictures[i], pictures[i][:, :1]])  # remap interpolates over the seam
        return cv2.remap(closed, x, y, cv2.INTER_LINEAR)

    return change


def of_another_robot(part):
    return lambda pictures, i, _: pictures[(i + int(part * LAP * len(pictures))) % len(pictures)]


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
enter({f'images {name}': pictures_changed(change) for name, change in PICTURES.items()})
enter({
    f'images {name}, from the start': pictures_changed(PICTURES[name], 0.0)
    for name in ALSO_FROM_START
})  # fmt: skip
enter({
    f'images of another robot, {part:g} of the lap ahead':
        pictures_changed(of_another_robot(part), 0.0, NEVER)
    for part in (0.3, 0.6)
}, ends_s=NEVER, allowed_s=SAME_PLACE_S)  # fmt: skip
enter({
    'images damaged': changed(Picture, damaged),
    'camera frozen': frozen(0.0),
    'camera frozen, with noise': frozen(6.0),
    'camera frozen, noise and gain': frozen(6.0, 0, 0.1),
    'two frames in turns': frozen(3.0, 1),
    'two far frames in turns': frozen(3.0, 20),
})  # fmt: skip
enter({
    f'camera turned by {degrees} degrees': pictures_changed(rolled(degrees), FROM_S, NEVER)
    for degrees in (30, 90)
}, ends_s=NEVER, allowed_s=NOTICED_S)  # fmt: skip


# Clocks.


def stamped(seconds, kind=Picture, start_s=0.0, stop_s=NEVER):
    """The stamps are so many seconds ahead."""
    return changed(kind, lambda message, *_: [message.later(0.0, seconds)], start_s, stop_s)


BOTH = Picture, Reading
enter(
    {f'clock of the camera {s:+g} s': stamped(s) for s in (-7.0, -2.0, -0.3, 0.3, 2.0, 7.0)},
    ends_s=NEVER, allowed_s=CONSISTENT_LIE_S,
)  # fmt: skip
enter({
    f'clock of the camera steps {s:+g} s': stamped(s, Picture, FROM_S, UNTIL_S)
    for s in (-2.0, -0.3, 0.3, 2.0)
})  # fmt: skip
enter({f'all clocks step {s:+g} s': stamped(s, BOTH, FROM_S) for s in (-100, -3, 3)}, ends_s=FROM_S)
# Three messages pass before odometry of times that have passed is no accident.
enter({'all clocks step -1.71 s': stamped(-1.71, BOTH, FROM_S)}, ends_s=FROM_S, allowed_s=0.1)


# Wheels that slip, robots that are carried.


def slip(world, rng, twist=(0.6, 0.3)):
    """The wheels turn for some seconds while the robot stands."""
    before, after = world.part(0.0, FROM_S), world.part(FROM_S, NEVER)
    period = int(np.median(np.diff(world.times_ns)))
    count, seen = round(SLIP_S * SECOND_NS / period), round(SLIP_S * STANDING_HZ)
    step = [twist[0] * period * 1e-9, 0.0, twist[1] * period * 1e-9]
    standing = replace(
        before,
        times_ns=np.arange(count) * period,
        steps=np.tile(step, (count, 1)),
        twists=np.tile(twist, (count, 1)),
        variances=np.repeat(before.variances[-1:], count, axis=0),
        true=np.repeat(before.true[-1:], count, axis=0),
        pictures_ns=np.arange(seen) * (SECOND_NS // STANDING_HZ),
        pictures=noisy(np.repeat(before.pictures[-1:], seen, axis=0), rng),
    )
    return before.followed_by(standing).followed_by(after).messages


def pushed(world, _):
    """The robot moves for some seconds while the wheels say that it stands."""
    t = world.seconds(world.times_ns)
    during = (t >= FROM_S) & (t < FROM_S + SLIP_S)
    steps, twists = world.steps.copy(), world.twists.copy()
    steps[during] = twists[during] = 0.0
    return replace(world, steps=steps, twists=twists).messages


def kidnapped(world, _, dark_s=0.0):
    """In the middle of the drive the robot is put down elsewhere, in no time; the camera shows
    nothing for some seconds more.
    """
    before, after = world.part(0.0, FROM_S), world.part(FROM_S + CARRIED_S, NEVER)
    keep = after.seconds(after.pictures_ns) >= dark_s
    pictures_ns, pictures = after.pictures_ns[keep], after.pictures[keep]
    after = replace(after, pictures_ns=pictures_ns, pictures=pictures)
    return before.followed_by(after).messages


enter({'wheels slip': slip, 'robot pushed': pushed}, ends_s=FROM_S + SLIP_S, allowed_s=NOTICED_S)
enter({'kidnapped': kidnapped}, ends_s=FROM_S, allowed_s=NOTICED_S)
# Nothing shows it until images are missed.
in_the_dark = functools.partial(kidnapped, dark_s=DARK_S)
enter({'kidnapped in the dark': in_the_dark}, ends_s=FROM_S + DARK_S, allowed_s=1.5)


# Nodes that end and come back.


def restarted(node, world, _):
    yield from world.messages
    for second, up in ((FROM_S, False), (FROM_S + DOWN_S, True)):
        at_ns = int(world.start_ns + second * SECOND_NS)
        yield Message(at_ns, at_ns, Restart(node, up))


NODES = ('omnicam_node', 'sfa_node', 'ekf_node')
enter(
    {f'{node} restarted': functools.partial(restarted, node) for node in NODES},
    ends_s=FROM_S + DOWN_S,
)


# Lies: of the drive without a fault, as it reaches the filter.


def queued(delay_s):
    """Images that wait, and are stamped when they leave: `delay_s` of the second of the drive."""
    return lambda message, _, second: [message.later(delay_s(second), delay_s(second))]


def clocked(ahead_s):
    return lambda message, _, second: [message.later(0.0, ahead_s(second))]


def mounted(lever):
    """A camera that sits beside where it was: ahead, left in meters."""

    def change(message, *_):
        x, y, yaw = message.content.pose
        place = complex(x, y) + np.exp(1j * yaw) * lever
        return [seen_at(message, [place.real, place.imag, yaw], message.content.turned)]

    return change


def turning(degrees_per_s):
    """A camera that turns on its mast."""

    def change(message, _, second):
        angle = math.radians(degrees_per_s) * (second - FROM_S)
        pose = message.content.pose + np.array([0.0, 0.0, angle])
        return [seen_at(message, pose, message.content.turned + angle)]

    return change


def seen_at(message, pose, turned):
    content = message.content._replace(pose=np.array(pose), turned=turned)
    return message._replace(content=content)


def wheels(factor):
    """Wheels that read so many times the way."""

    def change(message, *_):
        read, scale = message.content, np.array([factor, factor, 1.0])
        read = read._replace(pose=read.pose * scale, twist=read.twist * scale[1:])
        return [message._replace(content=read)]

    return changed(Reading, change, 0.0, NEVER)


def looped(from_s, length_s):
    """A video that repeats its last seconds."""

    def lie(drive, rng):
        images = [m for m in drive.messages if isinstance(m.content, Seen)]
        at_s = np.array([(m.at_ns - drive.start_ns) / SECOND_NS for m in images])
        again_s = from_s - length_s + (at_s - from_s) % length_s
        source = np.where(at_s < from_s, np.arange(len(images)), np.searchsorted(at_s, again_s))
        contents = iter([images[i].content for i in source])
        made = changed(Seen, lambda m, *_: [m._replace(content=next(contents))], 0.0, NEVER)
        return made(drive, rng)

    return lie


LIES.update({
    name: Fault(changed(Seen, change, start_s, NEVER), NEVER)
    for name, change, start_s in (
        ('images 1 s late by a queue', queued(lambda _: 1.0), 0.0),
        ('images 2 s late by a queue', queued(lambda _: 2.0), 0.0),
        ('a queue that grows by 0.05 s/s', queued(lambda s: 0.05 * max(s - 10.0, 0.0)), 0.0),
        ('a queue that grows by 0.15 s/s', queued(lambda s: 0.15 * max(s - 10.0, 0.0)), 0.0),
        ('clock of the camera -1 s', clocked(lambda _: -1.0), 0.0),
        ('clock of the camera +1 s', clocked(lambda _: 1.0), 0.0),
        ('clock of the camera drifts -0.03 s/s', clocked(lambda s: -0.03 * s), 0.0),
        ('camera 1 m ahead', mounted(1.0 + 0j), FROM_S),
        ('camera 1.5 m to the left', mounted(1.5j), FROM_S),
        ('camera 1.5 m ahead, from the start', mounted(1.5 + 0j), 0.0),
        ('camera turns by 1 degree/s', turning(1.0), FROM_S),
        ('camera turns by 3 degrees/s', turning(3.0), FROM_S),
    )
})  # fmt: skip
LIES.update({
    'wheels read 0.8 of the way': Fault(wheels(0.8), NEVER),
    'wheels read 1.25 of the way': Fault(wheels(1.25), NEVER),
    'a video loops its last 8 s': Fault(looped(20.0, 8.0), NEVER),
})  # fmt: skip
