"""Stage: rows of all tiles as one table with stable numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.ground_change import GroundPatch
from subiaco_change.decisions.point_labels import patch_record
from subiaco_change.records import ChangeRecord
from subiaco_change.tiling.decision_stages import TileRows
from subiaco_change.tiling.ground_stage import PatchRow, TilePatches
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.work.task_runner import TaskRunner


@dataclass(frozen=True)
class RowColumns:
    """Columns (R,) of the rows of all tiles; those of ``anchors[k]`` begin at ``offset[k]``."""

    anchors: tuple[str, ...]
    offset: Ints
    id: Ints
    change: NDArray[np.uint8]
    semantic: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    dz: Floats
    lod: Floats

    def first(self, anchor: str) -> int:
        """Return the position of the first row of a tile."""
        return int(self.offset[self.anchors.index(anchor)])


@dataclass(frozen=True)
class TableColumns:
    """What tasks must know of the table: rows of objects and of patches of ground."""

    objects: RowColumns
    patches: RowColumns


@dataclass(frozen=True)
class Table:
    """Rows by id, and what tasks must know of them."""

    records: tuple[ChangeRecord, ...]
    columns: TableColumns


def build_table(
    runner: TaskRunner,
    compared: Mapping[str, str],
    patched: Mapping[str, str],
    counts: Sequence[int],
    origin: Floats,
    evidence: str,
    trust: Callable[[Sequence[ChangeRecord]], Sequence[ChangeRecord]] = lambda rows: rows,
) -> Table:
    """Collect the rows.

    Parameters
    ----------
    runner : TaskRunner
    compared, patched : mapping of str to str
        Keys of decided objects and of patches, by tile.
    counts : (int, int)
        Objects of *before* and of *after*: pieces cut off later are numbered on from there.
    origin : (3,) float64
    evidence : str
        For rows of the ground.
    trust : callable, optional
        Gives the rows the confidences that they have among each other.
    """
    objects = {tile: list(runner.load(TileRows, compared[tile]).records) for tile in sorted(compared)}
    patches = {
        tile: [_patch(row, origin, evidence) for row in runner.load(TilePatches, patched[tile]).rows]
        for tile in sorted(patched)
    }
    ranked = sorted(
        (
            (_rank(row), "object", tile, k, row)
            for tile, rows in objects.items()
            for k, row in enumerate(rows)
        ),
        key=lambda item: item[:4],
    )
    ranked += sorted(
        ((_rank(row), "patch", tile, k, row) for tile, rows in patches.items() for k, row in enumerate(rows)),
        key=lambda item: item[:4],
    )
    numbers = {(kind, tile, k): i for i, (_, kind, tile, k, _) in enumerate(ranked)}
    pieces: tuple[dict[tuple[str, int], int], ...] = ({}, {})
    trusted = trust([row for *_, row in ranked])
    records = [
        replace(
            row,
            object_id=i,
            id_before=_named(row.id_before, tile, counts[0], pieces[0]),
            id_after=_named(row.id_after, tile, counts[1], pieces[1]),
        )
        for i, ((_, _, tile, _, _), row) in enumerate(zip(ranked, trusted, strict=True))
    ]
    columns = TableColumns(
        _columns("object", objects, numbers, records), _columns("patch", patches, numbers, records)
    )
    return Table(tuple(records), columns)


def _rank(row: ChangeRecord) -> tuple[float, ...]:
    return (int(row.semantic), round(row.x, 2), round(row.y, 2), round(row.z, 2), row.n_before, row.n_after)


def _named(
    ids: tuple[int, ...], tile: str, count: int, pieces: dict[tuple[str, int], int]
) -> tuple[int, ...]:
    return tuple(k if k >= 0 else count + pieces.setdefault((tile, k), len(pieces)) for k in ids)


def _patch(row: PatchRow, origin: Floats, evidence: str) -> ChangeRecord:
    none = np.zeros((0, 2), dtype=np.int64)
    patch = GroundPatch(
        row.change, row.area, row.dz, row.dz_spread, row.lod, none, row.outline, row.confidence, row.reason
    )
    return patch_record(patch, origin, row.height, evidence)


def _columns(
    kind: str,
    rows: Mapping[str, list[ChangeRecord]],
    numbers: Mapping[tuple[str, str, int], int],
    records: Sequence[ChangeRecord],
) -> RowColumns:
    ids = [numbers[kind, tile, k] for tile, own in rows.items() for k in range(len(own))]
    found = [records[i] for i in ids]
    return RowColumns(
        anchors=tuple(rows),
        offset=np.concatenate([[0], np.cumsum([len(own) for own in rows.values()])]).astype(np.int64),
        id=np.array(ids, dtype=np.int64),
        change=np.array([r.change for r in found], dtype=np.uint8),
        semantic=np.array([r.semantic for r in found], dtype=np.uint8),
        confidence=np.array([r.confidence for r in found], dtype=np.float32),
        dz=np.array([r.delta_h_m for r in found], dtype=np.float64),
        lod=np.array([r.lod95_m for r in found], dtype=np.float64),
    )
