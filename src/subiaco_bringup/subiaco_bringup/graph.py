"""The node graphs, described once: launch files and our supervisor both read them from here."""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from subiaco_change.request import ChangeRequest
from subiaco_geo.atomic import whole_file
from subiaco_geo.config import merge, parse_setting, read_parameters
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.settings import departures
from subiaco_mapping.request import MappingRequest

#: Begins the arguments of one node of a process of several: name, package, executable, its own arguments.
PART = "--part"


@dataclass(frozen=True)
class NodeSpec:
    """One process of a graph.

    Parameters
    ----------
    name : str
        Node name.
    package, executable : str
        As ``ros2 run`` takes them; the module is ``PACKAGE.nodes.EXECUTABLE``.
    parameters : mapping
        Nested parameters, configuration and the node's own alike.
    remappings : tuple of (from, to)
    principal : bool
        The job is done when this node has ended.
    restart : bool
        It can be started again after a crash without harm.
    essential : bool
        The job has failed where this node has; the others go on without any other.
    grace : float
        Seconds that it needs to put everything away when interrupted.
    companion : bool
        The job does not wait for its end.
    namespace : str
        Of the node and of all its relative topics.
    parts : tuple of NodeSpec
        Nodes that run in this one process, which then is no node itself.
    """

    name: str
    package: str
    executable: str
    parameters: Mapping[str, Any]
    remappings: tuple[tuple[str, str], ...] = ()
    principal: bool = False
    restart: bool = False
    essential: bool = True
    grace: float = 10.0
    companion: bool = False
    namespace: str = ""
    parts: tuple[NodeSpec, ...] = ()

    def arguments(self) -> list[str]:
        """Return the arguments after the executable; the parameters go into a file."""
        if self.parts:
            return [
                word for p in self.parts for word in (PART, p.name, p.package, p.executable, *p.arguments())
            ]
        words = ["--ros-args", "-r", f"__node:={self.name}"]
        if self.namespace:
            words += ["-r", f"__ns:=/{self.namespace.strip('/')}"]
        for source, target in self.remappings:
            words += ["-r", f"{source}:={target}"]
        return [*words, "--params-file", str(parameter_file(self.parameters))]


@dataclass(frozen=True)
class GraphSpec:
    """The processes of one job."""

    name: str
    nodes: tuple[NodeSpec, ...]


def deployed(
    graph: GraphSpec, *, namespace: str = "", autostart: bool = True, use_sim_time: bool | None = None
) -> GraphSpec:
    """Return a graph under a namespace, started or not, on another clock.

    Parameters
    ----------
    namespace : str
        Of every node, so that graphs of several LiDARs run side by side.
    autostart : bool
        Whether nodes configure and activate themselves; else ``ros2 lifecycle set`` does.
    use_sim_time : bool, optional
        Follow ``/clock``; as the graph says where left out.
    """
    given: dict[str, Any] = {} if autostart else {"autostart": False}
    if use_sim_time is not None:
        given["use_sim_time"] = use_sim_time
    nodes = (
        replace(node, namespace=namespace, parameters={**node.parameters, **given}) for node in graph.nodes
    )
    return replace(graph, nodes=tuple(nodes))


def with_foxglove(graph: GraphSpec, port: int, host: str = "127.0.0.1") -> GraphSpec:
    """Return a graph with a node that serves its topics to Foxglove; the job goes on without that node."""
    clock = any(node.parameters.get("use_sim_time") for node in graph.nodes)
    parameters = {"host": host, "port": port, "use_sim_time": clock}
    node = NodeSpec(
        "foxglove", "subiaco_bringup", "foxglove_node", parameters, essential=False, companion=True
    )
    return replace(graph, nodes=(*graph.nodes, node))


def in_one_process(graph: GraphSpec) -> GraphSpec:
    """Return a graph whose nodes share one process; companions keep their own.

    That takes less memory; one of the nodes works at a time.
    """
    parts = tuple(node for node in graph.nodes if not node.companion)
    grace = max(node.grace for node in parts)
    process = NodeSpec(
        graph.name, "subiaco_bringup", "composed_nodes", {}, principal=True, grace=grace, parts=parts
    )
    return replace(graph, nodes=(process, *(node for node in graph.nodes if node.companion)))


