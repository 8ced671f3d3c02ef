"""Labels of points that belong to no object: ground between ground points, and fragments."""

import numpy as np
import pytest

from subiaco_change.decisions.point_labels import label_rest, surrounded, unlabelled
from subiaco_change.objects.voxel_objects import EpochView
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.codes import Change, Semantic


def test_ground_among_beams_two_metres_apart_is_seen_and_beyond_the_last_of_them_it_is_not():
    axis = np.arange(0.0, 20.1, 2.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    rng = np.random.default_rng(0)
    inside, beyond = rng.uniform(1, 19, (500, 2)), rng.uniform((20.1, 2), (23, 18), (500, 2))
    assert surrounded(inside, points, 3.0).all()
    assert not surrounded(beyond, points, 3.0).any()


def test_nothing_is_seen_without_ground_or_far_from_it():
    assert not surrounded(np.zeros((2, 2)), np.zeros((0, 2)), 3.0).any()
    assert surrounded(np.zeros((0, 2)), np.ones((4, 2)), 3.0).shape == (0,)
    corners = np.array([(-5.0, -5), (-5, 5), (5, -5), (5, 5)])
    assert not surrounded(np.zeros((1, 2)), corners, 3.0).any()
    assert surrounded(np.zeros((1, 2)), corners, 8.0).all()


def plants(xyz):
    """Points (N, 3) of vegetation that no object holds."""
    count = len(xyz)
    return EpochView(
        xyz,
        np.tile([0.0, 0.0, 1.0], (count, 1)),
        np.full(count, Semantic.VEGETATION, np.uint8),
        np.full(count, -1, np.int32),
        np.full(count, 1.5),
        np.full(count, np.inf),
        np.ones(count),
    )


def label(view, labels, occupied, touch=0.5):
    """Label the rest of points that were all in view of the other epoch."""
    seen = lambda places: np.ones(len(places), dtype=bool)  # noqa: E731
    return label_rest(view, labels, None, [], seen, EvidenceConfig(), np.zeros((0, 3)), occupied, touch)


def test_points_of_no_object_are_unchanged_only_where_the_other_epoch_holds_points_too():
    view = plants(np.column_stack([np.arange(6.0), np.zeros(6), np.full(6, 1.5)]))
    labels = unlabelled(view)
    joined = label(view, labels, lambda places: places[:, 0] < 2.5)  # only there does something stand
    assert labels.change.tolist() == [Change.UNCHANGED] * 3 + [Change.UNOBSERVED] * 3
    assert len(joined) == 0


@pytest.mark.parametrize("change", [Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED])
def test_points_of_no_object_belong_to_the_changed_object_that_they_touch(change):
    x = np.array([0.0, 0.3, 1.0, 0.2])  # the object, its eaves, something beside it, what both epochs hold
    view = plants(np.column_stack([x, [0.0, 0.0, 0.0, 0.1], np.full(4, 3.0)]))
    labels = unlabelled(view)
    labels.instance[0], labels.change[0] = 7, change
    labels.semantic[0], labels.confidence[0] = Semantic.BUILDING, 0.9
    joined = label(view, labels, lambda places: places[:, 1] > 0.05)
    assert joined.tolist() == [1]
    assert labels.change.tolist() == [change, change, Change.UNOBSERVED, Change.UNCHANGED]
    assert labels.instance.tolist() == [7, 7, -1, -1]
    assert labels.semantic[1] == Semantic.BUILDING
    assert labels.confidence[1] == labels.confidence[0]


def test_points_of_no_object_beside_an_unchanged_object_stay_without_one():
    view = plants(np.array([(0.0, 0.0, 3.0), (0.3, 0.0, 3.0)]))
    labels = unlabelled(view)
    labels.instance[0] = 7
    assert len(label(view, labels, lambda places: np.zeros(len(places), dtype=bool))) == 0
    assert labels.instance.tolist() == [7, -1]
