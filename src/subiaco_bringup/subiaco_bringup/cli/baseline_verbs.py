"""The verb that runs the simple methods people use today: baseline."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from typing import Annotated

import typer

from subiaco_bringup.cli.change_verbs import After, Before, RegistrationName, TransformFile, known_transform
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


class Method(StrEnum):
    """A simple method."""

    DSM = "dsm"
    NN = "nn"
    M3C2 = "m3c2"
    C2C = "c2c"


_METHOD_HELP = (
    "dsm: difference of the highest point per cell. nn: nearest neighbour against a level of detection. "
    "m3c2: distance along the normal against its level of detection. c2c: nearest neighbour, one threshold."
)


def baseline(
    method: Annotated[Method, typer.Argument(help=_METHOD_HELP)],
    before: Before,
    after: After,
    output: Output,
    transform: TransformFile = None,
    registration: RegistrationName = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Find changes by a simple method, for comparison.

    It writes the same outputs as 'subiaco change'.

    Example: subiaco baseline dsm out/before out/after -o out/dsm --transform out/change/registration.json
    """
    from subiaco_change.baselines.config import BaselineConfig
    from subiaco_change.baselines.run import run_baseline
    from subiaco_change.job import ChangeJob

    set_up_logging(verbose, quiet)
    given = known_transform(transform, registration)
    model = load_config(BaselineConfig, tuple(config or ()), settings or [])
    job = ChangeJob(before, after, output, transform=given, overwrite=overwrite)
    with Progress(quiet=quiet) as progress:
        result = run_baseline(job, method.value, model, progress)
    counts = Counter(record.change.label for record in result.records)
    listed = ", ".join(f"{count} {label}" for label, count in sorted(counts.items()))
    say(f"{method.value}: {output} ({listed or 'no change'}); open {output / 'report.html'}", quiet=quiet)


def register(app: typer.Typer) -> None:
    """Add this verb to the command."""
    app.command("baseline")(baseline)
