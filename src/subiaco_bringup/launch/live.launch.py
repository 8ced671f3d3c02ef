"""Record, watch and map a live vehicle into one folder.

ros2 launch subiaco_bringup live.launch.py output:=surveys/2025-03-14_am config:=config/drivers/ublox.yaml
"""

from pathlib import Path

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.graph import GraphSpec
from subiaco_bringup.jobs import require_live_config
from subiaco_bringup.launching import launch_description, split_paths, split_words
from subiaco_bringup.live_graph import live_graph
from subiaco_bringup.recording import parse_remapping

ARGUMENTS = (
    ("output", None, "folder of the drive to write"),
    ("config", "", "configuration files after the shipped ones, separated by blanks"),
    ("set", "", "key=value settings, separated by blanks"),
    ("remap", "", "OURS:=DRIVERS pairs, separated by blanks"),
    ("route", "", "planned route: GeoJSON, or CSV with lat and lon"),
    ("record", "true", "false where somebody else records"),
)


def describe(values: dict[str, str]) -> GraphSpec:
    """Describe the graph that the arguments ask for; a setting that is none is refused before it starts."""
    files, settings = (
        config_files("mapping", tuple(split_paths(values["config"]))),
        split_words(values["set"]),
    )
    require_live_config(files, settings)
    return live_graph(
        Path(values["output"]),
        files,
        settings,
        remappings=[parse_remapping(word) for word in split_words(values["remap"])],
        route=Path(values["route"]) if values["route"] else None,
        record=values["record"].lower() == "true",
        sim_time=values["use_sim_time"] == "true",
    )


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return launch_description(ARGUMENTS, describe)
