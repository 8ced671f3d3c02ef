"""Stage: the plants of the whole map decided against one another (Decision 18)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import shapely
from shapely.geometry.base import BaseGeometry

from subiaco_change.decisions.confidence import ConfidenceConfig, decided_anew
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import ObjectChange
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.plant_measures import PlantConfig
from subiaco_change.decisions.vegetation_null import PlantMeasures, fit_null, null_of, null_words
from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.records import ChangeRecord
from subiaco_change.tiling.stage_params import TileParams
from subiaco_geo.frames import Ints
from subiaco_geo.work.results import register_codec
from subiaco_geo.work.tasks import Inputs


def _well_known_text(shape: Any) -> str:
    return str(shapely.to_wkb(shape, hex=True))


register_codec(BaseGeometry, _well_known_text, shapely.from_wkb)


@dataclass(frozen=True)
class PlantRow:
    """A row of a tile on which the plants of the pair have a say: its number, measures and LoD95 [m]."""

    row: int
    plant: PlantMeasures
    lod: float


@dataclass(frozen=True)
class RowPoints:
    """Points of the rows in one epoch; ``points`` (P, 3): position among ``tiles``, place there, row."""

    tiles: tuple[str, ...]
    points: Ints


@dataclass(frozen=True)
class TileComparison:
    """Rows of the groups of a tile.

    Parts of objects have numbers below zero in ``records``; ``plants``: what was measured of the plants among
    the rows.
    """

    records: tuple[ChangeRecord, ...]
    plants: tuple[PlantRow, ...]
    before: RowPoints
    after: RowPoints

    def of(self, epoch: str) -> RowPoints:
        """Return the points of an epoch."""
        return self.before if epoch == "before" else self.after


@dataclass(frozen=True)
class TileRows:
    """Rows of the groups of a tile in their order, decided."""

    records: tuple[ChangeRecord, ...]


@dataclass(frozen=True)
class FittedNull:
    """Null distribution of the plants of the pair, as JSON."""

    words: str


@dataclass(frozen=True)
class PlantSlice:
    """What the null distribution reads of the configuration."""

    plants: PlantConfig


@dataclass(frozen=True)
class PlantDecisionSlice:
    """What the decision of plants reads of the configuration."""

    RULE_STAGES: ClassVar[tuple[str, ...]] = ("plants",)

    decisions: DecisionConfig
    plants: PlantConfig
    confidence: ConfidenceConfig
    rules_off: tuple[str, ...]


def plants_of(changes: Sequence[ObjectChange]) -> tuple[PlantRow, ...]:
    """Return the plants among the rows of a tile."""
    return tuple(PlantRow(k, c.plant, c.lod) for k, c in enumerate(changes) if c.plant is not None)


def find_vegetation_null(inputs: Inputs, params: TileParams[PlantSlice]) -> FittedNull:
    """Fit what the unchanged plants of the pair differ by, from ``compared/<tile>`` of all tiles."""
    plants = [
        row.plant
        for tile in inputs.under("compared")
        for row in inputs.of(TileComparison, f"compared/{tile}").plants
    ]
    return FittedNull(null_words(fit_null(plants, params.config.plants.null_model)))


@obeys_rules
def decide_tile(inputs: Inputs, params: TileParams[PlantDecisionSlice]) -> TileRows:
    """Decide the plants of a tile again, with the null of the pair; all other rows stay as they are.

    ``inputs`` hold ``compared`` of the tile and ``null``.
    """
    config = params.config
    null = null_of(inputs.of(FittedNull, "null").words, config.plants.null_model)
    compared = inputs.of(TileComparison, "compared")
    rows = list(compared.records)
    for found in compared.plants:
        decision = decide_plant(found.plant, found.lod, config.decisions, null)
        rows[found.row] = decided_anew(rows[found.row], decision, config.confidence)
    return TileRows(tuple(rows))
