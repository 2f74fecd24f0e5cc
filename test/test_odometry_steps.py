# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry that jumps, repeats its pose or leaps ahead in time; whose stamps are irregular; that
repeats commands, which the robot follows by the camera's delay later.
"""

import math

import numpy as np
import pytest
from filter_drives import SECOND, START_NS, FilterDrive, from_rest, started, winding
from places import as_complex, lengths

from sfa_localization.bags.motion_arrays import to_odometry
from sfa_localization.data.errors import DataError
from sfa_localization.data.geometry import compose, invert
from sfa_localization.data.odometry_steps import Paths, beyond
from sfa_localization.data.rig import Quantity, Rig
from sfa_localization.data.run import Trajectory
from sfa_localization.fusion.pose_filter import Level, PoseFilter

SURE = np.diag([0.0025, 0.0025, 0.0004])


def test_a_robot_may_stop_within_a_step_but_not_turn_back():
    assert beyond([0.01, 0.0], 0.04, [[1.0, 0.0]]) == pytest.approx(0.0)
    assert beyond([-0.5, 0.0], 0.04, [[1.0, 0.0]]) == pytest.approx(0.5)


def slow_drive(**how):
    """20 s at 0.4 m/s and 25 Hz."""
    return FilterDrive(twists=winding(20, 25.0, speed=0.4), rate_hz=25, **how)


def fused_over(poses, twists, drive, images=True):
    """(second, error m, level, reasons) at each odometry message; images every fifth are exact."""
    fused, outputs = started(std=0.02), []
    for i, stamp_ns in enumerate(drive.stamps_ns.tolist()):
        fused.add_odometry(stamp_ns, *twists[i], (4e-4, 1e-4), poses[i])
        if images and i % 5 == 0:
            fused.add_measurement(stamp_ns, drive.poses[i], SURE)
        error = math.dist(fused.state.pose[:2], drive.poses[i, :2])
        outputs.append((i / drive.rate_hz, error, fused.status.level, fused.status.reasons))
    return outputs


def jumped(poses, at, way_m, turn_rad=0.0):
    """Poses (N, 3) that go on from a step ahead, and a turn, from a message on."""
    pivot = poses[at]
    z = (poses[:, 0] - pivot[0] + 1j * (poses[:, 1] - pivot[1])) * np.exp(1j * turn_rad)
    z += pivot[0] + 1j * pivot[1] + way_m * np.exp(1j * (pivot[2] + turn_rad))
    later = np.column_stack([z.real, z.imag, poses[:, 2] + turn_rad])
    return np.where(np.arange(len(poses))[:, None] < at, poses, later)


@pytest.mark.parametrize('with_twist', [True, False])
@pytest.mark.parametrize(('way_m', 'turn_rad'), [
    (0.3, 0.0), (-0.5, 0.0), (0.0, 0.3), (0.3, 1.0),
])  # fmt: skip
def test_odometry_that_jumps_moves_nothing_and_is_told_until_an_image_comes(
    way_m, turn_rad, with_twist
):
    drive = slow_drive()
    twists = drive.read.copy()
    if with_twist:
        twists[251] += [way_m * 25, turn_rad * 25]
    outputs = fused_over(jumped(drive.reckoned, 251, way_m, turn_rad), twists, drive)
    assert max(error for _, error, *_ in outputs) < 0.05
    told = [t for t, _, level, why in outputs if 'odometry jumped' in ' '.join(why)]
    assert told == [252 / 25, 253 / 25, 254 / 25]
    assert all(level is Level.DEGRADED for t, _, level, _ in outputs if t in told)
    assert outputs[-1][2] is Level.LOCALISED


def test_speed_that_changes_within_a_message_and_noise_that_is_learned_are_no_jumps():
    """As of commands that are repeated, at 10 Hz: 0 to 2 m/s, and 0 to 2 rad/s."""
    twists = np.repeat([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, -2.0]], 10, axis=0)
    commanded = FilterDrive(twists=np.tile(twists, (2, 1)), rate_hz=10)
    noisy = slow_drive()
    noise = np.random.default_rng(0).normal(0.0, 0.03, noisy.reckoned.shape) * [1.0, 1.0, 0.1]
    for drive, poses, since in (
        (commanded, commanded.reckoned, 0),
        (noisy, noisy.reckoned + noise, 4),
    ):
        outputs = fused_over(poses, drive.read, drive)
        assert not any('jumped' in ' '.join(why) for t, *_, why in outputs if t > since)


@pytest.mark.parametrize('times', [2, 12])
@pytest.mark.parametrize('twist', ['fresh', 'stale', 'zero'])
def test_a_pose_that_is_repeated_adds_nothing(times, twist):
    rate_hz = 25
    drive = FilterDrive(twists=from_rest(winding(20, rate_hz, speed=0.4), rate_hz), rate_hz=rate_hz)
    renewed = np.arange(len(drive.stamps_ns)) // times * times
    twists = {'fresh': drive.read, 'stale': drive.read[renewed], 'zero': 0 * drive.read}[twist]
    outputs = fused_over(drive.reckoned[renewed], twists, drive, images=False)
    last = renewed[-1]  # beyond it, nobody knows
    assert outputs[last][1] < 0.02
    assert np.mean([error for _, error, *_ in outputs]) < 0.06


@pytest.mark.parametrize('times', [1, 3, 8])
def test_poses_without_twists_are_no_second_publisher(times):
    drive = FilterDrive(twists=from_rest(winding(20, 25, speed=1.0), 25), rate_hz=25)
    renewed, paths = np.arange(len(drive.stamps_ns)) // times * times, Paths()
    for i, pose in enumerate(drive.reckoned[renewed].tolist()):
        paths.add(i / 25, pose, 0.0, 0.0)
        assert not paths.in_turn and not paths.aside


def test_an_orientation_that_is_never_filled_is_left_to_the_twist():
    drive, errors = FilterDrive(seconds=20, rate_hz=25), []
    poses = drive.reckoned * [1.0, 1.0, 0.0]
    outputs = fused_over(poses, drive.read, drive)
    errors = [error for _, error, *_ in outputs]
    assert np.mean(errors) < 0.03
    entries = [
        (stamp, (pose, (*twist, 0.0, 0.0)))
        for stamp, pose, twist in zip(
            drive.stamps_ns.tolist(), poses.tolist(), drive.read.tolist(), strict=True
        )
    ]
    odometry, sentences, _ = to_odometry(entries, '/odom')
    assert sentences == ['the orientation is never filled; the twist is integrated instead']
    assert np.ptp(odometry.poses[:, 2]) > 1.0


def test_poses_that_are_never_filled_and_a_robot_that_stands_go_on_by_the_twist():
    drive = FilterDrive(twists=from_rest(winding(10)))
    outputs = fused_over(np.zeros((500, 3)), drive.read, drive, images=False)
    assert max(error for _, error, *_ in outputs) < 1e-6
    drive = FilterDrive(twists=np.repeat([[0.5, 0.0], [0.0, 0.0], [0.5, 0.3]], 100, axis=0))
    outputs = fused_over(drive.reckoned, drive.read, drive, images=False)
    assert max(error for _, error, *_ in outputs) < 1e-6
    assert not any('no odometry' in reason for *_, why in outputs for reason in why)


@pytest.mark.parametrize('ahead_s', [0.6, 30.0])
@pytest.mark.parametrize('kind', [0, 1])
def test_a_single_stamp_ahead_is_left_out_and_blocks_nothing(ahead_s, kind):
    drive, fused, errors = FilterDrive(seconds=10, omega_std=0.01), started(), []
    for k, (stamp_ns, of, index) in enumerate(drive.events()):
        wrong = of == kind and index % 45 == 20
        event = stamp_ns + round(wrong * ahead_s * SECOND), of, index
        drive.give(fused, event, heading=True)
        errors.append(0 if of or wrong else drive.error(fused, index)[0])
        assert k < 50 or wrong or fused.status.level is not Level.LOST
    name = ['odometry', 'measurement'][kind]
    many = [sum(i % 45 == 20 for i in range(len(drive.stamps_ns))), 3][kind]
    assert fused.counts[f'{name}: stamp ahead of those before'] in (many, many - 1)
    assert max(errors) < 0.1 and fused.counts['clock went back'] == 0


def test_a_clock_that_is_set_ahead_is_followed_from_the_third_message_on():
    drive, fused = FilterDrive(seconds=10), started()
    for stamp_ns, kind, index in drive.events():
        later_ns = round(3e5 * SECOND) * (stamp_ns - START_NS > 5 * SECOND)
        drive.give(fused, (stamp_ns + later_ns, kind, index), heading=True)
    assert fused.state.stamp_ns == int(drive.stamps_ns[-1]) + round(3e5 * SECOND)
    assert drive.error(fused, -1)[0] < 0.1


# Messages beside the path, and messages without pose.


def values_of(drive, poses, twists):
    """The messages of a bag's topic."""
    rows = zip(drive.stamps_ns.tolist(), poses.tolist(), twists.tolist(), strict=True)
    return [(stamp_ns, (pose, (*twist, 4e-4, 1e-4))) for stamp_ns, pose, twist in rows]


