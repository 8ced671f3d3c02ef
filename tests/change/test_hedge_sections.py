"""Hedges that are one instance, of which a part grew or was trimmed."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from test_measures import block, voxels

from subiaco_change.association.config import AssociationConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import ObjectChange, ObjectRules
from subiaco_change.decisions.plant_measures import measure_plant
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.split_merge import split_hedge_segments
from subiaco_change.instance_splitting.hedge_sections import changed_sections
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.known_space import KnownSpace
from subiaco_change.objects.measures import MeasureConfig, measure
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_geo.codes import Change, Semantic

RULES = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())


def hedge(pieces, seed, seen=True):
    """Boxes (x from, x to, height), 1 m wide, leaves 0.1 m apart with 2 cm of noise."""
    rng = np.random.default_rng(seed)
    solid = [block((a, 0, 0), (b, 1, h), 0.1) for a, b, h in pieces]
    xyz = np.concatenate(solid) + rng.normal(0, 0.02, (sum(map(len, solid)), 3))
    cells = voxels(np.concatenate([block((a, 0, 0), (b, 1, h)) for a, b, h in pieces]))
    held = replace(cells, observed=np.full(len(cells), seen))
    return ObjectInstance(0, Semantic.VEGETATION, 0.8, np.arange(len(xyz)), held, 0.05, xyz)


def decided(before, after, semantic=Semantic.VEGETATION, reason="as a whole", rules=RULES):
    """Rows of a hedge, or of another object, that both epochs have and that is unchanged as a whole."""
    before, after = (replace(side, semantic=semantic) for side in (before, after))
    measures = measure(before.voxels, after.voxels, MeasureConfig())
    whole = Decision(Change.UNCHANGED, reason, 0.5)
    is_plant = semantic is Semantic.VEGETATION
    plant = measure_plant([before], [after], measures, rules.plants) if is_plant else None
    change = ObjectChange((before,), (after,), semantic, "one_to_one", measures, whole, plant)
    return split_hedge_segments([change], rules)


fences = partial(decided, semantic=Semantic.OTHER, reason="it stayed")


@pytest.mark.parametrize(("height", "label"), [(1.1, Change.DECREASED), (2.0, Change.INCREASED)])
def test_the_half_of_a_hedge_whose_top_moved_is_a_row_of_its_own(height, label):
    before, after = hedge([(0, 12, 1.5)], 1), hedge([(0, 6, 1.5), (6, 12, height)], 2)
    rest, moved = decided(before, after)
    assert (rest.decision.change, moved.decision.change) == (Change.UNCHANGED, label)
    assert moved.plant.section == pytest.approx(height - 1.5, abs=0.05)
    assert f"top changed by {moved.plant.section:+.2f} m" in moved.decision.reason
    assert before.xyz[moved.points("before"), 0].min() > 5.4
    assert before.xyz[rest.points("before"), 0].max() < 6.6
    together = np.concatenate([c.points("before") for c in (rest, moved)])
    assert np.array_equal(np.sort(together), before.points)


@pytest.mark.parametrize(("height", "count"), [(1.7, 1), (2.8, 2)], ids=["between", "far above"])
def test_a_wall_whose_top_plants_hide_in_one_epoch_did_not_grow(height, count):
    """*Before* has leaves where *after* has the upper part of the wall; a crown above says nothing."""
    before, after = hedge([(0, 12, 1.5)], 1), hedge([(0, 6, 1.5), (6, 12, 1.9)], 2)
    leaves = np.random.default_rng(3).uniform((6, 0, height - 0.1), (12, 1, height + 0.1), (600, 3))
    rules = replace(RULES, spaces=(KnownSpace(standing=leaves), KnownSpace()))
    assert len(fences(before, after, rules=rules)) == count


@pytest.mark.parametrize(("height", "label"), [(1.0, Change.DECREASED), (1.9, Change.INCREASED)])
def test_a_section_of_a_fence_that_was_raised_or_lowered_is_a_row_of_its_own(height, label):
    before, after = hedge([(0, 12, 1.5)], 1), hedge([(0, 6, 1.5), (6, 12, height)], 2)
    rest, moved = fences(before, after)
    assert (rest.decision.change, moved.decision.change) == (Change.UNCHANGED, label)
    assert moved.measures.delta_h == pytest.approx(height - 1.5, abs=0.05)
    assert f"top changed by {moved.measures.delta_h:+.2f} m" in moved.decision.reason
    with rules_switched_off(["fences_by_tops"]):
        assert [c.decision.reason for c in fences(before, after)] == ["it stayed"]


def test_a_fence_that_kept_its_height_or_was_raised_as_a_whole_is_one_row():
    before = hedge([(0, 12, 1.5)], 1)
    (same,) = fences(before, hedge([(0, 12, 1.6)], 2))
    assert same.decision.reason == "it stayed"
    (raised,) = fences(before, hedge([(0, 12, 2.1)], 2))
    assert raised.decision.change is Change.INCREASED
    (parked,) = fences(
        before, hedge([(0, 12, 2.1)], 2), semantic=Semantic.MOBILE
    )  # vehicles have no sections
    assert parked.decision.reason == "it stayed"


@pytest.mark.parametrize(("reach", "count"), [(3.0, 1), (1.7, 0)], ids=["open above", "view ended there"])
def test_a_section_grew_only_if_the_earlier_epoch_saw_free_space_above_its_tops(reach, count):
    """*Before* holds points up to 1.5 m; of *after*, half rises to 1.9 m, within the tolerance of voxels."""
    before, after = hedge([(0, 12, 1.5)], 1), hedge([(0, 6, 1.5), (6, 12, 1.9)], 2)

    def free(xyz):
        return np.where(xyz[:, 2] < reach, 0.9, 0.5)

    spaces = KnownSpace(above=free), KnownSpace()
    assert len(changed_sections([before], [after], 0.3, spaces)[0]) == count
    assert len(changed_sections([after], [before], 0.3, spaces[::-1])[0]) == count
    with rules_switched_off(["space_above_sections"]):
        assert len(changed_sections([before], [after], 0.3, spaces)[0]) == 1


def test_two_hedges_in_one_instance_of_which_one_grew_and_one_was_trimmed_are_two_rows():
    found = decided(hedge([(0, 12, 1.5)], 1), hedge([(0, 6, 1.1), (6, 12, 1.95)], 2))
    moved = [c for c in found if c.decision.change is not Change.UNCHANGED]
    assert {c.decision.change for c in moved} == {Change.INCREASED, Change.DECREASED}
    for change in moved:
        x = change.before[0].xyz[:, 0]
        assert x.max() < 6.6 if change.decision.change is Change.DECREASED else x.min() > 5.4


def test_a_hedge_that_moved_as_a_whole_stays_one_row():
    found = decided(hedge([(0, 8, 1.5)], 1), hedge([(0, 8, 1.95)], 2))
    assert [c.decision.change for c in found] == [Change.INCREASED]


@pytest.mark.parametrize("height", [1.5, 1.7], ids=["the same", "under the threshold"])
def test_noise_and_little_growth_part_nothing(height):
    found = decided(hedge([(0, 12, 1.5)], 1), hedge([(0, 6, 1.5), (6, 12, height)], 2))
    assert [c.decision.change for c in found] == [Change.UNCHANGED]


def test_a_top_that_the_other_epoch_never_looked_at_is_no_section():
    before, after = hedge([(0, 12, 1.5)], 1, seen=False), hedge([(0, 6, 1.5), (6, 12, 1.0)], 2)
    assert changed_sections([before], [after], 0.3)[0] == []


def test_tops_of_trees_are_not_compared():
    before, after = hedge([(0, 6, 5.0)], 1), hedge([(0, 3, 5.0), (3, 6, 4.4)], 2)
    assert changed_sections([before], [after], 0.3)[0] == []


@pytest.mark.parametrize(("height", "label"), [(0.8, Change.DECREASED), (2.2, Change.INCREASED)])
def test_a_hedge_that_touches_a_tree_is_judged_apart_from_it(height, label):
    before, after = (hedge([(0, 4, 7.0), (4, 12, top)], seed) for seed, top in ((1, 1.5), (2, height)))
    rest, moved = decided(before, after)
    assert (rest.decision.change, moved.decision.change) == (Change.UNCHANGED, label)
    assert moved.plant.section == pytest.approx(height - 1.5, abs=0.05)
    x = np.concatenate([moved.before[0].xyz[:, 0], moved.after[0].xyz[:, 0]])
    assert x.min() > 3.4


def test_low_branches_of_a_tree_are_no_hedge():
    before, after = hedge([(0, 6, 7.0)], 1), hedge([(0, 6, 7.0)], 2)
    branches = (block((6, 0, 1.5), (9, 1, top)) for top in (2.8, 2.2))
    pair = []
    for whole, beside in zip((before, after), branches, strict=True):
        cells = voxels(np.concatenate([whole.voxels.xyz, beside]))
        fine = np.random.default_rng(3).uniform(beside.min(axis=0), beside.max(axis=0), (2000, 3))
        xyz = np.concatenate([whole.xyz, fine])
        pair.append(replace(whole, voxels=cells, xyz=xyz, points=np.arange(len(xyz))))
    assert changed_sections([pair[0]], [pair[1]], 0.3)[0] == []


@pytest.mark.parametrize("share", [0.01, 0.04, 0.15])
@pytest.mark.parametrize("sparser", ["before", "after"])
def test_the_end_of_a_hedge_that_few_beams_met_in_one_epoch_keeps_its_top(sparser, share):
    rng = np.random.default_rng(7)
    full, other = hedge([(0, 12, 1.5)], 1), hedge([(0, 12, 1.5)], 2)
    few = other.xyz[(other.xyz[:, 0] < 7) | (rng.random(len(other.xyz)) < share)]
    thin = replace(other, xyz=few, points=np.arange(len(few)))
    pair = (thin, full) if sparser == "before" else (full, thin)
    assert changed_sections([pair[0]], [pair[1]], 0.3)[0] == []


def test_a_thinly_sampled_trim_is_found_where_its_tops_moved_beyond_their_spread():
    rng = np.random.default_rng(7)
    full, other = hedge([(0, 12, 1.8)], 1), hedge([(0, 6, 1.8), (6, 12, 0.9)], 2)
    few = other.xyz[rng.random(len(other.xyz)) < 0.15]
    thin = replace(other, xyz=few, points=np.arange(len(few)))
    (section,), _ = changed_sections([full], [thin], 0.3)
    assert section.rise == pytest.approx(-0.85, abs=0.2)
    assert section.xy[:, 0].min() > 5


def test_tops_that_few_beams_met_are_not_trimmed():
    rng = np.random.default_rng(5)
    before, after = hedge([(0, 12, 1.5)], 1), hedge([(0, 12, 1.5)], 2)
    thin = after.xyz[rng.random(len(after.xyz)) < 0.01]
    sparse = replace(after, xyz=thin, points=np.arange(len(thin)))
    assert [c.decision.change for c in decided(before, sparse)] == [Change.UNCHANGED]
