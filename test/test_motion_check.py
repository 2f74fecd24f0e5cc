# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Sources of motion that contradict each other: which of them is wrong, and what is done."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from metric_worlds import criss_cross, drive, lanes, meander
from page_tables import ROOT
from places import as_complex, distances

from sfa_localization.bags.drives import ReadingRecipe, read_drive
from sfa_localization.bags.writer import BagWriter
from sfa_localization.camera.settings import CameraConfig, PanoramaConfig
from sfa_localization.camera.turns import headings
from sfa_localization.data.errors import CameraError, DataError
from sfa_localization.data.geometry import align, wrap_angle
from sfa_localization.data.run import (
    PanoramaArray,
    Points,
    Run,
    Trajectory,
    integrate,
)
from sfa_localization.inspection import InspectionConfig, inspect
from sfa_localization.motion.breaks import parted
from sfa_localization.motion.check import check_motion
from sfa_localization.motion.dead_reckoning import OdometryTrack
from sfa_localization.motion.settings import SegmentConfig
from sfa_localization.motion.sources import (
    IMAGES,
    POSE,
    TWIST,
    compare_map,
)
from sfa_localization.motion.truth import TruePoses, timed_points, true_poses
from sfa_localization.training import train
from sfa_localization.training_input import Recipe, compared


def rows(odometry, chosen):
    return type(odometry)(*(getattr(odometry, name)[chosen] for name in odometry.__slots__))


def showing(run, change):
    images = np.stack([change(image) for image in run.panoramas.images])
    return replace(run, panoramas=PanoramaArray(run.panoramas.stamps_ns, images))


def locked(run):
    """The camera turns its images back to where they first looked."""
    yaw, stamps_ns = np.unwrap(run.odometry.poses[:, 2]), run.panoramas.stamps_ns
    turns = iter(np.interp(stamps_ns, run.odometry.stamps_ns, yaw) / (2 * np.pi))
    return showing(run, lambda image: np.roll(image, -round(next(turns) * image.shape[1]), axis=1))


def driven(run, poses=(1, 1, 1), twists=(1, 1)):
    """With factors on x, y and yaw, and on v and omega."""
    odometry = run.odometry
    made = replace(odometry, poses=odometry.poses * poses, twists=odometry.twists * twists)
    return replace(run, odometry=made)


def stamped_in(run, unit_ns):
    """With another unit in the nanoseconds of the odometry's stamps."""
    second, part = np.divmod(run.odometry.stamps_ns, 10**9)
    stamps_ns = second * 10**9 + part // unit_ns
    return replace(run, odometry=replace(run.odometry, stamps_ns=stamps_ns))


def gyro(run, factor=1.0, late_s=0.0):
    """With a factor on the rate of the gyroscope, which stamps so late."""
    rate = run.yaw_rate
    stamps_ns = rate.stamps_ns + round(late_s * 1e9)
    return replace(run, yaw_rate=replace(rate, stamps_ns=stamps_ns, omega=factor * rate.omega))


@pytest.fixture(scope='module')
def sample(tmp_path_factory):
    """The sample's test drive."""
    run = read_drive(ROOT / 'bags/sample_test', tmp_path_factory.mktemp('run'))
    images = PanoramaArray(run.panoramas.stamps_ns, np.array(run.panoramas.images))
    return replace(run, name='drive', panoramas=images)


def checked(run, force=False):
    """The run that is learned from, and the comparison of its sources of motion."""
    (run,), (check,) = compared([run], Recipe(), force)
    return run, check


def inspected(run, path, **how):
    with BagWriter(path) as bag:
        for at, image in zip(run.panoramas.stamps_ns, run.panoramas.images, strict=True):
            bag.image('/images', int(at), image, 'camera', 'jpeg')
        odometry, rate = run.odometry, run.yaw_rate
        for at, *motion in zip(odometry.stamps_ns, odometry.poses, odometry.twists, strict=True):
            bag.odometry('/odom', int(at), *map(tuple, motion), (0.0, 0.0))
        for at, omega in zip(rate.stamps_ns, rate.omega, strict=True) if rate else ():
            bag.imu('/imu', int(at), float(omega), 0.0)
    return inspect(path, config=InspectionConfig(min_pictures=100), **how)