IN_TURN = {
    'one each': (lambda i: i % 2 == 1, 2.0 + 1.0j, 0.7),
    'one is slower': (lambda i: i % 7 == 3, -3.0, 3.0),
    'by chance': (lambda i: np.random.default_rng(0).random(len(i)) < 0.5, 1.0, -1.5),
}


@pytest.mark.parametrize('name', IN_TURN)
def test_two_publishers_in_turn_are_named_and_not_believed(name):
    chosen, shift, turn = IN_TURN[name]
    drive = slow_drive()
    z = shift + as_complex(drive.reckoned) * np.exp(1j * turn)
    other = np.column_stack([z.real, z.imag, drive.reckoned[:, 2] + turn])
    poses = np.where(chosen(np.arange(len(z)))[:, None], other, drive.reckoned)
    with pytest.raises(DataError, match=r'two publishers on /wheels: .*; stop one, or record each'):
        to_odometry(values_of(drive, poses, drive.read), '/wheels')
    outputs = fused_over(poses, drive.read, drive)
    assert max(error for t, error, *_ in outputs if t > 3.0) < 0.05
    assert outputs[-1][2] is Level.DEGRADED and 'along two paths in turn' in outputs[-1][3][0]


NAN = np.full(3, np.nan)
FAULTS = {
    'all zeros': ([0.0, 0.0, 0.0], [0.0, 0.0], 'pose beside the path'),
    'pose of zeros': ([0.0, 0.0, 0.0], None, 'pose beside the path'),
    'pose elsewhere': ([7.0, -3.0, 1.0], None, 'pose beside the path'),
    'also the quaternion': (NAN, [0.0, 0.0], 'neither pose nor twist'),
}


