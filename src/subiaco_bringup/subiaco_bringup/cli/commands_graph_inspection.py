"""Verbs that show a running graph: nodes, topics, parameters and frames, without the ``ros2`` command."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any

import typer

from subiaco_bringup.cli.options import AsJson, print_json
from subiaco_geo.errors import InputError

Domain = Annotated[
    int | None,
    typer.Option(
        "--domain",
        min=0,
        max=232,
        metavar="N",
        help="ROS domain to inspect [default: ROS_DOMAIN_ID, or 0]."
        " 'subiaco graph mapping -v' says its domain.",
    ),
]
Seconds = Annotated[
    float, typer.Option("--seconds", min=0.0, max=60.0, help="Time over which rates are counted [s].")
]


def ask(request: Mapping[str, Any], domain: int | None) -> dict[str, Any]:
    """Return what a domain answers to a request of :mod:`subiaco_bringup.graph_inspection`."""
    from subiaco_bringup.environment import node_environment
    from subiaco_bringup.graph_inspection import inspect

    with node_environment(shared=True) as environment:
        chosen = {} if domain is None else {"ROS_DOMAIN_ID": str(domain)}
        return inspect({**environment, **chosen}, request)


def columns(rows: Iterable[Sequence[str]]) -> str:
    """Return rows of cells as aligned text."""
    cells = [list(row) for row in rows]
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))] if cells else []
    lines = ("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in cells)
    return "\n".join(lines)


def quality_text(ends: Sequence[Mapping[str, Any]]) -> str:
    """Say what publishers or subscriptions offer or ask for, e.g. ``reliable, latched``."""
    kinds = {"best_effort": "best effort", "transient_local": "latched"}
    found = {
        ", ".join(
            kinds.get(end[name], end[name])
            for name in ("reliability", "durability")
            if end[name] != "volatile"
        )
        for end in ends
    }
    return " / ".join(sorted(found))


def rate_text(facts: Mapping[str, Any]) -> str:
    """Say how often a topic is published, empty where it was not counted."""
    return "" if "rate_hz" not in facts else f"{facts['rate_hz']:.1f} Hz"


def graph_text(found: Mapping[str, Any]) -> str:
    """Return nodes and topics as text."""
    if not found["nodes"]:
        return "no node runs in this ROS domain; give --domain N, or ROS_DOMAIN_ID=N, for another one"
    nodes = [("NODE", "STATE")] + [(name, found["states"].get(name, "")) for name in found["nodes"]]
    topics = [("TOPIC", "TYPE", "PUBLISHERS", "SUBSCRIPTIONS", "QUALITY OF SERVICE", "RATE")]
    for name, facts in found["topics"].items():
        if facts["publishers"] or facts["subscriptions"]:
            row = (str(len(facts["publishers"])), str(len(facts["subscriptions"])))
            offered = quality_text(facts["publishers"] or facts["subscriptions"])
            topics.append((name, facts["type"], *row, offered, rate_text(facts)))
    services = [("SERVICE", "TYPE"), *found["services"].items()]
    return "\n\n".join(columns(rows) for rows in (nodes, topics, services) if len(rows) > 1)


def topic_text(name: str, facts: Mapping[str, Any]) -> str:
    """Return everything about one topic as text."""
    lines = [f"{name}: {facts['type']}"]
    if "rate_hz" in facts:
        lines.append(f"{facts['rate_hz']:.1f} messages a second, {facts['kilobytes_s']:.0f} kB/s")
    rows = [("", "NODE", "RELIABILITY", "DURABILITY", "DEPTH")]
    for side in ("publishers", "subscriptions"):
        for end in facts[side]:
            depth = str(end["depth"]) if end["depth"] else "unknown"
            rows.append((side[:-1], end["node"], end["reliability"], end["durability"], depth))
    return "\n".join([*lines, columns(rows)])


def node_text(name: str, found: Mapping[str, Any]) -> str:
    """Return the topics and services of one node as text."""
    state = found["states"].get(name)
    lines = [f"{name}: {state}" if state else name]
    rows = []
    for side in ("publishers", "subscriptions"):
        for topic, facts in found["topics"].items():
            mine = [end for end in facts[side] if end["node"] == name]
            if mine:
                rows.append((side[:-1], topic, facts["type"], quality_text(mine), rate_text(facts)))
    return "\n".join([*lines, columns([("", "TOPIC", "TYPE", "QUALITY OF SERVICE", "RATE"), *rows])])


def frames_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return transforms as an indented tree."""
    children: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        children.setdefault(row["parent"], []).append(row)
    roots = sorted(set(children) - {row["child"] for row in rows})

    def below(frame: str, depth: int) -> list[str]:
        lines = []
        for row in children.get(frame, []):
            how = "fixed" if row["fixed"] else f"{row['rate_hz']:.1f} Hz"
            place = ", ".join(f"{value:.2f}" for value in row["position"])
            lines.append(f"{'  ' * depth}{row['child']}  ({how}; at {place} m in {frame})")
            lines += below(row["child"], depth + 1)
        return lines

    if not rows:
        return "no transform came on /tf or /tf_static; give --seconds, or --domain N for another domain"
    return "\n".join(line for root in roots for line in [root, *below(root, 1)])


