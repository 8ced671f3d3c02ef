"""Record the topics of a live vehicle.

ros2 launch subiaco_bringup record.launch.py output:=bags/2025-03-14_am
"""

from pathlib import Path

from launch import LaunchDescription
from subiaco_bringup.defaults import config_files
from subiaco_bringup.graph import GraphSpec
from subiaco_bringup.launching import launch_description, split_paths, split_words
from subiaco_bringup.recording import parse_remapping, record_graph
from subiaco_geo.config import load_config
from subiaco_mapping.recording.config import RecordingConfig

ARGUMENTS = (
    ("output", None, "bag folder to write; an existing one is gone on with"),
    ("config", "", "configuration files, separated by blanks"),
    ("set", "", "key=value settings, separated by blanks"),
    ("remap", "", "OURS:=SOURCE, separated by blanks: where a topic comes from"),
    ("duration", "0.0", "end after so many seconds; 0 until Ctrl-C"),
)


def describe(values: dict[str, str]) -> GraphSpec:
    """Describe the graph that the arguments ask for; a setting that is none is refused before it starts."""
    files, settings = config_files("record", tuple(split_paths(values["config"]))), split_words(values["set"])
    load_config(RecordingConfig, files, settings)
    return record_graph(
        Path(values["output"]),
        files,
        settings,
        remappings=[parse_remapping(text) for text in split_words(values["remap"])],
        duration=float(values["duration"]),
    )


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return launch_description(ARGUMENTS, describe)