@pytest.mark.parametrize('name', FAULTS)
def test_single_faulty_messages_are_left_out_and_counted(name):
    pose, twist, reason = FAULTS[name]
    drive = slow_drive(start=(1.0, 1.0, 0.0))
    where = np.arange(len(drive.stamps_ns)) % 40 == 30
    right = drive.reckoned + np.array([1.0, 2.0, 0.0])
    poses = np.where(where[:, None], pose, right)
    twists = np.where(where[:, None], twist or drive.read, drive.read)
    odometry, said, faults = to_odometry(values_of(drive, poses, twists), '/odom')
    assert np.array_equal(odometry.poses, right[~where]) and faults == {reason: where.sum()}
    assert said == [f'{where.sum()} of {len(where)} messages left out: {reason}']
    fused = started(drive.start)
    for stamp_ns, (of_pose, (v, omega, *variances)) in values_of(drive, poses, twists):
        fused.add_odometry(stamp_ns, v, omega, variances, of_pose)
    assert fused.counts[f'odometry: {reason}'] == where.sum()
    assert math.dist(fused.state.pose[:2], drive.poses[-1, :2]) < 0.02


@pytest.mark.parametrize('share', [1.0, 0.3])
def test_where_no_pose_is_filled_the_twist_is_used(share):
    drive = slow_drive()
    where = np.random.default_rng(0).random(len(drive.stamps_ns)) < share
    poses, twists = np.where(where[:, None], NAN, drive.reckoned), drive.read
    odometry, said, _ = to_odometry(values_of(drive, poses, twists), '/odom')
    moved = compose(invert(odometry.poses[0]), odometry.poses[-1])
    assert np.allclose(moved, compose(invert(drive.reckoned[0]), drive.reckoned[-1]), atol=0.01)
    text = f'{where.sum()} of {len(where)} messages have no pose (NaN, or a quaternion of zeros)'
    assert [each.split(';')[0] for each in said] == [text]
    outputs = fused_over(poses, drive.read, drive, images=False)
    assert max(error for _, error, *_ in outputs) < 0.02
    with pytest.raises(DataError, match='neither poses nor twists'):
        to_odometry(values_of(drive, drive.reckoned * np.nan, 0 * twists), '/odom')


