# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Sources of motion that contradict each other: which of them is wrong, and what is done."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from metric_worlds import criss_cross, drive, lanes, meander

from sfa_localization.bags.drives import read_drive
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.turns import VisualGyro
from sfa_localization.data.errors import CameraError, DataError
from sfa_localization.data.geometry import compose, wrap_angle
from sfa_localization.data.run import Image, Odometry, PanoramaArray, Run, YawRate, integrate
from sfa_localization.inspection import BagReport, InspectionConfig, inspect
from sfa_localization.metric.breaks import parted
from sfa_localization.metric.motion_check import check_drives, check_motion
from sfa_localization.metric.motion_sources import (
    IMAGES,
    POSE,
    TWIST,
    Source,
    compare,
    compare_map,
)
from sfa_localization.training import train


@dataclass(frozen=True)
class Recorded:
    """What a robot has recorded."""

    images: list[tuple[int, Image]]
    odometry: Odometry
    gyro: YawRate | None = None

    def showing(self, change: Callable[[Image], Image]) -> Recorded:
        return replace(self, images=[(at, change(image)) for at, image in self.images])

    def locked(self) -> Recorded:
        """The camera turns its images back to where they first looked."""
        yaw, stamps = np.unwrap(self.odometry.poses[:, 2]), [at for at, _ in self.images]
        turned = np.interp(stamps, self.odometry.stamps_ns, yaw) / (2 * np.pi)
        pairs = zip(self.images, turned, strict=True)
        rolled = [(at, np.roll(i, -round(by * i.shape[1]), axis=1)) for (at, i), by in pairs]
        return replace(self, images=rolled)

    def later(self, images_s: float = 0.0, gyro_s: float = 0.0) -> Recorded:
        images = [(at + round(images_s * 1e9), image) for at, image in self.images]
        gyro = self.gyro and replace(self.gyro, stamps_ns=self.gyro.stamps_ns + round(gyro_s * 1e9))
        return replace(self, images=images, gyro=gyro)

    def driven(self, poses=(1, 1, 1), twists=(1, 1), yaw: float = 0.0) -> Recorded:
        """With factors on x, y and yaw, on v and omega, and poses headed off the motion."""
        poses = self.odometry.poses * poses + np.array([0.0, 0.0, yaw])
        made = replace(self.odometry, poses=poses, twists=self.odometry.twists * twists)
        return replace(self, odometry=made)

    def turned(self, factor: float) -> Recorded:
        """With this factor on the gyroscope's rate."""
        return replace(self, gyro=replace(self.gyro, omega=factor * self.gyro.omega))

    def stamped_in(self, unit_ns: int) -> Recorded:
        """With another unit in the nanoseconds of the odometry's stamps."""
        second, part = np.divmod(self.odometry.stamps_ns, 10**9)
        stamps = second * 10**9 + part // unit_ns
        return replace(self, odometry=replace(self.odometry, stamps_ns=stamps))

    def jumping(self, seconds: Iterable[float], meters: float) -> Recorded:
        """With poses that jump at these times in different directions."""
        odometry, rng = self.odometry, np.random.default_rng(0)
        poses, time_s = odometry.poses.copy(), (odometry.stamps_ns - odometry.stamps_ns[0]) * 1e-9
        for at in seconds:
            bearing = rng.uniform(-np.pi, np.pi)
            poses[time_s >= at, :2] += meters * np.array([np.cos(bearing), np.sin(bearing)])
        return replace(self, odometry=replace(odometry, poses=poses))

    def write(self, path: Path) -> Path:
        with BagWriter(path) as bag:
            for at, image in self.images:
                bag.image('/images', at, image, 'camera', 'jpeg')
            rows = self.odometry.stamps_ns.tolist(), self.odometry.poses, self.odometry.twists
            for at, pose, twist in zip(*rows, strict=True):
                bag.odometry('/odom', at, tuple(pose), tuple(twist), (0.0, 0.0))
            rates = (self.gyro.stamps_ns, self.gyro.omega) if self.gyro else ([], [])
            for at, omega in zip(*rates, strict=True):
                bag.imu('/imu', int(at), float(omega), 0.0)
        return path

    def checked(self, force: bool = False):
        """The run that is learned from, and the comparison of its sources of motion."""
        stamps, gyro = np.array([at for at, _ in self.images]), VisualGyro()
        panoramas = PanoramaArray(stamps, np.stack([image for _, image in self.images]))
        run = Run('drive', panoramas, self.odometry, self.gyro)
        headings = [gyro.add(image) for _, image in self.images]
        (run,), (check,) = check_drives([run], [headings], force)
        return run, check


