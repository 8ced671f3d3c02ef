"""The life cycle of our nodes: configure, activate, deactivate, clean up, shut down.

* Unconfigured: the node has its parameters and nothing else.
* Inactive: parameters are read and checked; publishers, subscriptions and services exist, and none of them
  runs. Messages wait in the middleware up to the depth of their subscription, so that a replay stands still
  and loses none. Calls of services wait too.
* Active: the node works.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy._rclpy_pybind11 import RCLError
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter

from subiaco_geo.errors import SubiacoError
from subiaco_ros.parameters import AUTOSTART, unlock_parameters, when_given


class App(Protocol):
    """The working part of a node process."""

    @property
    def done(self) -> bool:
        """Whether the process may end with success."""

    def step(self) -> float:
        """Do what is not a callback; return the seconds that may be spent waiting for callbacks."""


@runtime_checkable
class Closing(Protocol):
    """An app that must put something away, however its process ends."""

    def close(self) -> None:
        """Put it away; SubiacoError where it cannot be."""


@runtime_checkable
class Reconfigurable(Protocol):
    """An app with parameters that may be set while it works."""

    def reconfigure(self, values: Mapping[str, Any]) -> None:
        """Take new values of parameters by name; SubiacoError where one is refused."""


#: Puts an app together from the parameters of its node.
Build = Callable[[Node], App]

#: Seconds between two looks at the services of a node that does not work.
_IDLE = 0.1


#: Parameters of every node that are read when its process starts, and what they mean.
_AT_THE_START = {
    AUTOSTART: "Whether the node configures and activates itself when it is started",
    "use_sim_time": "Whether the node follows /clock instead of the clock of this computer",
}


class ActiveGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that run only while their node is active."""

    def __init__(self) -> None:
        super().__init__()
        self.active = False

    def can_execute(self, entity: Any) -> bool:
        """Say whether an entity may run, and is waited for."""
        return self.active and super().can_execute(entity)


