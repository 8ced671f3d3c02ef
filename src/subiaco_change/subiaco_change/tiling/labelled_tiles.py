"""The labelled clouds of a run, tile by tile, as any process reads them from the store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.tiling.epoch_stages import Epochs
from subiaco_change.tiling.epoch_tiles import EPOCHS, EpochContext, InputPoints
from subiaco_change.tiling.every_point import with_every_point
from subiaco_change.tiling.label_stage import TileLabels
from subiaco_change.tiling.retiling import LabelledPoints
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats
from subiaco_geo.work.results import unpack
from subiaco_geo.work.store import Store


@dataclass(frozen=True)
class LabelledTiles:
    """Where the labelled points of both epochs lie, and what else their clouds are made of.

    ``labelled``: keys of the labels by tile; ``points``, ``inputs`` and ``lit``: by epoch, as in
    :class:`~subiaco_change.tiling.epoch_stages.Epochs`.
    """

    store: Store
    origin: Floats
    sides: tuple[EpochContext, ...]
    frame: CommonFrame
    labelled: Mapping[str, str]
    points: Mapping[str, Mapping[str, str]]
    inputs: Mapping[str, Mapping[str, str]]
    lit: Mapping[str, bool]
    every_point: bool

    @staticmethod
    def of(run: Epochs, frame: CommonFrame, labelled: Mapping[str, str]) -> LabelledTiles:
        """Take of a run what its clouds are made of."""
        return LabelledTiles(
            run.runner.store, run.origin, run.sides, frame, labelled, run.points, run.inputs, run.lit,
            run.config.every_point,
        )  # fmt: skip

    def tile(self, epoch: str, tile: str) -> PointCloud:
        """Return the labelled points of a tile of an epoch, thinned to the leaf; there may be none."""
        piece = unpack(TileLabels, self.store.load(self.labelled[tile])).of(epoch)
        fields: dict[str, NDArray[Any]] = {
            **piece.labels.fields(),
            "m3c2_distance": piece.m3c2_distance,
            "m3c2_significant": piece.m3c2_significant,
            "normals": piece.normals,
        }
        if self.lit[epoch]:
            own = self.points[epoch]
            known = self._points(epoch, tile).intensity if tile in own else None
            fields["intensity"] = np.zeros(0, np.float32) if known is None else known
        return PointCloud(piece.xyz, self.origin, self._side(epoch).crs, fields)

    def written(self, epoch: str, tile: str) -> PointCloud:
        """Return the points of a tile that are written: all of the input, or those of the leaf."""
        thinned = self.tile(epoch, tile)
        if not self.every_point or not len(thinned):
            return thinned
        points = self._points(epoch, tile)
        pieces = [unpack(InputPoints, self.store.load(self.inputs[epoch][name])) for name in points.sources]
        return with_every_point(thinned, points, pieces, self._side(epoch), self.frame)

    def _points(self, epoch: str, tile: str) -> LabelledPoints:
        return unpack(LabelledPoints, self.store.load(self.points[epoch][tile]))

    def _side(self, epoch: str) -> EpochContext:
        return self.sides[EPOCHS.index(epoch)]
