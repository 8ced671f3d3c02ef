"""Ghost trails, distinguished from hedges that beams graze."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from test_measures import block
from test_one_epoch_parts import obj

from subiaco_change.association.config import AssociationConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import (
    OwnEpochEvidence,
    decide_moving_object_trail,
    limit_confidence,
    own_epoch_evidence,
)
from subiaco_change.decisions.object_decision import ObjectRules, decide_object
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.trail_shapes import (
    contrast_with_ground,
    decide_by_ground_beneath,
    decide_by_side,
    decide_person_on_the_way,
    decide_strip_on_road,
    doubt_of_porous,
)
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.objects.voxel_objects import OTHERS, EpochView, ObjectInstance
from subiaco_geo.codes import Change, Semantic

RULES = DecisionConfig()
NOWHERE = cKDTree(np.zeros((0, 3)))


def everywhere(xyz):
    return np.ones(len(xyz), dtype=bool)


def nowhere(xyz):
    return np.zeros(len(xyz), dtype=bool)


def passing(top, passed):
    """An object of 4 x 2 m that ``passed`` beams passed for each that returned."""
    cells = block((0, 0, 0), (4, 2, top))
    seen = obj([(cells, False)])
    return replace(seen, passed=np.full(len(seen.points), passed))


@pytest.mark.parametrize(
    ("passed", "top", "semantic", "observed", "trail"),
    [
        (6.0, 1.5, Semantic.VEGETATION, nowhere, True),
        (4.0, 1.5, Semantic.VEGETATION, everywhere, False),
        (4.0, 1.5, Semantic.OTHER, everywhere, False),
        (4.0, 1.5, Semantic.BUILDING, nowhere, True),
        (1.0, 1.5, Semantic.BUILDING, everywhere, False),
        (1.2, 3.2, Semantic.VEGETATION, everywhere, True),
        (1.2, 3.2, Semantic.VEGETATION, nowhere, False),
        (0.8, 3.2, Semantic.VEGETATION, everywhere, False),
        (9.0, 8.0, Semantic.VEGETATION, everywhere, False),
    ],
    ids=[
        "far more than any hedge lets by",
        "a hedge that beams graze",
        "a fence between beams",
        "walls let nothing by",
        "a wall seen from both sides",
        "a lorry that was looked through",
        "a bush that nothing was seen behind",
        "a bush that stops most beams",
        "a tall crown",
    ],
)
def test_what_passed_is_told_from_what_beams_graze(passed, top, semantic, observed, trail):
    decision = decide_moving_object_trail(
        [passing(top, passed)], semantic, OwnEpochEvidence(observed, NOWHERE), RULES
    )
    assert (decision is not None) == trail
    if decision is not None:
        assert decision.change is Change.NOT_REPORTED
        assert f"{passed} beams passed" in decision.reason


def test_what_lies_in_the_lane_of_known_traffic_needs_fewer_beams():
    places = passing(1.5, 2.0)
    along = OwnEpochEvidence(nowhere, cKDTree(np.add(places.xyz, (0.0, 0.5, 0.0))))
    beside = OwnEpochEvidence(
        nowhere, cKDTree(np.add(places.xyz, (0.0, 2.0, 0.0)))
    )  # half of it is within a metre
    assert decide_moving_object_trail([places], Semantic.VEGETATION, along, RULES) is not None
    assert decide_moving_object_trail([places], Semantic.VEGETATION, beside, RULES) is None
    assert decide_moving_object_trail([passing(1.5, 1.0)], Semantic.VEGETATION, along, RULES) is None


def test_an_object_is_a_trail_only_if_all_its_parts_were_looked_through():
    parts = [passing(1.5, 9.0), passing(1.5, 0.5)]
    assert (
        decide_moving_object_trail(parts, Semantic.MOBILE, OwnEpochEvidence(everywhere, NOWHERE), RULES)
        is None
    )


def test_a_car_that_is_compared_elsewhere_is_no_traffic():
    xyz = block((0, 0, 0), (4, 2, 1.5))
    count = len(xyz)
    semantic = np.full(count, Semantic.MOBILE, dtype=np.uint8)
    instance = np.where(xyz[:, 0] < 2, OTHERS, -1).astype(np.int32)
    flat = np.ones(count)
    view = EpochView(xyz, np.zeros((count, 3)), semantic, instance, xyz[:, 2], flat, flat, 9.0 * flat)
    assert own_epoch_evidence(view, everywhere).traffic.data == pytest.approx(xyz[xyz[:, 0] > 2])


def timed(moved: float, count: int = 60) -> ObjectInstance:
    """An object whose points all moved with one probability."""
    obj = passing(1.5, 1.0)
    points = np.arange(count)
    return replace(obj, points=points, xyz=np.zeros((count, 3)), moved=np.full(count, moved))


def sides(width: float, moved: float, semantic: Semantic) -> ObjectInstance:
    """Two walls of 6 m, so far apart from each other, and a third one between their ends."""
    xyz = np.concatenate(
        [block((0, y, 0), (6, y + 0.25, 2.5)) for y in (0.0, width)] + [block((0, 0, 0), (0.25, width, 2.5))]
    )
    known = obj([(xyz, False)])
    return replace(known, semantic=semantic, moved=np.full(len(known.points), moved))


@pytest.mark.parametrize(
    ("width", "moved", "semantic", "stood"),
    [
        (3.5, 0.5, Semantic.BUILDING, True),
        (2.0, 0.5, Semantic.BUILDING, False),
        (3.5, 0.6, Semantic.BUILDING, False),
        (3.5, 0.5, Semantic.VEGETATION, False),
    ],
    ids=["a shed", "as narrow as a lorry", "seen to move", "leaves"],
)
def test_walls_wider_apart_than_a_vehicle_stood_where_the_times_tell_nothing(width, moved, semantic, stood):
    decision = decide_moving_object_trail([sides(width, moved, semantic)], semantic, None, RULES)
    assert (decision is None) == stood
    with rules_switched_off(("wider_than_vehicles",)):
        decision = decide_moving_object_trail([sides(width, moved, semantic)], semantic, None, RULES)
    assert decision is not None
    assert decision.change is Change.UNOBSERVED


def test_a_verdict_by_times_takes_the_place_of_counts() -> None:
    looked_through = replace(timed(0.0), passed=np.full(60, 500.0))
    assert decide_moving_object_trail([looked_through], Semantic.VEGETATION, None, RULES) is None
    decision = decide_moving_object_trail([timed(0.95)], Semantic.VEGETATION, None, RULES)
    assert decision is not None
    assert decision.change is Change.NOT_REPORTED
    assert "95% of having moved" in decision.reason


def test_counts_decide_where_one_part_has_no_times_and_the_reason_says_so() -> None:
    counted = replace(timed(0.0), moved=np.zeros(0), passed=np.full(60, 500.0))
    decision = decide_moving_object_trail([counted], Semantic.VEGETATION, None, RULES)
    assert decision is not None
    assert "the map keeps no times" in decision.reason


@pytest.mark.parametrize(("moved", "claimed"), [(0.0, True), (0.45, True), (0.5, False), (0.55, False)])
def test_what_is_as_likely_a_trail_as_an_object_is_not_claimed(moved: float, claimed: bool) -> None:
    decision = decide_moving_object_trail([timed(moved)], Semantic.VEGETATION, None, RULES)
    assert (decision is None) == claimed
    if decision is not None:
        assert decision.change is Change.UNOBSERVED
        assert f"(probability {moved:.0%}, limit 50%)" in decision.reason


@pytest.mark.parametrize(("moved", "expected"), [(0.0, 0.9), (0.3, 0.7), (0.5, 0.5)])
def test_a_claim_on_what_was_seen_for_a_moment_only_is_not_trusted(moved: float, expected: float) -> None:
    claim = Decision(Change.ADDED, "in the later survey alone", 1.5)
    certain, reason = limit_confidence(claim, [timed(moved)], 0.9, RULES)
    assert certain == pytest.approx(expected)
    assert ("the object moved" in reason) == (moved > 0)
    same = Decision(Change.UNCHANGED, "as it was", 0.1)
    assert limit_confidence(same, [timed(moved)], 0.9, RULES) == (0.9, "as it was")


@pytest.mark.parametrize(
    ("moved", "free", "doubts"),
    [
        (0.001, 0.7, "with a probability of 30% its place was occupied in the other survey."),
        (0.3, 0.999, "with a probability of 30% the object moved during mapping."),
    ],
)
def test_a_lowered_confidence_names_only_doubts_that_do_not_round_to_zero(moved, free, doubts) -> None:
    claim = Decision(Change.ADDED, "in the later survey alone", 1.5)
    reason = limit_confidence(claim, [timed(moved)], 0.9, RULES, free)[1]
    assert reason == f"{claim.reason} The confidence is lowered: {doubts}"


@given(moved=st.floats(0.0, 1.0), free=st.floats(0.5, 1.0))
def test_a_change_needs_an_object_that_stood_and_a_place_that_was_free(moved: float, free: float) -> None:
    decision = decide_moving_object_trail([timed(moved)], Semantic.VEGETATION, None, RULES, free)
    assert (decision is None) == (1.0 - (1.0 - moved) * free < RULES.trail_uncertain)
    claim = Decision(Change.ADDED, "in the later survey alone", 1.5)
    certain, _ = limit_confidence(claim, [timed(moved)], 0.9, RULES, free)
    assert certain <= 1.0 - moved + 1e-9
    if moved > 0:
        assert certain <= (1.0 - moved) * free + 1e-9


def test_the_reason_says_that_movement_and_free_space_together_leave_too_much_doubt() -> None:
    decision = decide_moving_object_trail([timed(0.45)], Semantic.VEGETATION, None, RULES, 0.85)
    assert decision is not None
    assert decision.change is Change.UNOBSERVED
    assert (
        "(probability 45%), or its place may not have been free (together 53%, limit 50%)" in decision.reason
    )


def test_a_wall_higher_than_any_vehicle_did_not_pass_however_briefly_it_was_seen() -> None:
    brief = timed(0.5)
    heights = np.linspace(0.3, 5.3, len(brief.voxels.height))
    wall = replace(brief, voxels=replace(brief.voxels, height=heights))
    assert decide_moving_object_trail([wall], Semantic.BUILDING, None, RULES) is None
    claim = Decision(Change.ADDED, "in the later survey alone", 1.5)
    assert limit_confidence(claim, [wall], 0.9, RULES) == (0.9, claim.reason)
    bus = replace(brief, voxels=replace(brief.voxels, height=0.7 * heights))
    assert decide_moving_object_trail([bus], Semantic.BUILDING, None, RULES) is not None


#: Ground points half a metre apart.
ROAD = np.stack(np.meshgrid(np.arange(-20, 40, 0.5), np.arange(-20, 20, 0.5)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("length", "width", "top", "hidden", "trail"),
    [
        (22.0, 2.4, 3.0, False, True),
        (22.0, 2.4, 3.0, True, False),
        (22.0, 0.9, 1.5, False, False),
        (9.0, 2.4, 3.0, False, False),
        (22.0, 2.4, 8.0, False, False),
    ],
    ids=["a trail", "it hid the road: a long shed", "as narrow as a hedge", "a lorry", "a row of trees"],
)
def test_a_strip_longer_than_any_vehicle_on_a_road_that_was_seen_beneath_it_is_a_trail(
    length, width, top, hidden, trail
):
    under = (ROAD >= 0).all(axis=1) & (ROAD[:, 0] <= length) & (ROAD[:, 1] <= width)
    own = OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(ROAD[~under] if hidden else ROAD))
    strip = [obj([(block((0.0, 0.0, 0.3), (length, width, top)), False)])]
    decision = decide_strip_on_road(strip, own, RULES)
    assert (decision is not None and decision.change is Change.NOT_REPORTED) == trail
    assert decide_strip_on_road(strip, OwnEpochEvidence(nowhere, NOWHERE), RULES) is None, (
        "beams were counted"
    )


def strip(xy, low, high):
    """An object over places (N, 2), from ``low`` to ``high`` above the ground [m]."""
    z = np.arange(low, high, 0.2)
    xyz = np.column_stack([np.repeat(xy, len(z), axis=0), np.tile(z, len(xy))])
    return [obj([(xyz, False)])]


def walked(width, length=9.0, bend=0.0):
    """Places (N, 2) of a strip along the x axis that bends to the left [rad]."""
    along, across = np.meshgrid(np.arange(0, length, 0.15), np.linspace(-0.5, 0.5, 7) * width, indexing="ij")
    turned = bend * along / length
    x, y = along * np.cos(turned), along * np.sin(turned)
    return np.column_stack([(x - across * np.sin(turned)).ravel(), (y + across * np.cos(turned)).ravel()])


@pytest.mark.parametrize(
    ("places", "low", "high", "semantic", "doubted"),
    [
        (walked(0.45), 0.1, 1.8, Semantic.VEGETATION, True),
        (walked(0.45, bend=1.2), 0.1, 1.8, Semantic.OTHER, True),
        (walked(0.05), 0.1, 1.8, Semantic.OTHER, False),
        (walked(1.1), 0.1, 1.8, Semantic.VEGETATION, False),
        (walked(0.45), 0.1, 0.9, Semantic.VEGETATION, False),
        (walked(0.45), 0.1, 2.8, Semantic.VEGETATION, False),
        (walked(0.45), 0.8, 1.8, Semantic.VEGETATION, True),
        (walked(0.45), 0.1, 1.55, Semantic.VEGETATION, True),
        (walked(0.45), 1.1, 1.9, Semantic.OTHER, False),
        (walked(0.45, 1.0), 0.1, 1.8, Semantic.VEGETATION, False),
        (walked(0.45), 0.1, 1.8, Semantic.MOBILE, False),
    ],
    ids=[
        "a pedestrian", "round a corner", "a fence", "a hedge", "a low hedge", "a tall one",
        "behind parked cars", "a short one", "a rail",
        "a shrub", "parked bicycles",
    ],
)  # fmt: skip
def test_nothing_is_claimed_of_a_strip_as_thin_and_tall_as_a_person_where_nothing_counted_beams(
    places, low, high, semantic, doubted
):
    bare = OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(ROAD))
    decision = decide_person_on_the_way(strip(places, low, high), semantic, bare)
    assert (decision is not None and decision.change is Change.UNOBSERVED) == doubted
    counted = OwnEpochEvidence(nowhere, NOWHERE)
    assert decide_person_on_the_way(strip(places, low, high), semantic, counted) is None


ASPHALT = np.stack(np.meshgrid(np.arange(-3, 9, 0.25), np.arange(-4, 6, 0.25)), axis=-1).reshape(-1, 2)


def scattered(fill, top, seed=11):
    """An object of 6 by 1.8 m of so many points as ``fill`` times the asphalt, anywhere below a top [m]."""
    count = int(fill * 6 * 1.8 * 16 / 4)  # an object has four points at every place
    return [obj([(np.random.default_rng(seed).uniform([0, 0, 0.1], [6, 1.8, top], (count, 3)), False)])]


COUNTED = OwnEpochEvidence(nowhere, NOWHERE)


def on_asphalt(hidden):
    """What its own survey knows where the object hides this share of the asphalt beneath, from one end on."""
    beneath = ((ASPHALT[:, 0] > 0) & (ASPHALT[:, 0] < 6 * hidden)) & (np.abs(ASPHALT[:, 1] - 0.9) < 0.9)
    return OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(ASPHALT[~beneath]))


def contrast(fill, top, semantic, own):
    return contrast_with_ground(scattered(fill, top), semantic, own, RULES)


@pytest.mark.parametrize(
    ("fill", "top", "semantic", "hidden", "doubted"),
    [
        (0.8, 1.6, Semantic.VEGETATION, False, True),
        (0.8, 3.0, Semantic.OTHER, False, True),
        (2.0, 1.6, Semantic.VEGETATION, False, False),
        (0.8, 1.6, Semantic.VEGETATION, True, False),
        (0.8, 8.0, Semantic.VEGETATION, False, False),
        (0.8, 1.6, Semantic.MOBILE, False, False),
    ],
    ids=["a car", "a lorry", "a hedge", "a bush on its bed", "a crown", "a parked car"],
)
def test_what_neither_fills_its_place_nor_hides_the_ground_beneath_is_doubted(
    fill, top, semantic, hidden, doubted
):
    beneath = ((ASPHALT > 0) & (ASPHALT < (6, 1.8))).all(axis=1)
    own = OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(ASPHALT[~beneath] if hidden else ASPHALT))
    found = doubt_of_porous(contrast(fill, top, semantic, own), semantic)
    assert found.endswith("the confidence is lowered.") == doubted
    assert doubt_of_porous(contrast(fill, top, semantic, COUNTED), semantic) == ""


@pytest.mark.parametrize(
    ("fill", "top", "semantic", "hidden", "seen_through"),
    [
        (0.8, 1.6, Semantic.VEGETATION, 0.0, True),
        (0.8, 3.0, Semantic.MOBILE, 0.05, True),
        (0.8, 1.6, Semantic.MOBILE, 0.25, False),
        (2.0, 1.6, Semantic.VEGETATION, 0.0, False),
        (0.8, 1.6, Semantic.BUILDING, 0.0, False),
        (0.8, 8.0, Semantic.VEGETATION, 0.0, False),
    ],
    ids=["a trail", "a trail of a van", "a car seen from afar", "a dense hedge", "a wall", "a crown"],
)
def test_what_has_few_points_and_hides_none_of_the_ground_is_not_claimed(
    fill, top, semantic, hidden, seen_through
):
    decision = decide_by_ground_beneath(contrast(fill, top, semantic, on_asphalt(hidden)))
    assert (decision is not None and decision.change is Change.UNOBSERVED) == seen_through
    assert decide_by_ground_beneath(contrast(fill, top, semantic, COUNTED)) is None


def vehicle_on_asphalt(cabin):
    """A new vehicle of 4.4 by 1.8 m, seen from above: with a cabin, or a box."""
    rng = np.random.default_rng(12)
    xy = rng.uniform([0, 0], [4.4, 1.8], (150, 2))
    top = np.where(np.abs(xy[:, 0] - 2.0) < 1.1, 1.5, 0.9) if cabin else np.full(len(xy), 1.5)
    seen = obj([(np.column_stack([xy, rng.uniform(0.8, 1.0, len(xy)) * top]), False)])
    free = np.ones(len(seen.voxels), dtype=bool)
    return replace(seen, voxels=replace(seen.voxels, free_space_confirmed=free))


@pytest.mark.parametrize(
    ("cabin", "off", "change"),
    [
        (True, (), Change.ADDED),
        (True, ("cabins_stand",), Change.UNOBSERVED),
        (False, (), Change.UNOBSERVED),
    ],
)
def test_a_vehicle_with_a_cabin_stood_though_the_ground_beneath_was_seen(cabin, off, change):
    road = np.stack(np.meshgrid(np.arange(-3, 8, 0.1), np.arange(-4, 6, 0.1)), axis=-1).reshape(-1, 2)
    own = OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(road))
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), RULES, own=(None, own))
    with rules_switched_off(off):
        found = decide_object((), (vehicle_on_asphalt(cabin),), Semantic.MOBILE, rules)
    assert found.decision.change is change


@pytest.mark.parametrize(
    ("fill", "top", "semantic", "hidden", "told"),
    [
        (0.8, 3.6, Semantic.VEGETATION, 0.2, True),
        (0.8, 3.6, Semantic.MOBILE, 0.2, True),
        (2.5, 3.6, Semantic.MOBILE, 0.2, False),
        (0.8, 3.6, Semantic.MOBILE, 0.4, False),
        (1.3, 1.5, Semantic.MOBILE, 0.2, False),
        (0.8, 3.6, Semantic.BUILDING, 0.2, False),
        (0.8, 8.0, Semantic.VEGETATION, 0.2, False),
    ],
    ids=[
        "a trail of a bus",
        "the same",
        "a lorry",
        "a lorry of which little was seen",
        "a car",
        "a wall",
        "a crown",
    ],
)
def test_what_has_fewer_points_than_one_of_its_sides_on_ground_that_was_seen_is_not_claimed(
    fill, top, semantic, hidden, told
):
    decision = decide_by_side(contrast(fill, top, semantic, on_asphalt(hidden)))
    assert (decision is not None and decision.change is Change.UNOBSERVED) == told
    assert decide_by_side(contrast(fill, top, semantic, COUNTED)) is None


def test_a_planted_row_that_hides_the_ground_is_no_person():
    places = walked(0.45)
    hidden = cKDTree(places).query(ROAD)[0] < 0.3
    row = strip(places, 0.1, 1.8)
    assert decide_person_on_the_way(
        row, Semantic.VEGETATION, OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(ROAD))
    )
    planted = OwnEpochEvidence(nowhere, NOWHERE, ground=cKDTree(ROAD[~hidden]))
    assert decide_person_on_the_way(row, Semantic.VEGETATION, planted) is None


def test_the_ground_beneath_objects_is_evidence_only_where_nothing_counted_beams():
    xyz = np.column_stack([ROAD, np.zeros(len(ROAD))])
    semantic, flat = np.full(len(xyz), Semantic.GROUND, dtype=np.uint8), np.ones(len(xyz))
    none = np.full(len(xyz), -1, dtype=np.int32)
    bare = EpochView(xyz, np.zeros(xyz.shape), semantic, none, flat, flat, flat)
    assert own_epoch_evidence(bare, everywhere).ground.n == len(xyz)
    assert own_epoch_evidence(replace(bare, passed=flat), everywhere).ground is None
