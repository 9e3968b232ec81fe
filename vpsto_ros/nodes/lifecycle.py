"""The lifecycle that all nodes share: parameters, autostart, timers, guarded subscriptions, a clean end."""

import dataclasses
import faulthandler
import gc
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any, ClassVar

import rclpy
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args

from vpsto_ros.configuration import documented, option
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError, VpstoError
from vpsto_ros.nodes.conversions import TimeBase
from vpsto_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Complaints, Pulse, Report
from vpsto_ros.nodes.parameters import check_change, declare_parameters, help_text, read_parameters
from vpsto_ros.nodes.stop_signals import StopSignals

_LOOK = 0.1  # a spinning node looks so often whether a signal wants it to end [s]
MAX_AHEAD = 0.5
"""A message stamped farther in the future is refused: it would look fresh long after its sender died [s]."""
MAX_SILENCE = 1.0
"""A node whose time stands still for longer, by a steady clock, reports STALE [s]."""
FAULT_SHOWN = 5.0
"""An unexpected error shows as ERROR for so long after it last happened [s]."""

# A best-effort publisher never reaches a reliable subscriber; the other way round works.
EXTERNAL = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def reliable(depth: int) -> QoSProfile:
    """Quality of service of a publisher whose messages shall arrive."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)


def best_effort(depth: int) -> QoSProfile:
    """Quality of service of a publisher whose messages are soon outdated."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def latched(depth: int = 1) -> QoSProfile:
    """Quality of service of a publisher whose last message reaches those who join later."""
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
    )


@documented
@dataclasses.dataclass(frozen=True)
class NodeConfig:
    """What every node can be told."""

    autostart: bool = option(True, "configure and activate without being asked to")
    base_frame: str = option("fr3_link0", "frame of all poses: the robot's base, z up, table at z = 0")


class NoTimeYet(VpstoError):
    """A stamp came before the first message on /clock, so that nobody can say how old it is."""


