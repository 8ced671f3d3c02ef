"""The recorder as a process: its place in a graph, and the job of ``subiaco record``."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from subiaco_bringup.environment import node_environment
from subiaco_bringup.graph import GraphSpec, NodeSpec, merged_config
from subiaco_bringup.supervisor import Supervisor
from subiaco_geo.atomic import refuse_existing
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError

#: Closing a recording takes the time that the disk needs for what waits in memory.
GRACE = 60.0


def recorder_spec(
    config: Mapping[str, Any],
    output: Path,
    *,
    remappings: Sequence[tuple[str, str]] = (),
    duration: float = 0.0,
    principal: bool = False,
) -> NodeSpec:
    """Describe the recorder; started again after a crash it goes on with a new file.

    Parameters
    ----------
    config : mapping
        May hold more than the ``record`` slice; the recorder gets that alone.
    output : Path
        Bag folder.
    remappings : sequence of (our name, source)
        Where a topic comes from; the bag gets our name.
    duration : float
        End after so long [s]; 0 never.
    principal : bool
        The job is done when the recorder has ended; any other stays when the disk is full, to say so.
    """
    parameters = {
        "record": {"exit_when_stopped": principal, **config.get("record", {})},
        "output": str(Path(output).resolve()),
        "resume": True,
        "duration": float(duration),
    }
    names = tuple((ours.lstrip("/"), source) for ours, source in remappings)
    return NodeSpec(
        "recorder", "subiaco_mapping", "recorder_node", parameters, names, principal, restart=True
    )


def parse_remapping(text: str) -> tuple[str, str]:
    """Turn ``/gnss/fix:=/ublox/fix`` into a pair."""
    ours, separator, source = text.partition(":=")
    if not separator or not ours or not source:
        raise InputError(f"--remap {text}: expected OUR_TOPIC:=SOURCE, e.g. /gnss/fix:=/ublox/fix")
    return ours, source


def record_graph(
    output: Path,
    config_files: Iterable[Path] = (),
    settings: Iterable[str] = (),
    *,
    remappings: Sequence[tuple[str, str]] = (),
    duration: float = 0.0,
) -> GraphSpec:
    """Describe a recording with nothing around it."""
    config = merged_config(config_files, settings)
    node = recorder_spec(config, output, remappings=remappings, duration=duration, principal=True)
    return GraphSpec("record", (node,))


def run_recording(
    output: Path,
    config_files: Iterable[Path] = (),
    settings: Iterable[str] = (),
    *,
    remappings: Sequence[tuple[str, str]] = (),
    duration: float = 0.0,
    resume: bool = False,
) -> tuple[dict[str, Any], list[str]]:
    """Record until interrupted, which is how a recording ends, or until the time is up.

    A recorder that crashes is started again and goes on with a new file. The nodes of the vehicle are
    looked for in the caller's ROS domain.

    Returns
    -------
    dict
        What ``recording.yaml`` says: files, messages and losses by topic.
    list of str
        Essential sensors of which nothing was recorded.

    Raises
    ------
    InputError
        The configuration is at fault, the folder exists, or the disk is full.
    SubiacoError
        The recorder failed.
    """
    from subiaco_mapping.recording.config import RecordingConfig
    from subiaco_mapping.recording.recorder import COUNTS_NAME, RESUME_REMEDY

    files, given = list(config_files), list(settings)
    config = load_config(RecordingConfig, files, given).record
    fresh = not (resume and output.is_dir())
    if fresh:
        refuse_existing(output, overwrite=False, remedy=RESUME_REMEDY)
    graph = record_graph(output, files, given, remappings=remappings, duration=duration)
    with node_environment(shared=True) as environment:
        supervisor = Supervisor(graph, environment, grace=GRACE)
        with suppress(KeyboardInterrupt):
            supervisor.run()
        supervisor.require_whole()
    counts = output / COUNTS_NAME
    facts = dict(yaml.safe_load(counts.read_text("utf-8"))) if counts.is_file() else {}
    if fresh and counts.is_file() and not facts.get("messages"):
        shutil.rmtree(output)  # a folder without a message is no recording
    topics = facts.get("topics", {})
    return facts, config.absent({name: values["received"] for name, values in topics.items()})
