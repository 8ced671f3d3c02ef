"""Plants of one tile are decided against the plants of all tiles of the pair."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from test_confidence import TYPICAL, _record
from test_vegetation_null import TREE, street

from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.confidence import features
from subiaco_change.decisions.rules import Decision
from subiaco_change.tiling.decision_stages import (
    PlantDecisionSlice,
    PlantRow,
    PlantSlice,
    RowPoints,
    TileComparison,
    decide_tile,
    find_vegetation_null,
)
from subiaco_change.tiling.stage_inputs import TileParams, slice_of
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.work.results import pack
from subiaco_geo.work.store import MemoryStore
from subiaco_geo.work.tasks import Inputs

CONFIG = ChangeConfig()
GROWN = Decision(Change.INCREASED, "before the pair was known", 2.0, 3.0)


def params(kind):
    return TileParams("all", 80.0, (), np.zeros(3), slice_of(kind, CONFIG))


def row(number):
    found = features(GROWN, TYPICAL, Semantic.VEGETATION, 0.8)
    return _record(
        object_id=number, semantic=Semantic.VEGETATION, change=Change.INCREASED, id_before=(number,),
        id_after=(number,), match_kind="one_to_one", evidence="observed", features=tuple(found.tolist()),
        footprint=shapely.box(0, 0, 1, 1), reason=GROWN.reason,
    )  # fmt: skip


def tile(plants):
    """What one tile leaves of its plants, all called grown by fixed limits; one more row is no plant."""
    records = [row(k) for k in range(len(plants) + 1)]
    rows = tuple(PlantRow(k + 1, plant, 0.03) for k, plant in enumerate(plants))
    none = RowPoints((), np.zeros((0, 3), dtype=np.int32))
    return pack(TileComparison(tuple(records), rows, none, none))


def null_of_tiles(store, **keys):
    inputs = Inputs(store, {f"compared/{name}": key for name, key in keys.items()})
    return find_vegetation_null(inputs, params(PlantSlice))


def decided(store, key, null):
    inputs = Inputs(store, {"compared": key, "null": null})
    return decide_tile(inputs, params(PlantDecisionSlice)).records


@pytest.fixture
def store():
    return MemoryStore()


def test_a_tile_is_decided_by_what_the_crowns_of_all_tiles_did(store):
    rest = street(30, 0.25, 0.05)
    few = [replace(TREE, outline=0.28), replace(TREE, outline=0.8)]
    for name, plants in (("a", rest[:15]), ("b", [*rest[15:], *few])):
        store.save(name, tile(plants))
    store.save("null", pack(null_of_tiles(store, a="a", b="b")))
    rows = decided(store, "b", "null")
    assert [r.change for r in rows[-2:]] == [Change.UNCHANGED, Change.INCREASED]
    assert "the other 31 crowns of this pair by +0.2" in rows[-1].reason
    assert rows[0].change is Change.INCREASED  # no plant: stays as it was decided
    assert rows[0].reason == GROWN.reason


def test_the_null_is_the_same_however_the_crowns_lie_in_tiles(store):
    plants = street(30, 0.25, 0.05, (0.9, -0.7))
    store.save("all", tile(plants))
    store.save("a", tile(plants[20:]))
    store.save("b", tile(plants[:20]))
    whole, parts = null_of_tiles(store, x="all"), null_of_tiles(store, x="a", y="b")
    assert whole.words == parts.words
