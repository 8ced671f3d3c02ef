"""The registry of rules: every rule has one place, a switch, numbers that exist, and keys of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from subiaco_change.config import ChangeConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules import RULE_GROUPS, RULES, STAGES_OF_RULES, known_rules, rules_of_stages
from subiaco_change.method_rules.places import rule_places
from subiaco_change.method_rules.switches import (
    applies,
    first_argument,
    obeys_rules,
    rule_mask,
    rules_recorded,
    rules_switched_off,
    switchable,
)
from subiaco_change.tiling.decision_stages import ComparisonSlice, PlantDecisionSlice, PlantSlice
from subiaco_change.tiling.ground_stage import GroundSlice
from subiaco_change.tiling.label_stage import LabelSlice
from subiaco_change.tiling.stage_inputs import TileParams, slice_of
from subiaco_change.tiling.tile_segmentation import SegmentationSlice
from subiaco_geo.settings import method_statement, setting_values
from subiaco_geo.work.tasks import fingerprint

SLICES = {
    "segmentation": SegmentationSlice,
    "comparison": ComparisonSlice,
    "plants": PlantDecisionSlice,
    "ground": GroundSlice,
    "labels": LabelSlice,
}


@switchable("thin_volumes", first_argument)
def doubled(values):
    return 2 * values


def test_every_rule_is_applied_in_exactly_one_place():
    places = rule_places()
    assert set(places) == set(RULES)
    assert {name: found for name, found in places.items() if len(found) != 1} == {}


def test_names_are_unique_and_every_rule_states_a_reason_in_a_sentence():
    names = [rule.name for group in RULE_GROUPS.values() for rule in group]
    assert len(names) == len(set(names))
    for rule in RULES.values():
        assert rule.reason[0].isupper(), rule.name
        assert rule.reason.endswith("."), rule.name
        assert set(rule.stages) <= set(STAGES_OF_RULES), rule.name


def test_every_number_of_a_rule_is_a_setting_or_a_constant_of_the_method():
    known = set(setting_values(ChangeConfig()))
    known |= {f"method_numbers.{name}" for name in setting_values(NUMBERS)}
    assert [n for rule in RULES.values() for n in rule.numbers if n not in known] == []


def test_a_rule_that_is_off_gives_way_to_the_answer_without_it_and_comes_back():
    assert doubled(3) == 6
    with rules_switched_off(["thin_volumes"]):
        assert doubled(3) == 3
        assert not applies("thin_volumes", True)
        assert not rule_mask("thin_volumes", np.ones(2, dtype=bool)).any()
    assert doubled(3) == 6
    assert applies("thin_volumes", True)


def test_a_stage_switches_off_the_rules_that_its_parameters_name():
    @obeys_rules
    def stage(inputs, params):
        return doubled(inputs)

    config = ChangeConfig(rules_off=("thin_volumes",))
    params = TileParams("0_0", 80.0, (), np.zeros(3), slice_of(ComparisonSlice, config))
    assert stage(3, params) == 3
    assert stage(3, replace(params, config=slice_of(ComparisonSlice, ChangeConfig()))) == 6
    assert doubled(3) == 6


@given(st.lists(st.floats(allow_nan=True), max_size=5))
def test_only_a_rule_whose_answer_differs_is_recorded(values):
    array = np.array(values, dtype=np.float64)
    with rules_recorded() as used, np.errstate(over="ignore"):
        answer = doubled(array)
    same = np.array_equal(answer, array, equal_nan=True)
    assert used == (set() if same else {"thin_volumes"})


def test_conditions_are_recorded_where_they_hold():
    with rules_recorded() as used:
        applies("sign_certain", False)
        rule_mask("roof_gap", np.zeros(3, dtype=bool))
        assert used == set()
        applies("sign_certain", True)
        rule_mask("roof_gap", np.array([False, True]))
    assert used == {"sign_certain", "roof_gap"}


@pytest.mark.parametrize("rule", sorted(RULES))
def test_a_rule_changes_the_keys_of_its_own_stages_alone(rule):
    usual, without = ChangeConfig(), ChangeConfig(rules_off=(rule,))
    changed = {
        stage
        for stage, kind in SLICES.items()
        if fingerprint(slice_of(kind, usual)) != fingerprint(slice_of(kind, without))
    }
    assert changed == set(RULES[rule].stages)
    assert fingerprint(slice_of(PlantSlice, usual)) == fingerprint(slice_of(PlantSlice, without))


def test_rules_that_are_off_stand_in_the_statement_of_the_method_in_the_order_of_the_registry():
    config = ChangeConfig(rules_off=("closed_gaps", "raised_surfaces"))
    assert config.rules_off == ("raised_surfaces", "closed_gaps")
    statement = method_statement(config)
    assert statement["departures"] == {"rules_off": ["raised_surfaces", "closed_gaps"]}
    assert statement["hash"] != method_statement(ChangeConfig())["hash"]
    assert rules_of_stages(config.rules_off, ("ground",)) == ("closed_gaps",)


def test_a_name_that_is_no_rule_is_refused_with_the_nearest_one():
    with pytest.raises(ValueError, match="did you mean thin_volumes"):
        known_rules(["thin_volume"])
    with pytest.raises(ValidationError, match="did you mean closed_gaps"):
        ChangeConfig(rules_off=("closed_gap",))
