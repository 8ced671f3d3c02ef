"""What one epoch alone holds in the lane of a survey vehicle is claimed with low confidence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_measures import block
from test_one_epoch_parts import obj

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.driven_lane import (
    DrivenLane,
    SurveyPath,
    decide_in_traffic,
    lane_near,
    lane_share_of_claim,
    limit_in_lane,
)
from subiaco_change.decisions.rules import Decision
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_geo.codes import Change

RULES = DecisionConfig()
#: A straight drive of 60 m along x, the sensor 2 m above the ground, a position each 2 m.
STRAIGHT = np.column_stack([np.arange(0, 61, 2.0), np.zeros(31), np.full(31, 2.0)])
CLAIM = Decision(Change.REMOVED, "Only the earlier survey has the object.", 2.0)


def car(left, top=1.5, length=4.0):
    """An object 1.8 m wide whose near side is so far to the left of the path [m]."""
    return obj([(block((20.0, left, 0.0), (20.0 + length, left + 1.8, top)), False)])


def confidence_of(thing, decision=CLAIM, path=STRAIGHT):
    share = lane_share_of_claim(decision, [thing], [DrivenLane(path).covers], RULES)
    return limit_in_lane(decision.change, share, 0.9, decision.reason, RULES)


def test_what_stood_where_a_survey_vehicle_drove_is_claimed_with_half_confidence_and_says_why():
    certain, reason = confidence_of(car(-0.9))
    assert certain == 0.5
    assert "in the lane that a survey vehicle drove through" in reason


@pytest.mark.parametrize(
    "left", [0.9, 2.0, -3.5], ids=["beside the lane", "at the kerb", "on the other side"]
)
def test_a_parked_car_beside_the_lane_keeps_its_confidence(left):
    assert confidence_of(car(left)) == (0.9, CLAIM.reason)


def test_a_tree_above_the_lane_keeps_its_confidence():
    assert confidence_of(car(-0.9, top=7.0)) == (0.9, CLAIM.reason)


def test_what_is_in_both_epochs_keeps_its_confidence_in_the_lane():
    same = Decision(Change.UNCHANGED, "as it was", 0.1)
    assert confidence_of(car(-0.9), same) == (0.9, "as it was")


def test_without_a_trajectory_nothing_is_known_of_a_lane():
    assert lane_share_of_claim(CLAIM, [car(-0.9)], [], RULES) == 0.0
    assert confidence_of(car(-0.9), path=STRAIGHT[:0]) == (0.9, CLAIM.reason)


def test_the_rule_can_be_switched_off():
    with rules_switched_off(("claim_in_driven_lane",)):
        assert confidence_of(car(-0.9)) == (0.9, CLAIM.reason)


def test_the_lane_continues_beyond_the_end_of_a_drive_but_not_far():
    lane = DrivenLane(STRAIGHT)
    ahead = np.array([[88.0, 0.0, 0.5], [-28.0, 1.0, 0.5], [93.0, 0.0, 0.5], [-33.0, 0.0, 0.5]])
    assert lane.covers(ahead).tolist() == [True, True, False, False]


@pytest.mark.parametrize(("radius", "bends"), [(150.0, True), (-200.0, True), (10.0, False)])
def test_beyond_its_end_the_lane_keeps_the_bend_of_a_street_but_not_that_of_a_turn(radius, bends):
    way = np.arange(0.0, abs(radius) if bends else 18.0, 0.5)
    arc = np.column_stack([abs(radius) * np.sin(way / abs(radius)), radius * (1 - np.cos(way / abs(radius)))])
    lane = DrivenLane(np.column_stack([arc, np.full(len(way), 2.0)]))
    beyond = (way[-1] + 25.0) / abs(radius)
    bent = np.array([[abs(radius) * np.sin(beyond), radius * (1 - np.cos(beyond)), 0.5]])
    step = arc[-1] - arc[-2]
    straight = np.append(arc[-1] + 25.0 * step / np.linalg.norm(step), 0.5)[None]
    assert lane.covers(bent).tolist() == [bends]
    assert lane.covers(straight).tolist() == [not bends]


def test_a_vehicle_that_waits_at_the_end_of_its_drive_keeps_its_direction():
    waiting = STRAIGHT[-1] + np.random.default_rng(2).normal(0, 0.02, (600, 3))
    lane = DrivenLane(np.concatenate([STRAIGHT, waiting]))
    assert lane.covers(np.array([[85.0, 0.0, 0.5], [60.0, 20.0, 0.5]])).tolist() == [True, False]


@pytest.mark.parametrize("step", [0.7, 2.9, 3.1, 4.6, 7.0])
def test_a_fast_drive_continues_beyond_its_end_however_far_apart_its_positions_are(step):
    """At 65 km/h every second scan of a 10 Hz sensor lies 3.6 m further: more than gives a direction."""
    x = np.arange(0.0, 61.0, step)
    lane = DrivenLane(np.column_stack([x, np.zeros(len(x)), np.full(len(x), 2.0)]))
    asked = np.array([[x[-1] + 25.0, 0.0, 0.5], [-25.0, 0.0, 0.5], [x[-1] + 35.0, 0.0, 0.5]])
    assert lane.covers(asked).tolist() == [True, True, False]


@pytest.mark.parametrize("after_gap", [1, 2, 3])
def test_a_drive_has_no_direction_across_a_gap(after_gap):
    """A path that leaves the neighbourhood of a tile comes back elsewhere."""
    back = np.add(STRAIGHT[:after_gap], (200.0, 40.0, 0.0))
    lane = DrivenLane(np.concatenate([STRAIGHT, back]))
    assert lane.covers(np.array([[30.0, 0.0, 0.5], [130.0, 20.0, 0.5]])).tolist() == [True, False]


def test_a_lorry_that_covers_the_lane_lies_in_it_although_its_points_lie_beside_it():
    """Of a lorry 2.9 m wide a survey beside it sees one side and the rear."""
    side = block((20.0, 1.4, 0.0), (27.0, 1.5, 3.0))
    rear = block((20.0, -1.4, 0.0), (20.1, 1.5, 3.0))
    lorry = obj([(np.concatenate([side, rear]), False)])
    assert DrivenLane(STRAIGHT).covers(lorry.xyz).mean() < 0.3
    assert lane_share_of_claim(CLAIM, [lorry], [DrivenLane(STRAIGHT).covers], RULES) > 0.6


def moved_where(y_from, y_to):
    """Mapping recorded moving objects between two distances to the left of the path."""
    return lambda xyz: np.where((xyz[:, 1] >= y_from) & (xyz[:, 1] < y_to), 0.97, 0.1)


@pytest.mark.parametrize(
    ("left", "moved", "traffic"),
    [
        (-0.9, moved_where(-1.0, 1.0), True),
        (-0.9, moved_where(-1.0, -0.5), False),
        (-0.9, None, False),
        (2.0, moved_where(2.0, 4.0), False),
    ],
    ids=["crossed", "passed beside it", "no times of beams", "not in the lane"],
)
def test_what_moving_objects_crossed_in_the_lane_was_a_vehicle_of_the_traffic(left, moved, traffic):
    decision = decide_in_traffic([car(left)], [DrivenLane(STRAIGHT).covers], moved, RULES)
    assert (decision is not None) == traffic
    if decision is not None:
        assert decision.change is Change.NOT_REPORTED
        assert "moving objects crossed 100% of its place" in decision.reason


def test_a_tree_above_the_lane_is_no_traffic():
    crown = car(-0.9, top=7.0)
    everywhere = moved_where(-9.0, 9.0)
    assert decide_in_traffic([crown], [DrivenLane(STRAIGHT).covers], everywhere, RULES) is None


def test_nothing_is_known_between_positions_that_are_far_apart():
    gap = np.delete(STRAIGHT, range(10, 20), axis=0)
    assert DrivenLane(gap).covers(np.array([[29.0, 0.0, 0.5], [10.0, 0.0, 0.5]])).tolist() == [False, True]


def test_a_street_below_a_bridge_is_no_lane_of_the_drive_on_the_bridge():
    assert not DrivenLane(STRAIGHT + np.array([0.0, 0.0, 8.0])).covers(np.array([[20.0, 0.0, 0.5]])).any()


@given(st.floats(0, 2 * np.pi), st.floats(-50, 50), st.floats(-1.1, 1.1), st.floats(0, 60), st.booleans())
def test_the_lane_has_the_width_of_a_vehicle_in_every_direction(angle, shift, aside, along, stands):
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    path = STRAIGHT @ turn.T + shift
    path = np.repeat(path, 3, axis=0) if stands else path  # the vehicle waits at every position
    places = np.array([[along, aside, 0.5], [along, np.sign(aside or 1) * 1.5, 0.5]]) @ turn.T + shift
    assert DrivenLane(path).covers(places).tolist() == [True, False]


def test_the_lane_of_either_survey_counts():
    other = replace(CLAIM, change=Change.ADDED)
    far, near = DrivenLane(STRAIGHT + np.array([0.0, 3.5, 0.0])), DrivenLane(STRAIGHT)
    for lanes in ([near.covers, far.covers], [far.covers, near.covers]):
        assert lane_share_of_claim(other, [car(-0.9)], lanes, RULES) == 1.0


def test_the_part_of_a_long_drive_near_some_points_covers_them_as_the_whole_drive_does():
    rng = np.random.default_rng(4)
    turns = np.cumsum(rng.normal(0, 0.05, 2000))
    drive = np.cumsum(np.column_stack([np.cos(turns), np.sin(turns), np.zeros(2000)]), axis=0)
    places = drive[900:950] + np.column_stack([rng.normal(0, 1.0, (50, 2)), np.full(50, -1.5)])
    near = lane_near(SurveyPath(drive), places).covers(places)
    assert near.tolist() == DrivenLane(drive).covers(places).tolist()
    assert 0 < near.sum() < 50
    assert not lane_near(SurveyPath(drive), places[:0]).covers(places).any()
