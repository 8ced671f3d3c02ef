"""Inspection of a bag: usable or not and why, topics, rates, losses, RTK states."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.bags import BagReader, packet_from_cdr, require_topic
from subiaco_geo.errors import errors_name
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, LIVOX_TYPES, MESSAGE_TYPES, METADATA, POINTS, types_of
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.bag_check import watch_bag
from subiaco_mapping.health_monitor.survey_verdict import judge
from subiaco_mapping.inspection.bag_faults import faults
from subiaco_mapping.named_bags import NamedBagReader, guess_names
from subiaco_mapping.pipeline import read_metadata
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.conversions import fix_from_msg, stamp_ns
from subiaco_mapping.preprocessing.decode import PacketDecoder
from subiaco_mapping.preprocessing.point_times import TIME_FIELDS

_STATES = {2: "rtk fixed", 1: "float", 0: "single", -1: "none", -2: "unknown"}
_GAP_FACTOR = 5.0


def _rate_facts(times_ns: list[int], msg_type: str, start_ns: int) -> dict[str, Any]:
    """Return count, rate [Hz] and the gaps of a topic by log time [s]."""
    times = np.sort(np.array(times_ns, dtype=np.int64))
    facts: dict[str, Any] = {"type": msg_type, "count": len(times)}
    if len(times):
        facts["begins_s"] = round((int(times[0]) - start_ns) * 1e-9, 3)
    if len(times) > 2 and times[-1] > times[0]:
        steps = np.diff(times) * 1e-9
        typical = max(float(np.median(steps)), float(steps.mean()))
        facts["rate_hz"] = round((len(times) - 1) / ((times[-1] - times[0]) * 1e-9), 2)
        facts["longest_gap_s"] = round(float(steps.max()), 3)
        facts["gaps"] = int((steps > _GAP_FACTOR * typical).sum())
    return facts


def _gnss_facts(reader: BagReader, config: GnssConfig) -> dict[str, Any]:
    fixes = [(m.log_time_ns, fix_from_msg(reader.deserialize(m), config)) for m in reader.messages({FIX})]
    states = Counter(fix.status for _, fix in fixes)
    return {
        "states": {_STATES.get(status, str(status)): count for status, count in sorted(states.items())},
        "unusable": sum(not fix.is_usable() for _, fix in fixes),
        "clock_offset_s": _offset([log - fix.time_ns for log, fix in fixes]),
    }


def _offset(differences_ns: list[int]) -> float | None:
    """Return the median of log time minus stamp [s]."""
    return round(float(np.median(differences_ns)) * 1e-9, 4) if differences_ns else None


def _packet_facts(reader: BagReader, metadata: str, config: DecodeConfig) -> dict[str, Any]:
    """Decode every packet and count what is missing."""
    decoder = PacketDecoder(metadata, config)
    points, second, offsets = [], [], []
    for message in reader.messages({LIDAR_PACKETS}):
        for scan in decoder.push(packet_from_cdr(message.raw)):
            points.append(len(scan.first))
            second.append(0 if scan.last is None else len(scan.last))
            offsets.append(message.log_time_ns - scan.end_ns)
    for scan in decoder.flush():
        points.append(len(scan.first))
        second.append(0 if scan.last is None else len(scan.last))
    return {
        **asdict(decoder.counts),
        "points_per_scan": round(float(np.mean(points))) if points else 0,
        "second_returns_per_scan": round(float(np.mean(second))) if second else 0,
        "clock_offset_s": _offset(offsets),
    }


def inspect_bag(bag: Path, config: MappingConfig | None = None) -> dict[str, Any]:
    """Look a bag over.

    Topics of other names than ours are found by ``config.topics``, else by their types.

    Returns
    -------
    dict
        ``verdict`` (usable, usable with care, not usable), ``forbids`` and ``cares`` with the reasons,
        ``flagged`` (stretches, as the live manifest has them), ``topics`` (type, count, rate, gaps),
        ``taken_as`` (guessed names), ``duration_s``, ``lidar`` (packets lost, late, duplicate; points),
        ``gnss`` (states, unusable), ``imu``, ``warnings``.

    Raises
    ------
    InputError
        The bag cannot be read, or the packets' metadata is not what it should be.
    """
    config = config or MappingConfig()
    with BagReader(Path(bag)) as plain:
        guessed = guess_names(plain.topics, config.topics)
    names = config.topics.bag_names() | guessed
    with NamedBagReader(Path(bag), names) as reader:
        with errors_name(Path(bag)):
            facts = _facts(bag, reader, config)
        monitor = watch_bag(reader, config)
        verdict = judge(monitor, reader.topics, facts["duration_s"], config.deskewed or _has_times(reader))
        verdict = verdict.with_more(*faults(reader, facts, config))
    facts["taken_as"] = guessed
    facts["flagged"] = monitor.flags.flagged(monitor.now_ns)
    facts |= {"verdict": verdict.word, "forbids": list(verdict.forbids), "cares": list(verdict.cares)}
    return facts


def _has_times(reader: BagReader) -> bool:
    """Whether the first cloud carries point times; true where packets or nothing come instead."""
    if LIDAR_PACKETS in reader.topics or POINTS not in reader.topics:
        return True
    first = next(reader.messages({POINTS}), None)
    if first is not None and first.msg_type in LIVOX_TYPES:
        return True
    names = () if first is None else tuple(field.name for field in reader.deserialize(first).fields)
    return any(name in names for name in TIME_FIELDS)


def _facts(bag: Path, reader: BagReader, config: MappingConfig) -> dict[str, Any]:
    times: dict[str, list[int]] = {topic: [] for topic in reader.topics}
    for message in reader.messages():
        times[message.topic].append(message.log_time_ns)
    facts: dict[str, Any] = {
        "bag": str(bag),
        "start_s": round(reader.start_ns * 1e-9, 3),
        "duration_s": round((reader.end_ns - reader.start_ns) * 1e-9, 3),
        "topics": {
            t: _rate_facts(times[t], info.msg_type, reader.start_ns)
            for t, info in sorted(reader.topics.items())
        },
    }
    for topic in (LIDAR_PACKETS, POINTS, FIX, IMU):
        if topic in reader.topics:
            require_topic(reader, topic, types_of(topic))
    if LIDAR_PACKETS in reader.topics:
        require_topic(reader, METADATA, MESSAGE_TYPES[METADATA])
        facts["lidar"] = _packet_facts(reader, str(read_metadata(reader)), config.decode)
    if FIX in reader.topics:
        facts["gnss"] = _gnss_facts(reader, config.gnss)
    if IMU in reader.topics:
        stamped = ((m.log_time_ns, reader.deserialize(m)) for m in reader.messages({IMU}))
        differences = [log - stamp_ns(imu.header.stamp) for log, imu in stamped]
        facts["imu"] = {"clock_offset_s": _offset(differences)}
    facts["warnings"] = _warnings(facts)
    return facts


def _warnings(facts: dict[str, Any]) -> list[str]:
    topics, warnings = facts["topics"], []
    lidar = facts.get("lidar", {})
    if lidar.get("lost"):
        share = lidar["lost"] / (lidar["packets"] + lidar["lost"])
        warnings.append(f"{lidar['lost']} LiDAR packets lost ({share:.1%})")
    if abs(lidar.get("clock_offset_s") or 0.0) > 1.0:
        warnings.append(
            f"LiDAR clock is {lidar['clock_offset_s']} s off the log time; "
            "set decode.time_base or decode.time_offset_ns"
        )
    warnings += [
        f"{t}: {f['gaps']} gaps, the longest {f['longest_gap_s']} s"
        for t, f in topics.items()
        if f.get("gaps")
    ]
    return warnings


def describe(facts: dict[str, Any]) -> str:
    """Write the facts of :func:`inspect_bag` as one screen for people: the verdict first."""
    lines = [f"{facts['bag']}: {facts['duration_s']} s", f"verdict: {facts['verdict'].upper()}"]
    lines += [f"  why not: {text}" for text in facts["forbids"]]
    lines += [f"  care: {text}" for text in facts["cares"]]
    lines += [f"  taken as {ours}: {theirs}" for theirs, ours in facts["taken_as"].items()]
    lines.append("topics:")
    for topic, values in facts["topics"].items():
        rate = f", {values['rate_hz']} Hz" if "rate_hz" in values else ""
        lines.append(f"  {topic}  {values['count']} {values['type']}{rate}")
    for name in ("lidar", "gnss", "imu"):
        listed = ", ".join(f"{key} {value}" for key, value in facts.get(name, {}).items())
        lines += [f"{name}: {listed}"] if listed else []
    return "\n".join(lines)