def mirrored(image):
    return image[:, ::-1]


WRONG = {
    'mirrored images': (lambda s: replace(showing(s, mirrored), yaw_rate=None),
                        'or swap left and right wheel'),
    'mirrored odometry': (lambda s: driven(s, (1, -1, -1), (1, -1)),
                          'odometry turns opposite to gyroscope and images: swap left and right'),
    'locked': (locked, 'images turn independently of odometry and gyroscope: switch'),
    'a part of the turn': (lambda s: showing(s, lambda i: cv2.resize(i[:, :450], i.shape[1::-1])),
                           'times as far as odometry and gyroscope: a panorama shows all around'),
    'millimeters': (lambda s: driven(s, (1000, 1000, 1)), '(odometry pose in millimeters?)'),
    'both': (lambda s: driven(s, (1000, 1000, 1), (1000, 1)), 'odometry pose drives at'),
    'degrees': (lambda s: driven(s, twists=(1, 180 / np.pi)), '(odometry twist in degrees?)'),
    'y to the right': (lambda s: driven(s, (1, -1, 1)), 'm ahead: correct its heading and axes'),
    'sign of the twist': (lambda s: driven(s, twists=(1, -1)), 'odometry twist turns opposite to'),
    'microseconds': (lambda s: stamped_in(s, 10**3), 'stamps holds microseconds: correct'),
}  # fmt: skip


@pytest.mark.parametrize('name', WRONG)
def test_what_cannot_be_right_is_named_with_the_remedy_and_stops_the_training(sample, name):
    change, text = WRONG[name]
    with pytest.raises(DataError, match=re.escape(text)):
        checked(change(sample))


def test_the_check_is_in_the_report_and_stops_the_training(sample, tmp_path, caplog):
    report = inspected(sample, tmp_path / 'right')
    assert report.lacks == report.motion.corrected == report.motion.notes == []
    assert len(report.motion.pairs) == 7
    wrong, bag = showing(sample, mirrored), tmp_path / 'wrong'
    report = inspected(wrong, bag)
    text = 'images turn opposite to odometry and gyroscope: set `clockwise`'
    assert text in ' '.join(report.lacks) and text in report.as_text()
    with pytest.raises(DataError, match='set `clockwise`'):
        train([bag], tmp_path / 'model.npz')
    assert not (tmp_path / 'model.npz').exists()
    checked(wrong, force=True)
    assert text in caplog.text
    # Columns may grow counterclockwise.
    counter = ReadingRecipe(panorama=PanoramaConfig(clockwise=False))
    assert inspected(wrong, tmp_path / 'counter', recipe=counter).lacks == []


def test_inspect_sees_the_panoramas_that_training_makes(sample, tmp_path):
    """Of a camera that hangs upside down."""
    hanging = showing(sample, lambda image: image[::-1, ::-1])
    assert 'images turn opposite' in inspected(hanging, tmp_path / 'a').lacks[0]
    mounted = ReadingRecipe(camera=CameraConfig(mount_rpy=(180.0, 0.0, 0.0)))
    assert inspected(hanging, tmp_path / 'b', recipe=mounted).lacks == []


def test_two_views_side_by_side_are_no_panorama(sample, tmp_path):
    stereo = showing(sample, lambda i: np.concatenate([i[:, 100:400], i[:, 110:410]], axis=1))
    report = inspected(stereo, tmp_path / 'bag')
    assert 'stereo pair: the left half shows the same' in report.facts['images']
    assert 'do not show all directions' in ' '.join(report.lacks)
    with pytest.raises(CameraError, match='two views side by side'):
        train([tmp_path / 'bag'], tmp_path / 'model.npz')


