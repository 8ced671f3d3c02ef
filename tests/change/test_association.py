"""The assignment is optimal, and splits, merges and storeys stay one object."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_change.association.config import AssociationConfig
from subiaco_change.association.costs import candidate_costs
from subiaco_change.association.matching import assign, associate
from subiaco_change.decisions.object_decision import object_lod
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_geo.codes import Semantic


def brute_force(costs, unmatched):
    """The least total over every partial matching."""
    count_b, count_a = costs.shape
    best = np.inf
    for columns in itertools.product(range(-1, count_a), repeat=count_b):
        used = [c for c in columns if c >= 0]
        if len(set(used)) < len(used):
            continue
        total = sum(costs[i, c] for i, c in enumerate(columns) if c >= 0)
        best = min(best, total + unmatched * (count_b + count_a - 2 * len(used)))
    return best


@given(
    st.integers(1, 4),
    st.integers(1, 4),
    st.lists(st.floats(0, 20), min_size=16, max_size=16),
    st.lists(st.booleans(), min_size=16, max_size=16),
    st.floats(0.5, 8),
)
def test_the_assignment_is_optimal(count_b, count_a, values, gates, unmatched):
    costs = np.array(values).reshape(4, 4)[:count_b, :count_a]
    gate = np.array(gates).reshape(4, 4)[:count_b, :count_a]
    rows, columns = np.nonzero(gate)
    pairs = assign(count_b, count_a, rows, columns, costs[rows, columns], unmatched)
    assert len({i for i, _ in pairs}) == len(pairs) == len({j for _, j in pairs})
    assert all(gate[i, j] for i, j in pairs)
    total = sum(costs[i, j] for i, j in pairs) + unmatched * (count_b + count_a - 2 * len(pairs))
    assert total == pytest.approx(brute_force(np.where(gate, costs, np.inf), unmatched))


def block(instance, west, south, east, north, top):
    """An object that fills a box with 0.5 m voxels."""
    axes = [np.arange(a, b, 0.5) + 0.25 for a, b in ((west, east), (south, north), (0, top))]
    xyz = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    count = len(xyz)
    yes = np.ones(count, dtype=bool)
    voxels = Voxels(
        np.full(count, instance), xyz, np.tile([0.0, 0.0, 1.0], (count, 1)), xyz[:, 2], yes, yes, ~yes
    )
    return ObjectInstance(instance, Semantic.BUILDING, 0.9, np.arange(count), voxels, 0.03)


def matches(before, after):
    found = associate(before, after, AssociationConfig(), 0.5)
    return sorted((m.before, m.after, m.kind) for m in found)


def test_a_house_that_gains_a_storey_is_one_object():
    assert matches([block(0, 0, 0, 8, 10, 3)], [block(0, 0, 0, 8, 10, 6)]) == [((0,), (0,), "one_to_one")]


def test_a_house_that_falls_into_two_parts_is_a_split():
    after = [block(0, 0, 0, 4, 10, 4), block(1, 5, 0, 10, 10, 4)]
    assert matches([block(0, 0, 0, 10, 10, 4)], after) == [((0,), (0, 1), "split")]


def test_two_parts_that_grow_together_are_a_merge():
    before = [block(0, 0, 0, 4, 10, 4), block(1, 5, 0, 10, 10, 4)]
    assert matches(before, [block(0, 0, 0, 10, 10, 4)]) == [((0, 1), (0,), "merge")]


def test_things_far_apart_stay_unmatched():
    found = matches([block(0, 0, 0, 4, 4, 4)], [block(0, 30, 0, 34, 4, 4)])
    assert found == [((), (0,), "none"), ((0,), (), "none")]


def test_what_is_left_of_a_large_object_is_that_object_however_small():
    large, left = block(0, 0, 0, 20, 20, 8), block(0, 0, 0, 3, 3, 2)
    assert matches([large], [left]) == [((0,), (0,), "one_to_one")]


@pytest.mark.parametrize("swapped", [False, True])
def test_of_an_object_that_was_hidden_for_the_most_part_the_places_count_that_were_seen(swapped):
    """What is left of a house was inside it: the earlier survey saw the place of its front alone."""
    row, left = block(0, 0, 0, 24, 0.5, 3), block(0, 0, 0, 8, 12, 3)
    front = left.voxels.xyz[:, 1] < 0.5
    hidden = replace(left, voxels=replace(left.voxels, observed=front, occupied_in_other=front))
    for rest, found in (
        (hidden, [((0,), (0,), "one_to_one")]),
        (left, [((), (0,), "none"), ((0,), (), "none")]),
    ):
        assert matches(*(([rest], [row]) if swapped else ([row], [rest]))) == found


@pytest.mark.parametrize(("rise", "phi"), [(0.0, 0.30), (0.25, 0.05), (0.5, 0.0)])
def test_phi_is_what_the_separation_stays_under_the_level_of_detection(rise, phi):
    flat = replace(block(0, 0, 0, 6, 6, 0.5), lod=0.3)
    lifted = replace(flat, voxels=replace(flat.voxels, xyz=np.add(flat.voxels.xyz, (0.0, 0.0, rise))))
    plain, printed = (AssociationConfig(cost="plain", kappa=k) for k in (0.0, 2.0))
    costs = [candidate_costs([flat], [lifted], [(0,)], [(0,)], c)[2] for c in (plain, printed)]
    assert costs[1] - costs[0] == pytest.approx(2.0 * phi, abs=1e-9)


def test_neighbours_are_not_confused():
    row = [block(i, 12 * i, 0, 12 * i + 9, 9, 4) for i in range(4)]
    shifted = [block(i, 12 * i + 0.5, 0, 12 * i + 9.5, 9, 4) for i in range(4)]
    assert matches(row, shifted[::-1]) == [((i,), (3 - i,), "one_to_one") for i in range(4)]


def test_every_object_is_in_exactly_one_match():
    before = [block(i, 6 * i, 0, 6 * i + 5, 5, 3) for i in range(5)]
    after = [block(i, 7 * i, 0, 7 * i + 5, 5, 3) for i in range(4)]
    found = matches(before, after)
    assert sorted(i for b, _, _ in found for i in b) == list(range(5))
    assert sorted(j for _, a, _ in found for j in a) == list(range(4))


def test_parts_of_one_instance_that_were_paired_crosswise_are_one_match():
    before = [block(0, 0, 0, 10, 2, 4), replace(block(5, 0, 2, 10, 10, 6), whole=0)]
    after = [block(0, 2, 3, 8, 9, 3), replace(block(7, 0, 0, 10, 2, 4), whole=0)]
    assert matches(before, after) == [((0, 1), (1, 0), "split")]
    apart = [replace(obj, whole=obj.instance) for obj in (*before, *after)]
    assert len(matches(apart[:2], apart[2:])) == 2


def test_a_twig_without_a_level_of_detection_leaves_its_house_one():
    house, twig = block(0, 0, 0, 8, 10, 3), replace(block(1, 8, 0, 9, 1, 2), lod=np.inf)
    assert object_lod([house, twig]) == house.lod
    assert object_lod([twig]) == np.inf
