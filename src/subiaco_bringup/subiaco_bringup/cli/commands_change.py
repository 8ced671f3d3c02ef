"""Verbs on pairs of epochs: change, evaluate, report."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from subiaco_bringup.cli.change_options import (
    EPOCH_HELP,
    DryRun,
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
    worker_count,
)
from subiaco_bringup.cli.finding_box import remembered_log, say_findings
from subiaco_bringup.cli.options import (
    AsJson,
    ConfigFiles,
    Output,
    Overwrite,
    Quiet,
    Settings,
    Verbose,
    no_collection,
    print_json,
    say,
    set_up_logging,
)
from subiaco_bringup.cli.progress import Progress
from subiaco_geo.errors import InputError
from subiaco_geo.work.executors import load_for_workers

if TYPE_CHECKING:
    from subiaco_change.request import ChangeRequest

#: What workers of a change run need.
_LOADED = ("subiaco_change.tiling.worker_start", "subiaco_report.pages")


def change(
    epochs: Annotated[
        list[Path],
        typer.Argument(metavar="BEFORE AFTER", help=f"{EPOCH_HELP} More than two: in the order of time."),
    ],
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
    dry_run: DryRun = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two maps: labelled clouds, a table, a report.

    The same command continues a run that was stopped.

    With more than two epochs, every consecutive pair is compared, and history.csv follows each object.

    Example: subiaco change out/before out/after -o out/change
    """
    begins = all(path.exists() for path in epochs) and (overwrite or not output.exists())
    if begins and scheduler is None and worker_count(workers) > 1:
        load_for_workers(_LOADED)  # on another core, while this process loads the same

    with no_collection():
        from subiaco_change.history import run_epochs
        from subiaco_change.job import run_change
        from subiaco_report.pages import write_pages

    set_up_logging(verbose, quiet)
    if len(epochs) < 2:
        raise InputError("change: give two epochs or more, BEFORE AFTER")
    request = change_request(
        before=epochs[0], after=epochs[-1], output=output,
        trajectory_before=trajectory_before, trajectory_after=trajectory_after,
        transform=transform, registration=registration, without=without, parcels=parcels,
        semantics=semantics, instances=instances, keep_stages=keep_stages, from_stage=from_stage,
        workers=workers, scheduler=scheduler, config=config, settings=settings, overwrite=overwrite,
    )  # fmt: skip
    if dry_run is not None:
        _say_estimate(request, dry_run, quiet)
        return
    if len(epochs) > 2:
        with remembered_log() as said, Progress(quiet=quiet) as progress:
            history = run_epochs(epochs, request, progress, write_pages)
        say(f"history: {output / 'history.csv'} ({len(history)} objects)", quiet=quiet)
        for found in sorted(output.glob("*_to_*/run.json")):
            say_findings(found.parent, said, quiet=quiet)
        return
    with remembered_log() as said, Progress(quiet=quiet) as progress:
        records = run_change(request, progress, write_pages=write_pages)
    counts = Counter(record.change.label for record in records)
    listed = ", ".join(f"{count} {label}" for label, count in sorted(counts.items()))
    say(f"changes: {output} ({listed or 'no objects'}); open {output / 'report.html'}", quiet=quiet)
    say_findings(output, said, quiet=quiet)


def _say_estimate(request: ChangeRequest, tiles: int, quiet: bool) -> None:
    """Do the largest tiles of the first and the last epoch, and say what the whole will take."""
    from subiaco_change.dry_run import dry_run
    from subiaco_report.pages import write_pages

    with Progress(quiet=quiet) as progress:
        found = dry_run(request, tiles, progress, write_pages)
    say(f"dry run: {found.text()}", quiet=quiet)


def evaluate(
    pairs: Annotated[
        list[Path],
        typer.Argument(
            metavar="CHANGE_DIR TRUTH",
            help="Change directory and the survey with its ground truth; several pairs are scored together.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder for the scores, which are also printed."),
    ] = None,
    published: Annotated[
        str | None,
        typer.Option(
            metavar="RUN",
            help="Score this run of the only path, a folder in the layout of the published evaluation.",
        ),
    ] = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="What another method found, one for each pair: the difference and its interval over tiles.",
        ),
    ] = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Score change directories against truth, by the published protocol and by object.

    Labels made by any other method are scored too: a folder of clouds or arrays in place of CHANGE_DIR.

    Example: subiaco evaluate out/change bags/demo -o out/evaluation
    """
    from subiaco_evaluation.score_files import evaluation_markdown, write_evaluation
    from subiaco_evaluation.scoring import compare, evaluate_published
    from subiaco_evaluation.scoring import evaluate as score

    set_up_logging(verbose, quiet)
    if published is not None and len(pairs) == 1:
        result = evaluate_published(pairs[0], published)
    elif published is not None or len(pairs) % 2:
        raise InputError("evaluate: give CHANGE_DIR and TRUTH in pairs, or one folder with --published")
    else:
        cases = list(zip(pairs[::2], pairs[1::2], strict=True))
        result = score(cases)
        if against:
            result["against"] = compare(cases, against)
    if output is not None:
        write_evaluation(result, output)
    if as_json:
        print_json(result)
    else:
        typer.echo(evaluation_markdown(result))


def report(
    change_directory: Annotated[
        Path, typer.Argument(metavar="CHANGE_DIR", help="Change directory, which 'subiaco change' wrote.")
    ],
    project: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the project in the header of the report.")
    ] = None,
    client: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the client in the header of the report.")
    ] = None,
    logo: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture in the header: .png, .jpg or .webp.")
    ] = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Build report.html and summary.html of a change directory again, and changes.qgs where it is missing.

    An existing changes.qgs is kept, because it may contain layers of your own. Project, client and logo are
    kept for the next time.

    Example: subiaco report out/change --project "Survey 2025" --client "City of Subiaco"
    """
    from subiaco_change.outputs.change_directory_reading import read_change_directory
    from subiaco_report.pages import write_pages
    from subiaco_report.project_facts import store_project_facts

    set_up_logging(verbose, quiet)
    if (project, client, logo) != (None, None, None):
        read_change_directory(change_directory)
        store_project_facts(change_directory, project, client, logo)
    say(f"report: {write_pages(change_directory)}", quiet=quiet)


