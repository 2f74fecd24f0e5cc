# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Teach and go: record a drive, say while it is driven where to drive still, then train.

The drive is judged by `inspect` of what is recorded so far, and learned by `train`: both run in a
process of their own, so that what is said here is what they say of the bag.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
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
from sfa_localization.bags.reader import KINDS, Bag
from sfa_localization.bags.recorder import BagRecorder, files_with_messages
from sfa_localization.bags.settings import TopicNames
from sfa_localization.data.errors import BagError, ConfigError, LocalizationError
from sfa_localization.data.events import CLOCK_JUMP_NS
from sfa_localization.data.geometry import Array
from sfa_localization.data.image_topics import TRANSPORTS, without_transport
from sfa_localization.mapping.driven_ground import DrivenGround
from sfa_localization.mapping.settings import GroundConfig
from sfa_localization.nodes import conversions as convert
from sfa_localization.nodes.discovery import DEPTH, is_ours
from sfa_localization.nodes.lifecycle import ERROR, OK, WARN, LocalizationNode, latched_qos
from sfa_localization.nodes.monitor import steady_s
from sfa_localization.nodes.process import NODES
from sfa_localization.nodes.settings import TeachNodeConfig
from sfa_localization.nodes.worker import Worker

STATIC_TF = 'tf2_msgs/msg/TFMessage'
CELL_M = 0.25
REACH_M = 1.0
"""Cells of the map, and the distance to an image within which `inspect` takes ground as covered."""
_DEPTH_OF_QUEUE = 100
_ENOUGH = 'enough to train on: call ~/finish'
_FLAGS = {KINDS[name].flag: f"the parameter '{name}'" for name in ('image', 'odometry', 'imu')}
"""Options of the commands, as this node names them."""


def _changed_ns(file: Path) -> int:
    return file.stat().st_mtime_ns