@pytest.fixture(scope='module')
def sample(tmp_path_factory) -> Recorded:
    """The sample's test drive."""
    run = read_drive(Path(__file__).parents[1] / 'bags/sample_test', tmp_path_factory.mktemp('run'))
    images = zip(run.panoramas.stamps_ns.tolist(), run.panoramas.images, strict=True)
    return Recorded([*images], run.odometry, run.yaw_rate)


def inspected(recorded: Recorded, bag: Path, **how) -> BagReport:
    return inspect(recorded.write(bag), config=InspectionConfig(min_pictures=100), **how)


def mirrored(image: Image) -> Image:
    return image[:, ::-1]


def two_views(image: Image) -> Image:
    """Half of a panorama, as two cameras side by side see it."""
    return np.concatenate([image[:, 100:400], image[:, 110:410]], axis=1)


def a_part(begin: int, end: int) -> Callable[[Image], Image]:
    """Some columns of a panorama, stretched to its shape."""
    return lambda image: cv2.resize(image[:, begin:end], image.shape[1::-1])


WRONG = {
    'mirrored images': (lambda s: s.showing(mirrored),
                        'images turn opposite to odometry and gyroscope: set `clockwise`'),
    'images or odometry': (lambda s: replace(s.showing(mirrored), gyro=None),
                           'or swap left and right wheel'),
    'mirrored odometry': (lambda s: s.driven((1, -1, -1), (1, -1)),
                          'odometry turns opposite to gyroscope and images: swap left and right'),
    'locked': (lambda s: s.locked(), 'images turn independently of odometry and gyroscope: switch'),
    'ordinary': (lambda s: s.showing(a_part(200, 400)),
                 'times as far as odometry and gyroscope: a'),
    'a part of the turn': (lambda s: s.showing(a_part(0, 450)), 'a panorama shows all around'),
    'millimeters per second': (lambda s: s.driven(twists=(1000, 1)),
                               '(odometry twist in millimeters?)'),
    'millimeters': (lambda s: s.driven((1000, 1000, 1)), '(odometry pose in millimeters?)'),
    'both': (lambda s: s.driven((1000, 1000, 1), (1000, 1)), 'odometry pose drives at'),
    'degrees per second': (lambda s: s.driven(twists=(1, 180 / np.pi)),
                           '(odometry twist in degrees?)'),
    'y to the right': (lambda s: s.driven((1, -1, 1)), 'm ahead: correct its heading and axes'),
    'headed to the left': (lambda s: s.driven(yaw=np.pi / 2), 'm sideways and'),
    'sign of the twist': (lambda s: s.driven(twists=(1, -1)), 'odometry twist turns opposite to'),
    'milliseconds': (lambda s: s.stamped_in(10**6), 'stamps holds milliseconds: correct'),
    'microseconds': (lambda s: s.stamped_in(10**3), 'stamps holds microseconds: correct'),
}  # fmt: skip


@pytest.mark.parametrize('name', WRONG)
def test_what_cannot_be_right_is_named_with_the_remedy_and_stops_the_training(sample, name):
    change, text = WRONG[name]
    with pytest.raises(DataError, match=re.escape(text)):
        change(sample).checked()


def test_force_makes_errors_warnings(sample, caplog):
    _, check = sample.showing(mirrored).checked(force=True)
    assert check.wrong[0] in caplog.text


def test_the_check_is_in_the_report_and_stops_the_training(sample, tmp_path):
    report = inspected(sample, tmp_path / 'right')
    assert report.lacks == report.motion.corrected == report.motion.notes == []
    assert len(report.motion.pairs) == 7
    wrong, bag = sample.showing(mirrored), tmp_path / 'wrong'
    report = inspected(wrong, bag)
    text = 'images turn opposite to odometry and gyroscope: set `clockwise`'
    assert any(text in lack for lack in report.lacks) and text in report.as_text()
    with pytest.raises(DataError, match='set `clockwise`'):
        train([bag], tmp_path / 'model.npz')
    assert not (tmp_path / 'model.npz').exists()
    # Columns may grow counterclockwise.
    assert inspected(wrong, tmp_path / 'counter', clockwise=False).lacks == []


