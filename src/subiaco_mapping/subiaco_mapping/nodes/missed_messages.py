"""Messages that a live node missed, counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from subiaco_mapping.recording.losses import SequenceCounter


class Arrivals:
    """Count by topic what came, what was lost on the way, and what was left out.

    Losses are gaps in the numbers that the middleware gives to messages.
    """

    def __init__(self) -> None:
        self._received: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()
        self._numbers: dict[str, SequenceCounter] = {}

    def counted(
        self, topic: str, handler: Callable[[Any], object]
    ) -> Callable[[Any, Mapping[str, Any]], None]:
        """Return a subscription's callback that counts before it hands the message on."""
        numbers = self._numbers.setdefault(topic, SequenceCounter())

        def on_message(message: Any, info: Mapping[str, Any]) -> None:
            self._received[topic] += 1
            number = info["publication_sequence_number"]
            if number is not None:
                numbers.take(number)
            handler(message)

        return on_message

    def leave_out(self, topic: str) -> None:
        """Note a message that came before the places of the sensors, or of a time that was mapped before."""
        self._left_out[topic] += 1

    @property
    def lost(self) -> int:
        """Messages that are known to be missing, whatever the topic."""
        return sum(numbers.lost for numbers in self._numbers.values())

    def facts(self) -> dict[str, dict[str, int]]:
        """Return the counts of every topic that has spoken."""
        return {
            topic: {
                "received": count,
                "lost": self._numbers[topic].lost,
                "before_start": self._numbers[topic].before,
                "left_out": self._left_out[topic],
            }
            for topic, count in sorted(self._received.items())
        }


def missed_messages(arrivals: Mapping[str, Mapping[str, int]]) -> str:
    """Say by topic how many messages a live drive lost on the way or left out.

    Parameters
    ----------
    arrivals : mapping of topic to mapping
        Counts as of :meth:`Arrivals.facts`.

    Returns
    -------
    str
        Empty where nothing is missing.
    """
    texts = []
    for topic, counts in arrivals.items():
        kinds = {"lost": counts["lost"], "left out": counts["left_out"]}
        if any(kinds.values()):
            told = ", ".join(f"{number} {kind}" for kind, number in kinds.items() if number)
            texts.append(f"{topic} {told} of {counts['received'] + counts['lost']}")
    return "; ".join(texts)
