# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Whether images show where the robot was some seconds ago: the odds of every delay, by poses.

Late images show poses that the robot has had, one after the other: they lie on the odometry's path
of before, laid into the map where images in time have put it. A Bayes filter over the delay holds
for each the transform from odometry to the map, a small Kalman filter, which a delay that begins or
grows takes over from the one before. So a delay that grows on a circle shows, where turns alone do
not, and a video that loops, at its first images: hardly any robot is carried onto its own path to a
decimeter. In a curve, slip is no delay, because it turns no heading; on a straight line, large slip
looks like one. Images that lie elsewhere have an own hypothesis. `turn_watch` compares turns, which
also show images that are early.

Of a robot that drives steadily, on a line or a circle, from before it is first heard of, images may
be late by anything, and nothing shows it until it turns or stops. So delays that last from the
start are followed by themselves, as likely as none, until images have shown that they are in time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfa_localization.data.geometry import Array, wrap_angle
from sfa_localization.fusion.driven_path import (
    AS_BEFORE,
    COUNT,
    DELAYS,
    Complex,
    Knot,
    Path,
    continued,
    path_to,
)
from sfa_localization.fusion.pace import STANDING, TOLERATED_S, tolerated_s

_MARGIN_S = 0.1
"""Images err in places, so longer delays than those that turns show are no fault."""
_WRONG_M, _LEAST_S = 1.0, 0.25
"""No delay in which a robot drives so many meters is small, but one as short as this: cameras have
such."""
SUSPECTED, CLEARED = 0.5, 0.3
"""Probability of images of another time from which the estimate is not trusted, and below which it
is again."""
_LATEST_STEPS = 5
"""Of the path, whose speed is the present one."""
_NEAR = DELAYS <= TOLERATED_S + _MARGIN_S
_NEAR_SHARE = _NEAR / _NEAR.sum()
_SURPRISE = 1e-2
"""Probability of larger delays at the start."""
_BREAK, _HEAL, _ELSEWHERE = 1e-4, 1e-3, 1e-4
"""Probabilities, per image, that images in time come to any other delay, that others come to be in
time, and that any are of elsewhere from now on."""
_RESTARTED, _ANEW = 0.5, 0.05
"""Share of the images of elsewhere that are in time, because the robot is in another place: where
the filter has just moved it there, and where it has not."""
_DRIFT, _MOST_DRIFT = 0.7, 1 / 3
"""Probability, per second, that a delay moves by a step; the most of it per image."""
_BARRIER = 0.35
"""Share of the drifts that lead out of the delays of images in time, and back into them: where
nothing shows a delay, as on a circle, neither side grows."""
_EDGE = int(_NEAR.sum()) - 1
_UP, _DOWN = np.ones((2, COUNT))
# What cannot go one way goes the other: any delay that stays is as likely as any other one.
_UP[0], _UP[_EDGE], _UP[_EDGE + 1], _UP[-1] = 2.0, _BARRIER, 2 - _BARRIER, 0.0
_DOWN[0], _DOWN[_EDGE], _DOWN[_EDGE + 1], _DOWN[-1] = 0.0, 2 - _BARRIER, _BARRIER, 2.0
_ELSEWHERE_DENSITY = 1 / (100.0 * 2 * math.pi)
"""Of poses anywhere in 100 m^2, 1/(m^2 rad)."""
_EVIDENCE = 1.2
"""Factor on the odds of images in time against late ones from which an image counts for either."""
_OUTLIERS = 0.05
"""Share of the images that lie anywhere."""
_FLOOR_M, _FLOOR_RAD, _CAUTION = 0.1, 0.015, 2.0
"""Least standard deviations of images, and a factor on their variances: neighbors err alike."""
_SLIP, _YAW_PER_RADIAN, _YAW_PER_METER = 0.06, 0.03, 0.005
"""Errors of the odometry, m and rad per root of m or rad: thrice and one and a half times those
that the filter expects, because slip lasts for some meters."""
_LEAST_M, _LEAST_RAD = 0.08, 0.05
"""An image after less motion shows nothing new."""
_USELESS_VARIANCE = 4.0
"""m^2: images less certain than the robot moves in a few seconds show no delay."""
_SHOWN = 0.05
"""Images are in time where larger delays from the start are less likely."""
_FAR_M, _FAR_RAD = 0.5, 0.3
"""Where the robot has moved and turned less meanwhile, a delay does no harm."""
_LATELY_S, _LEARNT_S = 3.0, 10.0
"""A drive that is not steady for so long shows delays, and after so long the odometry's bias."""
_SCALE_ERROR, _LEAST_SEEN_RAD = 0.01, 0.1
"""Of the turns of good odometry; and what headings of images may have in error."""
_DENSITY = (2 * math.pi) ** -1.5
_TINY = 1e-300  # keeps quotients of vanishing odds finite