def test_two_views_side_by_side_are_no_panorama(sample, tmp_path):
    report = inspected(sample.showing(two_views), tmp_path / 'bag')
    assert 'stereo pair: the left half shows the same' in report.facts['images']
    assert any('do not show all directions' in lack for lack in report.lacks)
    with pytest.raises(CameraError, match='two views side by side'):
        train([tmp_path / 'bag'], tmp_path / 'model.npz')


CORRECTED = {
    'upside down': (lambda s: s.turned(-1), 'gyroscope turns opposite to odometry and images'),
    'degrees': (lambda s: s.turned(180 / np.pi), 'converted from degrees'),
    'degrees the other way': (lambda s: s.turned(-180 / np.pi), 'converted from degrees'),
    '2 s late': (lambda s: s.later(gyro_s=2.0), 'gyroscope: stamped 2.02 s late'),
    '1 s early': (lambda s: s.later(gyro_s=-1.0), 'gyroscope: stamped 0.98 s early'),
}


@pytest.mark.parametrize('name', CORRECTED)
def test_a_gyroscope_is_corrected(sample, name):
    change, text = CORRECTED[name]
    run, check = change(sample).checked()
    assert any(text in each for each in check.corrected), check.corrected
    seconds = (sample.gyro.stamps_ns - sample.gyro.stamps_ns[0]) * 1e-9
    at = (run.yaw_rate.stamps_ns - sample.gyro.stamps_ns[0]) * 1e-9
    expected = np.interp(at + 0.02, seconds, sample.gyro.omega)
    assert np.abs(run.yaw_rate.omega - expected)[60:-60].max() < 0.05


def test_a_gyroscope_of_another_motion_or_epoch_is_left_out(sample):
    omega = np.random.default_rng(0).normal(size=len(sample.gyro.omega))
    noise = replace(sample, gyro=replace(sample.gyro, omega=omega))
    for recorded, text in ((noise, 'left out'), (sample.later(gyro_s=1e6), 'another clock')):
        run, check = recorded.checked()
        assert run.yaw_rate is None and text in check.corrected[0]


@pytest.mark.parametrize(
    ('late_s', 'circle', 'text'),
    [
        (0.0, False, ''),
        (0.3, False, 's late; taken into account'),
        (-0.3, True, 's early; taken into account'),
        (0.9, False, 's late: synchronize the clocks'),
    ],
)
def test_clocks_that_differ_are_corrected_or_reported(sample, tmp_path, late_s, circle, text):
    late = sample.showing(rolled_up if circle else np.asarray).later(images_s=late_s)
    report = inspected(replace(late, gyro=None), tmp_path / 'bag')
    pair = report.motion.pair(POSE, IMAGES)
    assert pair.delay_s == pytest.approx(late_s, abs=0.03)
    assert text in report.as_text() and ('stamped' in report.as_text()) == bool(text)
    assert any('synchronize' in lack for lack in report.lacks) == (abs(late_s) > 0.5)


def rolled_up(panorama: Image) -> Image:
    """The image (200, 200, 3) of a mirror that shows a panorama around its center."""
    rows, columns = np.mgrid[:200, :200] - 99.5
    radius = np.hypot(rows, columns)
    across = (np.arctan2(rows, columns) / (2 * np.pi) % 1 * panorama.shape[1]).astype(int)
    along = ((95 - radius) / 60 * panorama.shape[0]).astype(int)
    inside = (along >= 0) & (along < panorama.shape[0])
    circle = panorama[np.clip(along, 0, panorama.shape[0] - 1), across % panorama.shape[1]]
    return np.where(inside[..., None], circle, 0).astype(np.uint8)


@pytest.mark.parametrize(
    ('every', 'seconds', 'meters', 'text'),
    [
        (1, [12.0], 1.1, 'odometry pose jumps once, by up to 1.1'),
        (1, np.arange(3.0, 32.0, 3.0), 0.2, 'record the frame odom instead of map'),
        (3, np.arange(3.0, 32.0, 3.0), 0.2, 'jumps 10 times'),
    ],
)
def test_odometry_that_jumps_goes_on_as_before(sample, every, seconds, meters, text):
    odometry = slower(sample.odometry, every)
    jumping = replace(sample, odometry=odometry).jumping(seconds, meters)
    run, check = jumping.checked()
    assert any(text in each for each in check.corrected)
    assert np.abs(run.odometry.poses - odometry.poses)[:, :2].max() < 0.03 * every


def slower(odometry: Odometry, every: int) -> Odometry:
    return Odometry(*(getattr(odometry, name)[::every] for name in Odometry.__slots__))


