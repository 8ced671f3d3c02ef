"""Verbs that tell how far to trust results on one's own city: inject, calibrate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from subiaco_bringup.cli.change_options import RegistrationName, TrajectoryFile, known_transform
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

ObjectFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Clouds of objects to insert, one object a file, named by class (building*, tree*, car* ...) "
        "[objects of the map itself].",
    ),
]


def inject(
    survey: Annotated[
        Path, typer.Argument(metavar="MAP", help="Map directory, or a cloud with --trajectory.")
    ],
    output: Output,
    objects: ObjectFolder = None,
    trajectory: TrajectoryFile = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random choices.")] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Insert known changes into a map, with correct occlusion, and write the ground truth beside it.

    'subiaco change MAP MAP2' then finds them, and 'subiaco evaluate CHANGE_DIR MAP2' scores that. How
    many, how large: --set inserted=20, removed, moved, grown, cut, patches, patch_rise ...; truth/scene.yaml
    of what is written lists all settings.

    Example: subiaco inject out/2025 -o out/2025_injected --seed 3
    """
    from subiaco_evaluation.injection.config import InjectionConfig
    from subiaco_evaluation.injection.inject import inject as put_in
    from subiaco_evaluation.injection.inject import read_donors
    from subiaco_evaluation.injection.truth_writing import write_injected
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


def calibrate(
    survey: Annotated[
        Path, typer.Argument(metavar="MAP", help="Map directory, or a cloud with --trajectory.")
    ],
    output: Output,
    objects: ObjectFolder = None,
    trajectory: TrajectoryFile = None,
    copies: Annotated[int | None, typer.Option(help="Number of injected copies for the fit.")] = None,
    registration: RegistrationName = None,
    repeat: Annotated[
        Path | None,
        typer.Option(
            metavar="MAP",
            help="Map of other sequences of the same streets and days: the noise of a second pass is "
            "measured from it, and modelled where absent.",
        ),
    ] = None,
    config: ConfigFiles = None,
    change_config: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="Settings of 'subiaco change'; repeatable.")
    ] = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Estimate the smallest detectable change on your map and calibrate the confidence values.

    It runs change detection on injected copies of MAP; 'subiaco change --config DIR/confidence.yaml' takes
    the confidences from there. Every class needs a dozen changes at least: more --copies, or more in each
    (--set injection.inserted=30); config.yaml of what is written lists all settings.

    Example: subiaco calibrate out/2025 -o out/calibration
    """
    import pandas as pd

    from subiaco_change.config import ChangeConfig
    from subiaco_evaluation.injection.calibrate import MapCalibrationConfig, write_calibration
    from subiaco_evaluation.injection.calibrate import calibrate as run
    from subiaco_evaluation.injection.inject import read_donors
    from subiaco_geo.atomic import refuse_existing, refuse_foreign
    from subiaco_geo.maps import load_epoch

    set_up_logging(verbose, quiet)
    refuse_existing(output, overwrite)
    refuse_foreign(output, "calibration.json")
    chosen = [*(settings or []), *([] if copies is None else [f"copies={copies}"])]
    model = load_config(MapCalibrationConfig, tuple(config or ()), chosen)
    change = load_config(ChangeConfig, config_files("change", tuple(change_config or ())), [])
    donors = () if objects is None else tuple(read_donors(objects, model.injection.leaf))
    given = known_transform(None, registration)
    other = None if repeat is None else load_epoch(repeat).cloud
    with Progress(quiet=quiet) as progress:
        result = run(load_epoch(survey, trajectory), change, model, donors, progress, given, other)
        document = write_calibration(output, result, model, survey, overwrite)
    table = pd.read_csv(output / "detectable.csv")
    typer.echo(table.to_string(index=False, na_rep="not reached"))
    say(
        f"calibration: {output} ({document['found']} of {document['injected_changes']} changes found; "
        f"calibration error of changed rows {document['held_out_ece']:.2f})",
        quiet=quiet,
    )


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.command("inject", short_help="Insert known changes into a map.")(inject)
    app.command("calibrate", short_help="Estimate the smallest detectable change on your map.")(calibrate)
