"""The jobs of the command line that run through the node graph."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from subiaco_bringup.domain import require_free_domain
from subiaco_bringup.environment import node_environment
from subiaco_bringup.graph import (
    GraphSpec,
    change_graph,
    deployed,
    in_one_process,
    mapping_graph,
    merged_config,
    with_foxglove,
)
from subiaco_bringup.supervisor import Death, OnStatus, Report, Supervisor
from subiaco_change.request import ChangeRequest
from subiaco_geo.atomic import refuse_existing
from subiaco_geo.config import validate
from subiaco_geo.errors import InputError
from subiaco_mapping.request import MappingRequest

LOGGER = logging.getLogger(__name__)


def _run(graph: GraphSpec, progress: Report | None, *, replays: bool = False) -> None:
    with node_environment() as environment:
        if replays and "ROS_DOMAIN_ID" in os.environ:
            require_free_domain(environment)
        LOGGER.info("to watch the graph, use its domain: ROS_DOMAIN_ID=%s", environment["ROS_DOMAIN_ID"])
        Supervisor(graph, environment, progress).run()


def run_mapping_graph(
    request: MappingRequest,
    *,
    rate: float = 0.0,
    foxglove_port: int | None = None,
    one_process: bool = False,
    progress: Report | None = None,
) -> None:
    """Replay bags of one epoch through the ROS 2 nodes into a map directory.

    The nodes run in a ROS domain of their own; set ``ROS_DOMAIN_ID`` to choose it, e.g. for a viewer.

    Parameters
    ----------
    request : MappingRequest
        Its bags are one sequence each, in order.
    rate : float
        Replay speed; 0 is as fast as the nodes go.
    foxglove_port : int, optional
        Port on which Foxglove can connect from this computer.
    one_process : bool
        The nodes share a process, which takes less memory; one of them works at a time.
    progress : callable, optional
        Told ``(stage, fraction)``.

    Raises
    ------
    InputError
        A bag is at fault, the output exists, or other nodes use the chosen ROS domain for sensor data.
    SubiacoError
        A node failed.
    """
    from subiaco_mapping.named_bags import open_bag
    from subiaco_mapping.pipeline import lidar_topic

    refuse_existing(request.output, request.overwrite)
    for bag in request.bags:
        with open_bag(bag, request.config.topics) as reader:
            lidar_topic(reader)
    graph = mapping_graph(request, rate=rate)
    graph = graph if foxglove_port is None else with_foxglove(graph, foxglove_port)
    _run(in_one_process(graph) if one_process else graph, progress, replays=True)


def run_change_graph(request: ChangeRequest, progress: Report | None = None) -> None:
    """Compare two maps through the change node into a change directory.

    Raises
    ------
    InputError, RegistrationError
        As for :func:`subiaco_change.job.run_change`, which the node runs.
    SubiacoError
        The node failed.
    """
    refuse_existing(request.output, request.overwrite)
    _run(change_graph(request), progress)


def require_live_config(config_files: Iterable[Path], settings: Iterable[str]) -> None:
    """Refuse a configuration that the recorder or the mapping nodes do not know.

    Raises
    ------
    InputError
        Names the setting at fault.
    """
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.recording.config import RecordingConfig

    values = merged_config(config_files, settings)
    recorder = {"record": values.pop("record", {})}
    validate(RecordingConfig, recorder, "configuration")
    validate(MappingConfig, values, "configuration")


def run_live_graph(
    output: Path,
    config_files: Iterable[Path] = (),
    settings: Iterable[str] = (),
    *,
    remappings: Sequence[tuple[str, str]] = (),
    route: Path | None = None,
    record: bool = True,
    sim_time: bool = False,
    namespace: str = "",
    foxglove_port: int | None = None,
    progress: Report | None = None,
    on_status: OnStatus | None = None,
) -> None:
    """Record, watch and map live topics until interrupted: that is how a live survey ends.

    The drivers are looked for in the caller's ROS domain.

    Parameters
    ----------
    output : Path
        Folder of the drive; see :func:`subiaco_bringup.live_graph.live_graph` for the rest.
    namespace : str
        Of all nodes and topics; one for each LiDAR where a vehicle has several.
    foxglove_port : int, optional
        Port on which Foxglove can connect from this computer.
    on_status : callable, optional
        Told what the monitor sees, twice a second.

    Raises
    ------
    InputError
        The configuration or the route is at fault, or the folder holds something.
    SubiacoError
        A node that the survey cannot do without failed again and again, or one could not put away
        what it had; what the others wrote stands.
    """
    from subiaco_bringup.live_graph import MAP, SEQUENCE, live_graph
    from subiaco_mapping.health_monitor.files import MANIFEST, add_stretches
    from subiaco_mapping.health_monitor.routes import read_route

    files, given = list(config_files), list(settings)
    require_live_config(files, given)
    if route is not None:
        read_route(route)
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output}: exists already; give every drive a folder of its own")
    graph = live_graph(
        output, files, given, remappings=remappings, route=route, record=record, sim_time=sim_time
    )
    graph = graph if foxglove_port is None else with_foxglove(graph, foxglove_port)
    graph = deployed(graph, namespace=namespace)
    output.mkdir(parents=True, exist_ok=True)
    with node_environment(shared=True) as environment:
        supervisor = Supervisor(graph, environment, progress, on_status=on_status)
        try:
            with suppress(KeyboardInterrupt):
                supervisor.run()
        finally:
            deaths = [_stretch(death) for death in supervisor.deaths]
            for folder in (output, output / MAP):
                add_stretches(folder / MANIFEST, SEQUENCE, "node_died", deaths)
        supervisor.require_whole()


def _stretch(death: Death) -> dict[str, Any]:
    seconds = round(death.time_ns * 1e-9, 3)
    return {
        "start_s": seconds,
        "end_s": seconds,
        "scans": 0,
        "length_m": 0.0,
        "source": death.node,
        "detail": death.how,
    }
