"""Rows of houses part at steps of their roofs; single buildings stay whole."""

import numpy as np
import pytest
from scenes import house, rectangle

from subiaco_change.segmentation.bounding_rectangles import box_sides
from subiaco_change.segmentation.clustering import cell_clusters
from subiaco_change.segmentation.object_rows import PassageConfig, ProfileConfig, split_at_passages, split_row


def row(*heights, width=6.0, angle=0.4):
    """Flat-roofed houses wall to wall, the row turned by an angle [rad]."""
    rng = np.random.default_rng(1)
    parts = [house(rng, (k + 0.5) * width, 0.0, width, 9.0, h) for k, h in enumerate(heights)]
    owner = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    xyz = np.concatenate(parts)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    inner = abs((xyz[:, 0] + width / 2) % width - width / 2) > 0.6  # party walls belong to either
    return xyz[:, :2] @ turn.T, xyz[:, 2], np.where(inner, owner, -1)


@pytest.mark.parametrize("heights", [(3.0, 6.0, 3.0), (6.0, 3.2), (3.0, 5.0, 7.0, 5.0)])
def test_every_house_of_a_stepped_row_is_one_part(heights):
    xy, height, owner = row(*heights)
    parts = split_row(xy, height, ProfileConfig())
    assert len(np.unique(parts)) == len(heights)
    for part in np.unique(parts):
        owners = owner[(parts == part) & (owner >= 0)]
        assert np.bincount(owners).max() > 0.98 * len(owners)


@pytest.mark.parametrize("heights", [(5.0,), (5.0, 5.0, 5.0), (5.0, 5.6)])
def test_no_step_no_cut(heights):
    xy, height, _ = row(*heights, width=8.0)
    assert split_row(xy, height, ProfileConfig()).max() == 0


def test_a_lean_to_narrower_than_a_house_stays_with_it():
    rng = np.random.default_rng(2)
    xyz = np.concatenate([house(rng, 0, 0, 10, 8, 6.0), house(rng, 6.2, 0, 2.4, 8, 2.6)])
    assert split_row(xyz[:, :2], xyz[:, 2], ProfileConfig()).max() == 0