class Image(NamedTuple):
    """Where an image shows the robot, x + iy, and variances m^2, along each axis, and rad^2."""

    stamp_ns: int
    place: complex
    yaw: float
    variance: float
    yaw_variance: float


class Behind(NamedTuple):
    """By which angle rad images have turned more than odometry since a steady drive began, beyond
    what odometry errs (CUSUM: Page, Biometrika, 1954).

    Odometry with the `bias` of its turn rate, rad/s, that other driving has shown: images that fall
    behind look like another one. `seen` and `reckoned` are the headings rad of the newest image and
    by odometry.
    """

    stamp_ns: int
    seen: float
    reckoned: float
    bias: float
    angle: float = 0.0


class Lateness(NamedTuple):
    """The odds (K + 1,) of each delay and of elsewhere, and transforms from odometry to the map.

    A position p of the odometry's frame, x + iy, lies at turn p + shift, both (K,). `variance` (K,)
    is that of the place along each axis, at the point of `path` that the newest image, of
    `stamp_ns`, shows. `broken`: the odometry was silent since, and the transforms begin anew.
    `lasting` are those of delays that last from the start, or from `since_ns`, until images are
    known to be in time; anew where they are far `behind` on a circle.
    """

    odds: Array
    turn: Complex
    shift: Complex
    variance: Array
    yaw_variance: Array
    path: Path
    stamp_ns: int
    suspected: bool = False
    broken: bool = False
    since_ns: int = 0
    lasting: Lateness | None = None
    behind: Behind | None = None

    @property
    def apart(self) -> float:
        """Probability of images of another time or place."""
        return 1.0 - float(self.odds[:-1][_tolerated(self.path)].sum())

    @property
    def late(self) -> bool:
        """Whether images are likely of another time, and not of another place."""
        return self.suspected and float(self.odds[-1]) < SUSPECTED

    @property
    def error_s(self) -> float:
        """Root mean square of the delay; those that are tolerated count nothing."""
        return math.sqrt(float(self.odds[:-1] @ np.where(_tolerated(self.path), 0.0, DELAYS**2)))

    @property
    def untested(self) -> bool:
        """Whether images may be late from the start, and show another place then."""
        lasting = self.lasting
        if lasting is None or self.suspected:
            return False
        return bool(lasting.odds[:-1] @ _harmful(lasting.path) > _SHOWN)

    @property
    def problem(self) -> str:
        """What is most likely the matter; '' where nothing is suspected."""
        if not self.suspected:
            return ''
        far = np.where(np.append(_tolerated(self.path), False), 0.0, self.odds)
        best = int(np.argmax(far))
        if best == COUNT:
            return 'images and odometry show different motions'
        return f'images are stamped {DELAYS[best]:.1f} s late, or delayed: synchronize the clocks'


def followed(
    late: Lateness | None,
    trail: tuple[Knot, ...],
    now: Knot,
    pose: Array,
    covariance: Array,
    restarted: bool,
    bias: float,
) -> Lateness | None:
    """The odds after an image of a pose (3,) with covariance (3, 3), at the pose by odometry `now`.

    `restarted`: the filter has taken it for the robot's new place. `bias`, rad/s, is taken off the
    odometry's turn rate.
    """
    image = _image(now[0], pose, covariance)
    if image.variance > _USELESS_VARIANCE:
        return late
    path = path_to(now, trail)
    begun = _begun(path, image)
    behind = _behind(late, path, image, bias, restarted)
    lasting = _lasting(late, trail, now, image, restarted, _is_far(behind, path))
    if late is None:
        return begun._replace(lasting=lasting, behind=behind)
    if late.broken:
        return _judged(_anew(late, begun))._replace(lasting=lasting, behind=behind)
    if restarted or _moved(late.path, path)[0]:
        late = _corrected(_predicted(late, path, (now[0] - late.stamp_ns) * 1e-9), image)
    in_time, elsewhere = float(late.odds[:-1][_NEAR].sum()), float(late.odds[-1])
    if restarted or _ANEW * elsewhere > in_time:
        late = _replaced(late, begun, _RESTARTED if restarted else _ANEW)
    return _judged(late)._replace(lasting=lasting, behind=behind)


