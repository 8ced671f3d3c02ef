"""Tune the simple methods on tuning seeds: one setting after the other, each value tabulated.

Fused maps, the true registration, cells of the published protocol pooled over the seeds; the settings of
:mod:`subiaco_evaluation.baselines.config` are where the search begins. Reporting seeds are refused.

Called by ``scripts/prove_presets.py --tune``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_evaluation.baseline_run import compare_pair
from subiaco_evaluation.baselines.cells import Pair
from subiaco_evaluation.baselines.pair_preparation import prepare_pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.grid import GridConfig, LabelledCells, look_up, rasterise
from subiaco_evaluation.layouts import in_after_frame
from subiaco_evaluation.scores import confusion, scores
from subiaco_evaluation.truth import read_truth
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Ints
from subiaco_geo.maps import load_epoch

_VOIDS = ("unchanged", "ground", "unobserved")
_CLEANING: dict[str, tuple[Any, ...]] = {
    "min_area": (0.0, 1.0, 2.0, 4.0, 8.0, 16.0), "opening": (0, 1), "voids": _VOIDS,
}  # fmt: skip
#: Values that are tried, by method and setting.
SEARCHED: dict[str, dict[str, tuple[Any, ...]]] = {
    "dsm": {"threshold": (0.1, 0.15, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0), **_CLEANING},
    "nn": {"minimum": (0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5), **_CLEANING},
    "c2c": {"threshold": (0.2, 0.35, 0.5, 0.75, 1.0, 1.5), **_CLEANING},
    "m3c2": {
        "minimum": (0.1, 0.2, 0.35, 0.5),
        "half_length": (1.0, 2.0),
        "no_counterpart": ("changed", "unchanged"),
        **_CLEANING,
    },
}


@dataclass(frozen=True)
class Case:
    """One survey, prepared: both maps in one frame, and the true cells."""

    pair: Pair
    truth: LabelledCells

    def score(self, method: str, config: BaselineConfig) -> Ints:
        """Return the 5x6 matrix of a method."""
        said = compare_pair(self.pair, method, config)
        codes, _ = look_up(cells_of(said.before, said.after), self.truth.keys)
        labelled = (self.truth.codes < 5) & (codes != 254)
        return confusion(self.truth.codes[labelled], codes[labelled])


def cells_of(before: PointCloud, after: PointCloud) -> LabelledCells:
    """Return the cells of labelled points of both epochs, by the published protocol."""
    clouds = (before, after)
    return rasterise(
        np.concatenate([c.world() for c in clouds]),
        np.concatenate([c.fields["change"] for c in clouds]),
        np.repeat([0, 1], [len(before), len(after)]),
        GridConfig(),
    )


def prepare(survey: Path, config: BaselineConfig) -> Case:
    """Read a simulated survey with fused maps."""
    truth = read_truth(survey)
    epochs = (load_epoch(survey / epoch) for epoch in ("before", "after"))
    pair, _ = prepare_pair(*epochs, config, truth.T_after_before)
    real = in_after_frame(truth)
    return Case(pair, cells_of(real["before"], real["after"]))


def pooled(cases: Iterable[Case], method: str, config: BaselineConfig) -> float:
    """Return the mIoU over all cases together [percent]."""
    return scores(sum(case.score(method, config) for case in cases))["miou_percent"]


def with_setting(config: BaselineConfig, method: str, name: str, value: object) -> BaselineConfig:
    """Return settings with one of a method's changed."""
    part = getattr(config, method).model_copy(update={name: value})
    return config.model_copy(update={method: part})


def tune(surveys: list[Path], methods: list[str], rounds: int = 1) -> dict[str, dict[str, Any]]:
    """Print a table a method and return what is best: each setting in turn, the others held.

    A value replaces the one that stands only where it is better by 0.1 mIoU.
    """
    config = BaselineConfig()
    cases = [prepare(survey, config) for survey in surveys]
    best = {}
    for method in methods:
        top = pooled(cases, method, config)
        print(f"{method}: {top:.2f} mIoU with the defaults, {len(cases)} seeds", flush=True)
        for _ in range(rounds):
            for name, values in SEARCHED[method].items():
                config, top = _tune_setting(cases, method, config, name, values, top)
        chosen = {name: getattr(getattr(config, method), name) for name in SEARCHED[method]}
        best[method] = {"miou_percent": round(top, 2), **chosen}
        print(f"{method}: best {best[method]}", flush=True)
    return best


def _tune_setting(
    cases: list[Case],
    method: str,
    config: BaselineConfig,
    name: str,
    values: tuple[Any, ...],
    top: float,
) -> tuple[BaselineConfig, float]:
    stands = getattr(getattr(config, method), name)
    found = {stands: top}
    for value in values:
        if value not in found:
            found[value] = pooled(cases, method, with_setting(config, method, name, value))
    print(f"  {name:14} " + "  ".join(f"{v}: {found[v]:.1f}" for v in sorted(found, key=str)), flush=True)
    leader = max(found, key=lambda value: found[value])
    if found[leader] < top + 0.1:
        return config, top
    return with_setting(config, method, name, leader), found[leader]
