"""Requests: one validated object for a job, whichever door it comes through.

The command, the ROS action, the launch files and the Python API build the same request, and one function
runs it. As JSON it crosses process borders: parameters of nodes and goals of actions carry it as one string.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from subiaco_geo.config import StrictModel, validate
from subiaco_geo.errors import InputError
from subiaco_geo.settings import departures


class Request(StrictModel):
    """What to do, with all options; frozen."""

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Build a request from values.

        Raises
        ------
        InputError
            A value is missing, unknown or out of bounds; the message names it.
        """
        return validate(cls, values, "request")

    @classmethod
    def from_json(cls, text: str, source: str, **values: Any) -> Self:
        """Build a request from JSON; ``values`` are those that it does not say.

        Raises
        ------
        InputError
            Not a JSON object, or no valid request; the message begins with ``source``.
        """
        return validate(cls, {**values, **json_object(text, source)}, source)

    def to_json(self) -> str:
        """Return the request as JSON, without what is at its default."""
        return json.dumps(departures(self))

    def resolved(self) -> Self:
        """Return the request with absolute paths, for a process that works in another folder."""
        return self.model_copy(
            update={name: _absolute(getattr(self, name)) for name in type(self).model_fields}
        )


def json_object(text: str, source: str) -> dict[str, Any]:
    """Return the object that a JSON text holds; an empty text holds nothing.

    Raises
    ------
    InputError
        It is not JSON, or not an object.
    """
    try:
        found = json.loads(text) if text.strip() else {}
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source}: not valid JSON ({error})") from error
    if not isinstance(found, Mapping):
        raise InputError(f"{source}: expected a JSON object of options by name, such as {{}}")
    return dict(found)


def _absolute(value: Any) -> Any:
    if isinstance(value, Path):
        return value.resolve()
    if isinstance(value, tuple) and all(isinstance(item, Path) for item in value):
        return tuple(item.resolve() for item in value)
    return value