def _behind(
    late: Lateness | None, path: Path, image: Image, bias: float, restarted: bool
) -> Behind:
    """With another image; `bias` is that of the filter."""
    now = Behind(image.stamp_ns, image.yaw, float(path.yaws[0]), 0.0)
    if late is None or late.behind is None:
        return now
    last = late.behind
    seconds, more = (now.stamp_ns - last.stamp_ns) * 1e-9, bias - last.bias
    if restarted or late.broken or not path.steady(_LATELY_S):
        return now._replace(bias=last.bias - math.expm1(-seconds / _LEARNT_S) * more)
    turned = float(wrap_angle(now.reckoned - last.reckoned)) + seconds * more
    angle = last.angle + float(wrap_angle(now.seen - last.seen - turned))
    beyond = max(abs(angle) - _SCALE_ERROR * abs(turned), 0.0)
    return now._replace(bias=last.bias, angle=math.copysign(beyond, angle))


def _is_far(behind: Behind, path: Path) -> bool:
    """Whether images may be so late by now that it does harm."""
    angle = abs(behind.angle)
    if angle <= _LEAST_SEEN_RAD or not path.circling:
        return False
    v, omega = np.abs(path.rates.mean(axis=1)).tolist()
    return bool(angle > _FAR_RAD or angle * v > _FAR_M * omega)


def _lasting(
    late: Lateness | None,
    trail: tuple[Knot, ...],
    now: Knot,
    image: Image,
    restarted: bool,
    far: bool,
) -> Lateness | None:
    """Delays that last from the start, after another image; None where images are in time.

    Where images were late when the filter moved the estimate, odometry was wrong as well: they have
    to show their time anew, by what is driven from there; and where they may be `far` behind.
    """
    before = late and late.lasting
    if late is not None and before is None and not far and not (restarted and late.late):
        return None
    since_ns = now[0] if restarted else before.since_ns if before else 0
    trail = tuple(knot for knot in trail if knot[0] >= since_ns)
    path = continued(path_to(now, trail), trail, now)
    odds = np.append((_NEAR_SHARE + ~_NEAR / np.sum(~_NEAR)) / 2, _ELSEWHERE)
    even = _begun(path, image)._replace(odds=odds / odds.sum(), since_ns=since_ns)
    if late is None or before is None or restarted or far:
        return even
    if late.broken or len(trail) < AS_BEFORE:
        return even._replace(odds=before.odds)
    if not _moved(before.path, path).any():
        return before
    variances = _grown(before.variance, before.yaw_variance, before.path, path)
    before = before._replace(variance=variances[0], yaw_variance=variances[1], path=path)
    seen = _corrected(before, image)
    if seen.odds[-1] > SUSPECTED:  # images of elsewhere show nothing
        return even
    return None if seen.apart < _SHOWN else seen


def _begun(path: Path, image: Image) -> Lateness:
    """By each delay, the image shows where the robot was then."""
    odds = (1 - _SURPRISE) * _NEAR_SHARE + _SURPRISE / (COUNT + 1)
    odds = np.append(odds, _SURPRISE / (COUNT + 1))
    turn = np.exp(1j * (image.yaw - path.yaws))
    shift = image.place - turn * path.places
    variances = np.full(COUNT, image.variance), np.full(COUNT, image.yaw_variance)
    return Lateness(odds / odds.sum(), turn, shift, *variances, path, image.stamp_ns)


