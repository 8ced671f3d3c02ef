"""Verbs that put the method beside others and beside itself: baseline, train, ablate."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from subiaco_bringup.cli.change_options import After, Before, RegistrationName, TransformFile, known_transform
from subiaco_bringup.cli.finding_box import remembered_log, say_findings
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
from subiaco_bringup.defaults import config_directory, config_files
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError


class Method(StrEnum):
    """A method to compare with."""

    DSM = "dsm"
    NN = "nn"
    M3C2 = "m3c2"
    C2C = "c2c"
    PDAL_M3C2 = "pdal-m3c2"
    DSM_SIAMESE = "dsm-siamese"
    DSM_FC_EF = "dsm-fc-ef"
    SIAMESE_KPCONV = "siamese-kpconv"
    TRIPLET_KPCONV = "triplet-kpconv"
    EFS_KPCONV = "efs-kpconv"
    DC3DCD = "dc3dcd"


class Learned(StrEnum):
    """A learned method."""

    DSM_SIAMESE = "dsm-siamese"
    DSM_FC_EF = "dsm-fc-ef"
    SIAMESE_KPCONV = "siamese-kpconv"
    TRIPLET_KPCONV = "triplet-kpconv"
    EFS_KPCONV = "efs-kpconv"
    DC3DCD = "dc3dcd"


_METHOD_HELP = (
    "dsm: difference of the highest point per cell. nn: nearest neighbour against a level of detection. "
    "m3c2: distance along the normal against its level of detection. c2c: nearest neighbour, one threshold. "
    "pdal-m3c2: M3C2 as PDAL computes it. The others are trained networks and need PyTorch ('make learned'): "
    "dsm-siamese and dsm-fc-ef on surface models, the kpconv methods and dc3dcd on points."
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
    """Find changes by a simple or learned method, for comparison.

    It writes the same outputs as 'subiaco change'.

    Example: subiaco baseline dsm out/before out/after -o out/dsm --transform out/change/registration.json
    """
    from subiaco_change.request import ComparisonRequest
    from subiaco_evaluation.baseline_run import run_baseline
    from subiaco_evaluation.config import BaselineConfig
    from subiaco_report.pages import write_pages

    set_up_logging(verbose, quiet)
    given = known_transform(transform, registration)
    model = load_config(BaselineConfig, tuple(config or ()), settings or [])
    request = ComparisonRequest.of(
        before=before, after=after, output=output, transform=given, overwrite=overwrite
    )
    with remembered_log() as said, Progress(quiet=quiet) as progress:
        result = run_baseline(request, method.value, model, progress, write_pages)
    counts = Counter(record.change.label for record in result.records)
    listed = ", ".join(f"{count} {label}" for label, count in sorted(counts.items()))
    say(f"{method.value}: {output} ({listed or 'no change'}); open {output / 'report.html'}", quiet=quiet)
    say_findings(output, said, quiet=quiet)


def train(
    method: Annotated[Learned, typer.Argument(help="Network to train; needs PyTorch ('make learned').")],
    surveys: Annotated[
        list[Path], typer.Argument(metavar="SURVEYS", help="Outputs of 'subiaco simulate' to learn from.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="WEIGHTS", help="File of weights to write (.npz).")
    ],
    validate: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="SURVEY",
            help="Survey that is scored after every epoch and not learned; repeatable. "
            "Without it the last of SURVEYS.",
        ),
    ] = None,
    prepared: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of prepared surveys that several trainings share."),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            metavar="WEIGHTS",
            help="Trained weights of the same network to begin with.",
        ),
    ] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Train a learned method on simulated surveys.

    A training that was stopped goes on where it stopped when the same command is given again. The learning
    curve lies beside the weights.

    Example: subiaco train siamese-kpconv sim/101 sim/102 sim/103 -o out/siamese.npz
    """
    from subiaco_evaluation.learned.config import TrainingConfig
    from subiaco_evaluation.learned.jobs import run_training, training_job

    set_up_logging(verbose, quiet)
    model = load_config(TrainingConfig, tuple(config or ()), settings or [])
    job = training_job(
        method.value, surveys, validate or (), output, prepared, start=start, overwrite=overwrite
    )
    with Progress(quiet=quiet) as progress:
        record = run_training(job, model, progress)
    say(
        f"{method.value}: {output} ({record['epochs']} epochs, {record['hours']:.2f} hours, mIoU "
        f"{record['validation_miou_percent']:.1f} % on the validation survey)",
        quiet=quiet,
    )


def ablate(
    cases: Annotated[
        list[Path],
        typer.Argument(
            metavar="CASES",
            help="BEFORE AFTER TRUTH: two epochs and their ground truth; several triples are scored "
            "together. With --rules: outputs of 'subiaco simulate'; clouds before.ply and after.ply or .laz "
            "in that folder, with before.tum and after.tum if there, take the place of its maps.",
        ),
    ],
    output: Output,
    rules: Annotated[
        bool,
        typer.Option(
            "--rules",
            help="Switch off every rule of the method in turn and report what the rule is worth, with an "
            "interval. A study that was stopped continues with the same command.",
        ),
    ] = False,
    jobs: Annotated[
        int, typer.Option("--jobs", min=1, metavar="N", help="Number of parallel runs with --rules.")
    ] = 1,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Run this variant, or this rule, alone, beside the full method; repeatable."
        ),
    ] = None,
    registration: RegistrationName = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Run an ablation study: disable each component, or restore the paper's setting, and report the scores.

    With --rules each rule of the method is switched off instead.

    Example: subiaco ablate bags/demo/before bags/demo/after bags/demo -o out/ablations

    Example: subiaco ablate --rules sim/101 sim/102 -o out/rules --jobs 2
    """
    from subiaco_change.config import ChangeConfig
    from subiaco_evaluation.ablation_study import Case, ablations_markdown, run_ablations
    from subiaco_evaluation.rule_study import run_rule_study, study_markdown

    set_up_logging(verbose, quiet)
    files = config_files("change", tuple(config or ()))
    ours = load_config(ChangeConfig, files, settings or [])
    if rules:
        if registration is not None or overwrite:
            raise InputError("ablate --rules: --registration and --overwrite do not apply; leave them out")
        with Progress(quiet=quiet) as progress:
            found = run_rule_study(cases, output, ours, progress, only=only or (), jobs=jobs)
        typer.echo(study_markdown(found))
        return
    if len(cases) % 3:
        raise InputError("ablate: give BEFORE AFTER TRUTH in threes; one of them is missing")
    given = known_transform(None, registration)
    paper = load_config(ChangeConfig, [*files, config_directory() / "paper.yaml"], settings or [])
    triples = [Case(*cases[start : start + 3]) for start in range(0, len(cases), 3)]
    with Progress(quiet=quiet) as progress:
        table = run_ablations(
            triples, output, ours, paper, progress, only=only or (), transform=given, overwrite=overwrite
        )
    typer.echo(ablations_markdown(table))


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.command("baseline")(baseline)
    app.command("train")(train)
    app.command("ablate", short_help="Score the method with each of its parts left out.")(ablate)
