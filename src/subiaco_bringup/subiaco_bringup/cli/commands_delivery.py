"""Verbs that make what a client looks at: the 3D viewer, and the delivery of a change directory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from subiaco_bringup.cli.options import Output, Quiet, Verbose, say, set_up_logging


def deliver(
    change_directory: Annotated[
        Path, typer.Argument(metavar="CHANGE_DIR", help="Change directory, which 'subiaco change' wrote.")
    ],
    output: Output,
    review: Annotated[
        str,
        typer.Option(metavar="WHICH", help="Rows to deliver by their review: all, accepted or not-rejected."),
    ] = "all",
    polygons: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Areas for cut and fill: .gpkg, .geojson, .shp. [lots of the run]"),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(metavar="JSON", help="Output of 'subiaco check --json', for the accuracy statement."),
    ] = None,
    cell: Annotated[
        float, typer.Option(metavar="M", help="Edge of the cells of the difference rasters, in metres.")
    ] = 0.5,
    without_clouds: Annotated[
        bool, typer.Option("--without-clouds", help="Leave the point clouds out.")
    ] = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Make the folder for a client: tables, rasters, clouds, volumes, accuracy statement.

    It has ISO 19115 metadata, and a manifest with the SHA-256 of every file.

    Example: subiaco deliver out/change -o delivery --review accepted --polygons lots.gpkg
    """
    from subiaco_report.delivery import Delivery, deliver

    set_up_logging(verbose, quiet)
    files = deliver(
        change_directory, output, Delivery(review, polygons, check, cell, clouds=not without_clouds)
    )
    say(f"delivery: {output} ({len(files)} files); open {output / 'README.txt'}", quiet=quiet)


def viewer(
    change_directory: Annotated[
        Path, typer.Argument(metavar="CHANGE_DIR", help="Change directory, which 'subiaco change' wrote.")
    ],
    show: Annotated[bool, typer.Option("--open", help="Open the page in the web browser.")] = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Write the 3D viewer of both surveys into CHANGE_DIR/viewer, and link the report to it.

    The viewer shows before, after, both, or a swipe between them, in any browser with WebGL 2. It needs no
    network and no web server. 'subiaco change' writes it too, up to 20 million points in both surveys.

    Example: subiaco viewer out/change --open
    """
    import webbrowser

    from subiaco_report.page import build_report
    from subiaco_report.viewer.build import build_viewer

    set_up_logging(verbose, quiet)
    page = build_viewer(change_directory)
    build_report(change_directory)
    say(f"viewer: {page}", quiet=quiet)
    if show:
        webbrowser.open(page.absolute().as_uri())


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.command("viewer", short_help="Write the 3D viewer of both surveys.")(viewer)
    app.command("deliver", short_help="Make the folder for a client.")(deliver)
