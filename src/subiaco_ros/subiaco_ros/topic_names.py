"""How our topic names become names of a node, so that remappings and namespaces hold."""

from __future__ import annotations

#: The one topic that all namespaces share, as in every package that reports diagnostics: a status carries the
#: namespace of its node in its name.
DIAGNOSTICS = "/diagnostics"


def relative(topic: str) -> str:
    """Return the name under which a node of ours publishes or subscribes a topic of ours."""
    return topic if topic == DIAGNOSTICS else topic.lstrip("/")