def test_poses_that_are_noisy_or_repeated_or_jump_are_of_one_publisher():
    drive = FilterDrive(twists=winding(20, 25.0, speed=1.0), rate_hz=25)
    rng, rows = np.random.default_rng(0), np.arange(len(drive.stamps_ns))
    noise = rng.normal(0.0, 0.1, (len(rows), 3)) * [1.0, 1.0, 0.3]
    for poses in (
        drive.reckoned + noise, drive.reckoned[rows // 4 * 4], jumped(drive.reckoned, 251, 0.6),
        np.round(drive.reckoned, 1),
    ):  # fmt: skip
        for twists in (drive.read, 0 * drive.read, -drive.read):
            assert to_odometry(values_of(drive, poses, twists), '/odom')[1:] == ([], {})


# Stamps.


def received(times):
    """Stamps s of odometry that is stamped on reception, exponentially late; order is kept."""
    late = np.random.default_rng(0).exponential(0.01, len(times))
    return np.maximum.accumulate(times + late) + 1e-6 * np.arange(len(times))


def stalled(times):
    """Stamps s of odometry of which 0.4 s arrive together, 0.1 ms apart, every second."""
    count = np.arange(len(times))
    end = np.floor(times) + 1.0
    return np.where((times % 1.0) > 0.6, end - 1e-4 * (1 + 50 - count % 50), times)


@pytest.mark.parametrize('stamped', [received, stalled])
def test_odometry_with_poses_may_be_stamped_irregularly(stamped):
    """The poses show how far it was, whatever the stamps; images come at 8 Hz in between."""
    drive, fused, errors = FilterDrive(seconds=20, omega_std=0.01, v_std=0.02), PoseFilter(), []
    times = np.arange(len(drive.stamps_ns)) / 50.0
    coming = [(t, 0, i) for i, t in enumerate(stamped(times).tolist())]
    coming += [(t, 1, 0) for t in np.arange(1.013, 19.0, 0.125).tolist()]
    path = Trajectory(drive.stamps_ns, drive.poses)
    for t, kind, i in sorted(coming):
        stamp_ns = START_NS + round(t * 1e9)
        if kind == 0:
            fused.add_odometry(stamp_ns, *drive.read[i], drive.variances(), drive.reckoned[i])
            continue
        pose = path.at(np.array([stamp_ns]))[0]
        update = fused.add_measurement(stamp_ns, pose, SURE)
        errors.append(math.hypot(*(fused.state.pose - pose)[:2]))
        assert update.accepted and abs(fused.state.twist[0]) < 2.5
        if t > 8.0:
            assert fused.status.level is Level.LOCALISED
    assert max(errors) < 0.1


# Commands.

DELAY_S, RATE_HZ = 0.3, 50


@pytest.mark.parametrize(('noise', 'delay_s'), [(0.0, DELAY_S), (1e-3, 0.0)])
def test_the_estimate_is_where_commands_led_a_camera_delay_ago(noise, delay_s):
    """Of twists that are commanded twice a second, and read with noise or without."""
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform([0.5, -1], [1, 1], (24, 2)), RATE_HZ // 2, axis=0)
    drive = FilterDrive(twists=commands + noise * rng.standard_normal(commands.shape))
    fused = started(std=0.01)
    fused.expect(Rig(camera_delay=Quantity(DELAY_S, 0.2)))
    for stamp_ns, (v, omega) in zip(drive.stamps_ns.tolist(), drive.twists.tolist(), strict=True):
        fused.add_odometry(stamp_ns, v, omega)
    for i in (450, 520, 599):
        state = fused.at(int(drive.stamps_ns[i]))
        assert state.stamp_ns == int(drive.stamps_ns[i])
        assert np.allclose(state.pose, drive.poses[i - round(delay_s * RATE_HZ)], atol=1e-4)
    assert np.array_equal(fused.state.pose, state.pose)
    times = START_NS + np.round(np.arange(9.0, 13.0, 0.005) * SECOND).astype(int)
    poses = np.array([fused.at(at).pose for at in times.tolist()])
    # A twist holds from the stamp before: what a message changes is known one period later.
    assert lengths(np.diff(poses, axis=0)).max() < 0.02
    assert np.abs(np.diff(poses[:, 2])).max() < 0.03
