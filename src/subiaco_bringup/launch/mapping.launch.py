"""Replay bags of one epoch into a map directory.

ros2 launch subiaco_bringup mapping.launch.py bag:="bags/demo/before" output:=out/before
"""

from pathlib import Path

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.graph import GraphSpec, mapping_graph
from subiaco_bringup.launching import launch_description, split_paths, split_words
from subiaco_geo.config import load_config
from subiaco_mapping.config import MappingConfig

ARGUMENTS = (
    ("bag", None, "bags of one epoch, separated by blanks; one a sequence"),
    ("output", None, "map directory to write"),
    ("config", "", "configuration files after the shipped ones, separated by blanks"),
    ("set", "", "key=value settings, separated by blanks"),
    ("rate", "0.0", "replay speed; 0 is as fast as the nodes go"),
    ("overwrite", "false", "replace an existing map directory"),
)


def describe(values: dict[str, str]) -> GraphSpec:
    """Describe the graph that the arguments ask for; a setting that is none is refused before it starts."""
    files, settings = (
        config_files("mapping", tuple(split_paths(values["config"]))),
        split_words(values["set"]),
    )
    load_config(MappingConfig, files, settings)
    return mapping_graph(
        split_paths(values["bag"]),
        Path(values["output"]),
        files,
        settings,
        rate=float(values["rate"]),
        overwrite=values["overwrite"].lower() == "true",
    )


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return launch_description(ARGUMENTS, describe)
