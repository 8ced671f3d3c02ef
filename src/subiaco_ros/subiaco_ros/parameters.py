"""Parameters of nodes, read into models: meaning, unit and bounds come from the models.

Nodes read their parameters when they are configured. From then on parameters are read-only, so that
``ros2 param set`` is refused; only those whose field says ``json_schema_extra=DYNAMIC`` are taken up at once.
Cleaning up lets all of them be set again. ``ros2 param describe`` tells what a parameter means.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from subiaco_geo.config import StrictModel, merge, validate

#: Says of a field of a model that the node takes a new value up while it works.
DYNAMIC: dict[str, Any] = {"dynamic": True}

#: Parameter of every node: whether it configures and activates itself.
AUTOSTART = "autostart"

_LARGEST_INTEGER = 2**63 - 1
#: Parameters that do not belong to a model: those that ROS itself declares, and :data:`AUTOSTART`.
_NO_SETTINGS = ("use_sim_time", "qos_overrides", "start_type_description_service", AUTOSTART)

Model = TypeVar("Model", bound=StrictModel)


def leaves(model: BaseModel, prefix: str = "") -> Iterator[tuple[str, FieldInfo, Any]]:
    """Yield dotted name, field and value of every setting of a model, nested ones included."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", field, model.model_dump(mode="json", include={name})[name]


def _bounds(field: FieldInfo) -> tuple[Any, Any, list[str]]:
    """Return the least and the greatest value of a field, None without one, and its bounds in words."""
    low: Any = None
    high: Any = None
    words: list[str] = []
    for rule in field.metadata:
        if isinstance(rule, annotated_types.Ge):
            low, said = rule.ge, f"at least {rule.ge}"
        elif isinstance(rule, annotated_types.Gt):
            low, said = rule.gt, f"greater than {rule.gt}"
        elif isinstance(rule, annotated_types.Le):
            high, said = rule.le, f"at most {rule.le}"
        elif isinstance(rule, annotated_types.Lt):
            high, said = rule.lt, f"less than {rule.lt}"
        else:
            continue
        words.append(said)
    return low, high, words


def is_dynamic(field: FieldInfo) -> bool:
    """Whether a node takes a new value of a field up while it works."""
    extra = field.json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("dynamic"))


def descriptor(field: FieldInfo, kind: Parameter.Type) -> ParameterDescriptor:
    """Return the descriptor of a field for a value of some type."""
    low, high, words = _bounds(field)
    made = ParameterDescriptor(
        type=kind.value,
        description=field.description or "",
        additional_constraints=", ".join(words),
        read_only=not is_dynamic(field),
        dynamic_typing=kind is Parameter.Type.NOT_SET,
    )
    if (low, high) == (None, None):
        return made
    if kind is Parameter.Type.DOUBLE:
        least = low if low is not None else -math.inf  # some limits are infinite by default
        most = high if high is not None else math.inf
        made.floating_point_range = [FloatingPointRange(from_value=float(least), to_value=float(most))]
    if kind is Parameter.Type.INTEGER:
        least = int(low) if low is not None else -_LARGEST_INTEGER
        most = int(high) if high is not None else _LARGEST_INTEGER
        made.integer_range = [IntegerRange(from_value=least, to_value=most, step=0)]
    return made


def _ros_value(value: Any) -> Any:
    """Return a value that a parameter can hold; None for what it cannot: nothing, empty and nested lists."""
    if isinstance(value, dict) or value is None:
        return None
    if not isinstance(value, list):
        return value
    if not value or any(isinstance(item, list | dict) or item is None for item in value):
        return None
    kinds = {type(item) for item in value}
    return [float(item) for item in value] if kinds == {int, float} else value


def describe_parameters(node: Node, model: BaseModel) -> None:
    """Declare the settings of a model that a node was not given, and describe all of them.

    Parameters
    ----------
    node : Node
        Its given parameters are declared.
    model : BaseModel
        As it was made from them.
    """
    for name, field, value in leaves(model):
        if node.has_parameter(name):
            node.set_descriptor(name, descriptor(field, node.get_parameter(name).type_))
            continue
        given = _ros_value(value)
        kind = Parameter.Type.NOT_SET if given is None else Parameter.Type.from_parameter_value(given)
        node.declare_parameter(name, given, descriptor(field, kind))


def when_given(name: str) -> str:
    """Say when a parameter that is read-only takes a value."""
    if name.split(".", maxsplit=1)[0] in _NO_SETTINGS:
        return "give it when the process starts"
    return "the node has read it; deactivate and clean up the node, set it, configure and activate again"


def unlock_parameters(node: Node) -> None:
    """Let the parameters of a node that is no longer configured be set again."""
    for name in node.get_parameters_by_prefix(""):
        if name.split(".")[0] not in _NO_SETTINGS:
            node.describe_parameter(name).read_only = False


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Turn ``{"a.b": 1}`` into ``{"a": {"b": 1}}``; lists become tuples' equals, plain lists."""
    values: dict[str, Any] = {}
    for name, value in flat.items():
        branch: Any = list(value) if hasattr(value, "tolist") or isinstance(value, (list, tuple)) else value
        for part in reversed(name.split(".")):
            branch = {part: branch}
        values = merge(values, branch)
    return values


def node_values(node: Node) -> dict[str, Any]:
    """Return the parameters given to a node, nested, without those that belong to no model."""
    found = node.get_parameters_by_prefix("").items()
    given = {name: parameter.value for name, parameter in found if parameter.value is not None}
    return {name: value for name, value in nested(given).items() if name not in _NO_SETTINGS}


def read_models(node: Node, own: type[Model], config: type[StrictModel] | None = None) -> tuple[Model, Any]:
    """Split a node's parameters into its own model and the library's configuration.

    Returns
    -------
    own : Model
    config : StrictModel or None
        The very model that the command line loads from the same files.

    Raises
    ------
    InputError
        A parameter is unknown or out of bounds; the message names it.
    """
    values = node_values(node)
    mine = {name: value for name, value in values.items() if name in own.model_fields}
    rest = {name: value for name, value in values.items() if name not in own.model_fields}
    source = f"parameters of {node.get_name()}"
    found = validate(own, mine if config is not None else {**mine, **rest}, source)
    describe_parameters(node, found)
    if config is None:
        return found, None
    settings = validate(config, rest, source)
    describe_parameters(node, settings)
    return found, settings