def list_graph(domain: Domain = None, seconds: Seconds = 2.0, as_json: AsJson = False) -> None:
    """Show the nodes, topics and services that run in a ROS domain, with quality of service and rates.

    Example: subiaco graph list --domain 42
    """
    found = ask({"what": "graph", "seconds": seconds}, domain)
    _show(found, graph_text(found), as_json)


def info(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A node or a topic, e.g. /odometry.")],
    domain: Domain = None,
    seconds: Seconds = 2.0,
    as_json: AsJson = False,
) -> None:
    """Show one topic (publishers, subscriptions, quality of service, rate) or the topics of one node.

    A name that is a node and a topic shows both.

    Example: subiaco graph info /points_deskewed
    """
    name = f"/{name.lstrip('/')}"
    found = ask({"what": "graph", "seconds": seconds, "topics": []}, domain)
    texts = []
    if name in found["topics"]:
        texts.append(topic_text(name, found["topics"][name]))
    if name in found["nodes"]:
        texts.append(node_text(name, found))
    if not texts:
        raise InputError(f"{name}: no such node or topic in this domain; 'subiaco graph list' shows them")
    own = {"topic": found["topics"].get(name), "node": name if name in found["nodes"] else None}
    _show(own, "\n\n".join(texts), as_json)


def param(
    node: Annotated[str, typer.Argument(metavar="NODE", help="Name of the node, e.g. /odometry.")],
    prefix: Annotated[
        str, typer.Argument(metavar="[PREFIX]", help="Only parameters that begin so, e.g. gnss.")
    ] = "",
    domain: Domain = None,
    as_json: AsJson = False,
) -> None:
    """Show the parameters of a node: value, bounds, and what each means.

    Example: subiaco graph param /odometry odometry.voxel
    """
    node = f"/{node.lstrip('/')}"
    rows = ask({"what": "parameters", "node": node}, domain)["parameters"]
    chosen = [row for row in rows if row["name"].startswith(prefix)]
    if not chosen:
        raise InputError(f"{node}: no parameter begins with {prefix}")
    table = [("PARAMETER", "VALUE", "CHANGE", "MEANING")]
    for row in chosen:
        bounds = f" ({row['constraints']})" if row["constraints"] else ""
        when = "at configuration" if row["read_only"] else "any time"
        table.append((row["name"], str(row["value"]), when, row["description"] + bounds))
    _show({"parameters": chosen}, columns(table), as_json)


def tf(domain: Domain = None, seconds: Seconds = 3.0, as_json: AsJson = False) -> None:
    """Show the tree of frames: what /tf and /tf_static say, with rates and positions.

    Example: subiaco graph tf
    """
    found = ask({"what": "frames", "seconds": max(seconds, 0.1)}, domain)
    _show(found, frames_text(found["frames"]), as_json)


def _show(value: Mapping[str, Any], text: str, as_json: bool) -> None:
    if as_json:
        print_json(value)
    else:
        sys.stdout.write(text + "\n")


def register(group: typer.Typer) -> None:
    """Add these verbs to ``subiaco graph``."""
    group.command("list", short_help="Show nodes, topics and services of a running graph.")(list_graph)
    group.command("info", short_help="Show one topic or node of a running graph.")(info)
    group.command("param", short_help="Show the parameters of a running node.")(param)
    group.command("tf", short_help="Show the tree of frames of a running graph.")(tf)
