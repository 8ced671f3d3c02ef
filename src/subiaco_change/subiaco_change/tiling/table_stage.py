"""Stage: rows of all tiles as one table with stable numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from subiaco_change.decisions.ground_change import GroundPatch
from subiaco_change.decisions.point_labels import patch_record
from subiaco_change.records import ChangeRecord
from subiaco_change.tiling.plant_stage import record_of
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats
from subiaco_geo.work.store import Arrays, Store


@dataclass(frozen=True)
class Table:
    """Rows by id, and what tasks must know of them.

    ``arrays``: for objects and, with ``patch_`` before the name, for patches of ground: ``anchors``
    (A,) tiles, ``offset`` (A + 1,), and in the order of these ``id change semantic confidence`` (R,).
    """

    records: tuple[ChangeRecord, ...]
    arrays: Arrays


def build_table(
    store: Store,
    compared: Mapping[str, str],
    patched: Mapping[str, str],
    counts: Sequence[int],
    origin: Floats,
    evidence: str,
    trust: Callable[[ChangeRecord], ChangeRecord] = lambda row: row,
) -> Table:
    """Collect the rows.

    Parameters
    ----------
    store : Store
    compared, patched : mapping of str to str
        Keys of decided objects and of patches, by tile.
    counts : (int, int)
        Objects of *before* and of *after*: pieces cut off later are numbered on from there.
    origin : (3,) float64
    evidence : str
        For rows of the ground.
    trust : callable, optional
        Lowers confidences that were never calibrated.
    """
    objects = {
        tile: [record_of(words) for words in json.loads(str(store.load(compared[tile])["records"]))]
        for tile in sorted(compared)
    }
    patches = {
        tile: [
            _patch(words, origin, evidence) for words in json.loads(str(store.load(patched[tile])["records"]))
        ]
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
    records = [
        replace(
            trust(row),
            object_id=i,
            id_before=_named(row.id_before, tile, counts[0], pieces[0]),
            id_after=_named(row.id_after, tile, counts[1], pieces[1]),
        )
        for i, (_, _, tile, _, row) in enumerate(ranked)
    ]
    arrays = {
        **_columns("", "object", objects, numbers, records),
        **_columns("patch_", "patch", patches, numbers, records),
    }
    return Table(tuple(records), arrays)


def _rank(row: ChangeRecord) -> tuple[float, ...]:
    return (int(row.semantic), round(row.x, 2), round(row.y, 2), round(row.z, 2), row.n_before, row.n_after)


def _named(
    ids: tuple[int, ...], tile: str, count: int, pieces: dict[tuple[str, int], int]
) -> tuple[int, ...]:
    return tuple(k if k >= 0 else count + pieces.setdefault((tile, k), len(pieces)) for k in ids)


def patch_of(words: Mapping[str, object]) -> GroundPatch:
    """Return the patch that a tile took apart; without its cells."""
    return GroundPatch(
        Change(int(str(words["change"]))),
        float(str(words["area"])),
        float(str(words["dz"])),
        float(str(words["dz_spread"])),
        float(str(words["lod"])),
        np.zeros((0, 2), dtype=np.int64),
        shapely.from_wkb(str(words["outline"])),
        float(str(words["confidence"])),
        str(words["reason"]),
    )


def _patch(words: Mapping[str, object], origin: Floats, evidence: str) -> ChangeRecord:
    return patch_record(patch_of(words), origin, float(str(words["height"])), evidence)


def _columns(
    prefix: str,
    kind: str,
    rows: Mapping[str, list[ChangeRecord]],
    numbers: Mapping[tuple[str, str, int], int],
    records: Sequence[ChangeRecord],
) -> dict[str, np.ndarray]:
    ids = [numbers[kind, tile, k] for tile, own in rows.items() for k in range(len(own))]
    found = [records[i] for i in ids]
    return {
        f"{prefix}anchors": np.array(list(rows), dtype=np.str_),
        f"{prefix}offset": np.concatenate([[0], np.cumsum([len(own) for own in rows.values()])]).astype(
            np.int64
        ),
        f"{prefix}id": np.array(ids, dtype=np.int64),
        f"{prefix}change": np.array([r.change for r in found], dtype=np.uint8),
        f"{prefix}semantic": np.array([r.semantic for r in found], dtype=np.uint8),
        f"{prefix}confidence": np.array([r.confidence for r in found], dtype=np.float32),
        f"{prefix}dz": np.array([r.delta_h_m for r in found], dtype=np.float64),
        f"{prefix}lod": np.array([r.lod95_m for r in found], dtype=np.float64),
    }
