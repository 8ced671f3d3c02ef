"""Replay bags of one epoch into a map directory.

ros2 launch subiaco_bringup mapping.launch.py bag:="bags/demo/before" output:=out/before
"""

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.graph import GraphSpec, mapping_graph
from subiaco_bringup.launching import (
    launch_description,
    request_arguments,
    request_options,
    split_paths,
    split_words,
)
from subiaco_geo.config import load_config
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.request import MappingRequest

ARGUMENTS = (
    ("bag", None, "bags of one epoch, separated by blanks; one a sequence"),
    *request_arguments(MappingRequest, ("output", "overwrite")),
    ("rate", "0.0", "replay speed; 0 is as fast as the nodes go"),
)


def describe(values: dict[str, str]) -> GraphSpec:
    """Describe the graph that the arguments ask for; what is no request is refused before it starts."""
    files = config_files("mapping", tuple(split_paths(values["config"])))
    config = load_config(MappingConfig, files, split_words(values["set"]))
    options = request_options(MappingRequest, values)
    request = MappingRequest.of(bags=split_paths(values["bag"]), config=config, **options)
    return mapping_graph(request, rate=float(values["rate"]))


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return launch_description(ARGUMENTS, describe)
