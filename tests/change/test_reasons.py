"""Every reason says what was compared, the value, the limit and the conclusion, in one sentence or more."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from assembled_run import compare_ground
from hypothesis import given
from hypothesis import strategies as st
from test_dynamic_objects import RULES, passing, timed
from test_vegetation_null import HEDGE, NULL, TREE

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import decide_moving_object_trail, limit_confidence
from subiaco_change.decisions.ground_cells import GroundChangeConfig
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.rules import NO_LEVEL, decide
from subiaco_change.decisions.vegetation_null import no_null
from subiaco_change.objects.measures import Measures
from subiaco_change.objects.space_carving import Interval
from subiaco_change.outputs.table import build_table, table_hash
from subiaco_geo.codes import Semantic

HOUSEHOLD = r"\b(?:gate|epoch|dh|stands|drove|told|looked at|looked across|it grew|it is new)\b|^It "


def faults(reason: str) -> list[str]:
    """Return what a reason lacks: value, limit and conclusion, in whole sentences of the field's words."""
    found = {
        "value": len(re.findall(r"\d", reason)) >= 2,
        "limit": re.search(r"limit[^.]*?\d|than the limit", reason) is not None,
        "conclusion": re.search(
            r"(?:: |, and )[^:]*(?:claimed|grew|shrank|is new|removed|moving object|not reported|stayed"
            r"|raised|lowered|both surveys|separately|beyond the limits|exceeds its limit)[^:]*\.",
            reason,
        )
        is not None,
        "finite": "nan" not in reason and "inf" not in reason.replace("information", ""),
        "sentence": reason[:1].isupper() or reason[:1].isdigit(),
        "end": reason.endswith("."),
        "field's words": not re.search(HOUSEHOLD, reason),
    }
    return [name for name, right in found.items() if not right]


SAME = Measures(
    iou=0.9, d_perp=0.0, delta_c=0.1, delta_h=0.0, delta_v=0.0, delta_v_surface=0.0, volume=100.0,
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
}  # fmt: skip


@pytest.mark.parametrize("name", list(CASES))
def test_a_reason_has_value_limit_and_conclusion(name: str) -> None:
    semantic, before, after, changes = CASES[name]
    reason = decide(semantic, before, after, replace(SAME, **changes), 0.03, CONFIG).reason
    assert faults(reason) == [], reason


SHARES = st.floats(0.0, 1.0)
CHANGES = st.floats(-5.0, 5.0)


@given(
    semantic=st.sampled_from([Semantic.BUILDING, Semantic.MOBILE, Semantic.OTHER]),
    where=st.sampled_from([(True, True), (True, False), (False, True)]),
    shares=st.tuples(SHARES, SHARES, SHARES, SHARES, SHARES),
    changes=st.tuples(CHANGES, CHANGES, CHANGES, CHANGES),
    voxels=st.integers(0, 5000),
    wide=st.floats(0.0, 3.0),
)
def test_the_reason_of_any_measures_has_value_limit_and_conclusion(
    semantic: Semantic,
    where: tuple[bool, bool],
    shares: tuple[float, ...],
    changes: tuple[float, ...],
    voxels: int,
    wide: float,
) -> None:
    height, volume, surface, centre = changes
    measures = replace(
        SAME, iou=shares[0], gone_share=shares[1], new_share=shares[2], observed_fraction=shares[3],
        free=shares[4], observed_voxels=voxels, delta_h=height, delta_v=20 * volume,
        net_changed_fraction=surface / 5, delta_c=abs(centre),
        height_bounds=Interval(height - wide, height + wide),
        volume_bounds=Interval(20 * (volume - wide), 20 * (volume + wide)),
    )  # fmt: skip
    reason = decide(semantic, *where, measures, 0.03, CONFIG).reason
    assert faults(reason) == [], reason


@given(
    plant=st.sampled_from([TREE, HEDGE]),
    values=st.tuples(CHANGES, CHANGES, CHANGES, CHANGES, SHARES, SHARES),
)
def test_the_reason_of_any_plant_has_value_limit_and_conclusion(
    plant: object, values: tuple[float, ...]
) -> None:
    outline, top, volume, surface, gained, lost = values
    measured = replace(
        plant, outline=outline / 5, top=top, volume=volume / 5, surface=surface / 5,
        rise=top if plant is HEDGE else math.nan, free_gained=gained, free_lost=lost,
    )  # fmt: skip
    reason = decide_plant(measured, 0.03, CONFIG, no_null(NULL)).reason
    assert faults(reason) == [], reason


@given(moved=st.floats(0.5, 1.0), passed=st.floats(6.0, 200.0))
def test_the_reason_of_a_trail_has_value_limit_and_conclusion(moved: float, passed: float) -> None:
    for objects in ([timed(moved)], [passing(1.5, passed)]):
        found = decide_moving_object_trail(objects, Semantic.MOBILE, None, RULES)
        if found is not None:
            assert faults(found.reason) == [], found.reason
    claim = decide(*CASES["added"][:3], replace(SAME, new_share=0.8), 0.03, CONFIG)
    certain, reason = limit_confidence(claim, [timed(moved)], 0.99, RULES)
    assert certain == pytest.approx(1.0 - moved)
    assert faults(reason) == [], reason


def test_the_reason_of_changed_ground_has_value_limit_and_conclusion() -> None:
    from test_ground_change import view

    def lift(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.4 * ((x > 40) & (x < 50) & (y > 40) & (y < 50))

    patches = compare_ground(view(seed=1), view(lift, seed=2), GroundChangeConfig()).patches
    assert patches
    for patch in patches:
        assert faults(patch.reason) == [], patch.reason
        assert "limit 0.15 m" in patch.reason
        assert "limit 25 m²" in patch.reason


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