@pytest.mark.parametrize(
    ('factor', 'late_s', 'texts'),
    [
        (-180 / np.pi, 0.0, ('gyroscope turns opposite to odometry', 'converted from degrees')),
        (1.0, 2.0, ('gyroscope: stamped 2.02 s late',)),
        (1.0, -1.0, ('gyroscope: stamped 0.98 s early',)),
    ],
)
def test_a_gyroscope_is_corrected(sample, factor, late_s, texts):
    run, check = checked(gyro(sample, factor, late_s))
    assert all(text in '; '.join(check.corrected) for text in texts)
    right, start = sample.yaw_rate, sample.yaw_rate.stamps_ns[0]
    at = (run.yaw_rate.stamps_ns - start) * 1e-9 + 0.02
    expected = np.interp(at, (right.stamps_ns - start) * 1e-9, right.omega)
    assert np.abs(run.yaw_rate.omega - expected)[60:-60].max() < 0.05


@pytest.mark.parametrize(('factor', 'shown'), [(1.0, None), (1.09, 330), (0.9, 400)])
def test_panoramas_of_less_than_a_turn_are_named_where_a_gyroscope_shows_it(sample, factor, shown):
    turns = np.unwrap(list(headings(sample.panoramas))) * factor
    images = sample.panoramas.stamps_ns, turns
    check = check_motion(sample.odometry, images, sample.yaw_rate)
    told = [text for text in check.notes if 'show all around once' in text]
    assert len(told) == (shown is not None)
    for text in told:
        degrees = float(text.split(', not ')[1].split()[0])
        assert degrees == pytest.approx(shown, abs=15)


def held(rate, rng):
    """Rates of which one is held for two seconds, after six that are right."""
    rows = np.arange(len(rate))
    return rate[np.where(rows % 200 < 150, rows, rows - rows % 200 + 150)]


RATES = {
    'zeros': (lambda w, rng: np.where(rng.random(len(w)) < 0.2, 0.0, w), (140, 160), True),
    'spikes': (lambda w, rng: np.where(rng.random(len(w)) < 0.01, 30.0, w), (5, 12), True),
    'small spikes': (lambda w, rng: np.where(rng.random(len(w)) < 0.01, w - 5.0, w), (5, 12), True),
    'held': (held, (100, 160), True),
    'noise': (lambda w, rng: w + rng.normal(0.0, 0.02, len(w)), (0, 0), True),
    'bias': (lambda w, rng: w + 0.02, (0, 0), True),
    'half zeros': (lambda w, rng: np.where(rng.random(len(w)) < 0.5, 0.0, w), (0, 0), False),
    'another range': (lambda w, rng: 0.8 * w, (0, 0), False),
}


@pytest.mark.parametrize('name', RATES)
def test_rates_that_wheels_and_images_contradict_are_left_out(sample, name):
    change, (least, most), stays = RATES[name]
    right = sample.yaw_rate
    recorded = replace(right, omega=change(right.omega, np.random.default_rng(0)))
    run, check = checked(replace(sample, yaw_rate=recorded))
    text = '; '.join(check.corrected)
    assert ('messages contradict wheels and images' in text) == bool(most)
    assert ('left out: the wheels agree better with the images' in text) != stays
    if not stays:
        assert run.yaw_rate is None
        return
    kept = run.yaw_rate
    assert least <= len(right.omega) - len(kept.omega) <= most
    of_kept = np.interp(kept.stamps_ns, right.stamps_ns, right.omega)
    assert np.median(np.abs(kept.omega - of_kept)) < 0.03
    assert np.abs(kept.omega - of_kept).max() < (0.7 if most else 0.1)


