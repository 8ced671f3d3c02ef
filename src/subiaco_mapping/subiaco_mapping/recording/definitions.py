"""Definitions of message types: those of ROS 2 Jazzy are known, others are read from their packages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from subiaco_geo.bags import make_typestore
from subiaco_geo.errors import InputError

ReadText = Callable[[str], str]


def _names(node: Any) -> Iterator[str]:
    """Yield the message types that a field's description names."""
    kind, payload = node
    if kind.name == "NAME":
        yield payload
    elif kind.name in ("ARRAY", "SEQUENCE"):
        yield from _names(payload[0])


class Definitions:
    """Texts and hashes of message types.

    Parameters
    ----------
    read_text : callable
        Type name to the text of its ``.msg`` file; raises OSError or LookupError where there is none.
    """

    def __init__(self, read_text: ReadText) -> None:
        self._read = read_text
        self._store: Typestore = make_typestore()

    def _learn(self, msg_type: str) -> None:
        if msg_type in self._store.fielddefs:
            return
        types = get_types_from_msg(self._read(msg_type), msg_type)
        for _, fields in types.values():
            for _, node in fields:
                for needed in _names(node):
                    if needed not in types:
                        self._learn(needed)
        self._store.register({name: t for name, t in types.items() if name not in self._store.fielddefs})

    def describe(self, msg_type: str) -> tuple[str, str]:
        """Return the definition and the type hash.

        Raises
        ------
        InputError
            The type's package is not installed.
        """
        try:
            self._learn(msg_type)
        except (OSError, LookupError) as error:
            raise InputError(
                f"{msg_type}: its definition was not found; install its message package"
            ) from error
        text, _ = self._store.generate_msgdef(msg_type, ros_version=2)
        return text, self._store.hash_rihs01(msg_type)
