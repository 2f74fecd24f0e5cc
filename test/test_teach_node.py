# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Teach and go: a drive through DDS is recorded, judged as `inspect` does, and learned."""

import errno
import os
import signal
import subprocess
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from sfa_localization.bags.reader import Bag
from sfa_localization.bags.recorder import BagRecorder
from sfa_localization.data.errors import BagError
from sfa_localization.data.run import Trajectory
from sfa_localization.evaluation import evaluate, moved, score
from sfa_localization.fusion.status import Level
from sfa_localization.inspection import inspect, path_length
from sfa_localization.place_model import PlaceModel

pytest.importorskip('rclpy')

import rclpy
from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid, Odometry
from ros_bench import start_process, until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image, Imu
from std_msgs.msg import String
from std_srvs.srv import Trigger
from taught_drives import (
    SAMPLE,
    TEST,
    driver,
    passed_on,
    records,
    start_chain,
    start_teaching,
)
from visualization_msgs.msg import MarkerArray

from sfa_localization.nodes.conversions import read_odometry
from sfa_localization.nodes.lifecycle import WARN, latched_qos
from sfa_localization.nodes.teach_node import TeachNode
from sfa_localization.nodes.worker import Worker

pytestmark = pytest.mark.ros


def test_a_recorded_bag_holds_the_same_messages_also_after_it_went_on(tmp_path):
    messages = records(SAMPLE)[:500]
    folder = tmp_path / 'drive'
    first = BagRecorder(folder)
    for message in messages[:300]:
        first.write(*message)
    first.flush()  # and the power fails
    assert len([*folder.glob('*.mcap')]) == 1
    with Bag(folder) as bag:
        assert sum(topic.count for topic in bag.topics.values()) == 300
        cut = 'drive_0.mcap: was not closed, as where the power was cut: read as far as it goes; '
        assert bag.problems == [f'{cut}`mcap recover` repairs it']
    second = BagRecorder(folder)
    for message in messages[300:]:
        second.write(*message)
    second.close()
    assert len([*folder.glob('*.mcap')]) == 2 and not (folder / 'metadata.yaml').exists()
    with Bag(folder) as bag:
        read = [bytes(data) for *_, data in bag.recording.messages([*bag.topics])]
    assert read == [data for _, _, data, _ in messages]


def test_a_bag_in_one_file_has_its_metadata(tmp_path):
    messages = records(SAMPLE)[:500]
    recorder = BagRecorder(tmp_path / 'drive')
    for message in messages:
        recorder.write(*message)
    recorder.close()
    assert records(tmp_path / 'drive') == messages
    assert (tmp_path / 'drive/metadata.yaml').exists()


def test_a_full_disk_names_the_bag_and_the_reason(tmp_path, monkeypatch):
    recorder = BagRecorder(tmp_path / 'drive')
    recorder.write(*records(SAMPLE)[0])
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(recorder._writer, 'flush', mock.Mock(side_effect=full))
    with pytest.raises(BagError, match='drive: cannot be written: No space left on device'):
        recorder.flush()


def test_a_recorder_without_messages_leaves_the_bag_as_it_was(tmp_path):
    BagRecorder(tmp_path / 'new').close()
    assert [*(tmp_path / 'new').iterdir()] == []
    recorder = BagRecorder(tmp_path / 'drive')
    recorder.write(*records(SAMPLE)[0])
    recorder.close()
    before = sorted(path.name for path in (tmp_path / 'drive').iterdir())
    BagRecorder(tmp_path / 'drive')  # and the power fails
    (tmp_path / 'drive/drive_7.mcap').touch()
    BagRecorder(tmp_path / 'drive').close()
    assert sorted(path.name for path in (tmp_path / 'drive').iterdir()) == before
    assert before == ['drive_0.mcap', 'metadata.yaml']


def is_running(pid):
    """Whether a process has not ended, also where nobody waits for it."""
    stat = Path(f'/proc/{pid}/stat')
    return stat.exists() and stat.read_text().rpartition(') ')[2][0] != 'Z'