def ros_value(name: str, value: Any) -> Any:
    """Return a value in a form that ROS parameters can hold, None where it has to be left out.

    ROS lists hold one type, so whole numbers among fractions become fractions.
    """
    if value is None or value in ([], ()):
        return None
    if isinstance(value, Mapping):
        return ros_parameters(value, name) or None
    if isinstance(value, (list, tuple)):
        if any(isinstance(item, (list, tuple, Mapping)) for item in value):
            raise InputError(f"{name}: a list of lists cannot be a ROS parameter; use the in-process verb")
        kinds = {type(item) for item in value}
        return [float(item) for item in value] if kinds == {int, float} else list(value)
    return str(value) if isinstance(value, Path) else value


def ros_parameters(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested parameters without what ROS cannot hold (nothing, empty lists)."""
    pairs = ((key, ros_value(f"{prefix}.{key}".lstrip("."), value)) for key, value in values.items())
    return {key: value for key, value in pairs if value is not None}


def parameter_file(parameters: Mapping[str, Any]) -> Path:
    """Write parameters in ROS form; equal parameters give the same file.

    One merged file a node, because ROS keeps the earlier of two values where
    a later file or ``-p`` gives a fraction for what was a whole number.
    """
    document = {"/**": {"ros__parameters": ros_parameters(parameters)}}
    text = yaml.safe_dump(document, sort_keys=True)
    name = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = _private_folder() / f"{name}.yaml"
    if path.is_symlink() or not path.is_file() or path.read_text() != text:
        with whole_file(path) as partial:
            partial.write_text(text)
    return path


def _private_folder() -> Path:
    """Return the folder of parameter files, which no other user may write into."""
    folder = Path(tempfile.gettempdir()) / f"subiaco-parameters-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise SubiacoError(
            f"{folder}: belongs to another user, who could change the parameters of the nodes;"
            " remove it, or set TMPDIR to a folder of your own"
        )
    if status.st_mode & 0o077:
        folder.chmod(0o700)
    return folder


def merged_config(files: Iterable[Path], settings: Iterable[str]) -> dict[str, Any]:
    """Merge configuration files and ``key=value`` settings as the command line does."""
    values: dict[str, Any] = {}
    for path in files:
        values = merge(values, read_parameters(Path(path)))
    for setting in settings:
        values = merge(values, parse_setting(setting))
    return values


def mapping_graph(request: MappingRequest, *, rate: float = 0.0) -> GraphSpec:
    """Describe the replay of bags through odometry and pose graph into a map directory.

    The nodes use the replay's clock and end with it.

    Parameters
    ----------
    request : MappingRequest
    rate : float
        Replay speed; 0 is as fast as the nodes go.
    """
    request = request.resolved()
    config = departures(request.config)
    bags = [str(bag) for bag in request.bags]
    common = {**config, "use_sim_time": True, "exit_at_end": True}
    odometry = {**common, "consumers": ["pose_graph"]}
    pose_graph = {
        **common, "output_directory": str(request.output), "bags": bags, "overwrite": request.overwrite,
    }  # fmt: skip
    consumers = (
        NodeSpec("odometry", "subiaco_mapping", "odometry_node", odometry),
        NodeSpec("pose_graph", "subiaco_mapping", "pose_graph_node", pose_graph, principal=True),
    )
    replay = {
        "bags": bags,
        "consumers": [node.name for node in consumers],
        "rate": float(rate),
        "names": config.get("topics", {}),
    }
    return GraphSpec("mapping", (NodeSpec("replay", "subiaco_mapping", "replay_node", replay), *consumers))


def change_graph(request: ChangeRequest) -> GraphSpec:
    """Describe the comparison of two maps into a change directory."""
    parameters = {"request": request.resolved().to_json(), "exit_at_end": True}
    node = NodeSpec("change", "subiaco_bringup", "change_node", parameters, principal=True)
    return GraphSpec("change", (node,))


def process_command(node: NodeSpec) -> list[str]:
    """Return the command that starts a node with this interpreter, no ``ros2`` tools needed."""
    return [sys.executable, "-m", f"{node.package}.nodes.{node.executable}", *node.arguments()]
