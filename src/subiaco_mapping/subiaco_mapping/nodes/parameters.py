"""Parameters of nodes as ROS describes them: meaning, unit and bounds come from the models.

Nodes read their parameters once, at the start. All are therefore read-only: ``ros2 param set`` is refused,
and ``ros2 param describe`` tells what a parameter means.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

_LARGEST_INTEGER = 2**63 - 1


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


def descriptor(field: FieldInfo, kind: Parameter.Type) -> ParameterDescriptor:
    """Return the descriptor of a field for a value of some type."""
    low, high, words = _bounds(field)
    made = ParameterDescriptor(
        type=kind.value,
        description=field.description or "",
        additional_constraints=", ".join(words),
        read_only=True,
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
