"""The page of topics: types, quality of service, frames, rates and fields, from the table of the graph."""

from __future__ import annotations

from reference_pages.markdown import GENERATED, cell, code, table
from subiaco_bringup.topic_table import SERVICES, TOPICS, TopicRow

_INTRODUCTION = """\
Names are relative: remappings and namespaces change them, and the table shows them without either. `/clock`
and `/diagnostics` are absolute. Every cloud on a topic is float32 in a local frame; coordinates of the map
grid appear in files and in the change table only. All stamps are the time of the sensor (UTC).

**Quality of service.** *reliable, volatile*: nothing is lost between our nodes. *reliable, transient local*
(latched): who comes later receives the last message. *as offered*: the subscription is best effort like
sensor data, unless every publisher is reliable; `qos_overrides` parameters overrule it. Inputs of sensors
hold four seconds of packets.

**Frames** (REP 105): `earth -> map -> odom -> base_link`, and `lidar_link`, `imu_link`, `gnss_link` below
`base_link`. `map` is east, north, up about `/map/origin`. Parameters rename the frames. Covariances are row
major with translation first, then rotation about fixed axes (REP 103).

**Composition.** Python nodes cannot be loaded into a component container. `subiaco graph mapping
--one-process` runs replay, odometry and pose graph in one process with one executor instead (on a
simulated drive of 5 s, 476 MB of memory at the peak instead of 712 MB for three processes). The nodes of the
live graph stay processes of their own: a recorder must not wait for a solution, and the others go on where
one has failed.

The protocol of `/replay/*` and `/odometry/sequence`: [Protocol of counts](replay-protocol.md). The fields
of our own types: [Messages](messages.md)."""


def page() -> str:
    """Return the page."""
    rows = [
        (code(row.name), code(row.msg_type), _who(row), row.quality, row.frame or "-", row.rate)
        for row in TOPICS
    ]
    head = ("topic", "type", "from -> to", "quality of service", "frame", "rate")
    parts = ["# Topics, services and frames", GENERATED, _INTRODUCTION, table(head, rows), "## Meaning"]
    parts += [_meaning(row) for row in TOPICS]
    services = [(code(row.name), code(row.kind), code(row.node), cell(row.meaning)) for row in SERVICES]
    parts += ["## Services and actions", table(("name", "type", "node", "meaning"), services)]
    return "\n\n".join(parts) + "\n"


def _who(row: TopicRow) -> str:
    return f"{', '.join(row.publishers)} -> {', '.join(row.subscribers)}"


def _meaning(row: TopicRow) -> str:
    text = f"### {row.name}\n\n{row.meaning}"
    if not row.fields:
        return text
    fields = [(code(name), cell(meaning)) for name, meaning in row.fields.items()]
    return f"{text}\n\n{table(('field', 'meaning'), fields)}"
