"""Scores without the changes whose true magnitude lies near a gate of the published thresholds.

The simulator marks such objects in ``truth/objects.csv`` (column ``near_gate``): within the uncertainty of
its own measurement their true label could as well be another one, so a claim about them is neither right nor
wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from subiaco_evaluation import object_matching as objects
from subiaco_evaluation.scores import LABELS, describe, reliability
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.frames import Ints

COLUMN = "near_gate"
_OWNED = 0.5  # share of a row's points on objects near a gate from which the row is left out


@dataclass(frozen=True)
class ClearScore:
    """What was counted on one scene without the objects near a gate, and how many these are."""

    left_out: int
    grid: Ints
    object_counts: dict[str, int] | None
    verdicts: pd.DataFrame | None


def near_gate_ids(table: pd.DataFrame) -> Ints | None:
    """Return the ids of objects near a gate; None where the truth does not say."""
    if COLUMN not in table:
        return None
    return table.loc[table[COLUMN] == 1, "object_id"].to_numpy(np.int64)


def without_objects(truth: PointCloud, ids: Ints) -> PointCloud:
    """Return a true epoch in which the change of some objects counts as not known."""
    change = np.where(np.isin(truth.fields["object"], ids), int(Change.UNOBSERVED), truth.fields["change"])
    return replace(truth, fields={**truth.fields, "change": change.astype(np.uint8)})


def points_without(points: objects.PointPairs, ids: Ints) -> objects.PointPairs:
    """Return the pairs in which the true change of points on some objects is not known."""
    true = np.where(np.isin(points.true_object, ids), objects.NO_TRUTH, points.true_change)
    return replace(points, true_change=true)


def verdicts_without(verdicts: pd.DataFrame, points: objects.PointPairs, ids: Ints) -> pd.DataFrame:
    """Drop the rows of which at least half of the points lie on some objects."""
    mine = points.matched & (points.instance >= 0)
    on_them = pd.Series(np.isin(points.true_object[mine], ids)).groupby(points.instance[mine]).mean()
    return verdicts[~(on_them.reindex(verdicts.index).fillna(0.0) >= _OWNED)]


def pool_clear(found: Sequence[ClearScore | None], bins: int) -> dict[str, Any] | None:
    """Add scenes up without their objects near a gate; None unless every truth marks them."""
    clear = [score for score in found if score is not None]
    if not clear or len(clear) < len(found):
        return None
    counts = [score.object_counts for score in clear if score.object_counts is not None]
    tables = [score.verdicts for score in clear if score.verdicts is not None]
    return {
        "objects_near_gate": sum(score.left_out for score in clear),
        "grid": describe(np.sum([score.grid for score in clear], axis=0)),
        "objects": objects.rates({k: sum(c[k] for c in counts) for k in counts[0]}) if counts else None,
        "changed_rows": changed_reliability(tables, bins),
    }


def changed_reliability(tables: Sequence[pd.DataFrame], bins: int) -> dict[str, Any] | None:
    """Return the reliability of the rows that claim a change; None without tables."""
    if not tables:
        return None
    rows = pd.concat(tables)
    rows = rows[(rows["scored"] > 0) & rows["label"].isin(LABELS) & (rows["label"] != Change.UNCHANGED.label)]
    return reliability(rows["confidence"].to_numpy(np.float64), rows["right"].to_numpy(bool), bins)