def review(
    change_directory: Annotated[
        Path, typer.Argument(metavar="CHANGE_DIR", help="Change directory, which 'subiaco change' wrote.")
    ],
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[REVIEWS]", help="Review files that the report saved; later ones win."),
    ] = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Apply reviews to the table, the GeoPackage, the lots and the pages of a change directory.

    Reviews come from the files given, from reviews.csv in the directory, and from what was typed into
    changes.csv or into changes.gpkg (the form in QGIS). Rejected changes leave every count.

    Example: subiaco review out/change reviews.csv
    """
    from subiaco_change.outputs.directory import take_up_reviews
    from subiaco_change.outputs.reviews import review_counts
    from subiaco_report.pages import write_pages

    set_up_logging(verbose, quiet)
    table, unknown = take_up_reviews(change_directory, list(files or []))
    page = write_pages(change_directory)
    counts = review_counts(table) | {"unknown": unknown}
    if as_json:
        print_json(counts)
        return
    listed = f"{counts['accepted']} accepted, {counts['rejected']} rejected"
    say(f"review: {counts['reviewed']} of {counts['changed']} changes ({listed}); open {page}", quiet=quiet)
    if unknown:
        say(f"review: {len(unknown)} reviews have no object in this table, first {unknown[0]}", quiet=quiet)


class ExportKind(StrEnum):
    """A form that other programs ask for."""

    LAZ = "laz"
    COPC = "copc"
    PLY = "ply"
    GPKG = "gpkg"
    PARQUET = "parquet"
    GEOJSON = "geojson"
    CSV = "csv"
    SHP = "shp"
    KML = "kml"
    DXF = "dxf"
    TERRAIN = "terrain"
    TILES = "tiles"
    KITTI = "kitti"
    FOXGLOVE = "foxglove"


def export(
    directory: Annotated[
        Path, typer.Argument(metavar="MAP_OR_CHANGE_DIR", help="Map directory or change directory to export.")
    ],
    output: Output,
    to: Annotated[
        ExportKind,
        typer.Option(
            metavar="FORM",
            help="Clouds: laz, copc, ply. Maps also: tiles (LAZ of 80 m and an index), kitti (trajectory),"
            " terrain (ground and surface models, hillshade, contours)."
            " Tables: gpkg, parquet, geojson, csv, shp, kml, dxf."
            " Clouds, outlines and table of changes in one MCAP file for Foxglove: foxglove.",
        ),
    ],
    cloudcompare: Annotated[
        bool,
        typer.Option("--cloudcompare", help="Name PLY fields so that CloudCompare loads them."),
    ] = False,
    review: Annotated[
        str,
        typer.Option(
            metavar="WHICH",
            help="Changes to write by their review: all, accepted or not-rejected. Points of the other"
            " changes get code 254.",
        ),
    ] = "all",
    sections: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --to terrain: lines (.gpkg, .geojson, .shp) along which ground and surface are cut.",
        ),
    ] = None,
    geoid: Annotated[
        Path | None,
        typer.Option(
            metavar="GRID",
            help="Geoid model (.gtx, .tif): heights are written above it, such as AHD with AUSGeoid2020.",
        ),
    ] = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Write a map or a change directory in a form that other programs ask for.

    Example: subiaco export out/2025 --to copc -o out/2025_copc
    """
    from subiaco_change.outputs.exports import export_changes
    from subiaco_change.outputs.terrain import export_terrain
    from subiaco_geo.exports import export_map

    set_up_logging(verbose, quiet)
    if cloudcompare and to is not ExportKind.PLY:
        raise InputError(
            f"--cloudcompare names the fields of a PLY; with --to {to} it has no meaning; leave it out"
        )
    if sections is not None and to is not ExportKind.TERRAIN:
        raise InputError(f"--sections cuts terrain; with --to {to} it has no meaning; leave it out")
    is_map = (directory / "map.yaml").is_file() or to is ExportKind.TERRAIN
    if is_map and review != "all":
        raise InputError(f"--review {review}: {directory} is a map, which has no reviews; leave it out")
    if to is ExportKind.TERRAIN and geoid is not None:
        raise InputError("--geoid: heights of terrain stay above the ellipsoid; give --to laz, copc or ply")
    if to is ExportKind.TERRAIN:
        files = export_terrain(directory, output, sections=sections)
    elif is_map:
        files = export_map(directory, output, to.value, cloudcompare=cloudcompare, geoid=geoid)
    else:
        files = export_changes(
            directory, output, to.value, cloudcompare=cloudcompare, review=review, geoid=geoid
        )
    names = ", ".join(str(file) for file in files) if len(files) < 5 else f"{len(files)} files in {output}"
    say(f"{to}: {names}", quiet=quiet)


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.command("change", short_help="Find what changed between two maps.")(change)
    app.command("evaluate", short_help="Score what was found against truth.")(evaluate)
    app.command("report", short_help="Build report.html of a change directory again.")(report)
    app.command("review", short_help="Apply reviews to the outputs of a change directory.")(review)
    app.command("export", short_help="Write a map or changes in a form other programs ask for.")(export)