def _moved(before: Path, path: Path) -> NDArray[np.bool_]:
    """(K,): by which delays an image shows something new."""
    turned = np.abs(wrap_angle(path.yaws - before.yaws))
    return np.asarray((np.abs(path.places - before.places) >= _LEAST_M) | (turned >= _LEAST_RAD))


def unrelated(
    late: Lateness | None, trail: tuple[Knot, ...], now: Knot, pose: Array, covariance: Array
) -> Lateness | None:
    """After an image without odometry: the odds remain, the transforms begin anew."""
    image = _image(now[0], pose, covariance)
    if late is None or image.variance > _USELESS_VARIANCE:
        return late
    judged = _judged(_anew(late, _begun(path_to(now, trail), image)))
    return judged._replace(lasting=late.lasting, behind=late.behind)


def _anew(late: Lateness, begun: Lateness) -> Lateness:
    """With the odds of before; what was elsewhere is perhaps in time."""
    odds = np.append(late.odds[:-1] + late.odds[-1] * _NEAR_SHARE, 0.0)
    return begun._replace(odds=odds, suspected=late.suspected)


def _tolerated(path: Path) -> NDArray[np.bool_]:
    """(K,): which delays are small for a robot as fast as on a path."""
    steps = np.abs(path.rates)
    moving = path.known[1:] & (steps > STANDING).any(axis=0)
    if not moving.any():
        return _NEAR
    v, omega = np.sqrt(np.mean(steps[:, moving] ** 2, axis=1)).tolist()
    v = max(v, float(steps[0, moving][:_LATEST_STEPS].mean()))
    limit_s = max(_WRONG_M / max(v, STANDING), _LEAST_S)
    return np.asarray(min(tolerated_s(v, omega) + _MARGIN_S, limit_s) >= DELAYS)


def _harmful(path: Path) -> NDArray[np.bool_]:
    """(K,): in which delays the robot has moved far."""
    moved, turned = np.abs(path.places - path.places[0]), np.abs(path.yaws - path.yaws[0])
    return np.asarray((moved > _FAR_M) | (turned > _FAR_RAD))


def _judged(late: Lateness) -> Lateness:
    """With what the odds say, but for late images of a steady drive, which shows no end of it."""
    if late.late and late.path.steady():
        return late
    return late._replace(suspected=late.apart > (CLEARED if late.suspected else SUSPECTED))


def _image(stamp_ns: int, pose: Array, covariance: Array) -> Image:
    x, y, yaw = pose.tolist()
    along_x, along_y, yaw_variance = covariance.diagonal().tolist()
    variance = _CAUTION * (along_x + along_y) / 2 + _FLOOR_M**2
    return Image(stamp_ns, complex(x, y), yaw, variance, _CAUTION * yaw_variance + _FLOOR_RAD**2)


def _replaced(late: Lateness, begun: Lateness, share: float) -> Lateness:
    """A share of the images of elsewhere is in time: the robot is elsewhere."""
    odds = late.odds.copy()
    odds[:-1] += share * odds[-1] * _NEAR_SHARE
    odds[-1] *= 1 - share
    turn, shift, variance, yaw_variance = (
        np.where(_NEAR, getattr(begun, name), getattr(late, name))
        for name in ('turn', 'shift', 'variance', 'yaw_variance')
    )
    return Lateness(
        odds, turn, shift, variance, yaw_variance, begun.path, begun.stamp_ns, late.suspected
    )


def _predicted(late: Lateness, path: Path, seconds: float) -> Lateness:
    """Before the next image: delays drift, begin and end, and the odometry errs."""
    came, near = _came(late.odds[:-1], min(_DRIFT * seconds, _MOST_DRIFT))
    total = came.sum(axis=0)
    came /= np.maximum(total, _TINY)
    turns, shifts, variances, yaw_variances = (
        np.array([np.roll(each, 1), each, np.roll(each, -1), np.full(COUNT, near @ each)])
        for each in (late.turn, late.shift, late.variance, late.yaw_variance)
    )
    turn, places = (came * turns).sum(axis=0), turns * path.places + shifts
    place, length = (came * places).sum(axis=0), np.abs(turn)
    turn = turn / np.maximum(length, _TINY)
    # Directions that differ have a mean shorter than 1, by half their variance.
    yaw_variance = (came * yaw_variances).sum(axis=0) + 2 * np.maximum(1 - length, 0.0)
    variance = (came * (variances + np.abs(places - place) ** 2 / 2)).sum(axis=0)
    variance, yaw_variance = _grown(variance, yaw_variance, late.path, path)
    healed = _HEAL * (float(late.odds[:-1][~_NEAR].sum()) + float(late.odds[-1])) * _NEAR_SHARE
    elsewhere = (1 - _HEAL) * late.odds[-1] + _ELSEWHERE
    odds = np.append((1 - _ELSEWHERE) * (total + healed), elsewhere)
    shift = place - turn * path.places
    return late._replace(
        odds=odds, turn=turn, shift=shift, variance=variance, yaw_variance=yaw_variance, path=path
    )


