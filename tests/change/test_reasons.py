"""Every reason says what was compared, the value, the limit and the conclusion, in one sentence or more."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from subiaco_change.decisions.measures import Measures
from subiaco_change.decisions.rules import NO_LEVEL, DecisionConfig, decide
from subiaco_change.decisions.space_carving import Interval
from subiaco_change.outputs.table import build_table, table_hash
from subiaco_geo.codes import Semantic

SAME = Measures(
    iou=0.9, d_perp=0.0, delta_c=0.1, delta_h=0.0, delta_v=0.0, delta_v_surface=0.0, volume=100.0, chi2=0.0,
    gone_share=0.0, new_share=0.0, observed_fraction=1.0, observed_voxels=500, net_changed_fraction=0.0,
)  # fmt: skip
CONFIG = DecisionConfig()
CASES = {
    "hardly observed": (Semantic.BUILDING, True, False, {"observed_fraction": 0.18, "observed_voxels": 50}),
    "too few voxels": (Semantic.BUILDING, True, False, {"observed_fraction": 0.9, "observed_voxels": 2}),
    "removed": (Semantic.BUILDING, True, False, {"gone_share": 1.0, "delta_v": -50.0}),
    "added": (Semantic.OTHER, False, True, {"new_share": 0.8}),
    "occupied": (Semantic.VEGETATION, True, False, {"gone_share": 0.3}),
    "a piece of a wall": (Semantic.BUILDING, False, True, {"new_share": 1.0}),
    "open": (Semantic.OTHER, True, False, {"gone_share": 1.0, "free": 0.5}),
    "little overlap": (Semantic.BUILDING, True, True, {"iou": 0.05}),
    "a car that stayed": (Semantic.MOBILE, True, True, {}),
    "a car that moved": (Semantic.MOBILE, True, True, {"iou": 0.0, "delta_c": 1.2}),
    "a house": (Semantic.BUILDING, True, True, {}),
    "a house that grew": (Semantic.BUILDING, True, True, {"delta_h": 3.0, "delta_v": 40.0}),
    "a house seen in part": (
        Semantic.BUILDING, True, True,
        {"height_bounds": Interval(-0.2, 1.5), "volume_bounds": Interval(-2.0, 20.0)},
    ),
    "a house of unknown height": (
        Semantic.BUILDING, True, True,
        {"height_bounds": Interval(math.nan, math.nan), "volume_bounds": Interval(0.0, 1.0)},
    ),
    "a crown": (
        Semantic.VEGETATION, True, True, {"delta_h": 2.0, "delta_v": 30.0, "net_changed_fraction": 0.4}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", list(CASES))
def test_a_reason_has_value_limit_and_conclusion(name: str) -> None:
    semantic, before, after, changes = CASES[name]
    reason = decide(semantic, before, after, replace(SAME, **changes), 0.03, CONFIG).reason
    assert len(re.findall(r"\d", reason)) >= 2, reason
    assert "limit" in reason
    assert "nan" not in reason
    assert reason[0].isupper()
    assert reason.endswith(".")
    assert ": " in reason or ", and " in reason, "what was compared, then the conclusion"
    assert not re.search(r"gate|epoch|\bdh\b|stands|drove|told|looked at", reason)


def test_what_has_no_level_of_detection_says_so_in_a_sentence() -> None:
    found = decide(Semantic.BUILDING, True, True, SAME, math.inf, CONFIG)
    assert found.reason == NO_LEVEL
    assert NO_LEVEL.endswith("nothing is claimed.")


def test_the_hash_of_a_table_does_not_depend_on_words(result) -> None:
    table = build_table(result.records, "EPSG:7850")
    reworded = build_table(
        [replace(r, reason=f"In other words: {r.reason}") for r in result.records], "EPSG:7850"
    )
    moved = build_table([replace(r, delta_h_m=9.0) for r in result.records], "EPSG:7850")
    assert table_hash(table) == table_hash(reworded) != table_hash(moved)