def test_a_command_ends_with_a_node_that_is_killed():
    code = (
        'import sys, time; from sfa_localization.nodes.worker import '
        "Worker; worker = Worker(['play', sys.argv[1], '--wait', '1000']); "
        'print(worker._process.pid, flush=True); time.sleep(1000)'
    )
    node = start_process('-c', code, SAMPLE, stdout=subprocess.PIPE)
    pid = int(node.stdout.readline())
    assert until(lambda: b'sfa_localization' in Path(f'/proc/{pid}/cmdline').read_bytes())
    assert is_running(pid)
    node.kill()
    node.communicate()
    assert until(lambda: not is_running(pid))


def test_a_signal_is_named_in_place_of_the_progress(tmp_path):
    worker = Worker(['play', SAMPLE, '--wait', '1000'])
    os.kill(worker._process.pid, signal.SIGKILL)
    assert until(lambda: worker.code is not None)
    assert worker.failure() == 'SIGKILL ended it, as by a system without memory'
    worker = Worker(['play', tmp_path / 'none'])
    assert until(lambda: worker.code is not None)
    assert worker.failure() == worker.last_line() and 'no such bag' in worker.failure()


def test_a_disk_that_cannot_keep_the_bag_is_named(tmp_path):
    recorder = BagRecorder(tmp_path / 'drive')
    recorder.write(*records(SAMPLE)[0])
    with mock.patch('os.fsync', side_effect=OSError(errno.EIO, os.strerror(errno.EIO))):
        recorder.flush()
        assert until(recorder._synced.done)
    with pytest.raises(BagError, match='drive: cannot be written: Input/output error'):
        recorder.flush()
    recorder.close()


@pytest.fixture
def taught(bench, tmp_path):
    return start_teaching(bench, tmp_path / 'garden.npz')


@pytest.fixture
def chain(bench, tmp_path):
    return start_chain(bench, tmp_path / 'garden.npz')


def call(bench, name):
    return bench.call(Trigger, f'teach_node/{name}', Trigger.Request())


def test_a_drive_is_taught_and_learned(bench, chain, taught, tmp_path):
    said = bench.listen(String, 'teach/state', latched_qos())
    grids = bench.listen(OccupancyGrid, 'teach/map', latched_qos())
    hints = bench.listen(MarkerArray, 'teach/hints', latched_qos())
    messages = records(SAMPLE, '/odom', '/imu', '/panorama/compressed')
    images = [n for n, (topic, *_) in enumerate(messages) if topic.startswith('/panorama')]
    drive = driver(bench, taught._recorder.counts.total)
    # Two images more are enough, here and to `inspect`, which skips a single one after a pause.
    drive(messages[: images[299]])
    assert until(lambda: '299 images with odometry are few' in said[-1].data), said[-1].data
    recorded = tmp_path / 'garden_drive1'
    (few,) = inspect(recorded).lacks
    assert few in said[-1].data and not any('enough to' in each.data for each in said)
    drive(messages[images[299] : images[301]])
    assert until(lambda: 'enough to train on' in said[-1].data), said[-1].data
    assert inspect(recorded).lacks == []
    assert until(lambda: hints[-1].markers[-1].text.startswith('enough'))
    assert until(lambda: 0 in grids[-1].data)
    drive(messages[images[301] :])
    assert call(bench, 'finish').success
    assert until(lambda: 'is written. The map' in said[-1].data, 300.0), said[-1].data
    report = inspect(recorded)
    assert report.lacks == [] and report.problems == []
    assert {topic.name: topic.count for topic in report.topics} == {
        '/odom': 3176, '/imu': 3176, '/panorama_raw/compressed': 427,
    }  # fmt: skip
    model = PlaceModel.load(tmp_path / 'garden.npz')
    assert model.quality['certified']
    answer = call(bench, 'finish')
    assert not answer.success and '~/extend' in answer.message
    assert until(lambda: all(node.active for node in chain))
    assert_localised_as_offline(bench, chain, model)
    assert call(bench, 'extend').success and taught._recorder.folder.name == 'garden_drive2'
    assert call(bench, 'cancel').success