# The comparison itself, of drives whose motion is known.

DRIVES = {
    'straight legs': criss_cross(12, seed=1),
    'wandering': meander(120.0, seed=3),
    'lanes': (lanes(8.0, 1.0, 8), (0.0, 0.0, 0.0)),
}


@pytest.mark.parametrize('name', DRIVES)
@pytest.mark.parametrize(('sign', 'delay_s'), [(1.0, 0.0), (-1.0, 0.7)])
def test_wrong_shifts_of_images_change_neither_sign_nor_delay(name, sign, delay_s):
    twists, start = DRIVES[name]
    run = drive(twists, start=start, yaw_noise=0.1, bias=0.01, seed=2)
    rng, number = np.random.default_rng(0), len(run.poses)
    steps = sign * np.diff(np.unwrap(run.poses[:, 2]), prepend=run.poses[0, 2])
    steps += 0.01 * rng.standard_normal(number)
    steps += np.where(rng.random(number) < 0.05, rng.uniform(-3, 3, number), 0.0)
    pose = Source(POSE, run.odometry.stamps_ns, {'turns': np.unwrap(run.odometry.poses[:, 2])})
    stamps = run.stamps_ns + round(delay_s * 1e9)
    pair = compare(pose, Source(IMAGES, stamps, {'turns': np.cumsum(steps)}))
    assert pair.scale == pytest.approx(sign, rel=0.1) and pair.correlation > 0.7
    assert pair.delay_s == pytest.approx(delay_s, abs=0.05)


def test_a_map_is_compared_with_its_odometry_over_ten_meters():
    run = drive(*DRIVES['straight legs'][:1], yaw_noise=0.1, speed_noise=0.1, seed=1)
    poses = run.poses + 0.3 * np.random.default_rng(0).normal(size=run.poses.shape) * [1, 1, 0]
    right = compare_map(run.odometry, run.stamps_ns, poses)
    assert not right.differs('alike') and right.scale == pytest.approx(1.0, abs=0.1)
    collapsed = compare_map(run.odometry, run.stamps_ns, poses * [0.4, 0.4, 1.0])
    assert collapsed.differs('scale') and collapsed.scale == pytest.approx(0.4, abs=0.04)
    assert compare_map(run.odometry, run.stamps_ns, poses[::-1]).differs('alike')


def test_a_drive_that_hardly_turns_says_nothing():
    run = drive(np.tile([1.0, 0.001], (2000, 1)))
    check = check_motion(run.odometry, (run.stamps_ns, 0 * run.stamps_ns), run.gyro)
    assert [(pair.b, pair.what) for pair in check.pairs] == [(TWIST, 'way')]
    assert check.wrong == check.corrected == []
    assert check.notes == ['images: too few of them, or turns, to tell whether they are mirrored']


def test_wheels_that_skid_are_worth_a_word():
    run = drive(*DRIVES['straight legs'][:1])
    twists = run.odometry.twists * [1.0, 2.0]
    wheels = replace(run.odometry, twists=twists, poses=integrate(run.odometry.stamps_ns, twists))
    check = check_motion(wheels, (run.stamps_ns, run.poses[:, 2]), run.gyro)
    assert check.wrong == check.corrected == [] and 'do the wheels skid' in check.notes[0]


@pytest.mark.parametrize('every', [1, 5, 25])
def test_messages_in_bundles_or_at_a_low_rate_do_not_jump(every):
    for twists, start in DRIVES.values():
        odometry = drive(twists, start=start, yaw_noise=0.2, speed_noise=0.2, seed=1).odometry
        assert parted(slower(odometry, every))[1] == ''
    bundled = odometry.stamps_ns // 10**8 * 10**8 + np.arange(len(odometry.stamps_ns))
    assert parted(replace(odometry, stamps_ns=bundled))[1] == ''


def test_a_jump_of_the_heading_turns_what_follows_back():
    odometry = drive(*DRIVES['wandering'][:1]).odometry
    later = compose(np.array([0.5, -0.3, 0.4]), odometry.poses)
    poses = np.where(np.arange(len(later))[:, None] < 3000, odometry.poses, later)
    joined, text = parted(replace(odometry, poses=poses))
    assert 'jumps once' in text
    off = joined.poses - odometry.poses
    assert np.abs(wrap_angle(off[:, 2])).max() < 0.02 and np.abs(off[:, :2]).max() < 0.3
