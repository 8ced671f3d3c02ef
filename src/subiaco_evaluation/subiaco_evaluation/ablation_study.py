"""Ablation study: every component and every Decision switched off in turn and scored against truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import BaseModel

from subiaco_change.config import ChangeConfig, with_parts_disabled
from subiaco_change.job import read_transform, run_change
from subiaco_change.request import ChangeRequest
from subiaco_change.strategies import Part
from subiaco_evaluation.scoring import evaluate
from subiaco_geo.atomic import whole_directory
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Decision of the method -> fields that ``config/paper.yaml`` reverts.
DECISIONS: dict[int, tuple[str, ...]] = {
    2: ("second_registration", "registration.coarse_method", "registration.polish"),
    7: ("instances.min_points",),
    8: ("association.gate_overlap", "association.kappa"),
    9: ("association.contained", "association.apart", "association.parts"),
    11: ("association.cost", "association.unmatched"),
    12: ("ground.cell", "ground.closing"),
    13: ("evidence.source", "decisions.vegetation"),
    14: ("decisions.min_observed", "decisions.min_voxels"),
    18: ("plants.null_model.enabled",),
}
FULL = "full"
#: What tells a directory of ablations from another folder.
MARKER = "ablations.csv"
_STAGES = ".stages"
_REGISTRATION = ("second_registration", "registration")


@dataclass(frozen=True)
class Case:
    """Two epochs and their truth."""

    before: Path
    after: Path
    truth: Path


def variants(ours: ChangeConfig, paper: ChangeConfig) -> dict[str, ChangeConfig]:
    """Return the configuration as it is, and with one part left out or one Decision reverted, by name."""
    found = {FULL: ours}
    found |= {f"without {part.value}": with_parts_disabled(ours, [part.value]) for part in Part}
    found |= {
        f"Decision {number} reverted": reduce(lambda c, field: _taken(c, paper, field), fields, ours)
        for number, fields in DECISIONS.items()
    }
    return found


def _taken(config: Any, source: Any, dotted: str) -> Any:
    """Copy of a configuration with one dotted field of another."""
    name, _, rest = dotted.partition(".")
    value = getattr(source, name)
    if rest:
        value = _taken(getattr(config, name), value, rest)
    assert isinstance(config, BaseModel)
    return config.model_copy(update={name: value})


def run_ablations(
    cases: Sequence[Case],
    output: Path,
    ours: ChangeConfig,
    paper: ChangeConfig,
    progress: Callable[[str, float], None] | None = None,
    *,
    only: Sequence[str] = (),
    transform: Floats | None = None,
    overwrite: bool = False,
) -> pd.DataFrame:
    """Run every variant on every case and tabulate the scores, cases pooled.

    Variants that do not touch the registration take that of the full method,
    so that they differ in what their name says alone. Stages that they have
    in common are done once.

    Parameters
    ----------
    cases : sequence of Case
    output : Path
        A change directory for every variant and case, and ``ablations.csv``.
    ours, paper : ChangeConfig
        Where the values of a reverted Decision come from: ``paper``.
    progress : callable, optional
    only : sequence of str
        Names of variants; all where empty. The full method is always run.
    transform : (4, 4) float64, optional
        Known registration of all cases.
    overwrite : bool

    Returns
    -------
    DataFrame
        A row a variant: scores of the published protocol [%] and of objects.

    Raises
    ------
    InputError, RegistrationError
    """
    chosen = variants(ours, paper)
    unknown = [name for name in only if name not in chosen]
    if unknown:
        raise InputError(f"--only {unknown[0]!r}: not known; choose from {', '.join(chosen)}")
    chosen = {name: config for name, config in chosen.items() if not only or name in (FULL, *only)}
    rows = []
    with whole_directory(output, overwrite=overwrite, marker=MARKER) as target:
        for number, (name, config) in enumerate(chosen.items()):
            pairs = []
            for index, case in enumerate(cases):
                if progress is not None:
                    progress(name, (number + index / len(cases)) / len(chosen))
                place = target / name.replace(" ", "_") / str(index)
                given = _known(target, ours, config, index) if transform is None else transform
                request = ChangeRequest.of(
                    before=case.before, after=case.after, output=place, transform=given, config=config,
                    stages=target / _STAGES / str(index),
                )  # fmt: skip
                run_change(request)
                pairs.append((place, case.truth))
            rows.append(_row(name, evaluate(pairs)))
        shutil.rmtree(target / _STAGES)
        table = pd.DataFrame(rows)
        table.to_csv(target / MARKER, index=False, lineterminator="\n")
    return table


def _known(target: Path, ours: ChangeConfig, config: ChangeConfig, index: int) -> Floats | None:
    """Registration of the full method, where the variant registers alike."""
    document = target / FULL / str(index) / "registration.json"
    same = all(getattr(ours, name) == getattr(config, name) for name in _REGISTRATION)
    return read_transform(document) if same and document.is_file() else None


def _row(name: str, scores: dict[str, Any]) -> dict[str, Any]:
    grid, objects = scores["grid"], scores.get("objects") or {}
    row = {"variant": name}
    row |= {key: grid[f"{key}_percent"] for key in ("accuracy", "mf1", "miou", "abstention")}
    row |= {f"iou_{label.lower()}": value for label, value in grid["iou_percent"].items()}
    return row | {f"object_{key}": objects.get(f"{key}_percent") for key in ("precision", "recall")}


def ablations_markdown(table: pd.DataFrame) -> str:
    """Return the table as Markdown; missing values are a dash."""
    head = [str(column).replace("_", " ") for column in table.columns]
    rows = [
        [value if isinstance(value, str) else "–" if pd.isna(value) else f"{value:.1f}" for value in row]
        for row in table.itertuples(index=False)
    ]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
