# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Base of the nodes: a lifecycle node that starts itself, guards callbacks, reports its health.

A node built on it names its Settings classes, makes its publishers and subscriptions in `setup`,
releases what else it holds in `teardown`, and reports its state in `health`.
"""

from __future__ import annotations

import signal
import traceback
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar, cast

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions, install_signal_handlers
from std_msgs.msg import Header

from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.rejections import short_line
from sfa_localization.data.settings import Settings
from sfa_localization.data.threads import one_core
from sfa_localization.nodes import parameters
from sfa_localization.nodes.discovery import PATIENCE_S
from sfa_localization.nodes.monitor import Monitor, steady_s
from sfa_localization.nodes.process import CANNOT_START, DIED, SIGNALS
from sfa_localization.nodes.settings import NodeConfig

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # the pip wheels of ROS have none
    TFMessage = None

_PACKAGE = 'sfa_localization'
DIAGNOSTICS_PERIOD_S = 1.0
"""Time between messages on /diagnostics: diagnostic_aggregator expects about one a second."""
SHARED = '/tf', '/diagnostics'
"""Topics on which many nodes publish."""
TWIN_S = 30.0
"""Longer than DDS takes to forget a node that was killed."""
_WAKE_PERIOD_S = 0.5  # a signal just before the executor waits does not always wake it
S = TypeVar('S', bound=Settings)
OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
_SUCCESS = TransitionCallbackReturn.SUCCESS
_FAILURE = TransitionCallbackReturn.FAILURE


def sensor_qos(depth: int = 5) -> QoSProfile:
    """Best effort, as REP-2003 asks of subscribers to sensors."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def latched_qos() -> QoSProfile:
    """Late subscribers receive the last message."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def static_qos() -> QoSProfile:
    """Of /tf_static: each driver publishes once, and keeps its transforms for late subscribers."""
    return QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class LocalizationNode(LifecycleNode):  # type: ignore[misc]
    """Lifecycle node with settings as parameters; `start` configures and activates it.

    The constructor raises ConfigError for a wrong parameter.
    """

    def __init__(self, name: str, kinds: Sequence[type[Settings]], **options: Any) -> None:
        super().__init__(name, **options)
        self.active = False
        self.failure = ''
        self.monitors: defaultdict[str, Monitor] = defaultdict(Monitor)
        self._full_names: dict[str, str] = {}
        self._entities: dict[Any, Callable[[Any], Any]] = {}
        self._outputs: list[Any] = []
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._alone_s = steady_s()
        self.twin = ''
        """Which other node publishes what this one does, in words."""
        self._settings = parameters.declare(self, [NodeConfig, *kinds])
        parameters.on_change(self, self._settings, self.check, self.settings_changed)

    # A node overrides these methods.

    def setup(self) -> None:
        """Make publishers and subscriptions. Raises LocalizationError where it cannot."""

    def started(self) -> None:
        """Called once the publishers are enabled."""

    def teardown(self) -> None:
        """Release what is neither publisher, subscription, service nor timer; also at the end."""

    def check(self, settings: parameters.Current) -> None:
        """Judge changed parameters. Raises LocalizationError where they cannot be used."""

    def settings_changed(self, settings: Settings) -> None:
        """Use changed parameters, which are checked already."""

    def health(self) -> tuple[int, str, dict[str, str]]:
        """Diagnostic level, one line, and further values."""
        return OK, 'running', {}

    def find_files(self, words: Sequence[str]) -> None:
        """Find files that the parameter file names, by the words of the command line."""
        for kind in parameters.resolve_beside_file(self, self._settings, words):
            self.settings_changed(self._settings[kind])

    # A node uses these methods.

    def settings(self, kind: type[S]) -> S:
        """The values in force."""
        return cast(S, self._settings[kind])

    def diagnostic(
        self, part: str, level: Any, text: str, values: dict[str, str], stamp: Any
    ) -> DiagnosticArray:
        """One status about a part of the node, with the node's name and namespace."""
        name = f'{self.get_fully_qualified_name().lstrip("/")}: {part}'
        status = DiagnosticStatus(level=level, name=name, message=text, hardware_id=_PACKAGE)
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        return DiagnosticArray(header=Header(stamp=stamp), status=[status])

    def publisher(self, kind: Any, topic: str, qos: QoSProfile | int = 10) -> Any:
        """A publisher that is silent until activation. A number is the depth of a reliable one."""
        overrides = QoSOverridingOptions.with_default_policies()
        publisher = self.create_lifecycle_publisher(
            kind, topic, qos, qos_overriding_options=overrides
        )
        self._entities[publisher] = self.destroy_lifecycle_publisher
        self._outputs += [] if topic in SHARED else [publisher]
        return publisher

    def subscribe(
        self,
        kind: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        substitute: str = '',
        entity: str | None = None,
        raw: bool = False,
    ) -> Any:
        """A subscription that counts messages, and those which `callback` rejects, under `topic`.

        An inactive node drops messages, except latched ones, which come only once. The topic
        `substitute`, if given, is subscribed to in place of `topic`. Subscriptions of another
        `entity` have their own qos_overrides. A `raw` one hands over messages as bytes.
        """
        latched = qos.durability is DurabilityPolicy.TRANSIENT_LOCAL
        self.require_input(topic, substitute)

        def receive(message: Any, info: dict[str, int]) -> None:
            if self.active or latched:
                self.take(topic, callback, message, info['received_timestamp'])

        subscription = self.create_subscription(
            kind,
            substitute or topic,
            cast(Any, receive),
            qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(entity_id=entity),
            raw=raw,
        )
        self._entities[subscription] = self.destroy_subscription
        return subscription

    def unsubscribe(self, subscription: Any) -> None:
        """End a subscription, unless it is None."""
        if subscription is not None:
            self._entities.pop(subscription)(subscription)

    def take(
        self, topic: str, callback: Callable[[Any], None], message: Any, received_ns: int = 0
    ) -> None:
        """Call with a message; count it, and whether it was used, under `topic`."""
        monitor = self.monitors[topic]
        monitor.receive(received_ns)
        if self.attempt(topic, callback, message):
            monitor.use()

    def full_name(self, topic: str) -> str:
        """The full name of an input after remapping; of another name, the name itself."""
        return self._full_names.get(topic, topic)

    def require_input(self, topic: str, substitute: str = '') -> None:
        """Note an input's full name. Raises ConfigError for a topic that this node publishes."""
        resolved = self._full_names[topic] = self.resolve_topic_name(substitute or topic)
        if any(publisher.topic_name == resolved for publisher in self.publishers):
            raise ConfigError(
                f'input {topic} is {resolved}, which this node itself publishes: remap one of both'
            )

    def following(self, topic: str) -> str:
        """The topic BASE/TRANSPORT, where BASE may be remapped, as image_transport names it.

        A remap of the whole name comes first.
        """
        base, _, transport = topic.rpartition('/')
        if self.is_remapped(topic) or not self.is_remapped(base):
            return topic
        return f'{self.resolve_topic_name(base)}/{transport}'

    def is_remapped(self, topic: str) -> bool:
        return self.resolve_topic_name(topic) != self.resolve_topic_name(topic, only_expand=True)

    def service(self, kind: Any, name: str, callback: Callable[[Any], str | None]) -> None:
        """A service with the fields success and message: what `callback` returns, or why it failed.
        Without a message, as where an answer has no fields, it is empty.
        """

        def answer(request: Any, response: Any) -> Any:
            try:
                message = callback(request)
                if message is not None:
                    response.success = True
                    response.message = message
            except LocalizationError as error:
                response.message = str(error)
            except Exception as error:
                self.defect(name, error)
            return response

        service = self.create_service(kind, name, answer)
        self._entities[service] = self.destroy_service

    def client(self, kind: Any, name: str) -> Any:
        """A client of a service, one for each name."""
        full_name = self.resolve_service_name(name)
        for client in self.clients:
            if client.srv_name == full_name:
                return client
        client = self.create_client(kind, name)
        self._entities[client] = self.destroy_client
        return client

    def order(self, kind: Any, name: str, callback: Callable[[Any], None]) -> None:
        """A service with an empty answer: a request is counted, and rejected, as a message is."""

        def take(request: Any) -> None:
            if self.active:
                self.take(name, callback, request)
            else:
                self.refuse(name, 'this node is not active')

        self.service(kind, name, take)

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call at a steady period: simulated time may stop, and wall time may step back."""
        name = f'timer {callback.__name__.strip("_")}'
        call = partial(self.attempt, name, callback)
        timer = self.create_timer(period_s, call, clock=self._steady)
        self._entities[timer] = self.destroy_timer

    def attempt(self, name: str, callback: Callable[..., None], *arguments: Any) -> bool:
        """Call; count and log an exception under `name`. Return whether there was none."""
        try:
            callback(*arguments)
        except LocalizationError as error:
            self.refuse(name, str(error))
        except Exception as error:
            self.defect(name, error)  # a node must outlive any message
        else:
            return True
        return False

    def refuse(self, topic: str, reason: str) -> int:
        """Count a rejection; log the first of a reason and each thousandth; return the count."""
        count = self.monitors[topic].refused.add(reason)
        if count == 1 or count % 1000 == 0:
            where = self.full_name(topic)
            self.get_logger().warning(f'{where}: {short_line(reason)} ({count} so far)')
        return count

    def defect(self, name: str, error: Exception) -> None:
        """Count an error in the program itself; log its traceback the first time.

        After a signal publishing fails, which is no defect.
        """
        if self.context.ok() and self.refuse(name, f'internal error: {type(error).__name__}') == 1:
            self.get_logger().error(traceback.format_exc())

    # Life cycle.

    def start(self) -> bool:
        """Configure and activate, if `autostart` is set; False if that failed."""
        if not self.settings(NodeConfig).autostart:
            return True
        return bool(self.trigger_configure() == _SUCCESS and self.trigger_activate() == _SUCCESS)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._configured_s = steady_s()
            self._diagnostics = self.publisher(DiagnosticArray, '/diagnostics')
            self.every(DIAGNOSTICS_PERIOD_S, self._publish_health)
            self.setup()
        except Exception as error:
            self.failure = _reason(error)
            if self.context.ok():  # else a signal is the cause
                self.get_logger().error(f'cannot start: {self.failure}')
            self._release()
            return _FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = super().on_activate(state)
        self.active = result == _SUCCESS
        if self.active:
            self.attempt('start', self.started)
            self.get_logger().info('active')
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._release()
        return super().on_cleanup(state)

    on_shutdown = on_error = on_cleanup

    def _release(self) -> None:
        self.active = False
        self.attempt('cleanup', self.teardown)
        for entity, destroy in reversed(self._entities.items()):
            destroy(entity)
        for held in (self._entities, self._outputs, self.monitors, self._full_names):
            held.clear()

    def _find_twin(self) -> None:
        """Note who else publishes on the outputs: a forgotten launch, or a bag that holds them."""
        now_s = steady_s()
        name = self.get_fully_qualified_name()
        others = []
        for output in self._outputs:
            infos = self.get_publishers_info_by_topic(output.topic_name)
            names = [f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in infos]
            if name in names:
                names.remove(name)
            others += [(other, output.topic_name) for other in names]
        self._alone_s = self._alone_s if others else now_s
        self.twin = ''
        if now_s > self._alone_s + TWIN_S:
            other, topic = others[0]
            this = 'another node of this name' if other == name else other
            self.twin = f'{this} publishes on {topic} too: end one of both'
            self.get_logger().warning(self.twin, once=True)

    def _publish_health(self) -> None:
        if not self.active:
            return
        self._find_twin()
        level, text, values = self.health()
        if self.twin:
            level = max(level, DiagnosticStatus.WARN)
            text = f'{self.twin}; {text}'
        stamp = self.get_clock().now()
        is_simulated = self.get_parameter('use_sim_time').value
        patient = steady_s() < self._configured_s + PATIENCE_S
        if is_simulated and not stamp.nanoseconds and not patient:
            problem = 'use_sim_time is true, but there is no time on /clock: play bags with --clock'
            self.refuse('/clock', problem)
            level = max(level, WARN)
            text = f'{problem}; {text}'
        for topic, monitor in self.monitors.items():
            values.update(monitor.values(f'{self.full_name(topic)}: '))
        message = self.diagnostic('status', level, text, values, stamp.to_msg())
        self._diagnostics.publish(message)


def run_nodes(make: Callable[[], Sequence[LocalizationNode]], words: list[str]) -> int:
    """Run nodes until SIGINT or SIGTERM; return the exit code of their process.

    The process must end afterwards, because it ignores signals then.
    """
    nodes: Sequence[LocalizationNode] = ()
    try:
        _initialize(words)
        executor = SingleThreadedExecutor()  # after a signal it cannot be made
        nodes = make()
        for node in nodes:
            parameters.warn_of_arguments(node, words)
            node.find_files(words)
        for node in nodes:
            if not node.start():
                return CANNOT_START if rclpy.ok() else 0
            executor.add_node(node)
        with one_core():
            _spin(executor, nodes[0])
    except Exception as error:
        if rclpy.ok() or isinstance(error, LocalizationError):  # else a signal is the cause
            rclpy.logging.get_logger(_PACKAGE).fatal(_reason(error))
            return DIED if any(node.active for node in nodes) else CANNOT_START
    finally:
        for node in nodes:
            node.attempt('cleanup', node.teardown)
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _initialize(words: list[str]) -> None:
    """Initialize ROS and its signal handlers. Raises ConfigError for arguments it cannot use."""
    try:
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # some of rclpy's texts are a list of arguments
        raise ConfigError(f'ROS cannot use its arguments: {error}') from None
    # rclpy's handlers call those before them, and restore them when ROS ends.
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    install_signal_handlers(SignalHandlerOptions.ALL)
    others = ' '.join(rclpy.utilities.remove_ros_args(words)[1:])
    if others:
        raise ConfigError(
            f'unknown arguments {others}: give parameters as --ros-args -p NAME:=VALUE, and topics '
            'as --ros-args -r NAME:=TOPIC'
        )


def _reason(error: Exception) -> str:
    """The message of an expected error; the traceback of an error in the program."""
    if isinstance(error, LocalizationError):
        return str(error)
    if isinstance(error, (ParameterException, RuntimeError)):
        return f'{error}: correct this parameter of ROS, or the qos_overrides of the topic'
    return traceback.format_exc()


def _spin(executor: SingleThreadedExecutor, node: LocalizationNode) -> None:
    """Spin until a signal.

    rclpy raises RuntimeError for a transition that does not fit, ValueError for a negative clock.
    """
    while rclpy.ok():
        try:
            executor.spin_once(_WAKE_PERIOD_S)
        except (RuntimeError, ValueError) as error:
            if rclpy.ok():
                node.refuse('rclpy', str(error))
