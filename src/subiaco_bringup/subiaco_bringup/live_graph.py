"""The graph in the vehicle: recorder, monitor, odometry and pose graph on live topics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from subiaco_bringup.graph import GraphSpec, NodeSpec, merged_config
from subiaco_bringup.recording import recorder_spec
from subiaco_geo.config import validate
from subiaco_mapping.topic_names import TopicsConfig

BAG, MAP = "bag", "map"
SEQUENCE = "live"
#: Closing a recording, and building the map of a long survey.
_RECORD_GRACE, _MAP_GRACE = 60.0, 1800.0
_LIVE_PERIOD = 0.7


def live_graph(
    output: Path,
    config_files: Iterable[Path] = (),
    settings: Iterable[str] = (),
    *,
    remappings: Sequence[tuple[str, str]] = (),
    route: Path | None = None,
    record: bool = True,
    sim_time: bool = False,
) -> GraphSpec:
    """Describe the live graph; everything of one drive lies in one folder.

    Parameters
    ----------
    output : Path
        Gets ``bag/``, ``map/``, ``manifest.yaml`` and ``quality.geojson``.
    remappings : sequence of (our name, driver's name)
        In addition to ``topics`` of the configuration.
    route : Path, optional
        Planned route.
    record : bool
        Leave the recorder out where somebody else records, or a bag is played.
    sim_time : bool
        Follow ``/clock``, as ``ros2 bag play --clock`` publishes it.
    """
    config = merged_config(config_files, settings)
    recording = {"record": config.pop("record", {})}
    topics = validate(TopicsConfig, config.get("topics", {}), "topics")
    names = (*topics.remappings(), *remappings)
    folder = Path(output).resolve()
    # A recording can be mapped afterwards: it outlives the nodes that map and watch.
    odometry = replace(_odometry(config), essential=not record)
    nodes = [_monitor(config, folder, route), odometry, _pose_graph(config, folder)]
    relative = tuple((ours.lstrip("/"), theirs) for ours, theirs in names)
    nodes = [
        replace(n, parameters={**n.parameters, "use_sim_time": sim_time}, remappings=relative) for n in nodes
    ]
    if record:
        recorder = recorder_spec(recording, folder / BAG, remappings=names)
        nodes.insert(0, replace(recorder, grace=_RECORD_GRACE))
    return GraphSpec("live", tuple(nodes))


def _monitor(config: dict[str, Any], folder: Path, route: Path | None) -> NodeSpec:
    planned = {} if route is None else {"route": str(Path(route).resolve())}
    own = {"output_directory": str(folder), "sequence": SEQUENCE, **planned}
    return NodeSpec(
        "monitor", "subiaco_mapping", "monitor_node", {**config, **own}, restart=True, essential=False
    )


def _odometry(config: dict[str, Any]) -> NodeSpec:
    parameters = {**config, "listeners": ["pose_graph", "monitor"]}
    return NodeSpec("odometry", "subiaco_mapping", "odometry_node", parameters, restart=True)


def _pose_graph(config: dict[str, Any], folder: Path) -> NodeSpec:
    own = {
        "output_directory": str(folder / MAP),
        "watch_manifest": str(folder / "manifest.yaml"),
        "live_period": _LIVE_PERIOD,
        "save_on_exit": True,
    }
    # A restarted process would have lost the drive so far, and half a map would look like a whole one.
    return NodeSpec(
        "pose_graph",
        "subiaco_mapping",
        "pose_graph_node",
        {**config, **own},
        essential=False,
        grace=_MAP_GRACE,
    )
