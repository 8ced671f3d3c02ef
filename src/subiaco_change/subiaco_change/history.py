"""History of objects over more than two epochs."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from shapely.geometry import MultiPolygon

from subiaco_change.job import run_change
from subiaco_change.outputs.directory import PageWriter
from subiaco_change.outputs.geopackage import write_layer
from subiaco_change.outputs.reviews import read_reviewed, same_objects
from subiaco_change.outputs.table import write_csv
from subiaco_change.request import ChangeRequest
from subiaco_change.segmentation.clustering import connect
from subiaco_geo.atomic import refuse_existing, refuse_foreign, whole_directory
from subiaco_geo.codes import CHANGED_LABELS, Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints
from subiaco_geo.sources import open_epoch

#: What tells a directory of several epochs from another folder.
MARKER = "history.csv"
COLUMNS = (
    "history_id",
    "class",
    "first_seen",
    "last_seen",
    "appeared_after",
    "gone_by",
    "not_seen",
    "changes",
    "confidence",
    "object_uids",
)
#: What a pair says of an object that it claims to be absent in the epoch of an end.
_ABSENT = {"id_before": Change.ADDED, "id_after": Change.REMOVED}


@dataclass(frozen=True)
class HistoryStep:
    """The table between two epochs that follow each other, and their names."""

    before: str
    after: str
    table: gpd.GeoDataFrame


def run_epochs(
    epochs: Sequence[Path],
    request: ChangeRequest,
    progress: Callable[[str, float], None] | None = None,
    write_pages: PageWriter | None = None,
) -> gpd.GeoDataFrame:
    """Compare epochs that follow each other, and follow every object through all of them.

    Parameters
    ----------
    epochs : sequence of Path
        Three or more map directories or clouds, in the order of time.
    request : ChangeRequest
        Its options hold for every pair; pairs share the stages of the epoch between them. Its output gets a
        change directory ``<before>_to_<after>`` for every pair, ``history.csv`` and ``history.gpkg``.
    progress : callable, optional
    write_pages : callable, optional
        Writes the report of every pair.

    Returns
    -------
    GeoDataFrame
        See :func:`build_history`.

    Raises
    ------
    InputError, RegistrationError
        Nothing is left under the output then; options that hold for one pair alone are refused.
    """
    output, overwrite = request.output, request.overwrite
    names = _names(epochs)
    if request.trajectory_before or request.trajectory_after or request.given:
        raise InputError("trajectories and given classes need exactly two epochs")
    if request.transform is not None and not np.array_equal(request.transform, np.eye(4)):
        raise InputError("a known transform other than the identity needs exactly two epochs")
    refuse_existing(output, overwrite)
    refuse_foreign(output, MARKER)
    for epoch in epochs:
        open_epoch(epoch)  # a missing or damaged epoch is refused before the first comparison
    steps = []
    stages = request.stages or output.with_name(f"{output.name}.stages")
    with whole_directory(output, overwrite=overwrite, marker=MARKER) as target:
        for number, ((first, second), (before, after)) in enumerate(
            zip(pairwise(epochs), pairwise(names), strict=True)
        ):
            pair = target / f"{before}_to_{after}"
            own = {"before": first, "after": second, "output": pair, "overwrite": False, "stages": stages}
            shared = _share(progress, number, len(names) - 1, f"{before} to {after}")
            run_change(request.model_copy(update=own), shared, write_pages=write_pages)
            table = read_reviewed(pair)
            assert table is not None, "written just now"
            steps.append(HistoryStep(before, after, table))
        history = build_history(steps)
        write_csv(target / MARKER, history)
        write_layer(target / "history.gpkg", "history", history)
    if request.stages is None:
        shutil.rmtree(stages, ignore_errors=True)
    return history


def _names(epochs: Sequence[Path]) -> list[str]:
    """Name the epochs after their directories or files."""
    names = [path.resolve().name if path.is_dir() else path.stem for path in epochs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two epochs are called {name}; rename one of the directories")
    return names


def _share(
    progress: Callable[[str, float], None] | None, number: int, count: int, pair: str
) -> Callable[[str, float], None] | None:
    """Give a pair its share of the progress of all."""
    if progress is None:
        return None
    return lambda stage, fraction: progress(f"{pair}: {stage}", (number + fraction) / count)


def build_history(steps: Sequence[HistoryStep]) -> gpd.GeoDataFrame:
    """Follow every object through the tables of epochs that follow each other.

    Two rows are one object where they share an instance of the epoch
    between them, or where neither has an instance there, no pair claims
    absence, and their footprints agree. Two rows of one pair are one object
    where each pair says of both that the place is occupied in the other
    epoch, and their footprints agree. A changed ground patch has no
    instances and is an object of its own. Mobile objects are left out.

    An epoch counts as one that saw the object absent only where a row says
    Added or Removed.

    Parameters
    ----------
    steps : sequence of HistoryStep
        In the order of time; each begins where the one before ends.

    Returns
    -------
    GeoDataFrame
        One row an object: :data:`COLUMNS` and the footprint of its last row.
        ``appeared_after`` is the last epoch that saw it absent, ``gone_by`` the
        first that saw it gone again, both empty where the object outlives the
        surveys; ``not_seen`` names epochs that could not tell.
    """
    kept = [replace(s, table=s.table[s.table["class"] != Semantic.MOBILE.label]) for s in steps]
    starts = np.cumsum([0, *(len(s.table) for s in kept)])
    links = [
        _links(first.table, second.table) + starts[number : number + 2]
        for number, (first, second) in enumerate(pairwise(kept))
    ]
    places = [_same_place(step.table) + start for step, start in zip(kept, starts, strict=False)]
    pairs = np.concatenate([*links, *places, np.empty((0, 2), dtype=np.int64)])
    size = int(starts[-1])
    component = connect(size, pairs)
    order = np.argsort(component, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(component[order])) + 1) if size else []
    rows = [_history(kept, starts, members) for members in groups]
    frame = pd.DataFrame(rows, columns=[*COLUMNS, "geometry"])
    return gpd.GeoDataFrame(frame, geometry="geometry", crs=kept[-1].table.crs)


def _links(first: gpd.GeoDataFrame, second: gpd.GeoDataFrame) -> Ints:
    """Rows (P, 2) of two tables that are one object, by the epoch between them."""
    instances = _instances(second["id_before"])
    pairs = [
        (row, other)
        for row, text in enumerate(first["id_after"])
        for instance in text.split(";")
        for other in instances.get(instance, ())
    ]
    open_ends = _without_instance(first, "id_after"), _without_instance(second, "id_before")
    pairs += _pairs_by_place(first, open_ends[0], second, open_ends[1])
    return np.array(sorted(set(pairs)), dtype=np.int64).reshape(-1, 2)


def _same_place(table: gpd.GeoDataFrame) -> Ints:
    """Rows (P, 2) of one table that are one object: each is occupied in the other epoch, at one place."""
    occupied = table["label"] != Change.UNOBSERVED.label
    old, new = (
        np.intersect1d(_without_instance(table, end), np.flatnonzero(occupied))
        for end in ("id_after", "id_before")
    )
    return np.array(_pairs_by_place(table, old, table, new), dtype=np.int64).reshape(-1, 2)


def _without_instance(table: gpd.GeoDataFrame, end: str) -> Ints:
    """Rows (K,) without an instance in an epoch that do not claim that the object is absent there."""
    claimed = table["label"] == _ABSENT[end].label
    return np.flatnonzero((table[end] == "") & ~claimed & (table["class"] != Semantic.GROUND.label))


def _pairs_by_place(
    first: gpd.GeoDataFrame, rows: Ints, second: gpd.GeoDataFrame, others: Ints
) -> list[tuple[int, int]]:
    """Pair rows of two tables whose class and footprint agree."""
    new, old = same_objects(second.iloc[others], first.iloc[rows])
    return list(zip(rows[old].tolist(), others[new].tolist(), strict=True))


def _instances(column: pd.Series) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for row, text in enumerate(column):
        for instance in filter(None, text.split(";")):
            found.setdefault(instance, []).append(row)
    return found


def _history(steps: Sequence[HistoryStep], starts: Ints, members: Ints) -> tuple[Any, ...]:
    """Sum up the rows of one object."""
    names = [steps[0].before, *(s.after for s in steps)]
    seen, absent, unknown = set[int](), set[int](), set[int]()
    changes, uids, confidences = [], [], []
    for member in members:
        number = int(np.searchsorted(starts, member, side="right")) - 1
        step, row = steps[number], steps[number].table.iloc[member - starts[number]]
        for epoch, end in ((number, "id_before"), (number + 1, "id_after")):
            if row["label"] == _ABSENT[end].label:
                absent.add(epoch)
            elif row["label"] == Change.UNOBSERVED.label and not row[end]:
                unknown.add(epoch)
            else:
                seen.add(epoch)
        uids.append(row["object_uid"])
        if row["label"] in CHANGED_LABELS:
            changes.append(f"{step.before} to {step.after}: {row['label']}")
            confidences.append(float(row["confidence"]))
    first, last = min(seen, default=0), max(seen, default=0)
    before = [e for e in absent if e < first]
    later = [e for e in absent if e > last]
    return (
        uids[0],
        row["class"],
        names[first],
        names[last],
        names[max(before)] if before else "",
        names[min(later)] if later else "",
        ";".join(names[e] for e in sorted(unknown - seen)),
        "; ".join(changes),
        min(confidences, default=float("nan")),
        ";".join(uids),
        row.geometry if isinstance(row.geometry, MultiPolygon) else MultiPolygon([row.geometry]),
    )
