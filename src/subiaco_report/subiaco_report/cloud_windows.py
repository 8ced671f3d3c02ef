"""Parts of both labelled clouds that the pages need, gathered in one pass."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from subiaco_change.outputs.change_directory_reading import ChangeDirectory
from subiaco_change.outputs.rasters import Coverage, read_coverage
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.frames import Ints
from subiaco_report.city_map import LONGEST
from subiaco_report.pictures import PictureBlocks, overview_frame
from subiaco_report.top_views import Above

_LOD_STEP, _LOD_STEPS = 1e-4, 100_000  # of the counted levels of detection [m], and how many there are


@dataclass
class LodCounts:
    """How many points have which level of detection."""

    counts: Ints = field(default_factory=lambda: np.zeros(_LOD_STEPS + 1, dtype=np.int64))
    points: int = 0

    def add(self, lod95: NDArray[np.float32]) -> None:
        """Take levels (N,) [m]; one that is not finite claims nothing."""
        steps = lod95[np.isfinite(lod95)].astype(np.float64) / _LOD_STEP
        index = np.minimum(steps, _LOD_STEPS).astype(np.int64)
        self.counts += np.bincount(index, minlength=_LOD_STEPS + 1)
        self.points += len(lod95)

    def percentile(self, percent: float) -> float | None:
        """Return a percentile [m] over all points, to a twentieth of a millimetre.

        A point without a level counts as one that is larger than any. None where the percentile has none.
        """
        total = np.cumsum(self.counts)
        rank = percent / 100.0 * self.points
        if total[-1] == 0 or total[-1] < rank:
            return None
        return float(np.searchsorted(total, rank) + 0.5) * _LOD_STEP

    @property
    def unclaimed(self) -> float:
        """Share of the points that claim nothing."""
        return 1.0 - float(self.counts.sum()) / max(self.points, 1)


@dataclass(frozen=True)
class Gathered:
    """Both labelled clouds in their files (*before*, *after*), and what one pass over them tells.

    ``overview`` and ``city`` are the same view at two sizes.
    """

    epochs: tuple[CloudFile, CloudFile]
    coverage: Coverage
    blocks: PictureBlocks
    lod: LodCounts
    overview: Above
    city: Above


def gather(change: ChangeDirectory) -> Gathered:
    """Read both labelled clouds of a change directory once, part by part."""
    epochs = change.open("before"), change.open("after")
    low = np.minimum(*(epoch.low[:2] for epoch in epochs))
    high = np.maximum(*(epoch.high[:2] for epoch in epochs))
    overview, city = Above(overview_frame(low, high)), Above(overview_frame(low, high, LONGEST))
    coverage = read_coverage(change.path / "coverage.tif")
    found = Gathered(epochs, coverage, PictureBlocks(low, high), LodCounts(), overview, city)
    for epoch in epochs:
        for part in epoch.parts():
            world, label = part.world(), np.asarray(part.fields["change"], dtype=np.uint8)
            found.blocks.add(world)
            found.lod.add(np.asarray(part.fields["lod95"], dtype=np.float32))
            overview.add(world, label)
            city.add(world, label)
    return found