def assert_localised_as_offline(bench, chain, model):
    """On the test drive: by the first image after two meters, with the error of `evaluate`."""
    located = bench.listen(String, 'ekf/state', latched_qos())
    fused = bench.listen(Odometry, 'ekf/odometry')
    driven, localised = [], []
    for message in passed_on(bench, chain):
        if isinstance(message, Odometry):
            driven.append(read_odometry(message)[2][:2])
        else:
            # Between two callbacks, the image is fused.
            bench.do(lambda: localised.append(chain[2].status().level is Level.LOCALISED))
            if localised.count(True) == 1 and localised[-1]:
                assert path_length(np.array(driven)) < 2.25  # images are 0.21 m apart
    assert any(localised) and until(lambda: located[-1].data == 'LOCALISED')
    offline = evaluate(model, TEST, align_bags=[SAMPLE])
    assert until(lambda: len(fused) == offline.scores['ekf']['n'])
    read = [read_odometry(message) for message in fused]
    live = Trajectory(np.array([r[0] for r in read]), np.array([r[2] for r in read]))
    error = score(offline.truth, moved(live, offline.transform))
    assert error['mean'] == pytest.approx(offline.scores['ekf']['mean'], abs=0.003)


def record(folder, *topics):
    """A drive with the first messages of the sample, under other names of topics."""
    recorder = BagRecorder(folder)
    for topic, kind, data, at_ns in records(SAMPLE)[:300]:
        recorder.write(dict(topics).get(topic, topic), kind, data, at_ns)
    recorder.close()


def test_only_what_was_not_taught_goes_on(bench, tmp_path):
    output = tmp_path / 'garden.npz'
    record(tmp_path / 'garden_drive1')
    output.touch()
    (tmp_path / 'garden_teach').mkdir()  # by a node that was killed
    node = bench.run(TeachNode, output=str(output))
    said = bench.listen(String, 'teach/state', latched_qos())
    assert until(
        lambda: said and said[-1].data == f'{output} is there: call ~/extend to drive more'
    )
    assert not call(bench, 'finish').success and not call(bench, 'cancel').success
    assert call(bench, 'extend').message.endswith('garden_drive2')
    assert call(bench, 'cancel').success and not any((tmp_path / 'garden_drive2').iterdir())
    bench.end(node)
    assert not (tmp_path / 'garden_teach').exists()
    os.utime(output, (1.0, 1.0))
    node = bench.run(TeachNode, output=str(output))
    goes_on = f'to go on with {tmp_path}/garden_drive1; ~/finish trains on it'
    assert until(lambda: goes_on in said[-1].data), said[-1].data
    answer = call(bench, 'finish')
    assert answer.success and answer.message.startswith(f'training on {tmp_path}/garden_drive1;')
    assert not call(bench, 'finish').success and not call(bench, 'extend').success
    with mock.patch.object(node, 'get_logger', return_value=mock.Mock()) as logger:
        assert until(lambda: said[-1].data.startswith('training failed: ')), said[-1].data
        assert until(lambda: mock.call(said[-1].data) in logger().error.mock_calls)
    assert '--' not in said[-1].data and said[-1].data.endswith(
        f'; {tmp_path}/garden_drive1: kept for ~/finish, or remove it'
    )
    answer = call(bench, 'finish')
    assert answer.success and call(bench, 'cancel').success
    assert said[-1].data == f'canceled; {tmp_path}/garden_drive1: kept for ~/finish'


def test_a_training_goes_on_at_the_next_start(bench, tmp_path, monkeypatch):
    """Unless it was canceled."""
    record(tmp_path / 'garden_drive1')
    started = mock.Mock(return_value=mock.Mock(code=None, **{'last_line.return_value': ''}))
    monkeypatch.setattr('sfa_localization.nodes.teach_node.Worker', started)
    nodes = [bench.run(TeachNode, output=str(tmp_path / 'garden.npz'))]
    assert call(bench, 'finish').success
    for goes_on in (True, False):
        bench.end(nodes.pop())
        nodes.append(bench.run(TeachNode, output=str(tmp_path / 'garden.npz')))
        assert (nodes[0]._recorder is None) == goes_on
        assert call(bench, 'cancel').success
    first, again = (each.args[0] for each in started.call_args_list)
    assert first == again and again[-1] == '--resume'


