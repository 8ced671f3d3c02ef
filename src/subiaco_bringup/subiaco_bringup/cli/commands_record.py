"""Verbs of the vehicle's recording: record, recover."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from subiaco_bringup.cli.options import (
    AsJson,
    ConfigFiles,
    Quiet,
    Settings,
    Verbose,
    print_json,
    say,
    set_up_logging,
)
from subiaco_bringup.defaults import config_files
from subiaco_geo.errors import InputError

if TYPE_CHECKING:
    from subiaco_geo.bag_recovery import BagRecovery, FileRecovery


def _show_what_the_recorder_says(quiet: bool) -> None:
    """Show its lines as they are: here they are the progress."""
    if quiet:
        return
    logger = logging.getLogger("subiaco_bringup.supervisor")
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.INFO)


def record(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="BAG_DIR", help="rosbag2 folder to write.")
    ],
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue in an existing folder, with a new file.")
    ] = False,
    duration: Annotated[
        float, typer.Option(help="Length of the recording in seconds; 0 records until Ctrl-C.")
    ] = 0.0,
    remap: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OURS:=SOURCE",
            help="Topic of a driver that is recorded under the name that Subiaco uses; repeatable.",
        ),
    ] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Record the raw topics of a live vehicle until Ctrl-C, and report every lost message.

    Files are whole every minute and flushed four times a second: a kill or a loss of power costs less
    than a second. A disk that runs full ends the recording with every file whole. A recorder that crashes
    is started again. Exit code 2 where no LiDAR or no GNSS message came, or packets without metadata.

    Example: subiaco record -o bags/2025-03-14_am --remap /gnss/fix:=/ublox_gps_node/fix
    """
    from subiaco_bringup.recording import parse_remapping, run_recording

    set_up_logging(verbose, quiet)
    _show_what_the_recorder_says(quiet)
    facts, absent = run_recording(
        output,
        config_files("record", tuple(config or ())),
        settings or [],
        remappings=[parse_remapping(text) for text in remap or []],
        duration=duration,
        resume=resume,
    )
    for line in _summary(output, facts):
        say(line, quiet=quiet)
    if absent:
        raise InputError(
            f"{output}: {' and '.join(absent)} was recorded; check that the drivers publish and that"
            " ROS_DOMAIN_ID is theirs"
        )


def _summary(output: Path, facts: Mapping[str, Any]) -> list[str]:
    if not facts.get("messages"):
        return [f"{output}: nothing was recorded"]
    lines = [f"bag: {output} ({facts['messages']} messages in {facts['files']} files)"]
    for topic, counts in facts.get("topics", {}).items():
        found = ", ".join(
            f"{name} {n}" for name, n in counts.items() if n and name not in ("received", "lost")
        )
        lines.append(f"  {topic}  {counts['received']}" + (f" ({found})" if found else ""))
    lost = sum(counts["lost"] for counts in facts.get("topics", {}).values())
    return [*lines, f"lost: {lost}" if lost else "nothing was lost"]


def recover(
    bag: Annotated[
        Path,
        typer.Argument(metavar="BAG", help="Recording that was cut off: its folder, .mcap or .mcap.partial."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="PATH", help="Repaired recording [NAME.recovered beside it]."),
    ] = None,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Replace the cut files by whole ones, and delete them.")
    ] = False,
    thorough: Annotated[
        bool, typer.Option("--thorough", help="Read every chunk of every file, not only the ends.")
    ] = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Repair a recording that was cut off, and report what is lost.

    The original is changed only with --in-place.

    Example: subiaco recover bags/2025-03-14_am
    """
    from subiaco_geo.bag_recovery import recover_bag

    set_up_logging(verbose, quiet)
    result = recover_bag(bag, output, in_place=in_place, thorough=thorough)
    if as_json:
        print_json(_as_json(result))
    else:
        for line in _told(result):
            say(line, quiet=quiet)


def _told(result: BagRecovery) -> list[str]:
    if not result.changed:
        return [f"{result.target}: whole already, {result.messages} messages; nothing to do"]
    lines = [_file_told(file) for file in result.files if not file.whole]
    return [
        *lines,
        f"bag: {result.target} ({result.messages} messages kept, {_lost_told(*result.files)} lost)",
    ]


def _lost_told(*files: FileRecovery) -> str:
    """Count what is lost in messages, and in bytes where a file does not tell how many messages it held."""
    counted = [file.messages_lost for file in files if file.messages_lost is not None]
    messages = sum(sum(lost.values()) for lost in counted)
    unknown = sum(file.bytes_lost for file in files if file.messages_lost is None)
    told = [f"{messages} messages"] if messages or not unknown else []
    return " and ".join([*told, *([f"{unknown} bytes of an unknown number of messages"] if unknown else [])])


def _file_told(file: FileRecovery) -> str:
    if file.target is None:
        return f"{file.source.name}: no message can be read; {file.bytes_lost} bytes lost"
    last = datetime.fromtimestamp(file.end_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    told = f"{file.source.name}: kept {file.messages} messages up to {last} UTC, lost {_lost_told(file)}"
    if file.messages_lost:
        topics = ", ".join(f"{count} of {topic}" for topic, count in sorted(file.messages_lost.items()))
        told += f" ({topics})"
    if file.lost_s:
        told += f", about {file.lost_s:.2f} s before it was cut"
    if file.damaged_chunks:
        told += f", {file.damaged_chunks} damaged chunks"
    return told


def _as_json(result: BagRecovery) -> dict[str, Any]:
    return {
        "bag": str(result.target),
        "changed": result.changed,
        "messages": result.messages,
        "bytes_lost": result.bytes_lost,
        "files": [vars(file) for file in result.files],
    }


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.command("record", short_help="Record the topics of a live vehicle.")(record)
    app.command("recover", short_help="Repair a recording that was cut off.")(recover)
