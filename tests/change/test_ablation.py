"""Parts of the method left out: each switch changes what it should, and nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest

from subiaco_change.association.config import AssociationConfig, PartConfig
from subiaco_change.config import ChangeConfig, with_parts_disabled
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_comparison import compare_objects
from subiaco_change.decisions.object_decision import ObjectRules
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.objects.voxel_objects import EpochView, Reach
from subiaco_change.segmentation.instances import InstanceConfig
from subiaco_change.strategies import Classified, Part, PointComparison, choose_strategies
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError

REACH = Reach(0.35, 2.0, 1.25)


def box(x, size=3.0):
    axes = [np.arange(0, size, 0.25)] * 3
    solid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    skin = (solid < 0.1).any(axis=1) | (solid > size - 0.35).any(axis=1)
    return solid[skin] + np.array([x, 0.0, 0.3])


def view(*things):
    """Boxes at x with a class, on a strip of ground."""
    ground = np.stack([np.arange(0, 40, 0.25), np.zeros(160), np.zeros(160)], axis=1)
    parts = [ground, *(box(x) for x, _ in things)]
    xyz = np.concatenate(parts)
    count = [len(p) for p in parts]
    semantic = np.repeat([int(Semantic.GROUND), *(int(s) for _, s in things)], count).astype(np.uint8)
    instance = np.repeat([-1, *range(len(things))], count).astype(np.int32)
    up = np.tile([0.0, 0.0, 1.0], (len(xyz), 1))
    return EpochView(xyz, up, semantic, instance, xyz[:, 2], np.full(len(xyz), 0.05), np.full(len(xyz), 0.9))


def everywhere(xyz):
    return np.ones(len(xyz), dtype=bool)


def changes(before, after, by_class):
    association = AssociationConfig(same_place=1.0, parts=PartConfig(points=0))
    rules = ObjectRules(MeasureConfig(), association, DecisionConfig(), by_class)
    return compare_objects(before, after, everywhere, everywhere, rules)


def test_without_classes_in_the_association_a_hedge_and_a_wall_in_one_place_are_one():
    before = view((5.0, Semantic.BUILDING))
    after = view((6.0, Semantic.VEGETATION))
    assert [c.match_kind for c in changes(before, after, by_class=True)] == ["none", "none"]
    assert [c.match_kind for c in changes(before, after, by_class=False)] == ["one_to_one"]


def test_without_semantics_all_that_touches_is_one_object_with_the_rules_of_buildings():
    whole = view((5.0, Semantic.BUILDING), (8.0, Semantic.VEGETATION), (20.0, Semantic.MOBILE))
    cloud = PointCloud(whole.xyz, np.zeros(3))
    strategy = choose_strategies([Part.SEMANTICS])
    classes = SimpleNamespace(semantic=whole.semantic)
    semantic, instance = strategy.instances(Classified(cloud, cloud, classes, InstanceConfig(), 0.5))
    off = whole.semantic != Semantic.GROUND
    assert set(semantic[off]) == {int(Semantic.BUILDING)}
    assert len(np.unique(instance[off])) == 2
    assert (instance[~off] == -1).all()
    assert np.array_equal(strategy.kept(instance), instance)


def test_without_the_level_of_detection_it_is_zero_and_nothing_else_changes():
    variance, sigma = np.array([1e-4, np.inf]), np.full(2, 0.01)
    bare, whole = choose_strategies([Part.LOD]), choose_strategies([])
    assert (bare.lods(variance, sigma, "linear") == 0).all()
    assert bare.decisions(DecisionConfig()) == DecisionConfig(lod_floor=0.0)
    known, unknown = whole.lods(variance, sigma, "linear")
    assert 0 < known < 0.1
    assert np.isposinf(unknown)
    assert whole.decisions(DecisionConfig()) == DecisionConfig()
    for name in ("by_class", "instances", "kept", "labels"):
        assert getattr(bare, name) == getattr(whole, name)


def test_without_objects_every_point_is_labelled_by_itself():
    before, after = view((5.0, Semantic.BUILDING), (12.0, Semantic.BUILDING)), view((5.0, Semantic.BUILDING))
    strategy = choose_strategies([Part.OBJECTS])
    compared = PointComparison(before, after, lambda xyz: xyz[:, 0] < 13.0, "before", REACH)
    given = np.full(len(before.xyz), Change.INCREASED, dtype=np.uint8)
    labels = strategy.labels(compared, given)
    ground, second = before.semantic == Semantic.GROUND, before.instance == 1
    assert (labels[ground] == Change.INCREASED).all()
    assert (labels[~second & ~ground] == Change.UNCHANGED).all()
    assert set(labels[second & (before.xyz[:, 0] < 13.0)]) == {int(Change.REMOVED)}
    assert set(labels[second & (before.xyz[:, 0] >= 13.0)]) == {int(Change.UNOBSERVED)}
    assert (strategy.kept(before.instance) == -1).all()
    assert np.array_equal(choose_strategies([]).labels(compared, given), given)


def test_parts_are_named_once_in_order_and_unknown_ones_refused():
    config = with_parts_disabled(ChangeConfig(without=("semantics",)), ["lod", "semantics"])
    assert config.without == (Part.LOD, Part.SEMANTICS)
    with pytest.raises(InputError, match="colour: not known"):
        with_parts_disabled(ChangeConfig(), ["colour"])