def test_a_clock_that_was_set_back_begins_a_drive_and_files_of_the_future_keep_their_order(
    bench, tmp_path
):
    """As after a power cut, of a board whose clock does not go on."""
    record(tmp_path / 'garden_drive1')  # at the sample's time
    record(tmp_path / 'garden_drive2')
    output = tmp_path / 'garden.npz'
    output.touch()
    for ahead_s, path in enumerate(
        [tmp_path / 'garden_drive1', output, tmp_path / 'garden_drive2']
    ):
        later_s = time.time() + 3600 + ahead_s
        for file in [*path.glob('*.mcap')] or [path]:
            os.utime(file, (later_s, later_s))
    node = bench.run(TeachNode, output=str(output), use_sim_time=True)
    assert node._untaught() == [tmp_path / 'garden_drive2']
    assert output.stat().st_mtime < time.time()
    said = bench.listen(String, 'teach/state', latched_qos())
    bench.publish_until(
        '/clock', Clock(clock=Time(sec=1)), lambda: node.get_clock().now().nanoseconds
    )
    again = f'the clock was set back: {tmp_path}/garden_drive3 is a drive of its own'
    bench.publish_until('/odom', Odometry(), lambda: any(again in each.data for each in said))
    bench.publish_until('/odom', Odometry(), lambda: node._recorder.counts)
    bench.do(node._end_recording)
    assert node._untaught() == [tmp_path / 'garden_drive2', tmp_path / 'garden_drive3']


def test_a_drive_that_ended_with_the_disk_is_finished(bench, taught):
    bench.publish('/odom', Odometry())
    assert until(lambda: taught._recorder.counts.total() and taught._recorder._file.tell())
    full = BagError('drive: cannot be written: No space left on device')
    with mock.patch.object(taught._recorder, 'flush', side_effect=full):
        assert until(lambda: 'make room, then call ~/finish' in taught._said), taught._said
    assert call(bench, 'finish').success and call(bench, 'cancel').success


def test_inputs_that_stop_or_have_two_publishers_are_named(bench, taught):
    said = bench.listen(String, 'teach/state', latched_qos())
    bench.publish_until('/odom', Odometry(), lambda: said and 'recording /odom' in said[-1].data)
    bench.node.create_publisher(Imu, '/imu', 10)
    second = rclpy.create_node('second', context=bench.context)
    second.create_publisher(Odometry, '/odom', 10)
    twice = 'bench and second publish on /odom, which is not recorded: end all but one'
    assert bench.publish_until('/odom', Odometry(), lambda: twice in said[-1].data)
    recorded = taught._recorder.counts.copy()
    heard = taught.monitors['/odom'].received
    bench.publish_until('/odom', Odometry(), lambda: taught.monitors['/odom'].received > heard)
    assert taught._recorder.counts == recorded
    second.destroy_node()
    assert until(lambda: twice not in said[-1].data)
    stopped = 'nothing comes from /odom'
    with mock.patch.object(taught, 'get_logger', return_value=mock.Mock()) as logger:
        assert until(lambda: stopped in said[-1].data), said[-1].data
    assert logger().warning.mock_calls == [mock.call(stopped)]
    taught._findings = {'facts': {'drive': ''}}
    assert taught.health()[0] == WARN
    assert '/imu' not in said[-1].data  # it never sent anything


def test_topics_are_named_without_transport_and_a_drive_keeps_its_transport(bench, tmp_path):
    names = {'image': '/image_raw', 'odometry': 'wheels'}
    raw = '/panorama/compressed', '/image_raw'
    record(tmp_path / 'new_drive1', raw, ('/odom', '/wheels'))
    for topic, kind in (('/image_raw', Image), ('/image_raw/compressed', CompressedImage)):
        bench.node.create_publisher(kind, topic, 10)
    bench.node.create_publisher(Odometry, '/wheels', 10)
    for model, image in (('old', '/image_raw/compressed'), ('new', '/image_raw')):
        node = bench.run(TeachNode, output=str(tmp_path / f'{model}.npz'), **names)
        assert until(lambda: len(node._recorded) == 2)  # noqa: B023
        assert {*node._recorded} == {image, '/wheels'}
        words = ['--image-topic', image, '--odom-topic', '/wheels']
        assert node._commands('inspect') == ['inspect', *words]
        bench.end(node)


def test_a_name_is_needed_and_nothing_is_finished_before_it_began(bench, taught):
    answer = call(bench, 'finish')
    assert not answer.success and 'nothing was recorded yet' in answer.message
    node = bench.run(TeachNode, start=False, options={'namespace': 'other'})
    assert not node.start() and "parameter 'output' is empty" in node.failure


def test_panoramas_are_recorded_unless_this_package_makes_them(bench, taught):
    bench.publish('/panorama/compressed', CompressedImage())
    assert until(lambda: '/panorama/compressed' in taught._recorder.counts)
