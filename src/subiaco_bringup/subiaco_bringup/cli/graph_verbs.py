"""Verbs that run the same jobs through the ROS 2 nodes as separate processes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from subiaco_bringup.cli.options import (
    ConfigFiles,
    Output,
    Overwrite,
    Quiet,
    Settings,
    Verbose,
    say,
    set_up_logging,
)
from subiaco_bringup.cli.progress import Progress
from subiaco_bringup.defaults import config_files

graph = typer.Typer(
    help="Run a job through the ROS 2 nodes, each a process of its own; the result is that of "
    "'subiaco map' or 'subiaco change'.\n\nExample: subiaco graph mapping bags/demo/before -o out/before",
    short_help="Run a job through the ROS 2 nodes: mapping or change.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@graph.command("mapping")
def mapping(
    bags: Annotated[
        list[Path], typer.Argument(metavar="BAG", help="One or more bags of one epoch, each a drive.")
    ],
    output: Output,
    config: ConfigFiles = None,
    settings: Settings = None,
    rate: Annotated[float, typer.Option(help="Replay speed; 0 is as fast as the nodes go.")] = 0.0,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Replay bags through odometry and pose graph into a map.

    Example: subiaco graph mapping bags/demo/before -o out/before
    """
    from subiaco_bringup.jobs import run_mapping_graph

    set_up_logging(verbose, quiet)
    with Progress(quiet=quiet) as progress:
        run_mapping_graph(
            bags,
            output,
            config_files("mapping", tuple(config or ())),
            settings or [],
            rate=rate,
            overwrite=overwrite,
            progress=progress,
        )
    say(f"map: {output}", quiet=quiet)


@graph.command("change")
def change(
    before: Annotated[Path, typer.Argument(metavar="BEFORE", help="Map directory or bare cloud.")],
    after: Annotated[Path, typer.Argument(metavar="AFTER", help="Map directory or bare cloud.")],
    output: Output,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Compare two maps through the change node.

    Example: subiaco graph change out/before out/after -o out/change
    """
    from subiaco_bringup.jobs import run_change_graph

    set_up_logging(verbose, quiet)
    with Progress(quiet=quiet) as progress:
        run_change_graph(
            before,
            after,
            output,
            config_files("change", tuple(config or ())),
            settings or [],
            overwrite=overwrite,
            progress=progress,
        )
    say(f"changes: {output}; open {output / 'report.html'}", quiet=quiet)


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.add_typer(graph, name="graph")
