# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Base of the nodes: a lifecycle node that starts itself, guards callbacks, reports its health.

A node written on it declares its Settings classes, makes its publishers and subscriptions in
`setup`, drops what else it holds in `teardown`, and reports its state in `health`.
"""

from __future__ import annotations

import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar, cast

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import EventHandler
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from std_msgs.msg import Header

from sfa_localization.data.errors import ConfigError, LocalizationError
from sfa_localization.data.rejections import short_line
from sfa_localization.data.settings import Settings
from sfa_localization.data.threads import one_core
from sfa_localization.nodes import entry, parameters
from sfa_localization.nodes.discovery import PATIENCE_S
from sfa_localization.nodes.monitor import Monitor, steady_s
from sfa_localization.nodes.settings import NodeConfig

_PACKAGE = 'sfa_localization'
DIAGNOSTICS_PERIOD_S = 1.0
"""Time between messages on /diagnostics: diagnostic_aggregator expects about one a second."""
_AWAKE_S = 0.5  # between looks whether a signal, or an event of QoS, has come
S = TypeVar('S', bound=Settings)
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


def sensor_qos(depth: int = 5) -> QoSProfile:
    """Best effort, as REP-2003 asks of those who listen to sensors."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def latched_qos() -> QoSProfile:
    """The last message reaches those who come later."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class LocalizationNode(LifecycleNode):  # type: ignore[misc]
    """Lifecycle node with settings as parameters; `start` configures and activates it.

    Raises ConfigError from the constructor for a parameter that is rejected.
    """

    def __init__(self, name: str, kinds: Sequence[type[Settings]], **options: Any) -> None:
        super().__init__(name, **options)
        # What rclpy itself makes: services of parameters and of the life cycle, and /clock.
        for made in self.services:
            made.callback = self._guarded(made.srv_name.rpartition('/')[2], made.callback)
        for heard in self.subscriptions:
            heard.callback = self._guarded(heard.topic_name, heard.callback)
        self.active = False
        self.failure = ''
        self.monitors: defaultdict[str, Monitor] = defaultdict(Monitor)
        self._resolved: dict[str, str] = {}
        self._entities: list[tuple[Callable[[Any], Any], Any]] = []
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        everything: list[type[Settings]] = [NodeConfig, *kinds]
        self._settings = {kind: parameters.declare(self, kind) for kind in everything}
        parameters.on_change(self, self._settings, self.check, self.settings_changed)
        parameters.warn_of_unknown(self)

    # What a node fills in.

    def setup(self) -> None:
        """Make publishers and subscriptions; a LocalizationError gives the reason why not."""

    def started(self) -> None:
        """Called once the publishers are enabled."""

    def teardown(self) -> None:
        """Release what `setup` made beyond publishers, subscriptions, services and timers."""

    def check(self, settings: parameters.Current) -> None:
        """Before live parameters change; a LocalizationError gives the reason why they cannot."""

    def settings_changed(self, settings: Settings) -> None:
        """Live parameters have changed to `settings`, which are checked already."""

    def health(self) -> tuple[int, str, dict[str, str]]:
        """Diagnostic level, one line, and further values."""
        return DiagnosticStatus.OK, 'running', {}

    # What a node uses.

    def settings(self, kind: type[S]) -> S:
        """The values in force."""
        return cast(S, self._settings[kind])

    def monitor(self, name: str) -> Monitor:
        """The counts of one input, made at its first use."""
        return self.monitors[name]

    def diagnostic(
        self, part: str, level: Any, text: str, values: dict[str, str], stamp: Any
    ) -> DiagnosticArray:
        """One status, with the node's name and namespace, about a part of it."""
        name = f'{self.get_fully_qualified_name().lstrip("/")}: {part}'
        status = DiagnosticStatus(level=level, name=name, message=text, hardware_id=_PACKAGE)
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        return DiagnosticArray(header=Header(stamp=stamp), status=[status])

    def publisher(self, kind: Any, topic: str, qos: QoSProfile | int = 10) -> Any:
        """A publisher that is silent until activation; its QoS can be overridden by parameters.

        A number is the depth of a reliable one.
        """
        made = self.create_lifecycle_publisher(
            kind, topic, qos, qos_overriding_options=QoSOverridingOptions.with_default_policies()
        )
        self._entities.append((self.destroy_lifecycle_publisher, made))
        return made

    def tell(self, publisher: Any, make: Callable[..., Any], *given: Any) -> None:
        """Publish what `make` fills, which is not made where nobody listens; no latched message."""
        if publisher.get_subscription_count():
            publisher.publish(make(*given))

    def subscribe(
        self,
        kind: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        instead: str = '',
    ) -> None:
        """A subscription whose rejected messages are counted under `topic` and end nothing.

        An inactive node drops messages; not those that come but once, latched. Messages of the
        topic `instead`, where it is given, are taken as those of `topic`.
        """
        latched = qos.durability is DurabilityPolicy.TRANSIENT_LOCAL
        self.require_input(topic, instead)
        receive, monitor = self.receiver(topic, callback, latched), self.monitor(topic)

        def take(message: Any, info: dict[str, int]) -> None:
            came_ns = info['received_timestamp']  # 0 where the middleware has none
            monitor.waited_s = max(time.time_ns() - came_ns, 0) * 1e-9 if came_ns > 0 else 0.0
            receive(message)

        made = self.create_subscription(
            kind,
            instead or topic,
            cast(Any, take),
            qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._entities.append((self.destroy_subscription, made))

    def unsubscribe(self, topic: str) -> None:
        """Drop the subscriptions of an input, if there are any."""
        resolved = self.shown(topic)
        for destroy, made in [*self._entities]:
            if isinstance(made, Subscription) and made.topic_name == resolved:
                self._entities.remove((destroy, made))
                self.destroy_subscription(made)

    def receiver(
        self, topic: str, callback: Callable[[Any], None], while_inactive: bool = False
    ) -> Callable[[Any], None]:
        """A callback that counts its messages, and their latency, under `topic`."""
        monitor = self.monitor(topic)

        def receive(message: Any) -> None:
            if self.active or while_inactive:
                received_s = monitor.receive()
                if self.attempt(topic, callback, message):
                    monitor.use(received_s)

        return receive

    def shown(self, topic: str) -> str:
        """An input by its full name, after remapping; what is no topic, as it is."""
        return self._resolved.get(topic, topic)

    def require_input(self, topic: str, instead: str = '') -> None:
        """Take a topic as an input. Raises ConfigError where this node itself publishes on it."""
        resolved = self._resolved[topic] = self.resolve_topic_name(instead or topic)
        if any(made.topic_name == resolved for made in self.publishers):
            raise ConfigError(
                f'input {topic} is {resolved}, which this node itself publishes: remap one of both'
            )

    def following(self, topic: str) -> str:
        """The topic BASE/TRANSPORT, below whatever its base is remapped to.

        So image_transport does; a remap of the whole name comes first.
        """
        base, _, transport = topic.rpartition('/')
        resolved = self.resolve_topic_name(base)
        own = self.resolve_topic_name(topic) != self.resolve_topic_name(topic, only_expand=True)
        if own or resolved == self.resolve_topic_name(base, only_expand=True):
            return topic
        return f'{resolved}/{transport}'

    def service(self, kind: Any, name: str, callback: Callable[[Any, Any], Any]) -> None:
        """A service of success and message; a LocalizationError gives the reason why not."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except LocalizationError as error:
                response.message = str(error)
            return response

        made = self.create_service(kind, name, self._guarded(name, answer))
        self._entities.append((self.destroy_service, made))

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call at a steady period: simulated time may stop, and wall time may step back."""
        name = f'timer {callback.__name__.strip("_")}'
        call = partial(self.attempt, name, callback)
        made = self.create_timer(period_s, call, clock=self._steady)
        self._entities.append((self.destroy_timer, made))

    def attempt(self, name: str, callback: Callable[..., None], *given: Any) -> bool:
        """Call; what it raises is counted and logged under `name`. True where it raised nothing."""
        try:
            callback(*given)
        except LocalizationError as error:
            self.refuse(name, str(error))
        except Exception as error:
            self.defect(name, error)  # a node must outlive any message
        else:
            return True
        return False

    def refuse(self, topic: str, reason: str) -> int:
        """Count a rejected message; log the first of a reason, then each thousandth.

        Returns how many of this reason there have been.
        """
        count = self.monitor(topic).refused.add(reason)
        if count == 1 or count % 1000 == 0:
            self.get_logger().warning(f'{self.shown(topic)}: {short_line(reason)} ({count} so far)')
        return count

    def defect(self, name: str, error: Exception) -> None:
        """Count an error in the program itself, and log where it came from.

        After a signal nothing can be published any more, and that is no defect.
        """
        if self.context.ok() and self.refuse(name, f'internal error: {type(error).__name__}') == 1:
            self.get_logger().error(traceback.format_exc())

    def _guarded(self, name: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """A callback that counts what it raises: a clock may be negative, a transition may not fit.

        The answer of a service is empty then.
        """

        def call(*given: Any) -> Any:
            try:
                return callback(*given)
            except Exception as error:
                if self.context.ok():
                    self.refuse(name, f'{type(error).__name__}: {error}')
                return given[-1]

        return call

    # Life cycle.

    def start(self) -> bool:
        """Configure and activate, where `autostart` asks for it; False when that failed."""
        if not self.settings(NodeConfig).autostart:
            return True
        return bool(self.trigger_configure() == _SUCCESS and self.trigger_activate() == _SUCCESS)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._configured_s = steady_s()
            self._diagnostics = self.publisher(DiagnosticArray, '/diagnostics')
            self.every(DIAGNOSTICS_PERIOD_S, self._publish_health)
            self.setup()
        except LocalizationError as error:
            self.failure = str(error)
            self.get_logger().error(f'cannot start: {error}')
            self._drop()
            return _FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = super().on_activate(state)
        self.active = result == _SUCCESS
        if self.active:
            self.started()
            self.get_logger().info('active')
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._drop()
        return super().on_cleanup(state)

    on_shutdown = on_error = on_cleanup

    def destroy_node(self) -> None:
        """End the node, and leave ROS at once.

        rclpy's state machine would keep the node until the garbage collection; where that comes
        while others start, the middleware may wait for itself.
        """
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def _drop(self) -> None:
        self.active = False
        self.teardown()
        for destroy, entity in reversed(self._entities):
            destroy(entity)
        self._entities.clear()
        self.monitors.clear()
        self._resolved.clear()

    def _publish_health(self) -> None:
        if not self.active:
            return
        level, text, values = self.health()
        problem = self._time_problem()
        if problem:
            self.refuse('/clock', problem)
            level, text = max(level, DiagnosticStatus.WARN), f'{problem}; {text}'
        for topic, monitor in self.monitors.items():
            values.update(monitor.values(f'{self.shown(topic)}: '))
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(self.diagnostic('status', level, text, values, now))

    def _time_problem(self) -> str:
        """What is wrong where simulated time is asked for, and does not come."""
        simulated = self.get_parameter('use_sim_time').value
        waiting = steady_s() < self._configured_s + PATIENCE_S
        if waiting or not simulated or self.get_clock().now().nanoseconds:
            return ''
        return 'use_sim_time is true, but there is no time on /clock: play bags with --clock'


class Executor(SingleThreadedExecutor):  # type: ignore[misc]
    """rclpy's, which asks all entities of a node twice for each callback, spared most of that.

    Events of QoS, more than all else, may wait until the node is awake; and after a callback, which
    wakes the executor itself, there is nothing to ask for.
    """

    _woken, _with_events, _events_s = False, True, 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        super().spin_once(timeout_sec)
        self._woken = True

    def get_nodes(self) -> list[Any]:
        """Those to wait for next; where there are none, the wait ends at once."""
        woken, self._woken = self._woken, False
        if woken:
            self.wake()
            return []
        self._with_events = steady_s() >= self._events_s
        if self._with_events:
            self._events_s = steady_s() + _AWAKE_S
        return list(super().get_nodes())

    def can_execute(self, entity: Any) -> bool:
        """Whether to ask for it: no callback is under way meanwhile."""
        return self._with_events or not isinstance(entity, EventHandler)


def run_node(make: Callable[[], LocalizationNode], words: list[str]) -> int:
    """Run a node until SIGINT or SIGTERM, which is exit code 0; or until it dies.

    For the main thread of a process that then ends: signals are ignored afterwards.
    """
    node = None
    try:
        problem = _initialise(words)
        if problem:
            rclpy.logging.get_logger(_PACKAGE).fatal(problem)
            return entry.CANNOT_START
        entry.leave_to_ros()
        # Made first: after a signal it could not be made any more.
        executor = Executor()
        node = make()
        parameters.warn_of_ignored_files(node, words)
        if not node.start():
            return entry.CANNOT_START if rclpy.ok() else 0  # a signal is no failure
        # A signal just before the executor waits does not always wake it.
        node.create_timer(_AWAKE_S, lambda: None, clock=node._steady)
        executor.add_node(node)
        with one_core():
            executor.spin()
    except ExternalShutdownException:
        return 0
    except Exception as error:
        if isinstance(error, rclpy_implementation.RCLError) and not rclpy.ok():
            return 0
        text = str(error) if isinstance(error, LocalizationError) else traceback.format_exc()
        rclpy.logging.get_logger(_PACKAGE).fatal(text)
        return entry.DIED if node is not None and node.active else entry.CANNOT_START
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        entry.ignore()
    return 0


def _initialise(words: list[str]) -> str:
    """Initialize ROS; the reason where its arguments or files cannot be used, else ''."""
    try:
        rclpy.init(args=words)
    except RuntimeError as error:  # the base of all of rclpy's; some texts are a list of arguments
        return f'ROS cannot use its arguments: {error}'
    others = ' '.join(rclpy.utilities.remove_ros_args(words)[1:])
    if not others:
        return ''
    return (
        f'unknown arguments {others}: give parameters as --ros-args -p NAME:=VALUE, and topics as '
        '--ros-args -r NAME:=TOPIC'
    )
