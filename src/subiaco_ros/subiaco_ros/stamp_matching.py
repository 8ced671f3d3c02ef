"""Messages of one stamp, matched across topics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class StampMatcher:
    """Collect the messages of several topics by stamp; give complete sets in stamp order.

    Topics are each in order, so a complete set means that older incomplete
    ones will never be completed: they are dropped and counted.

    Parameters
    ----------
    kinds : sequence of str
        Every set has one message of each, given back in this order.
    """

    def __init__(self, kinds: Sequence[str]) -> None:
        self._kinds = tuple(kinds)
        self._sets: dict[int, dict[str, Any]] = {}
        self.dropped = 0

    def add(self, kind: str, stamp_ns: int, message: Any) -> tuple[Any, ...] | None:
        """Add one message; return its set when that is complete."""
        found = self._sets.setdefault(stamp_ns, {})
        found[kind] = message
        if len(found) < len(self._kinds):
            return None
        older = [stamp for stamp in self._sets if stamp < stamp_ns]
        for stamp in [*older, stamp_ns]:
            del self._sets[stamp]
        self.dropped += len(older)
        return tuple(found[kind] for kind in self._kinds)
