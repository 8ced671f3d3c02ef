"""Compare two maps into a change directory.

ros2 launch subiaco_bringup change.launch.py before:=out/before after:=out/after output:=out/change
"""

from pathlib import Path

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.graph import GraphSpec, change_graph
from subiaco_bringup.launching import (
    launch_description,
    request_arguments,
    request_options,
    split_paths,
    split_words,
)
from subiaco_change.config import ChangeConfig
from subiaco_change.job import read_transform
from subiaco_change.request import ChangeRequest
from subiaco_geo.config import load_config

ARGUMENTS = request_arguments(ChangeRequest)


def describe(values: dict[str, str]) -> GraphSpec:
    """Describe the graph that the arguments ask for; what is no request is refused before it starts."""
    options = request_options(ChangeRequest, values)
    if options.get("transform", "identity") != "identity":
        options["transform"] = read_transform(Path(options["transform"]))
    files = config_files("change", tuple(split_paths(values["config"])))
    config = load_config(ChangeConfig, files, split_words(values["set"]))
    return change_graph(ChangeRequest.of(config=config, **options))


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return launch_description(ARGUMENTS, describe)
