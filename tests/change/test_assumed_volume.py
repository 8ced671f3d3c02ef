"""The volume of a house that one epoch alone has, where nothing tells what the other epoch saw."""

import numpy as np
import pytest

from subiaco_change.association.config import AssociationConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import ObjectRules, decide_object
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_geo.codes import Semantic

RULES = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())


def box(width, depth, height):
    """Voxels (N, 3) of the walls and the roof of a box whose corner is the origin [m]."""
    axes = [np.arange(0.25, size, 0.5) for size in (width, depth, height)]
    xyz = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.round((xyz - 0.25) / 0.5).astype(int)
    last = [len(axis) - 1 for axis in axes]
    shell = (
        (index[:, 0] % max(last[0], 1) == 0) | (index[:, 1] % max(last[1], 1) == 0) | (index[:, 2] == last[2])
    )
    return xyz[shell]


def obj(xyz, occupied_in_other):
    """A building; ``occupied_in_other`` (N,): the other epoch has points there; elsewhere it saw none."""
    yes = np.ones(len(xyz), dtype=bool)
    normal = np.tile([1.0, 0.0, 0.0], (len(xyz), 1))
    voxels = Voxels(
        np.zeros(len(xyz), int), xyz, normal, xyz[:, 2], yes, occupied_in_other, ~occupied_in_other
    )
    return ObjectInstance(0, Semantic.BUILDING, 0.9, np.arange(len(xyz)), voxels, 0.05, xyz)


@pytest.mark.parametrize("added", [True, False])
def test_a_house_whose_absence_is_assumed_came_or_went_with_its_whole_volume(added):
    house = [obj(box(10.0, 8.0, 5.0), np.zeros(len(box(10.0, 8.0, 5.0)), dtype=bool))]
    sides = ([], house) if added else (house, [])
    measures = decide_object(*sides, Semantic.BUILDING, RULES).measures
    sign = 1.0 if added else -1.0
    assert 300.0 < sign * measures.delta_v < 400.0
    assert measures.volume_bounds.low == measures.volume_bounds.high == measures.delta_v