def facades(*heights, width=5.0, depth=1.5, veranda=2.4):
    """What a street shows of a row: facades, and one veranda in front of all."""
    rng = np.random.default_rng(4)
    x = rng.uniform(0, len(heights) * width, 6000)
    z = rng.uniform(0, 1, 6000) * np.array(heights)[(x // width).astype(int)]
    roof = np.column_stack([rng.uniform(0, len(heights) * width, 2000), rng.uniform(-depth, 0, 2000)])
    xy = np.concatenate([np.column_stack([x, np.zeros_like(x)]), roof])
    return xy, np.concatenate([z, np.full(2000, veranda)]), (xy[:, 0] // width).astype(int)


@pytest.mark.parametrize("heights", [(4.4, 7.2, 4.4), (5.4, 4.4, 8.3), (7.2, 4.5)])
def test_facades_behind_one_veranda_are_one_part_each(heights):
    xy, height, owner = facades(*heights)
    parts = split_row(xy, height, ProfileConfig())
    assert len(np.unique(parts)) == len(heights)
    assert (parts == owner).mean() > 0.95


def test_an_unseen_stretch_of_a_row_has_no_height():
    xy, height, owner = facades(6.0, 3.5, 6.0)
    seen = (xy[:, 0] < 4.5) | (xy[:, 0] > 10.5)
    with np.errstate(all="raise"):
        parts = split_row(xy[seen], height[seen], ProfileConfig())
    assert (parts == owner[seen] // 2).mean() > 0.95


def test_a_hip_and_a_ridge_across_are_no_party_walls():
    rng = np.random.default_rng(5)
    xy = rng.uniform((0, 0), (16, 8), (8000, 2))
    hip = 3.0 + 0.6 * np.minimum.reduce([xy[:, 0], 16 - xy[:, 0], xy[:, 1], 8 - xy[:, 1]])
    gable = 3.0 + 0.7 * np.minimum(xy[:, 0], 16 - xy[:, 0])
    for roof in (hip, gable):
        assert split_row(xy, roof, ProfileConfig()).max() == 0


@pytest.mark.parametrize(("link", "parts"), [(2.5, 2), (3.8, 1)])
def test_two_houses_that_a_carport_joins_part_and_two_wings_that_a_roof_joins_do_not(link, parts):
    rng = np.random.default_rng(6)
    houses = [house(rng, x, 0.0, 9.0, 8.0, 4.0) for x in (0.0, 13.0)]
    between = rectangle(rng, (4.5, -2.0, link), (4.0, 0, 0), (0, 4.0, 0))
    xyz = np.concatenate([*houses, between])
    assert split_row(xyz[:, :2], xyz[:, 2], ProfileConfig()).max() + 1 == parts


def test_sides_of_a_turned_rectangle():
    xy = np.random.default_rng(3).uniform([-4, -1], [4, 1], (4000, 2))
    turned = xy @ np.array([[0.8, -0.6], [0.6, 0.8]])
    assert box_sides(turned) == pytest.approx((8.0, 2.0), abs=0.15)


def wall(start, end, height=5.0, step=0.2):
    """Points of a wall between two places, and their heights above the ground."""
    start, end = np.array(start, dtype=float), np.array(end, dtype=float)
    along = np.linspace(0.0, 1.0, round(np.linalg.norm(end - start) / step) + 1)
    z = np.arange(0.1, height, step)
    xy = start + np.repeat(along, len(z))[:, None] * (end - start)
    return np.column_stack([xy, np.tile(z, len(along))])


def ground_in(x, y, step=0.25):
    """Ground points in a rectangle."""
    return np.stack(np.meshgrid(np.arange(*x, step), np.arange(*y, step)), axis=-1).reshape(-1, 2)


def split_by_passages(xyz, ground):
    labels = cell_clusters(xyz[:, :2], 0.8)
    assert labels.max() == 0
    return split_at_passages(xyz[:, :2], xyz[:, 2], labels, ground, PassageConfig())


#: Fronts and sides of two houses, 1.2 m apart.
NEIGHBOURS = [
    wall((0, 0), (9, 0)),
    wall((9, 0), (9, 8)),
    wall((10.2, -2), (18, -2)),
    wall((10.2, -2), (10.2, 7)),
]


def test_houses_beside_a_passage_whose_ground_was_seen_are_two_objects():
    xyz = np.concatenate(NEIGHBOURS)
    parts = split_by_passages(xyz, ground_in((9.3, 10.0), (-1.0, 3.0)))
    assert np.array_equal(parts, np.where(xyz[:, 0] > 9.5, parts[-1], parts[0]))
    assert parts.max() == 1


def test_houses_between_which_nothing_was_seen_stay_one_object():
    assert split_by_passages(np.concatenate(NEIGHBOURS), ground_in((-5, 20), (-9, -3))).max() == 0


def test_two_wings_of_one_house_stay_together_whatever_ground_lies_between_them():
    xyz = np.concatenate([*NEIGHBOURS, wall((9, 7), (10.2, 7))])
    assert split_by_passages(xyz, ground_in((9.3, 10.0), (-1.0, 6.0))).max() == 0


def test_a_post_before_a_house_belongs_to_the_house():
    xyz = np.concatenate([*NEIGHBOURS[:2], wall((4, -0.8), (4.2, -0.8), 3.0)])
    assert split_by_passages(xyz, ground_in((0, 9), (-2.0, -0.1))).max() == 0


def test_a_corner_that_nobody_saw_is_no_passage():
    xyz = np.concatenate([wall((0, 0), (9, 0)), wall((9.7, 0.7), (9.7, 8))])
    assert split_by_passages(xyz, ground_in((9.0, 14.0), (-4.0, 8.0))).max() == 0
