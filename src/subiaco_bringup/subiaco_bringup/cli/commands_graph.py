"""Verbs that run the same jobs through the ROS 2 nodes as separate processes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from subiaco_bringup.cli import commands_graph_inspection
from subiaco_bringup.cli.change_options import (
    After,
    Before,
    FromStage,
    GivenInstances,
    GivenSemantics,
    ParcelsFile,
    RegistrationName,
    Scheduler,
    StageFolder,
    TrajectoryFile,
    TransformFile,
    WithoutParts,
    Workers,
    change_request,
)
from subiaco_bringup.cli.map_verdict import end_with_verdict
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
from subiaco_geo.config import load_config

FoxglovePort = Annotated[
    int | None,
    typer.Option(
        "--foxglove",
        min=0,
        max=65535,
        metavar="PORT",
        help="Serve the topics to Foxglove on this computer: open ws://127.0.0.1:PORT there, e.g. 8765.",
    ),
]

graph = typer.Typer(
    help="Run a job through the ROS 2 nodes, each a process of its own; the result is that of "
    "'subiaco map' or 'subiaco change'.\n\nExample: subiaco graph mapping bags/demo/before -o out/before",
    short_help="Run a job through the ROS 2 nodes, or show a running graph.",
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
    foxglove: FoxglovePort = None,
    one_process: Annotated[
        bool,
        typer.Option("--one-process", help="Run the nodes in one process: less memory, one works at a time."),
    ] = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Replay bags through odometry and pose graph into a map.

    Example: subiaco graph mapping bags/demo/before -o out/before
    """
    from subiaco_bringup.jobs import run_mapping_graph
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.request import MappingRequest

    set_up_logging(verbose, quiet)
    model = load_config(MappingConfig, config_files("mapping", tuple(config or ())), settings or [])
    request = MappingRequest.of(bags=tuple(bags), output=output, overwrite=overwrite, config=model)
    with Progress(quiet=quiet) as progress:
        run_mapping_graph(
            request, rate=rate, foxglove_port=foxglove, one_process=one_process, progress=progress
        )
    say(f"map: {output}", quiet=quiet)
    end_with_verdict(output, quiet=quiet)


@graph.command("change")
def change(
    before: Before,
    after: After,
    output: Output,
    trajectory_before: TrajectoryFile = None,
    trajectory_after: TrajectoryFile = None,
    transform: TransformFile = None,
    registration: RegistrationName = None,
    without: WithoutParts = None,
    parcels: ParcelsFile = None,
    semantics: GivenSemantics = None,
    instances: GivenInstances = None,
    keep_stages: StageFolder = None,
    from_stage: FromStage = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Compare two maps through the change node; options and result are those of 'subiaco change'.

    Example: subiaco graph change out/before out/after -o out/change
    """
    from subiaco_bringup.jobs import run_change_graph

    set_up_logging(verbose, quiet)
    request = change_request(
        before=before, after=after, output=output,
        trajectory_before=trajectory_before, trajectory_after=trajectory_after,
        transform=transform, registration=registration, without=without, parcels=parcels,
        semantics=semantics, instances=instances, keep_stages=keep_stages, from_stage=from_stage,
        workers=workers, scheduler=scheduler, config=config, settings=settings, overwrite=overwrite,
    )  # fmt: skip
    with Progress(quiet=quiet) as progress:
        run_change_graph(request, progress)
    say(f"changes: {output}; open {output / 'report.html'}", quiet=quiet)


@graph.command("live")
def live(
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Folder of the drive: gets bag/, map/, manifest.yaml, quality.geojson.",
        ),
    ],
    config: ConfigFiles = None,
    settings: Settings = None,
    remap: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OURS:=DRIVERS",
            help="Name under which a driver publishes a topic of Subiaco; repeatable.",
        ),
    ] = None,
    route: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Planned route: GeoJSON line, or CSV with columns lat,lon."),
    ] = None,
    no_record: Annotated[
        bool,
        typer.Option(
            "--no-record", help="Do not record, because another program records or a bag is played."
        ),
    ] = False,
    sim_time: Annotated[
        bool, typer.Option("--sim-time", help="Follow /clock, for 'ros2 bag play --clock'.")
    ] = False,
    namespace: Annotated[
        str,
        typer.Option(help="Namespace of all nodes and topics; one for each LiDAR where there are several."),
    ] = "",
    foxglove: FoxglovePort = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Record, watch and map a live vehicle until Ctrl-C; then the map is written.

    The screen shows the light of the street being driven: green, amber or red with the reason.

    Example: subiaco graph live -o surveys/2025-03-14_am --config config/drivers/ublox.yaml
    """
    from subiaco_bringup.jobs import run_live_graph
    from subiaco_bringup.live_view import LiveView
    from subiaco_bringup.recording import parse_remapping

    set_up_logging(verbose, quiet)
    with Progress(quiet=quiet) as progress, LiveView(quiet=quiet) as view:
        run_live_graph(
            output,
            config_files("mapping", tuple(config or ())),
            settings or [],
            remappings=[parse_remapping(text) for text in remap or []],
            route=route,
            record=not no_record,
            sim_time=sim_time,
            namespace=namespace,
            foxglove_port=foxglove,
            progress=progress,
            on_status=view,
        )
    for name in ("bag", "map", "manifest.yaml", "quality.geojson"):
        if (output / name).exists():
            say(f"{output / name}", quiet=quiet)


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    commands_graph_inspection.register(graph)
    app.add_typer(graph, name="graph")
