"""Verbs that tell how far to trust results on one's own city: inject."""

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
from subiaco_geo.config import load_config


def inject(
    survey: Annotated[
        Path, typer.Argument(metavar="MAP", help="Map directory, or a cloud with --trajectory.")
    ],
    output: Output,
    objects: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Clouds of objects to put, one a file, named by class (building*, tree*, car* ...); "
            "objects of the map itself where absent.",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option(metavar="F", help="Where the scanner went (TUM), for a bare cloud.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every choice.")] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Put known changes into a map, with what they hide hidden, and write the truth beside it.

    'subiaco change MAP MAP2' then finds them, and 'subiaco evaluate CHANGE_DIR MAP2' scores that.

    Example: subiaco inject out/2025 -o out/2025_injected --seed 3
    """
    from subiaco_change.injection.config import InjectionConfig
    from subiaco_change.injection.inject import inject as put_in
    from subiaco_change.injection.inject import read_donors
    from subiaco_change.injection.writing import write_injected
    from subiaco_geo.atomic import refuse_existing, refuse_foreign
    from subiaco_geo.maps import load_epoch

    set_up_logging(verbose, quiet)
    refuse_existing(output, overwrite)
    refuse_foreign(output, "map.yaml")
    chosen = [*(settings or []), *([] if seed is None else [f"seed={seed}"])]
    model = load_config(InjectionConfig, tuple(config or ()), chosen)
    donors = [] if objects is None else read_donors(objects, model.leaf)
    with Progress(quiet=quiet) as progress:
        injected = put_in(load_epoch(survey, trajectory), model, donors, progress)
        write_injected(output, survey, injected, model, overwrite)
    missed = ", ".join(f"{count} {name}" for name, count in injected.left_out.items())
    left = f"; fitted nowhere: {missed}" if missed else ""
    say(f"injected: {output} ({len(injected.rows)} changes{left})", quiet=quiet)


def register(app: typer.Typer) -> None:
    """Add this verb to the command."""
    app.command("inject", short_help="Put known changes into a map.")(inject)