def _grown(variance: Array, yaw_variance: Array, before: Path, path: Path) -> tuple[Array, Array]:
    """Variances (K,) after the way from one path to the next."""
    way, turned = np.abs(path.places - before.places), np.abs(path.yaws - before.yaws)
    yaw_variance = yaw_variance + _YAW_PER_RADIAN**2 * turned + _YAW_PER_METER**2 * way
    return variance + _SLIP**2 * way + way**2 * yaw_variance, yaw_variance


def _came(odds: Array, drift: float) -> tuple[Array, Array]:
    """The odds (4, K) that come to a delay from the one before, itself, the next, and all in time.

    And the shares (K,) of those that are in time.
    """
    up, down, stay = drift * _UP, drift * _DOWN, 1 - 2 * drift
    near = np.where(_NEAR, odds, 0.0)
    in_time = float(near.sum())
    came = [
        np.append(0.0, (up * odds)[:-1]),
        stay * odds * np.where(_NEAR, 1 - _BREAK, 1 - _HEAL),
        np.append((down * odds)[1:], 0.0),
        np.full(COUNT, _BREAK * in_time / COUNT),
    ]
    return np.array(came), near / max(in_time, _TINY)


def _corrected(late: Lateness, image: Image) -> Lateness:
    """Bayes' rule, by each delay's Kalman filter, where the image is no outlier."""
    path = late.path
    place = late.turn * path.places + late.shift
    miss = image.place - place
    yaw_miss = wrap_angle(image.yaw - np.angle(late.turn) - path.yaws)
    total, yaw_total = late.variance + image.variance, late.yaw_variance + image.yaw_variance
    fits = np.exp(-0.5 * (np.abs(miss) ** 2 / total + yaw_miss**2 / yaw_total))
    fits *= (1 - _OUTLIERS) * _DENSITY / (total * np.sqrt(yaw_total))
    fits = np.where(path.known, fits, 0.0)
    likely = fits + np.where(path.known, _OUTLIERS, 1.0) * _ELSEWHERE_DENSITY
    odds = _weighed(late.odds, np.append(likely, _ELSEWHERE_DENSITY))
    gain = fits / likely * late.variance / total
    yaw_gain = fits / likely * late.yaw_variance / yaw_total
    turn = late.turn * np.exp(1j * yaw_gain * yaw_miss)
    return late._replace(
        odds=odds,
        turn=turn,
        shift=place + gain * miss - turn * path.places,
        variance=late.variance * (1 - gain),
        yaw_variance=late.yaw_variance * (1 - yaw_gain),
        stamp_ns=image.stamp_ns,
    )


def _weighed(odds: Array, likely: Array) -> Array:
    """Odds (K + 1,) after an image so likely under each. What hardly distinguishes delays of images
    in time from others is an error of the image, which the next ones repeat.
    """
    weighed = odds * likely
    near, far = weighed[:-1][_NEAR], weighed[:-1][~_NEAR]
    before = odds[:-1][_NEAR].sum() / max(odds[:-1][~_NEAR].sum(), _TINY)
    shown = float(near.sum() / max(far.sum() * before, _TINY))
    if 1 / _EVIDENCE < shown < _EVIDENCE:
        weighed[:-1][_NEAR] = near / math.sqrt(shown)
        weighed[:-1][~_NEAR] = far * math.sqrt(shown)
    return np.asarray(weighed / weighed.sum())
