"""Compare two maps into a change directory.

ros2 launch subiaco_bringup change.launch.py before:=out/before after:=out/after output:=out/change
"""

from pathlib import Path

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.graph import GraphSpec, change_graph
from subiaco_bringup.launching import launch_description, split_paths, split_words
from subiaco_change.config import ChangeConfig
from subiaco_geo.config import load_config

ARGUMENTS = (
    ("before", None, "map directory or cloud of the earlier epoch"),
    ("after", None, "map directory or cloud of the later epoch"),
    ("output", None, "change directory to write"),
    ("config", "", "configuration files after the shipped ones, separated by blanks"),
    ("set", "", "key=value settings, separated by blanks"),
    ("overwrite", "false", "replace an existing change directory"),
)


def describe(values: dict[str, str]) -> GraphSpec:
    """Describe the graph that the arguments ask for; a setting that is none is refused before it starts."""
    files, settings = config_files("change", tuple(split_paths(values["config"]))), split_words(values["set"])
    load_config(ChangeConfig, files, settings)
    return change_graph(
        Path(values["before"]),
        Path(values["after"]),
        Path(values["output"]),
        files,
        settings,
        overwrite=values["overwrite"].lower() == "true",
    )


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return launch_description(ARGUMENTS, describe)
