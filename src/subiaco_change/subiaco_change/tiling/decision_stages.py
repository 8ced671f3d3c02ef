"""Stages of the decision: objects of one tile compared and decided, plants decided against the whole map.

The objects of the groups of one tile are matched, measured and decided. Plants are decided once more against
the unchanged plants of all tiles (Decision 18).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from subiaco_change.association.config import AssociationConfig
from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.confidence import decided_anew
from subiaco_change.decisions.confidence_config import ConfidenceConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_comparison import compare_objects, log_ratio, make_record
from subiaco_change.decisions.object_decision import ObjectChange, ObjectRules
from subiaco_change.decisions.plant_decisions import decide_plant, place_was_free
from subiaco_change.decisions.plant_measures import PlantConfig
from subiaco_change.decisions.trail_in_pieces import ROW_REACH
from subiaco_change.decisions.vegetation_null import PlantMeasures, fit_null, null_of, null_words
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.objects.column_volumes import NO_COLUMNS, OpenGround
from subiaco_change.objects.known_space import Certainty, Empty, Free, KnownSpace
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.objects.voxel_objects import NO_OBJECT, OTHERS, EpochView
from subiaco_change.records import ChangeRecord
from subiaco_change.segmentation.classes import SemanticsConfig
from subiaco_change.strategies import Part, choose_strategies
from subiaco_change.tiling.candidate_groups import CandidateGroups
from subiaco_change.tiling.epoch_tiles import EpochContext
from subiaco_change.tiling.stage_inputs import TileParams
from subiaco_change.tiling.tile_surroundings import Near, Region, load_region
from subiaco_change.visibility_evidence import EvidenceConfig, EvidenceKind, weakest
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.work.results import register_codec
from subiaco_geo.work.tasks import Inputs

_CELL = NUMBERS.tiling.region_cell


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
        free = place_was_free(decision, found.plant, config.decisions)
        rows[found.row] = decided_anew(rows[found.row], decision, config.confidence, free)
    return TileRows(tuple(rows))


@dataclass(frozen=True)
class ComparisonSlice:
    """What the comparison of objects reads of the configuration."""

    RULE_STAGES: ClassVar[tuple[str, ...]] = ("comparison",)

    evidence: EvidenceConfig
    measures: MeasureConfig
    association: AssociationConfig
    decisions: DecisionConfig
    plants: PlantConfig
    semantics: SemanticsConfig
    confidence: ConfidenceConfig
    without: tuple[Part, ...]
    rules_off: tuple[str, ...]


@obeys_rules
def compare_tile(inputs: Inputs, params: TileParams[ComparisonSlice]) -> TileComparison:
    """Compare the groups of objects that a tile answers for.

    ``inputs`` hold ``points lods beams`` around, ``groups`` and the frame.
    """
    config = params.config
    groups = inputs.of(CandidateGroups, "groups")
    mine = groups.anchor == groups.tiles.index(params.tile)
    boxes = groups.low[mine], groups.high[mine]
    near, far = _surroundings(*boxes, 1), _far_around(boxes, params.sides)
    regions = [load_region(inputs, side, params.origin, config.evidence, near, far) for side in params.sides]
    members = [mine[groups.before], mine[groups.after]]
    compact = [_compact(r.view, m) for r, m in zip(regions, members, strict=True)]
    views = [view for view, _ in compact]
    kinds = [side.kind for side in params.sides]
    rules = replace(
        with_evidence(object_rules(config), (regions[0], regions[1]), kinds),
        lanes=tuple(r.driven for r in regions if r.driven is not None),
        moved=(regions[0].moved, regions[1].moved),
        around=(regions[0].around, regions[1].around),
        from_above=all(side.from_above for side in params.sides),
    )
    changes = compare_objects(views[0], views[1], regions[0].observed, regions[1].observed, rules)
    numbers = [number for _, number in compact]
    around = log_ratio(len(views[0].xyz), len(views[1].xyz))
    records = [
        _in_city(
            make_record(
                change,
                0,
                params.origin,
                _evidence(change, kinds),
                config.confidence,
                config.decisions,
                around,
            ),
            numbers,
        )
        for change in changes
    ]
    before = RowPoints(tuple(regions[0].tiles), _points(regions[0], changes, "before"))
    after = RowPoints(tuple(regions[1].tiles), _points(regions[1], changes, "after"))
    return TileComparison(tuple(records), plants_of(changes), before, after)


class SpaceEvidence(Protocol):
    """What an epoch knows of the space around, in the common frame; see :class:`Region`."""

    @property
    def empty(self) -> Empty:
        """Tell which places were seen empty."""

    @property
    def free(self) -> Free:
        """Tell how probable it is that nothing stood at places."""

    @property
    def above(self) -> Free:
        """Tell the same above the tops of plants."""

    @property
    def below_view(self) -> Empty:
        """Tell which places are no higher than the view is known to have reached."""

    @property
    def certain(self) -> Certainty:
        """Tell how certain the evidence is at most."""


def with_evidence(
    rules: ObjectRules, evidence: tuple[SpaceEvidence, SpaceEvidence], kinds: Sequence[EvidenceKind]
) -> ObjectRules:
    """Return rules with what both epochs know of the space around: nothing where absence is assumed."""
    before, after = (None if kind == "assumed" else e.empty for e, kind in zip(evidence, kinds, strict=True))
    return replace(
        rules,
        ground=OpenGround(NO_COLUMNS, NO_COLUMNS, (before, after)),
        spaces=(_known_space(evidence[0], kinds[0]), _known_space(evidence[1], kinds[1])),
    )


def _known_space(evidence: SpaceEvidence, kind: EvidenceKind) -> KnownSpace:
    known = kind != "assumed"
    return KnownSpace(
        free=evidence.free if known else None,
        above=evidence.above if known else None,
        below_view=evidence.below_view,
        certain=evidence.certain,
    )


def object_rules(config: ComparisonSlice | ChangeConfig) -> ObjectRules:
    """Rules of the objects, less what is left out."""
    strategy = choose_strategies(config.without)
    decisions = strategy.decisions(config.decisions)
    return ObjectRules(
        config.measures,
        config.association,
        decisions,
        strategy.by_class,
        plants=config.plants,
        vehicles=config.semantics.vehicles,
    )


def _far_around(boxes: tuple[Floats, Floats], sides: Sequence[EpochContext]) -> Near | None:
    """Tell where rows of pieces of traffic may lie around groups; None where beams were counted.

    In a pair that was measured from above, a moving vehicle was met once, and left no row.
    """
    if all(side.kind == "observed" for side in sides) or all(side.from_above for side in sides):
        return None
    return _surroundings(*boxes, math.ceil(ROW_REACH / _CELL))


def _surroundings(low: Floats, high: Floats, margin: int) -> Near:
    """Tell which places (N, 3) lie in cells of the boxes (G, 2) of groups, or within a margin of cells."""
    first = np.floor(low.min(axis=0) / _CELL).astype(np.int64) - margin
    shape = np.floor(high.max(axis=0) / _CELL).astype(np.int64) - first + 1 + margin
    inside = np.zeros(tuple(shape.tolist()), dtype=bool)
    begin = np.floor(low / _CELL).astype(np.int64) - margin - first
    end = np.floor(high / _CELL).astype(np.int64) + 1 + margin - first
    for (x0, y0), (x1, y1) in zip(begin.tolist(), end.tolist(), strict=True):
        inside[x0:x1, y0:y1] = True

    def near(xyz: Floats) -> NDArray[np.bool_]:
        cell = np.floor(xyz[:, :2] / _CELL).astype(np.int64) - first
        known = ((cell >= 0) & (cell < shape)).all(axis=1)
        cell = np.clip(cell, 0, shape - 1)
        return np.asarray(known & inside[cell[:, 0], cell[:, 1]])

    return near


def _compact(view: EpochView, mine: NDArray[np.bool_]) -> tuple[EpochView, Ints]:
    """Keep the objects of the groups alone, numbered from 0 in their order; and their numbers in the city."""
    own = np.append(mine, False)[view.instance]
    numbers, slot = np.unique(view.instance[own], return_inverse=True)
    instance = np.where(view.instance < 0, NO_OBJECT, OTHERS).astype(np.int32)
    instance[own] = slot
    return replace(view, instance=instance), numbers.astype(np.int64)


def _in_city(record: ChangeRecord, numbers: list[Ints]) -> ChangeRecord:
    """Name the parts of a row by their numbers in the city; pieces cut off here get numbers below zero."""
    named = [
        tuple(int(known[k]) if k < len(known) else len(known) - k - 1 for k in ids)
        for ids, known in zip((record.id_before, record.id_after), numbers, strict=True)
    ]
    return replace(record, id_before=named[0], id_after=named[1])


def _evidence(change: ObjectChange, kinds: list[EvidenceKind]) -> EvidenceKind:
    """Return what tells of the absence: the other epoch's evidence, or the weaker of both."""
    if change.before and change.after:
        return weakest(kinds)
    return kinds[0] if change.after else kinds[1]


def _points(region: Region, changes: list[ObjectChange], epoch: str) -> Ints:
    """Tile, place there and row (P, 3) of every point of the rows."""
    rows = [change.points(epoch) for change in changes]
    members = np.concatenate([np.zeros(0, np.int64), *rows]).astype(np.int64)
    row = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    return np.column_stack([region.slot[members], region.index[members], row]).astype(np.int32)
