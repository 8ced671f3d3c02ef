"""Point stores that grow scan by scan and stay small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints

_COMPACT_AT = 3_000_000


@dataclass(frozen=True)
class Rows:
    """Voxel keys (N,), values (N, K) float64, object ids (N,), counts (N,)."""

    keys: Ints
    values: Floats
    object_id: Ints
    count: Ints

    def joined(self, others: list[Rows]) -> Rows:
        """Return all rows, these first."""
        parts = [self, *others]
        return Rows(
            np.concatenate([p.keys for p in parts]),
            np.concatenate([p.values for p in parts]),
            np.concatenate([p.object_id for p in parts]),
            np.concatenate([p.count for p in parts]),
        )


class FirstPoints:
    """Keeps the first point that fell into every voxel."""

    def __init__(self, leaf: float) -> None:
        self._leaf = leaf
        self._rows = _empty(3)
        self._pending: list[Rows] = []

    def add(self, xyz: Floats, object_id: Ints) -> None:
        """Offer points (N, 3) with their object ids (N,)."""
        keys = voxel_keys(voxel_indices(xyz, self._leaf))
        _, first = np.unique(keys, return_index=True)
        ones = np.ones(len(first), dtype=np.int64)
        self._pending.append(Rows(keys[first], xyz[first], object_id[first], ones))
        if sum(len(p.keys) for p in self._pending) > _COMPACT_AT:
            self._compact()

    def result(self) -> tuple[Floats, Ints]:
        """Return the kept points (N, 3) and object ids (N,), in voxel order."""
        self._compact()
        return self._rows.values, self._rows.object_id

    def _compact(self) -> None:
        rows = self._rows.joined(self._pending)
        _, first = np.unique(rows.keys, return_index=True)
        self._rows = Rows(rows.keys[first], rows.values[first], rows.object_id[first], rows.count[first])
        self._pending = []


class MeanPoints:
    """Averages points and one attribute per voxel; the object is that of the first point."""

    def __init__(self, leaf: float) -> None:
        self._leaf = leaf
        self._rows = _empty(4)
        self._pending: list[Rows] = []

    def add(self, xyz: Floats, attribute: NDArray[np.generic], object_id: Ints) -> None:
        """Add points (N, 3), an attribute (N,) and object ids (N,)."""
        keys = voxel_keys(voxel_indices(xyz, self._leaf))
        values = np.column_stack([xyz, attribute.astype(np.float64)])
        rows = Rows(keys, values, object_id, np.ones(len(keys), dtype=np.int64))
        self._pending.append(_summed(rows))
        if sum(len(p.keys) for p in self._pending) > _COMPACT_AT:
            self._rows, self._pending = _summed(self._rows.joined(self._pending)), []

    def result(self) -> tuple[Floats, Floats, Ints, Ints]:
        """Return mean points (N, 3), mean attribute (N,), object ids and counts, in voxel order."""
        self._rows, self._pending = _summed(self._rows.joined(self._pending)), []
        mean = self._rows.values / self._rows.count[:, None]
        return mean[:, :3], mean[:, 3], self._rows.object_id, self._rows.count


def _empty(columns: int) -> Rows:
    none = np.zeros(0, dtype=np.int64)
    return Rows(none, np.zeros((0, columns)), none, none)


def _summed(rows: Rows) -> Rows:
    if len(rows.keys) == 0:
        return rows
    order = np.argsort(rows.keys, kind="stable")
    keys, starts = np.unique(rows.keys[order], return_index=True)
    return Rows(
        keys,
        np.add.reduceat(rows.values[order], starts, axis=0),
        rows.object_id[order][starts],
        np.add.reduceat(rows.count[order], starts),
    )
