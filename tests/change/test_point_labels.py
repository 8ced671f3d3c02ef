"""Ground between ground points was seen; beyond the last of them it was not."""

import numpy as np

from subiaco_change.decisions.point_labels import label_rest, surrounded, unlabelled
from subiaco_change.decisions.voxel_objects import EpochView
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


def test_points_of_no_object_are_unchanged_only_where_the_other_epoch_holds_points_too():
    xyz = np.column_stack([np.arange(6.0), np.zeros(6), np.full(6, 1.5)])
    view = EpochView(
        xyz,
        np.tile([0.0, 0.0, 1.0], (6, 1)),
        np.full(6, Semantic.VEGETATION, np.uint8),
        np.full(6, -1, np.int32),
        np.full(6, 1.5),
        np.full(6, np.inf),
        np.ones(6),
    )
    labels = unlabelled(view)
    label_rest(
        view,
        labels,
        None,
        [],
        lambda places: np.ones(len(places), dtype=bool),  # all of it was in view
        EvidenceConfig(),
        np.zeros((0, 3)),
        lambda places: places[:, 0] < 2.5,  # but only there does something stand
    )
    assert labels.change.tolist() == [Change.UNCHANGED] * 3 + [Change.UNOBSERVED] * 3