class TeachNode(LocalizationNode):
    """Records its inputs, publishes what to drive still, and trains a model of it."""

    def __init__(self, **options: Any) -> None:
        super().__init__('teach_node', [TeachNodeConfig, TopicNames], **options)
        self._config_file = ''
        self._recorder: BagRecorder | None = None
        self._worker: Worker | None = None
        self._recorded: dict[str, Any] = {}
        self._scratch: Path | None = None

    def find_files(self, words: Sequence[str]) -> None:
        """The parameter file is also that of the commands."""
        if '--params-file' in words:
            self._config_file = words[words.index('--params-file') + 1]

    def setup(self) -> None:
        output = self.settings(TeachNodeConfig).output
        if not output:
            raise ConfigError("parameter 'output' is empty: name the model to write, GARDEN.npz")
        self._model = Path(output).expanduser()
        # Beside the model, so that the next start finds what a kill left.
        self._folder = self._model.with_name(f'{self._model.stem}_teach')
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f'{self._folder}: cannot be written: {error.strerror}') from None
        self._is_training = False
        self._scratch = self._folder
        self._judgment = self._folder / 'judgment.json'
        self._finished = self._folder / 'finished'
        self._findings: dict[str, Any] = {}
        self._next_look_s = 0.0
        self._problem = ''
        self._said = ''
        self._topics: dict[str, str] = {}
        self._date_before_now()
        drives = self._untaught()
        if drives and self._finished.exists():
            self._read_topics(drives[-1])
            self.get_logger().info(self._train())
        elif drives or not self._model.exists():
            self._start(next(reversed(self._drives()), self._drive(1)))
        latched = latched_qos()
        self._state = self.publisher(String, 'teach/state', latched)
        self._map = self.publisher(OccupancyGrid, 'teach/map', latched)
        self._hints = self.publisher(MarkerArray, 'teach/hints', latched)
        self._offer_services()
        self.every(1.0, self._step)

    def _offer_services(self) -> None:
        """Make services, and clients of the nodes early: to be found takes them a moment."""
        self.service(Trigger, '~/finish', self._finish)
        self.service(Trigger, '~/cancel', self._cancel)
        self.service(Trigger, '~/extend', self._extend)
        self._reload = self.client(Trigger, 'sfa_node/reload_model')
        names = NODES if self.settings(TeachNodeConfig).localize else ()
        self._chain = [self.client(ChangeState, f'{name}/change_state') for name in names]
        self._waiting = list(self._chain) if self._model.exists() else []
        self._is_new = bool(self._waiting)

    def teardown(self) -> None:
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
        self._end_recording()
        if self._scratch and not self._is_training:  # with which the next start goes on
            shutil.rmtree(self._scratch, ignore_errors=True)

    def health(self) -> tuple[int, str, dict[str, str]]:
        counts = {} if self._recorder is None else self._recorder.counts
        is_well = self._findings and not self._troubles()
        level = ERROR if self._problem else OK if is_well else WARN
        return level, self._said, {topic: str(count) for topic, count in counts.items()}

    # Recording.

    def _drive(self, number: int) -> Path:
        """The folder of a drive, beside the model."""
        return self._model.with_name(f'{self._model.stem}_drive{number}')

    def _drives(self) -> list[Path]:
        """The folders that hold messages, in the order of their numbers."""
        name = re.compile(re.escape(f'{self._model.stem}_drive') + '([0-9]+)')
        matches = [name.fullmatch(path.name) for path in self._model.parent.glob('*')]
        numbers = sorted(int(match[1]) for match in matches if match)
        return [folder for folder in map(self._drive, numbers) if files_with_messages(folder)]

    def _next_drive(self) -> Path:
        last = next(reversed(self._drives()), None)
        return self._drive(1 + int(last.name.rpartition('_drive')[2]) if last else 1)

    def _untaught(self) -> list[Path]:
        """The drives that were recorded after the model was written."""
        written_ns = _changed_ns(self._model) if self._model.exists() else 0
        return [
            folder
            for folder in self._drives()
            if _changed_ns(files_with_messages(folder)[-1]) > written_ns
        ]

    def _date_before_now(self) -> None:
        """Date files of the future before now, in their order: this clock was set back."""
        files = [files_with_messages(folder)[-1] for folder in self._drives()]
        files += [self._model] if self._model.exists() else []
        now_ns = time.time_ns()
        ahead = sorted((file for file in files if _changed_ns(file) > now_ns), key=_changed_ns)
        for number, file in enumerate(ahead):
            at_ns = now_ns - (len(ahead) - number) * 1_000_000
            os.utime(file, ns=(at_ns, at_ns))

    def _start(self, folder: Path) -> None:
        """Record into a folder."""
        self._findings = {}
        self._problem = ''
        self._is_set_back = False
        self._read_topics(folder)
        self._recorder = BagRecorder(folder)
        self.get_logger().info(f'recording into {folder}')

    def _read_topics(self, folder: Path) -> None:
        """Take the topics of a drive that was begun earlier."""
        with suppress(BagError), Bag(folder) as bag:  # of a new drive there is nothing to read
            self._topics = {without_transport(topic): topic for topic in bag.topics}

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
        named, types = self._wanted()
        bases = {without_transport(topic) for topic in self._recorded}
        topics = sorted(self.get_topic_names_and_types(), reverse=True)
        # A drive goes on in the transport of its beginning.
        for topic, kinds in sorted(topics, key=lambda each: each[0] not in self._topics.values()):
            wanted = types | ({STATIC_TF} if topic.endswith('/tf_static') else set())
            base = without_transport(topic)
            chosen = base in named or (wanted & {*kinds} and not is_ours(self, topic))
            if chosen and base not in bases and not topic.endswith(DEPTH):
                bases.add(base)
                self._record(topic, kinds[0])

    def _wanted(self) -> tuple[set[str], set[str]]:
        """The topics that parameters name, and the types of the inputs that they do not name."""
        given = self.settings(TopicNames)
        names = given.image, given.odometry, given.imu, given.points_topic
        types = {*TRANSPORTS.values()} if not given.image else set()
        types |= {ODOMETRY} if not given.odometry else set()
        types |= {IMU} if not given.imu else set()
        return {*map(self._full, names)}, types

    def _full(self, name: str) -> str:
        """The full name of a topic of a parameter, without its transport; '' of none."""
        return without_transport(self.resolve_topic_name(name)) if name else ''

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
        self._topics[without_transport(topic)] = topic
        self._recorded[topic] = self.subscribe(message_class, topic, write, qos, raw=True)

    def _write(self, topic: str, kind: str, data: bytes) -> None:
        if self._recorder is None or self._is_set_back:
            return
        if self.count_publishers(topic) > 1 and not topic.endswith('/tf_static'):
            return  # messages along two paths would spoil the whole drive
        now_ns = self.get_clock().now().nanoseconds
        if 0 < now_ns < self._recorder.end_ns - CLOCK_JUMP_NS:
            self._is_set_back = True
            return
        try:
            self._recorder.write(topic, kind, data, now_ns)
        except BagError as error:
            self._fail(error)

    def _fail(self, error: BagError) -> None:
        """Stop recording; what is recorded stays."""
        self._problem = f'{error}: the recording ended; make room, then call ~/finish or ~/extend'
        self._recorder = None

    def _begin_anew(self) -> None:
        """Record a drive of its own: what was recorded is later than now."""
        self._end_recording()
        drive = self._next_drive()
        self._start(drive)
        self._problem = f'the clock was set back: {drive} is a drive of its own'

    # Looking, and training.

    def _step(self) -> None:
        """Once a second: record new topics, look at the drive, say how far all is."""
        if self._recorder is not None:
            if self._is_set_back:
                self._begin_anew()
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
        if self._is_new:
            self._hand_over()
        self._say()

    def _commands(self, command: str, *words: str | Path) -> list[str | Path]:
        """A command with the topics and the parameter file of this node."""
        topics = self.settings(TopicNames)
        given = [
            (KINDS[name].flag, self._topics.get(self._full(getattr(topics, name)), ''))
            for name in ('image', 'odometry', 'imu')
            if self._full(getattr(topics, name)) in self._topics
        ]
        if self._config_file:
            given.append(('--config', self._config_file))
        return [command, *words, *(word for pair in given for word in pair)]

    def _look(self) -> None:
        """Inspect what is recorded, as often as the share of a core allows."""
        if steady_s() < self._next_look_s or not self._recorder or not self._recorder.counts:
            return
        report = self._folder / 'report.json'
        report.unlink(missing_ok=True)
        self._worker = Worker(self._commands('inspect', self._recorder.folder, '--json', report))

    def _looked(self, worker: Worker) -> None:
        """Publish what `inspect` found."""
        share = self.settings(TeachNodeConfig).share
        self._next_look_s = steady_s() + worker.elapsed_s * (1 / share - 1)
        report = self._folder / 'report.json'
        if self._recorder is None:
            return
        if not report.exists():
            self._problem = self._words(worker.failure())
            return
        self._problem = ''
        (self._findings,) = json.loads(report.read_text())['bags']
        places = [np.array(drive) for drive in self._findings['drives'] if drive]
        if places:
            self._show(places)

    def _show(self, places: list[Array]) -> None:
        """Publish the places (M, 3) of images of each part of the drive, and the ground covered."""
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
        lacks = filter(None, [error, *self._findings.get('lacks', [])])
        return self._words(next(lacks, _ENOUGH))

    @staticmethod
    def _words(sentence: str) -> str:
        """A sentence of a command, with the names of parameters in place of options."""
        for flag, parameter in _FLAGS.items():
            sentence = sentence.replace(flag, parameter)
        return sentence.removeprefix('error: ')

    def _troubles(self) -> list[str]:
        """Which inputs have stopped, and which have several publishers."""
        limit_s = self.settings(TeachNodeConfig).silence_timeout
        sensors = [topic for topic in self._recorded if not topic.endswith('/tf_static')]
        silent = [t for t in sensors if limit_s < self.monitors[t].silent_for_s() < math.inf]
        names = {
            topic: sorted(info.node_name for info in self.get_publishers_info_by_topic(topic))
            for topic in sensors
        }
        return [f'nothing comes from {", ".join(sorted(silent))}'] * bool(silent) + [
            f'{" and ".join(nodes)} publish on {topic}, which is not recorded: end all but one'
            for topic, nodes in names.items()
            if len(nodes) > 1
        ]

    def _say(self) -> None:
        """Publish one sentence when it is new."""
        if self._is_training and self._worker is not None:
            said = f'training: {self._words(self._worker.last_line()) or "starting"}'
        elif self._problem:
            said = self._problem
        elif self._recorder is None:
            said = self._said or f'{self._model} is there: call ~/extend to drive more'
        elif not self._recorder.counts:
            drive = self._recorder.folder
            said = 'waiting for images and odometry'
            if drive in self._drives():
                said += f' to go on with {drive}; ~/finish trains on it'
        else:
            recording = f'recording {", ".join(self._recorder.counts)}'
            is_driven = any(self._findings.get('drives', []))
            driven = self._findings['facts']['drive'] if is_driven else ''
            judged = [driven, self._verdict()] if self._findings else [recording]
            troubles = self._troubles()
            for trouble in troubles:
                if trouble not in self._said:
                    self.get_logger().warning(trouble)
            said = '; '.join(filter(None, [*troubles, *judged]))
        self._publish(said)

    def _publish(self, said: str) -> None:
        """Publish a sentence if it is new, and log it if it is a problem."""
        if said != self._said:
            self._said = said
            self._state.publish(String(data=said))
            if said == self._problem:
                self.get_logger().error(said)

    def _finish(self, _: Any) -> str:
        if self._is_training:
            raise LocalizationError('training already, see teach/state')
        recording = self._recorder is not None
        if not (self._untaught() or (self._recorder and self._recorder.counts)):
            advice = '' if recording else ': call ~/extend to drive more'
            raise LocalizationError(f'nothing was recorded yet{advice}')
        if self._worker is not None:
            self._worker.stop()
        self._end_recording()
        return self._train()

    def _train(self) -> str:
        """Train on new drives. If this node ends meanwhile, the next start goes on with it."""
        with suppress(OSError):  # the disk is full
            self._finished.touch()
        drives = self._untaught()
        way: list[str | Path] = ['--update', self._model] if self._model.exists() else ['--resume']
        self._is_training = True
        self._problem = ''
        outputs = '--output', self._model, '--json', self._judgment
        self._worker = Worker([*self._commands('train'), *drives, *outputs, *way])
        return f'training on {", ".join(map(str, drives))}; see teach/state'

    def _cancel(self, _: Any) -> str:
        if self._recorder is None and self._worker is None:
            raise LocalizationError('nothing is being recorded or trained')
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
        self._is_training = False
        self._finished.unlink(missing_ok=True)
        self._problem = ''
        self._end_recording()
        kept = ', '.join(map(str, self._untaught()))
        self._publish(f'canceled; {kept}: kept for ~/finish' if kept else 'canceled')
        return self._said

    def _extend(self, _: Any) -> str:
        if self._recorder is not None or self._is_training:
            raise LocalizationError('the last drive is not finished: call ~/finish or ~/cancel')
        drive = self._next_drive()
        self._start(drive)
        return f'recording into {drive}'

    def _trained(self, worker: Worker) -> None:
        """Say how the training ended; the nodes get the model as soon as they are there."""
        self._is_training = False
        self._finished.unlink(missing_ok=True)
        if worker.code:
            why = self._words(worker.failure())
            kept = ', '.join(map(str, self._untaught()))
            self._problem = f'training failed: {why}; {kept}: kept for ~/finish, or remove it'
            return
        judgment = json.loads(self._judgment.read_text())
        self._publish(f'{self._model} is written. {judgment["sentence"]}')
        self.get_logger().info(self._said)
        self._waiting = list(self._chain)
        self._is_new = True

    def _hand_over(self) -> None:
        """Let nodes that run reload the model; activate those that wait for it as they come."""
        if self._reload.service_is_ready() and len(self._waiting) == len(self._chain):
            self._reload.call_async(Trigger.Request())
            self._is_new = False
            return
        for client in [client for client in self._waiting if client.service_is_ready()]:
            self._activate(client)
            self._waiting.remove(client)
            self._is_new = bool(self._waiting)

    def _activate(self, client: Any) -> None:
        """Configure a node, and activate it then."""
        activate = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
        configure = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
        done = client.call_async(configure)
        done.add_done_callback(lambda _: client.call_async(activate))