def skidding(run, where):
    """Whose wheels turn by 0.6 rad/s more there."""
    odometry = run.odometry
    twists = odometry.twists + np.outer(where(np.arange(len(odometry.twists))), [0.0, 0.6])
    poses = integrate(odometry.stamps_ns, twists)
    return replace(run, odometry=replace(odometry, twists=twists, poses=poses))


@pytest.mark.parametrize('where', [lambda i: i // 25 % 5 == 0, lambda i: (i > 200) & (i < 240)])
def test_wheels_that_skid_now_and_then_do_not_condemn_the_gyroscope(sample, where):
    run, check = checked(skidding(sample, where))
    assert np.array_equal(run.yaw_rate.omega, sample.yaw_rate.omega)
    assert 'gyroscope' not in ' '.join(check.corrected)


def test_a_gyroscope_of_another_motion_or_epoch_is_left_out(sample):
    noise = gyro(sample, np.random.default_rng(0).normal(size=len(sample.yaw_rate.omega)))
    for recorded, text in ((noise, 'left out'), (gyro(sample, late_s=1e6), 'another clock')):
        run, check = checked(recorded)
        assert run.yaw_rate is None and text in check.corrected[0]


@pytest.mark.parametrize(
    ('late_s', 'text'),
    [(-0.3, 's early; taken into account'), (0.9, 's late: synchronize the clocks')],
)
def test_clocks_that_differ_are_corrected_or_reported(sample, tmp_path, late_s, text):
    stamps_ns = sample.panoramas.stamps_ns + round(late_s * 1e9)
    panoramas = replace(sample.panoramas, stamps_ns=stamps_ns)
    late = replace(sample, panoramas=panoramas, yaw_rate=None)
    report = inspected(late, tmp_path / 'bag')
    assert report.motion.pair(POSE, IMAGES).delay_s == pytest.approx(late_s, abs=0.03)
    assert text in report.as_text()
    assert ('synchronize' in ' '.join(report.lacks)) == (abs(late_s) > 0.5)


def shifted(stamps_ns, rate):
    """Stamps of a clock that gains `rate` s in each second."""
    return stamps_ns + np.round((stamps_ns - stamps_ns[0]) * rate).astype(np.int64)


# The comparison itself, of drives whose motion is known.

DRIVES = {
    'straight legs': criss_cross(12, seed=1),
    'wandering': meander(120.0, seed=3),
    'lanes': (lanes(8.0, 1.0, 8), (0.0, 0.0, 0.0)),
}


def test_a_map_is_compared_with_its_odometry_over_ten_meters():
    run = drive(*DRIVES['straight legs'][:1], yaw_noise=0.1, speed_noise=0.1, seed=1)
    poses = run.poses + 0.3 * np.random.default_rng(0).normal(size=run.poses.shape) * [1, 1, 0]
    right = compare_map(run.odometry, run.stamps_ns, poses)
    assert not right.differs('alike') and right.scale == pytest.approx(1.0, abs=0.1)
    collapsed = compare_map(run.odometry, run.stamps_ns, poses * [0.4, 0.4, 1.0])
    assert collapsed.differs('scale') and collapsed.scale == pytest.approx(0.4, abs=0.04)
    assert compare_map(run.odometry, run.stamps_ns, poses[::-1]).differs('alike')


@pytest.mark.parametrize('rate', [0.005, -0.003, 0.0])
@pytest.mark.parametrize(('late', 'said'), [
    ('images', 'images: their'), ('gyroscope', 'gyroscope: its'), ('both', 'odometry: its')
])  # fmt: skip
def test_a_clock_that_drifts_is_followed_along_the_drive(late, said, rate):
    run = drive(*DRIVES['straight legs'][:1], yaw_noise=0.02, seed=1)
    images, gyro = run.stamps_ns, run.gyro
    if late != 'gyroscope':
        images = shifted(images, rate)
    if late != 'images':
        gyro = replace(gyro, stamps_ns=shifted(gyro.stamps_ns, rate))
    panoramas = PanoramaArray(images, np.zeros((len(images), 1, 1, 3), np.uint8))
    recorded = Run('run', panoramas, run.odometry, gyro)
    check = check_motion(recorded.odometry, (images, run.poses[:, 2]), gyro)
    corrected = check.run(recorded)
    fast = (rate > 0) == (late != 'both')
    assert check.wrong == [] and len(check.corrected) == (rate != 0)
    for sentence in check.corrected:
        shown, way = re.fullmatch(
            rf'{said} clock runs (\S+) % (\w+): taken into account', sentence
        ).groups()
        assert float(shown) == pytest.approx(100 * abs(rate), abs=0.011)
        assert way == ('fast' if fast else 'slow')
        assert np.abs(corrected.panoramas.stamps_ns - run.stamps_ns).max() < 2e7


FOLLOWING = {
    'with a lag of 0.5 s': (0.5, np.inf, 0.0),
    'with a lag of 2 s': (2.0, np.inf, 0.0),
    'at 0.2 rad/s at most': (0.0, 0.2, 0.0),
    'beyond 23 degrees only': (0.0, np.inf, 0.4),
}


@pytest.mark.parametrize('how', FOLLOWING)
def test_images_that_follow_the_turns_are_refused_and_no_delay_is(how):
    run = drive(*DRIVES['straight legs'][:1], yaw_noise=0.02, seed=1)
    lag_s, fastest, ignored = FOLLOWING[how]
    yaw, shown = np.unwrap(run.odometry.poses[:, 2]), [0.0]
    for now in yaw[1:]:
        behind = now - shown[-1]
        pulled = (behind - np.clip(behind, -ignored, ignored)) * (0.02 / lag_s if lag_s else 1)
        shown.append(shown[-1] + np.clip(pulled, -0.02 * fastest, 0.02 * fastest))
    seen = np.interp(run.stamps_ns, run.odometry.stamps_ns, shown)
    for gyro in (run.gyro, None):
        check = check_motion(run.odometry, (run.stamps_ns, seen), gyro)
        assert len(check.wrong) == 1 and f"follow the robot's turns {how}: switch" in check.wrong[0]
    # Odometry that repeats commands is followed by the robot, and a gyroscope shows it.
    for gyro in (None, replace(run.gyro, omega=np.gradient(shown, 0.02))):
        check = check_motion(run.odometry, (run.stamps_ns, seen), gyro, commands=True)
        assert 'follow' not in ' '.join(check.wrong)


@pytest.mark.parametrize(('late_s', 'every'), [(0.45, 1), (-0.3, 1), (0.15, 3)])
def test_a_delay_or_few_images_are_no_stabilization(late_s, every):
    run = drive(*DRIVES['straight legs'][:1], yaw_noise=0.02, seed=2)
    jitter = np.random.default_rng(0).normal(0.0, 0.02, len(run.stamps_ns))
    stamps_ns = run.stamps_ns + np.round((late_s + jitter) * 1e9).astype(np.int64)
    check = check_motion(run.odometry, (stamps_ns[::every], run.poses[::every, 2]), run.gyro)
    assert check.wrong == [] and 'clock' not in ' '.join(check.corrected)


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


@pytest.mark.parametrize('name', DRIVES)
def test_messages_in_bundles_or_at_a_low_rate_do_not_jump(name):
    odometry = drive(*DRIVES[name], yaw_noise=0.2, speed_noise=0.2, seed=1).odometry
    bundled = odometry.stamps_ns // 10**8 * 10**8 + np.arange(len(odometry.stamps_ns))
    slower = (rows(odometry, slice(None, None, every)) for every in (1, 5, 25))
    for each in (*slower, replace(odometry, stamps_ns=bundled)):
        assert parted(each)[1] == ''


# The ground truth is one more source.


def marked(truth, late_s=0.0, lever=0j, swapped=False, unit=1.0, aside=0.0):
    """A truth of a marker beside base_link, with other stamps, axes, unit and headings."""
    places = as_complex(truth.poses) + lever * np.exp(1j * truth.poses[:, 2])
    yaw = truth.poses[:, 2] + aside
    if swapped:
        places, yaw = 1j * places.conj(), np.pi / 2 - yaw
    poses = np.column_stack([unit * places.real, unit * places.imag, yaw])
    return Trajectory(truth.stamps_ns + round(late_s * 1e9), poses)


def with_poses(truth, rows, pose):
    poses = truth.poses.copy()
    poses[rows] = pose
    return replace(truth, poses=poses)


TRUTHS = {
    'late': (lambda t: marked(t, 0.3), 'is stamped 0.30 s late'),
    'early': (lambda t: marked(t, -0.15), 'is stamped 0.15 s early'),
    'another clock': (lambda t: marked(t, 37.0), 'is stamped 37.00 s late'),
    'marker': (lambda t: marked(t, lever=-0.4 + 0.2j), 'lies 0.40 m behind and 0.20 m to the left'),
    'rare': (lambda t: marked(rows(t, np.s_[::8]), lever=0.4j), 'and 0.40 m to the left of'),
    'mirrored': (lambda t: marked(t, 0.2, 0.3j, True), 'is mirrored (y to the right, or x and y'),
    'millimeters': (lambda t: marked(t, unit=1000.0), 'is in millimeters'),
    'centimeters': (lambda t: marked(t, 0.1, unit=100.0), 'is in centimeters'),
    'turned marker': (lambda t: marked(t, aside=1.57), 'has headings +90 degrees beside'),
    'no headings': (lambda t: with_poses(t, np.s_[:], t.poses * [1, 1, 0]), 'has no headings'),
    'clockwise': (lambda t: with_poses(t, np.s_[:], t.poses * [1, 1, -1]), 'clockwise headings'),
    'zeros': (lambda t: with_poses(t, np.s_[::20], 0.0), '33 of 644 messages contradict'),
    'a place': (
        lambda t: with_poses(t, np.s_[9::20], [2.0, -1.0, 0.0]),
        '32 of 644 messages con',
    ),
    'held': (lambda t: with_poses(t, np.s_[301:316], t.poses[300]), 'up to 16 in a row'),
    'lost': (lambda t: with_poses(t, np.s_[-90:], 999.0), '90 of 644 messages contradict'),
    'lost at first': (lambda t: with_poses(t, np.s_[:60], -1.0), '60 of 644 messages contradict'),
}


def with_truth(seed=1, lines=10):
    run = drive(*criss_cross(lines, seed=seed), yaw_noise=0.1, speed_noise=0.1, seed=seed)
    return OdometryTrack.of(run.odometry, SegmentConfig()), Trajectory(run.stamps_ns, run.poses)


@pytest.mark.parametrize('name', TRUTHS)
def test_a_faulty_truth_is_corrected(name):
    change, text = TRUTHS[name]
    track, truth = with_truth()
    mended = true_poses(change(truth), track)
    assert text in '; '.join(mended.sentences)
    assert len(mended.sentences) == (3 if name == 'mirrored' else 2 if name == 'centimeters' else 1)
    inside = truth.covers(mended.poses.stamps_ns)
    right, poses = truth.at(mended.poses.stamps_ns[inside]), mended.poses.poses[inside]
    frame = align(poses[:, :2], right[:, :2])
    assert distances(frame.apply(poses[:, :2]), right).max() < 0.03
    assert mended.headings == (name != 'no headings')
    assert np.abs(wrap_angle(poses[:, 2] + frame.yaw_rad - right[:, 2])).max() < np.deg2rad(10.0)


def test_a_short_drive_has_the_offset_of_the_truth_of_other_drives_if_it_fits():
    """Too short to show it alone."""
    track, truth = with_truth(lines=2)
    late = marked(truth, 0.05)
    alone = true_poses(late, track)
    known = true_poses(late, track, usual=(0.0, 0.0, 0.05))
    assert not alone.sentences and 'is stamped 0.05 s late' in known.sentences[0]
    assert known.offset == pytest.approx((0.0, 0.0, 0.05))
    assert true_poses(truth, track, usual=(0.0, 0.0, 0.05)) == TruePoses(truth)


@pytest.mark.parametrize('name', DRIVES)
def test_a_right_truth_stays_as_it_is(name):
    run = drive(*DRIVES[name], yaw_noise=0.2, speed_noise=0.2, seed=1)
    track = OdometryTrack.of(run.odometry, SegmentConfig())
    noise = np.random.default_rng(0).normal(0.0, 0.01, run.poses.shape)
    for poses in (run.poses, run.poses + noise):
        truth = Trajectory(run.stamps_ns, poses)
        assert true_poses(truth, track) == TruePoses(truth)


def test_the_truth_of_another_drive_is_refused():
    """But not by odometry that nothing confirms."""
    track, truth = with_truth()
    _, other = with_truth(seed=5)
    with pytest.raises(DataError, match='moves independently of odometry: is it of this drive'):
        true_poses(other, track)
    assert true_poses(other, track, trusted=False).poses is other
    with pytest.raises(DataError, match=r'drives 3\.2\d times as far as odometry: publish meters'):
        true_poses(marked(truth, unit=3.28), track)


def test_a_truth_that_is_started_anew_is_reported():
    track, truth = with_truth()
    moved = truth.poses.copy()
    moved[300:] += [2.0, -1.0, 0.0]
    mended = true_poses(with_poses(truth, np.s_[:], moved), track)
    at_s = (truth.stamps_ns[300] - truth.stamps_ns[0]) * 1e-9
    (sentence,) = mended.sentences
    assert re.search(rf'jumps once by 2\.[0-3]. m after {at_s:.1f} s', sentence)
    assert len(mended.poses) == len(truth)


def fixes(truth, known=0j):
    """A receiver's points of a truth, with 2 cm of noise, beside true places of base_link."""
    noise = np.random.default_rng(0).normal(0.0, 0.02, (2, len(truth)))
    places = as_complex(truth.poses) + [1, 1j] @ noise
    rows = zip(truth.stamps_ns.tolist(), places.tolist(), strict=True)
    return Points.of([(str(at), at, place, 0.02, known) for at, place in rows])


@pytest.mark.parametrize('name', ['late', 'early', 'marker', 'zeros', 'a place'])
def test_points_of_a_topic_are_compared_in_time(name):
    change, text = TRUTHS[name]
    track, truth = with_truth()
    points, (sentence,) = timed_points(fixes(change(truth)), track)
    assert sentence.startswith('points_topic') and text in sentence
    poses = truth.at(points.stamps_ns)
    antenna = as_complex(poses) + points.lever * np.exp(1j * poses[:, 2])
    inside = truth.covers(points.stamps_ns)
    assert np.abs(points.places - antenna)[inside].max() < 0.12


def test_right_points_stay_as_they_are_and_those_of_another_shape_are_for_the_map_to_refuse():
    track, truth = with_truth()
    aside = fixes(marked(truth, lever=0.3j), known=0.3j)
    points, (sentence,) = timed_points(aside, track)
    assert 'to the left of base_link' in sentence
    assert np.abs(points.lever - 0.3j).max() < 0.02
    right = fixes(truth)
    points, texts = timed_points(right, track)
    assert not texts and points.rows() == right.rows()
    for wrong in marked(truth, swapped=True), marked(truth, unit=1000.0), with_truth(seed=5)[1]:
        points = fixes(wrong)
        assert timed_points(points, track) == (points, [])


def test_odometry_of_commands_shows_no_delay_of_a_truth():
    track, truth = with_truth()
    assert not true_poses(marked(truth, 0.2), track, open_loop=True).sentences
