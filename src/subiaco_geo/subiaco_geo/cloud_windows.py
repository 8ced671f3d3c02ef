"""Windows of a cloud that stays in its file: memory holds what lies in them, however large the file is."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.cloud_parts import cloud_parts
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Points read at a time for a window, how many such runs are kept for the next one, and are read in a pass.
RUN, _KEPT, _PASS = 1 << 14, 48, 16


class CloudFile:
    """A cloud in its file, and where in it every run of points lies.

    One pass over the file notes the box of every run of :data:`RUN` points; a window reads the runs
    whose boxes it touches. Files written tile by tile, as ours are, let a window touch few.

    Parameters
    ----------
    path : Path
    fields : tuple of str, optional
        Fields wanted; those that the file lacks are left out. None: all, see :func:`cloud_parts`.

    Raises
    ------
    InputError
        As :func:`subiaco_geo.cloud_io.read_cloud`.
    """

    def __init__(self, path: Path, fields: tuple[str, ...] | None) -> None:
        self.path, self._fields = path, fields
        self._whole: PointCloud | None = None
        boxes = []
        for part in cloud_parts(path, fields, _PASS * RUN):
            if len(part) > _PASS * RUN:  # a file that cannot be read in parts is not read again
                self._whole = part
            world = part.world()
            starts = np.arange(0, len(world), RUN)
            ends = (np.minimum, np.maximum)
            boxes.append(np.stack([end.reduceat(world, starts, axis=0) for end in ends], axis=1))
        if not boxes:
            raise InputError(f"{path}: holds no points; copy or export it again")
        self._boxes: Floats = np.concatenate(boxes)
        self.low: Floats = self._boxes[:, 0].min(axis=0)
        self.high: Floats = self._boxes[:, 1].max(axis=0)
        self._origin = np.round(self.low, -2) if np.abs(self.low).max() > 1e4 else np.zeros(3)
        self._run = lru_cache(_KEPT)(self._read)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the runs that are kept: another process reads its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_run"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what another process knows of the file."""
        self.__dict__.update(state)
        self._run = lru_cache(_KEPT)(self._read)

    def parts(self) -> Iterator[PointCloud]:
        """Yield all points part by part."""
        if self._whole is not None:
            return iter((self._whole,))
        return cloud_parts(self.path, self._fields, _PASS * RUN)

    def _read(self, run: int) -> PointCloud:
        if self._whole is not None:
            cloud = self._whole.select(np.arange(run * RUN, min((run + 1) * RUN, len(self._whole))))
        else:
            cloud = next(cloud_parts(self.path, self._fields, RUN, run * RUN))
            cloud = cloud.select(np.arange(min(RUN, len(cloud))))  # a short one that is read whole
        return cloud.rebased(self._origin)

    def inside(self, west: float, south: float, east: float, north: float) -> PointCloud:
        """Return the points in a window [m], world coordinates; the upper edges are outside."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        near = (low[:, 0] < east) & (high[:, 0] >= west) & (low[:, 1] < north) & (high[:, 1] >= south)
        found = []
        for run in np.flatnonzero(near).tolist() or [0]:
            cloud = self._run(run)
            x, y = (cloud.xyz[:, axis] + cloud.origin[axis] for axis in (0, 1))
            found.append(cloud.select((x >= west) & (x < east) & (y >= south) & (y < north)))
        fields = {name: np.concatenate([c.fields[name] for c in found]) for name in found[0].fields}
        xyz = np.concatenate([c.xyz for c in found])
        return PointCloud(xyz, self._origin, found[0].crs, fields)