class ManagedNode(LifecycleNode):
    """A lifecycle node around an app, which it builds when it is configured.

    Parameters
    ----------
    name : str
    build : callable
        Called at every configuration; SubiacoError where the parameters are at fault.
    options
        As :class:`rclpy.node.Node` takes them.
    """

    def __init__(self, name: str, build: Build, **options: Any) -> None:
        self._gate: ActiveGroup | None = None
        self._build = build
        self.app: App | None = None
        self.failure: Exception | None = None
        self._starting = False
        super().__init__(
            name, automatically_declare_parameters_from_overrides=True, enable_logger_service=True, **options
        )
        if not self.has_parameter(AUTOSTART):
            self.declare_parameter(AUTOSTART, True)
        for parameter, meaning in _AT_THE_START.items():
            described = ParameterDescriptor(
                type=Parameter.Type.BOOL.value, description=meaning, read_only=True
            )
            self.set_descriptor(parameter, described)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._refuse_unknown_transitions()
        self._standing = list(self.publishers)
        self._gate = ActiveGroup()

    def _refuse_unknown_transitions(self) -> None:
        """Answer no where a state lacks a transition: in rclpy the request ends the process."""
        service = self._service_change_state
        change_state = service.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except RCLError as error:
                self.get_logger().warning(f"transition refused: {str(error).splitlines()[0]}")
                response.success = False
                return response

        service.callback = answer

    def destroy_node(self) -> None:
        """Destroy the node and its state machine, through which the node would stay visible in the graph."""
        super().destroy_node()
        self._state_machine: Any = None

    @property
    def default_callback_group(self) -> CallbackGroup:
        """The group of entities that are made without one: those of the app run only while it is active."""
        return self._default_callback_group if self._gate is None else self._gate

    @property
    def active(self) -> bool:
        """Whether the node works."""
        return self._gate is not None and self._gate.active

    @property
    def finished(self) -> bool:
        """Whether the process may end: the app is done, or the node was shut down.

        Raises
        ------
        SubiacoError
            The node was shut down, and could not put everything away.
        """
        over = self._state_machine.current_state[1] == "finalized"
        if over and self.failure is not None:
            raise self.failure
        return over or (self.active and self.app is not None and self.app.done)

    def start(self) -> None:
        """Configure and activate, as ``autostart`` asks for; raise what stood in the way."""
        if not self.get_parameter(AUTOSTART).value:
            return
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self.failure or SubiacoError(f"node {self.get_name()} did not start")
        self._starting = False

    def step(self) -> float:
        """Let an active app do what is not a callback; return how long callbacks may be waited for [s]."""
        return self.app.step() if self.active and self.app is not None else _IDLE

    def put_away(self) -> None:
        """Let the app put away what it has, however its process ends."""
        app, self.app = self.app, None
        if isinstance(app, Closing):
            app.close()

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters; say of those that cannot be set now when they can."""
        for name in (p.name for p in parameter_list if self.has_parameter(p.name)):
            if self.describe_parameter(name).read_only:
                reason = f"{name} is read-only: {when_given(name)}"
                return SetParametersResult(successful=False, reason=reason)
        result: SetParametersResult = super().set_parameters_atomically(parameter_list)
        return result

    def create_subscription(self, msg_type: Any, topic: str, *arguments: Any, **options: Any) -> Any:
        """Create a subscription; the clock runs in every state."""
        if topic == "/clock":
            options.setdefault("callback_group", self._default_callback_group)
        return super().create_subscription(msg_type, topic, *arguments, **options)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, and make what the app needs."""
        return self._tried(self._configure, TransitionCallbackReturn.FAILURE, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the app work."""
        return self._tried(self._open, TransitionCallbackReturn.FAILURE, super().on_activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the app stand still; messages wait in the middleware."""
        return self._tried(self._close_gate, TransitionCallbackReturn.ERROR, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Put away what the app has, and let the parameters be set for the next configuration."""
        return self._tried(self._clean_up, TransitionCallbackReturn.ERROR, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Put away what the app has; the process ends, with the reason where something could not be."""
        return self._tried(self._clean_up, TransitionCallbackReturn.FAILURE, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002 - rclpy's interface
        """Go back to unconfigured, where something could not be put away."""
        self.app = None
        self._destroy_entities()
        return TransitionCallbackReturn.SUCCESS

    def _tried(
        self,
        work: Callable[[], None],
        otherwise: TransitionCallbackReturn,
        then: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        """Do the work of a transition; say what stood in its way, which rclpy would swallow."""
        self.failure = None
        try:
            work()
        except Exception as error:  # noqa: BLE001 - kept, and raised again by start()
            self.failure = error
            if not self._starting:
                self.get_logger().error(str(error) or repr(error))
            return otherwise
        return then(state)

    def _configure(self) -> None:
        try:
            self.app = self._build(self)
        except Exception:
            self._destroy_entities()
            raise

    def _open(self) -> None:
        if self._gate is not None:
            self._gate.active = True

    def _close_gate(self) -> None:
        if self._gate is not None:
            self._gate.active = False

    def _clean_up(self) -> None:
        self._close_gate()
        try:
            self.put_away()
        finally:
            self._destroy_entities()

    def _destroy_entities(self) -> None:
        """Destroy what the app made, and let its parameters be set again."""
        self._close_gate()
        plain = self._default_callback_group
        for waitable in [w for w in self.waitables if w.callback_group is self._gate]:
            if hasattr(waitable, "destroy"):  # an action server
                waitable.destroy()
        groups: tuple[tuple[Iterable[Any], Callable[[Any], object]], ...] = (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
        )
        for entities, destroy in groups:
            for entity in [e for e in entities if e.callback_group is not plain]:
                destroy(entity)
        for publisher in [p for p in self.publishers if p not in self._standing]:
            self.destroy_publisher(publisher)
        unlock_parameters(self)

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Hand new values to a configured app; read-only parameters were refused before."""
        if self.app is None or not isinstance(self.app, Reconfigurable):
            return SetParametersResult(successful=True)
        own = {p.name: p.value for p in parameters if p.name != "use_sim_time"}
        try:
            if own:
                self.app.reconfigure(own)
        except SubiacoError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)
