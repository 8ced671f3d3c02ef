"""Preview of a change run: thinned labelled clouds and the boxes of objects, built tile by tile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from subiaco_change.records import ChangeRecord, ChangeResult, TiledResult
from subiaco_geo.clouds import PointCloud, concatenate
from subiaco_geo.frames import Floats, Ints

_SPREAD = np.uint64(0x9E3779B97F4A7C15)  # odd, near 2^64 / golden ratio: products spread over all values


@dataclass(frozen=True)
class ChangePreview:
    """What a viewer shows of a change run, however large the city.

    Parameters
    ----------
    records : tuple of ChangeRecord
    before, after : PointCloud
        Labelled clouds in the frame of *after*, thinned evenly.
    boxes : mapping
        Least and greatest world coordinates (3,) [m] of every object, over both epochs.
    """

    records: tuple[ChangeRecord, ...]
    before: PointCloud
    after: PointCloud
    boxes: Mapping[int, tuple[Floats, Floats]]


def build_preview(result: TiledResult | ChangeResult, most: int) -> ChangePreview:
    """Build the preview of a result, of which one tile is in memory at a time.

    Parameters
    ----------
    result : TiledResult or ChangeResult
    most : int
        Largest number of points of each cloud.
    """
    thinned = CloudThinning(most), CloudThinning(most)
    boxes: dict[int, tuple[Floats, Floats]] = {}
    for pair in result.parts():
        for thinning, cloud in zip(thinned, pair, strict=True):
            thinning.add(cloud)
            _extend(boxes, cloud)
    before, after = (thinning.cloud() for thinning in thinned)
    return ChangePreview(result.records, before, after, boxes)


class CloudThinning:
    """Keeps an even share of the points of clouds that come one after the other.

    A point is kept where a hash of its number is below a limit, which is halved whenever too many are kept.

    Parameters
    ----------
    most : int
        Largest number of points that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most, self._halvings = most, 0
        self._parts: list[tuple[PointCloud, Ints]] = []
        self._count = 0

    def add(self, cloud: PointCloud) -> None:
        """Take a cloud, about the same origin as the others."""
        numbers = np.arange(self._count, self._count + len(cloud))
        self._count += len(cloud)
        self._parts.append(self._kept(cloud, numbers))
        while sum(len(part) for part, _ in self._parts) > self._most:
            self._halvings += 1
            self._parts = [self._kept(*part) for part in self._parts]

    def _kept(self, cloud: PointCloud, numbers: Ints) -> tuple[PointCloud, Ints]:
        if self._halvings == 0:
            return cloud, numbers
        chosen = numbers.astype(np.uint64) * _SPREAD >> np.uint64(64 - self._halvings) == 0
        return cloud.select(chosen), numbers[chosen]

    def cloud(self) -> PointCloud:
        """Return what was kept."""
        return concatenate([part for part, _ in self._parts])


def _extend(boxes: dict[int, tuple[Floats, Floats]], cloud: PointCloud) -> None:
    """Extend the boxes of objects by the points of a cloud."""
    instance = cloud.fields["instance"]
    order = np.argsort(instance, kind="stable")
    numbers, starts = np.unique(instance[order], return_index=True)
    if not len(numbers):
        return
    xyz = cloud.world()[order]
    low, high = np.minimum.reduceat(xyz, starts, axis=0), np.maximum.reduceat(xyz, starts, axis=0)
    for number, least, greatest in zip(numbers.tolist(), low, high, strict=True):
        if number >= 0:
            known = boxes.get(number, (least, greatest))
            boxes[number] = np.minimum(known[0], least), np.maximum(known[1], greatest)
