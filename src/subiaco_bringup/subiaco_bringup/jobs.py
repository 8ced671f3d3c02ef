"""The jobs of the command line that run through the node graph."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

from subiaco_bringup.environment import node_environment
from subiaco_bringup.graph import GraphSpec, change_graph, mapping_graph
from subiaco_bringup.supervisor import Report, Supervisor
from subiaco_geo.atomic import refuse_existing
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError

LOGGER = logging.getLogger(__name__)


def _run(graph: GraphSpec, progress: Report | None) -> None:
    with node_environment() as environment:
        LOGGER.info("to watch the graph, use its domain: ROS_DOMAIN_ID=%s", environment["ROS_DOMAIN_ID"])
        Supervisor(graph, environment, progress).run()


def run_mapping_graph(
    bags: Sequence[Path],
    output: Path,
    config_files: Iterable[Path] = (),
    settings: Iterable[str] = (),
    *,
    rate: float = 0.0,
    overwrite: bool = False,
    progress: Report | None = None,
) -> None:
    """Replay bags of one epoch through the ROS 2 nodes into a map directory.

    The nodes run in a ROS domain of their own; set ``ROS_DOMAIN_ID`` to choose it, e.g. for a viewer.

    Parameters
    ----------
    bags : sequence of Path
        One a sequence, in order.
    output : Path
        Map directory to write.
    config_files, settings
        As for ``subiaco map``.
    rate : float
        Replay speed; 0 is as fast as the nodes go.
    overwrite : bool
    progress : callable, optional
        Told ``(stage, fraction)``.

    Raises
    ------
    InputError
        A bag or the configuration is at fault, or the output exists.
    SubiacoError
        A node failed.
    """
    from subiaco_geo.bags import find_storage
    from subiaco_mapping.config import MappingConfig

    if not bags:
        raise InputError("no bag given; name at least one rosbag2 folder, .mcap or simulated epoch folder")
    files, given = list(config_files), list(settings)
    load_config(MappingConfig, files, given)
    refuse_existing(Path(output), overwrite)
    for bag in bags:
        find_storage(Path(bag))
    _run(mapping_graph(bags, output, files, given, rate=rate, overwrite=overwrite), progress)


def run_change_graph(
    before: Path,
    after: Path,
    output: Path,
    config_files: Iterable[Path] = (),
    settings: Iterable[str] = (),
    *,
    overwrite: bool = False,
    progress: Report | None = None,
) -> None:
    """Compare two maps through the change node into a change directory.

    Parameters and errors as for :func:`run_mapping_graph`; RegistrationError
    where the maps cannot be brought together.
    """
    from subiaco_change.config import ChangeConfig

    files, given = list(config_files), list(settings)
    load_config(ChangeConfig, files, given)
    refuse_existing(Path(output), overwrite)
    _run(change_graph(before, after, output, files, given, overwrite=overwrite), progress)
