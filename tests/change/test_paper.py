"""Every Decision of the method has a switch in config/paper.yaml, or a reason why it has none."""

import re
from pathlib import Path

import pytest

from subiaco_change.config import ChangeConfig
from subiaco_evaluation.ablation_study import DECISIONS, variants
from subiaco_geo.config import load_config

PAPER = Path(__file__).parents[2] / "config" / "paper.yaml"

#: Decision -> why the printed form cannot run, or where it is found.
REASONS = {
    1: "a matter of mapping: zeroed heights in xyz would contradict the CRS that the file names",
    3: "zeroing each epoch by its own ground erases the ground changes that the ground stage is to find",
    4: "one plane over a 5 m cell with a wall has metres of roughness: the gate hides storeys",
    5: "the printed solver has no usable licence; the energy that is minimised is the printed one",
    6: "the printed slope test selects walls as ground",
    10: "the same optimum, found per component: there is nothing to revert",
    15: "column score_paper holds the printed score beside the confidence",
}


def field(config, dotted):
    for name in dotted.split("."):
        config = getattr(config, name)
    return config


@pytest.fixture(scope="module")
def paper():
    return load_config(ChangeConfig, [PAPER], [])


@pytest.mark.parametrize("decision", range(1, 16))
def test_every_decision_has_a_switch_or_a_reason(decision, paper):
    assert (decision in DECISIONS) != (decision in REASONS)
    ours = ChangeConfig()
    for dotted in DECISIONS.get(decision, ()):
        assert field(paper, dotted) != field(ours, dotted), dotted


def test_every_switch_is_named_by_its_decision_in_the_file():
    named = {int(number) for number in re.findall(r"Decision (\d+)", PAPER.read_text())}
    assert named == set(DECISIONS)


def test_a_variant_reverts_its_decision_and_nothing_else(paper):
    ours = ChangeConfig()
    found = variants(ours, paper)
    assert found["full"] == ours
    literal = {"cell": paper.ground.cell, "closing": paper.ground.closing}
    assert found["Decision 12 reverted"].ground == ours.ground.model_copy(update=literal)
    for number, fields in DECISIONS.items():
        reverted = found[f"Decision {number} reverted"]
        touched = {name.split(".")[0] for name in fields}
        for name in ChangeConfig.model_fields:
            assert (getattr(reverted, name) != getattr(ours, name)) == (name in touched), name
        for dotted in fields:
            assert field(reverted, dotted) == field(paper, dotted)