class ManagedNode(LifecycleNode):
    """A lifecycle node that is configured once from its parameters.

    Subclasses set `default_config` and fill in :meth:`configure`, :meth:`figures` and :meth:`health` (and,
    where needed, :meth:`on_time_reset`, :meth:`stop` and `standstill`, what the diagnostics say when the time
    does not go on). Publishers, subscriptions and timers made with the methods of this class are silent while
    the node is inactive and are removed by `cleanup`.
    """

    default_config: ClassVar[Any] = NodeConfig()
    standstill: ClassVar[str] = "time stands still (the source of /clock is paused or gone)"

    def __init__(self, name: str, **arguments: Any) -> None:
        """Declare the parameters.

        Args:
            name: default node name.
            arguments: passed to rclpy's node.

        Raises:
            ConfigurationError: when a parameter is unknown, of the wrong type or out of range.
        """
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **arguments)
        self.failure: Exception | None = None
        self.configured = False
        self.active = False
        self.owns_process = False
        self.complaints = Complaints(self.get_logger().warning)
        self.faults = 0
        self._fault = (-FAULT_SHOWN, "")
        self._faults_logged: set[str] = set()
        self._pulse = Pulse()
        self.time_base = TimeBase()
        self._timers_kept: list[Timer] = []
        self._subscriptions_kept: list[Any] = []
        self._publishers_kept: list[Any] = []
        self._services_kept: list[Any] = []
        self._time_jumped = threading.Event()
        try:
            declare_parameters(self, self.default_config)
        except ConfigurationError:
            self.destroy_node()
            raise
        self.add_on_set_parameters_callback(self._on_set_parameters)
        threshold = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jump = self.get_clock().create_jump_callback(threshold, post_callback=self._on_jump)

    # What subclasses fill in.

    def configure(self, config: Any) -> None:
        """Build everything from the configuration; kernels are compiled here, not in the first cycle."""

    def cleanup(self) -> None:
        """Drop what `configure` made by other means than the methods below."""

    def spin(self, executor: Executor, signals: StopSignals) -> None:
        """What the main thread does until a signal wants the node to end."""
        while not signals.requested:
            executor.spin_once(timeout_sec=_LOOK)

    def stop(self) -> None:
        """Bring whatever is in motion to rest; called before the node becomes inactive."""

    def on_time_reset(self) -> None:
        """Forget everything that carries a time: the clock went backwards because a simulation restarted."""

    def figures(self) -> dict[str, Any]:
        """What the diagnostics show as values, besides what every node shows."""
        return {}

    def health(self) -> tuple[int, str]:
        """Level and message of the diagnostics of an active node."""
        trouble = self.complaints.recent()
        return (WARN, trouble) if trouble else (OK, "ok")

    def silence(self) -> float:
        """How long the node's time has stood still, by a steady clock [s]."""
        self._pulse.see(self.get_clock().now().nanoseconds)
        return self._pulse.silence

    # What subclasses use.

    def report(self) -> Report:
        """The present diagnostics.

        What a node says of its inputs counts in its own time. When that stands still, because whoever
        publishes /clock died, ages freeze and everything would look fresh for ever; hence the steady clock.
        """
        values = {**self.figures(), **self.complaints.values(), "internal_errors": self.faults}
        if not self.active:
            return Report(OK, "inactive", values)
        when, fault = self._fault
        if time.monotonic() - when < FAULT_SHOWN:
            return Report(ERROR, fault, values)
        silence = self.silence()
        if silence > MAX_SILENCE:
            return Report(STALE, f"{self.standstill} for {silence:.1f} s", values)
        return Report(*self.health(), values)

    def seconds(self, stamp: Time, ahead: float = MAX_AHEAD) -> float:
        """The stamp of a message that has just come, in seconds of the node's time base [s].

        Args:
            stamp: the stamp.
            ahead: how far in the future it may lie [s].

        Raises:
            InvalidInputError: it lies farther in the future.
            NoTimeYet: the simulation's clock was not heard yet.
        """
        now, then = self.now(), self.time_base.seconds(stamp)
        if now + self.time_base.origin == 0.0:
            raise NoTimeYet("no message on /clock yet")
        if then > now + ahead:
            raise InvalidInputError(
                f"the stamp is {then - now:.2f} s in the future (allowed {ahead} s); do both sides use one "
                "clock (use_sim_time)?"
            )
        return then

    def guarded(self, callback: Callable[..., None], topic: str = "") -> Callable[..., None]:
        """A callback that survives its errors: what is wrong with inputs is counted, a bug is shown as one.

        Args:
            callback: what to call.
            topic: what it handles; empty for a timer.
        """

        def call(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except NoTimeYet:
                return
            except VpstoError as error:
                text = f"{topic} refused: {error}" if topic else str(error)
                self.complaints.add(topic or "cycle", text)
            except Exception as error:
                self._take_fault(error)

        return call

    def _take_fault(self, error: Exception) -> None:
        """Log an unexpected error, each kind in full once, and show it in the diagnostics."""
        lines = traceback.format_exception(error)
        self.faults += 1
        self._fault = (time.monotonic(), f"internal error, going on: {type(error).__name__}: {error}")
        where = "".join(lines[:-1])
        if where not in self._faults_logged:
            self._faults_logged.add(where)
            self.get_logger().error("".join(lines))

    def now(self) -> float:
        """The node's time in the seconds of its time base [s]; handles a clock that went backwards."""
        if self._time_jumped.is_set():
            self._time_jumped.clear()
            self.complaints.add("clock_reset", "the clock went backwards (a restart?): starting afresh")
            self.on_time_reset()
        return self.clock_seconds()

    def clock_seconds(self) -> float:
        """The same without looking whether the clock went backwards [s]."""
        return self.time_base.seconds(self.get_clock().now().to_msg())

    def advertise(self, kind: type, topic: str, qos: QoSProfile) -> Any:
        """A publisher that is silent while the node is inactive."""
        publisher = self.create_lifecycle_publisher(kind, topic, qos)
        self._publishers_kept.append(publisher)
        return publisher

    def subscribe(
        self, kind: type, topic: str, callback: Callable, qos: QoSProfile = EXTERNAL
    ) -> Subscription:
        """Listen to a topic; a message that the callback refuses with a VpstoError is counted and logged."""
        handle = self.guarded(callback, topic)

        def receive(message: Any) -> None:
            if self.active:
                handle(message)

        subscription = self.create_subscription(kind, topic, receive, qos)
        self._subscriptions_kept.append(subscription)
        return subscription

    def serve(self, kind: type, name: str, callback: Callable) -> None:
        """Offer a service whose response has `success` and `message`; an inactive node answers that it is."""

        def answer(request: Any, response: Any) -> Any:
            if self.active:
                return callback(request, response)
            response.success, response.message = False, "the node is not active"
            return response

        self._services_kept.append(self.create_service(kind, name, answer))

    def every(self, period: float, callback: Callable[[], None], group: CallbackGroup | None = None) -> None:
        """Call back periodically in the node's time while the node is active.

        Timers know nothing of the lifecycle: they are created stopped, started by `activate` and cancelled by
        `deactivate`.
        """
        run = self.guarded(callback)

        def tick() -> None:
            self._pulse.beat()
            run()

        timer = self.create_timer(period, tick, callback_group=group)
        timer.cancel()
        self._timers_kept.append(timer)

    def start(self) -> None:
        """Configure and activate.

        Raises:
            Exception: what made a transition fail.
        """
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self.failure or RuntimeError("a lifecycle transition failed")

    def end(self) -> None:
        """Bring everything to rest and remove it, unless that was done already."""
        if self.configured:
            self.trigger_shutdown()

    # Transitions, called by rclpy.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters and build everything."""
        return self._transition(self._configure, state, super().on_configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the timers."""
        return self._transition(self._activate, state, super().on_activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Bring everything to rest and cancel the timers."""
        return self._transition(self._deactivate, state, super().on_deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove what `configure` built."""
        return self._transition(self._clean_up, state, super().on_cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Bring everything to rest and remove it."""
        return self._transition(self._shut_down, state, super().on_shutdown)

    def _transition(
        self, action: Callable, state: LifecycleState, base: Callable
    ) -> TransitionCallbackReturn:
        try:
            action()
            return base(state)
        except VpstoError as error:
            self.failure = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            # rclpy swallows what a transition raises, so a bug would vanish without a trace.
            self.failure = error
            self.get_logger().fatal(traceback.format_exc())
            return TransitionCallbackReturn.ERROR

    def _configure(self) -> None:
        config = read_parameters(self, self.default_config)
        simulated = self.get_parameter("use_sim_time").value
        self.time_base = TimeBase(0 if simulated else self.get_clock().now().to_msg().sec)
        try:
            self.configure(config)
        except Exception:
            self._remove()
            raise
        self.configured = True

    def _activate(self) -> None:
        if self.owns_process:
            # A full collection looks at every compiled kernel: 50 ms and more on a busy machine, in which
            # nothing is planned. What lives by now stays.
            gc.collect()
            gc.freeze()
        self.active = True
        self._pulse.beat()
        for timer in self._timers_kept:
            timer.reset()

    def _deactivate(self) -> None:
        self.stop()
        self.active = False
        for timer in self._timers_kept:
            timer.cancel()

    def _shut_down(self) -> None:
        if self.active:
            self._deactivate()
        if self.configured:
            self._clean_up()

    def _clean_up(self) -> None:
        self.cleanup()
        self._remove()

    def _remove(self) -> None:
        self.configured = False
        for timer in self._timers_kept:
            self.destroy_timer(timer)
        for subscription in self._subscriptions_kept:
            self.destroy_subscription(subscription)
        for publisher in self._publishers_kept:
            self.destroy_lifecycle_publisher(publisher)
        for service in self._services_kept:
            self.destroy_service(service)
        for kept in (self._timers_kept, self._subscriptions_kept, self._publishers_kept, self._services_kept):
            kept.clear()

    def _on_jump(self, _jump: Any) -> None:
        self._time_jumped.set()

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        own = [parameter.name for parameter in parameters if parameter.name != "use_sim_time"]
        if own and self.configured:
            reason = (
                f"{', '.join(own)}: parameters are read when the node is configured, which it is already; "
            )
            reason += "to change them, deactivate it, clean it up, set them, configure and activate it again"
            return SetParametersResult(successful=False, reason=reason)
        return check_change(self.default_config, parameters)


def run(node_class: type[ManagedNode], name: str, args: list[str] | None = None) -> int:
    """Run one node until it is told to stop; with ``--help``, print its parameters instead.

    Args:
        node_class: class of the node.
        name: name of the node, as long as no remap gives it another.
        args: command line with ROS arguments, the process's own when None.

    Returns:
        Exit status: 0 after a clean end, 2 after wrong parameters or arguments.
    """
    if {"-h", "--help"} & set(sys.argv if args is None else args):
        print(help_text(name, node_class.default_config))
        return 0
    with StopSignals() as signals:
        node = None
        try:
            if not _initialize(args):
                return 2
            node = _create(node_class, name)
            return 2 if node is None else _spin(node, signals)
        except (KeyboardInterrupt, ExternalShutdownException):
            return 0
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()


def _initialize(args: list[str] | None) -> bool:
    given = sys.argv if args is None else args
    try:
        unknown = remove_ros_args(given)[1:]
        if unknown:
            raise ValueError(
                f"unknown arguments {' '.join(unknown)}; set parameters by --ros-args -p name:=value"
            )
        rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        print(f"cannot start: {error}", file=sys.stderr)
        return False
    return True


def _create(node_class: type[ManagedNode], name: str) -> ManagedNode | None:
    try:
        return node_class(name)
    except (ConfigurationError, ParameterException) as error:
        rclpy.logging.get_logger(name).fatal(str(error))
        return None


def _spin(node: ManagedNode, signals: StopSignals) -> int:
    # One thread: beside a second one that handles messages, a planning step of 12 ms waits over and over for
    # the interpreter and takes 20 to 30 ms. What arrives meanwhile waits in its queue.
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.owns_process = True
    if sys.stderr is sys.__stderr__:
        faulthandler.enable()  # a crash in compiled code says in the log where it happened
    try:
        if node.get_parameter("autostart").value:
            node.start()
        signals.wait_for_loop()
        node.spin(executor, signals)
        node.end()
    except ConfigurationError:
        return 2  # logged by the transition that failed
    finally:
        executor.shutdown(timeout_sec=2.0)
    return 0
