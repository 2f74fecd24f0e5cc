# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Teach and go: record a drive, say while it is driven where to drive still, then train.

The drive is judged by `inspect` of what is recorded so far, and learned by `train`: both run in a
process of their own, so that what is said here is what they say of the bag.
"""

from __future__ import annotations

import importlib
import itertools
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from sfa_localization.bags.decoding import IMU, ODOMETRY
from sfa_localization.bags.reader import KINDS
from sfa_localization.bags.recorder import BagRecorder
from sfa_localization.bags.settings import TopicNames
from sfa_localization.data.errors import BagError, ConfigError, LocalizationError
from sfa_localization.mapping.driven_ground import DrivenGround
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes.discovery import DEPTH, is_ours
from sfa_localization.nodes.lifecycle import ERROR, OK, WARN, LocalizationNode, latched_qos
from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.process import NODES
from sfa_localization.nodes.settings import TRANSPORTS, TeachNodeConfig
from sfa_localization.nodes.worker import Worker

STATIC_TF = 'tf2_msgs/msg/TFMessage'
CELL_M = 0.25
REACH_M = 1.0
"""Cells of the map, and the distance to an image within which `inspect` takes ground as covered."""
_DEPTH_OF_QUEUE = 100
_ENOUGH = 'enough to train on: call ~/finish'


class TeachNode(LocalizationNode):
    """Records its inputs, publishes what to drive still, and trains a model of it."""

    def __init__(self, **options: Any) -> None:
        super().__init__('teach_node', [TeachNodeConfig, TopicNames], **options)
        self._config_file = ''
        self._recorder: BagRecorder | None = None
        self._worker: Worker | None = None
        self._recorded: dict[str, Any] = {}

    def find_files(self, words: Sequence[str]) -> None:
        """The parameter file is also that of the commands."""
        if '--params-file' in words:
            self._config_file = words[words.index('--params-file') + 1]

    def setup(self) -> None:
        output = self.settings(TeachNodeConfig).output
        if not output:
            raise ConfigError("parameter 'output' is empty: name the model to write, GARDEN.npz")
        self._model = Path(output).expanduser()
        self._folder = TemporaryDirectory(prefix='teach-')
        self._judgment = Path(self._folder.name) / 'judgment.json'
        self._is_training = False
        self._findings: dict[str, Any] = {}
        self._next_look_s = 0.0
        self._problem = ''
        self._said = ''
        self._start(*self._pending()[-1:] or [self._new_drive()])
        latched = latched_qos()
        self._state = self.publisher(String, 'teach/state', latched)
        self._map = self.publisher(OccupancyGrid, 'teach/map', latched)
        self._hints = self.publisher(MarkerArray, 'teach/hints', latched)
        self.service(Trigger, '~/finish', self._finish)
        self.service(Trigger, '~/cancel', self._cancel)
        self.service(Trigger, '~/extend', self._extend)
        self.every(1.0, self._step)

    def teardown(self) -> None:
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
        self._end_recording()

    def health(self) -> tuple[int, str, dict[str, str]]:
        counts = {} if self._recorder is None else self._recorder.counts
        level = ERROR if self._problem else WARN if not self._findings else OK
        return level, self._said, {topic: str(count) for topic, count in counts.items()}

    # Recording.

    def _new_drive(self) -> Path:
        """The folder of one more drive, beside the model."""
        stem = self._model.stem
        taken = {path.name for path in self._model.parent.glob(f'{stem}_*')}
        numbers = itertools.count(1)
        free = next(n for n in numbers if not taken & {f'{stem}_drive{n}', f'{stem}_trial{n}'})
        return self._model.with_name(f'{stem}_drive{free}')

    def _drives(self) -> list[Path]:
        """The folders that are there."""
        folders = self._model.parent.glob(f'{self._model.stem}_drive*')
        return sorted(folders, key=lambda path: (len(path.name), path.name))

    def _pending(self) -> list[Path]:
        """The folders that the model has not learned: they are newer."""
        learned_s = self._model.stat().st_mtime if self._model.exists() else 0.0
        return [path for path in self._drives() if path.stat().st_mtime > learned_s]

    def _start(self, folder: Path) -> None:
        """Record into a folder, or go on there."""
        self._recorder = BagRecorder(folder)
        self.get_logger().info(f'recording into {folder}')

    def _end_recording(self) -> None:
        for subscription in self._recorded.values():
            self.unsubscribe(subscription)
        self._recorded = {}
        if self._recorder is not None:
            recorder = self._recorder
            self._recorder = None
            recorder.close()

    def _listen(self) -> None:
        """Subscribe to new inputs: images, each in one transport, odometry, IMUs, /tf_static."""
        given = self.settings(TopicNames)
        named = {given.image: '', given.odometry: '', given.imu: '', given.points_topic: ''}
        bases = {self._base(topic) for topic in self._recorded}
        for topic, kinds in sorted(self.get_topic_names_and_types(), reverse=True):
            wanted = {*TRANSPORTS.values()} if not given.image else set()
            wanted |= {ODOMETRY} if not given.odometry else set()
            wanted |= {IMU} if not given.imu else set()
            wanted |= {STATIC_TF} if topic.endswith('/tf_static') else set()
            chosen = topic in named or (wanted & {*kinds} and not is_ours(self, topic))
            if chosen and self._base(topic) not in bases and not topic.endswith(DEPTH):
                bases.add(self._base(topic))
                self._record(topic, kinds[0])

    @staticmethod
    def _base(topic: str) -> str:
        """The name of a topic of images without its transport."""
        return topic.removesuffix('/compressed')

    def _record(self, topic: str, kind: str) -> None:
        """Subscribe to a topic as its publishers offer it."""
        package, _, name = kind.split('/')
        try:
            message_class = getattr(importlib.import_module(f'{package}.msg'), name)
        except ImportError:
            self.refuse(topic, f'is not recorded: install {package}')
            return
        offered = [each.qos_profile for each in self.get_publishers_info_by_topic(topic)]
        qos = QoSProfile(depth=_DEPTH_OF_QUEUE)
        if any(each.reliability is not ReliabilityPolicy.RELIABLE for each in offered):
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        if offered and all(each.durability is DurabilityPolicy.TRANSIENT_LOCAL for each in offered):
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        write = partial(self._write, topic, kind)
        self._recorded[topic] = self.subscribe(message_class, topic, write, qos, raw=True)

    def _write(self, topic: str, kind: str, data: bytes) -> None:
        if self._recorder is None:
            return
        now_ns = self.get_clock().now().nanoseconds
        try:
            self._recorder.write(topic, kind, data, now_ns)
        except BagError as error:
            self._fail(error)

    def _fail(self, error: BagError) -> None:
        """Stop recording; what is recorded stays."""
        self._problem = f'{error}: the recording ended'
        self._recorder = None
        self.get_logger().error(self._problem)

    # Looking, and training.

    def _step(self) -> None:
        """Once a second: record new topics, look at the drive, say how far all is."""
        if self._recorder is not None:
            self._listen()
            try:
                self._recorder.flush()
            except BagError as error:
                self._fail(error)
        if self._worker is not None and self._worker.code is not None:
            worker = self._worker
            self._worker = None
            (self._trained if self._is_training else self._looked)(worker)
        elif self._worker is None and self._recorder is not None:
            self._look()
        self._say()

    def _commands(self, command: str, *words: str | Path) -> list[str | Path]:
        """A command with the topics and the parameter file of this node."""
        topics = self.settings(TopicNames)
        given = [
            (KINDS[name].flag, getattr(topics, name))
            for name in ('image', 'odometry', 'imu')
            if getattr(topics, name)
        ]
        if self._config_file:
            given.append(('--config', self._config_file))
        return [command, *words, *(word for pair in given for word in pair)]

    def _start_worker(self, *words: str | Path) -> None:
        self._worker = Worker(words, Path(self._folder.name) / 'log')

    def _look(self) -> None:
        """Inspect what is recorded, as often as the share of a core allows."""
        if steady_s() < self._next_look_s or not self._recorder or not self._recorder.counts:
            return
        report = Path(self._folder.name) / 'report.json'
        report.unlink(missing_ok=True)
        self._start_worker(*self._commands('inspect', self._recorder.folder, '--json', report))

    def _looked(self, worker: Worker) -> None:
        """Publish what `inspect` found."""
        share = self.settings(TeachNodeConfig).share
        self._next_look_s = steady_s() + worker.elapsed_s * (1 / share - 1)
        report = Path(self._folder.name) / 'report.json'
        if not report.exists():
            self._problem = worker.last_line()
            return
        self._problem = ''
        (self._findings,) = json.loads(report.read_text())['bags']
        places = [np.array(drive) for drive in self._findings['drives'] if drive]
        if not places:
            return
        frame = self.settings(TeachNodeConfig).odom_frame
        now_ns = self.get_clock().now().nanoseconds
        driven = np.concatenate(places)[:, :2]
        part = np.repeat(np.arange(len(places)), [*map(len, places)])
        ground = DrivenGround.of(driven, part, np.zeros(len(driven)))
        cells = ground.cells(GroundConfig(cell=CELL_M, width=2 * REACH_M))
        self._map.publish(convert.to_grid(cells, now_ns, frame, cells.enclosed(driven)))
        self._hints.publish(convert.to_hints(places, self._verdict(), now_ns, frame))

    def _verdict(self) -> str:
        """The first reason why the drive is not enough, or that it is."""
        error = self._findings.get('error', '')
        return next(iter([*filter(None, [error]), *self._findings.get('lacks', [])]), _ENOUGH)

    def _say(self) -> None:
        """Publish one sentence when it is new."""
        if self._is_training and self._worker is not None:
            said = f'training: {self._worker.last_line()}'
        elif self._problem:
            said = self._problem
        elif self._recorder is None:
            said = self._said
        elif not self._recorder.counts:
            said = 'waiting for images and odometry'
        else:
            driven = self._findings.get('facts', {}).get('drive', '')
            known = [driven] if any(self._findings.get('drives', [])) else []
            said = '; '.join([*known, self._verdict()])
            said = said if self._findings else f'recording {", ".join(self._recorder.counts)}'
        self._say_once(said)

    def _say_once(self, said: str) -> None:
        if said != self._said:
            self._said = said
            self._state.publish(String(data=said))

    def _finish(self, _: Any) -> str:
        if self._recorder is None:
            raise LocalizationError('nothing is being recorded: call ~/extend to drive more')
        folder = self._recorder.folder
        if not self._recorder.counts:
            raise LocalizationError('nothing was recorded yet')
        if self._worker is not None:
            self._worker.stop()
        self._end_recording()
        update: list[str | Path] = ['--update', self._model] if self._model.exists() else []
        self._is_training = True
        outputs = '--output', self._model, '--json', self._judgment
        self._start_worker(*self._commands('train', *self._pending(), *outputs, *update))
        return f'recorded {folder}; training, see teach/state'

    def _cancel(self, _: Any) -> str:
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
        self._is_training = False
        self._end_recording()
        kept = []
        for folder in self._pending():
            kept.append(folder.with_name(folder.name.replace('_drive', '_trial')))
            folder.rename(kept[-1])
        self._problem = ''
        self._say_once(f'canceled; what was recorded is in {", ".join(map(str, kept))}')
        return self._said

    def _extend(self, _: Any) -> str:
        if self._recorder is not None or self._worker is not None:
            raise LocalizationError('the last drive is not finished: call ~/finish or ~/cancel')
        self._findings = {}
        folder = self._new_drive()
        self._start(folder)
        return f'recording into {folder}'

    def _trained(self, worker: Worker) -> None:
        """Say how the training ended, and let the nodes use the model."""
        self._is_training = False
        if worker.code:
            self._problem = f'training failed: {worker.last_line()}; the recording is kept'
            self.get_logger().error(self._problem)
            return
        self._problem = ''
        judgment = json.loads(self._judgment.read_text())
        self._say_once(f'{self._model} is written. {judgment["sentence"]}')
        self.get_logger().info(self._said)
        reload = self.client(Trigger, 'sfa_node/reload_model')
        if self.settings(TeachNodeConfig).localize:
            for name in NODES:
                self._activate(name)
        elif reload.service_is_ready():
            reload.call_async(Trigger.Request())

    def _activate(self, name: str) -> None:
        """Configure a node, and activate it then."""
        client = self.client(ChangeState, f'{name}/change_state')
        activate = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
        configure = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
        if not client.service_is_ready():
            self.refuse(name, 'is not there to be activated')
            return
        done = client.call_async(configure)
        done.add_done_callback(lambda _: client.call_async(activate))
